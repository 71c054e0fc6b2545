# SPDX-License-Identifier: Apache-2.0
"""What the nodes of one train report of themselves and of their inputs on ``/diagnostics``."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.monitor.view import Finding, InputView, Level

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from trainid_ros.results import Status

ESTIMATOR: Final = 'estimator'
INPUT: Final = 'input '
OTHER_CLOCK_S: Final = 3600.0
"""Stamps that differ more from this clock are of another one, as those of a bag [s]."""
# A node reports once a second; older reports of it no longer hold [s].
_REPORT_S: Final = 3.5
# An input whose count of messages has not grown for this time is silent [s], whatever the clock of its node says.
_GROWS_S: Final = 1.5
_REJECTED: Final = 'rejected.'
# Longer numbers, which any program may send, are not read.
_DIGITS: Final = 15


@dataclass(frozen=True, slots=True)
class Report:
    """One status of ``/diagnostics``: level, message and values, and when it arrived [s]."""

    level: Level
    message: str
    values: Mapping[str, str]
    time_s: float

    def number(self, key: str) -> float:
        """Return a value as a number, NaN if it is none."""
        try:
            return float(self.values.get(key, ''))
        except ValueError:
            return math.nan

    def rejections(self) -> Counter[str]:
        """Return the rejected samples by reason."""
        counts = {key: text for key, text in self.values.items() if key.startswith(_REJECTED)}
        return Counter(
            {key.removeprefix(_REJECTED): int(n) for key, n in counts.items() if n.isdecimal() and len(n) <= _DIGITS}
        )

    def status_s(self, status: Status, now_s: float) -> float:
        """Return for how long the estimate has had this status [s], NaN if the report does not say."""
        since_s = self.number('time in status [s]')
        is_known = self.values.get('status') == status.name and 0.0 <= since_s < math.inf
        return since_s + now_s - self.time_s if is_known else math.nan


class Reports:
    """The newest report of each node of a train on each subject: 'estimator' or one of its inputs."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], Report] = {}
        self._grew_s: dict[tuple[str, str], float] = {}

    def __bool__(self) -> bool:
        """Return whether any node has reported."""
        return bool(self._newest)

    def add(self, node: str, subject: str, report: Report) -> None:
        """Take in a report; what the node no longer reports beside it is forgotten."""
        last = self._newest.get((node, subject))
        if last is None or last.values.get('count') != report.values.get('count'):
            self._grew_s[node, subject] = report.time_s
        self._newest = {
            key: old for key, old in self._newest.items() if key[0] != node or report.time_s - old.time_s < _REPORT_S
        }
        self._newest[node, subject] = report

    def is_known(self, node: str) -> bool:
        """Return whether a node has reported."""
        return (node, ESTIMATOR) in self._newest

    def estimator(self, node: str, now_s: float) -> Report | None:
        """Return the report of a node on its estimator, None if there is none that still holds."""
        report = self._newest.get((node, ESTIMATOR))
        return report if report is not None and now_s - report.time_s < _REPORT_S else None

    def inputs(self, now_s: float) -> dict[str, InputView]:
        """Return the inputs by name, each as the node that heard it last reports it, be it long ago."""
        seen: dict[str, InputView] = {}
        for (node, subject), report in sorted(self._newest.items()):
            name = subject.removeprefix(INPUT)
            if name == subject:
                continue
            item = _input(name, report, now_s - self._grew_s[node, subject])
            if name not in seen or item.silent_s < seen[name].silent_s:
                seen[name] = item
        return seen

    def findings(self, now_s: float) -> Iterable[Finding]:
        """Yield what is reported as not in order, each input once, as the node that takes it worst says it."""
        worst: dict[str, Finding] = {}
        for (node, subject), report in sorted(self._newest.items()):
            source = subject.removeprefix(INPUT) if subject.startswith(INPUT) else node.rpartition('/')[2]
            finding = Finding(report.level, source, report.message)
            if now_s - report.time_s >= _REPORT_S or report.level is Level.OK:
                continue
            if source not in worst or report.level.severity > worst[source].level.severity:
                worst[source] = finding
        yield from worst.values()


def _input(name: str, report: Report, unchanged_s: float) -> InputView:
    """Return an input that a node reports, whose count of messages has been the same for some time [s]."""
    age_s, silent_s = report.number('age [s]'), report.number('time since last message [s]')
    grows = unchanged_s < _GROWS_S
    return InputView(
        name=name,
        value='',
        rate=report.number('rate [Hz]') if grows else math.nan,
        age_s=age_s if abs(age_s) < OTHER_CLOCK_S else math.nan,
        silent_s=math.inf if math.isnan(silent_s) else silent_s if grows else max(silent_s, unchanged_s),
        publishers=(report.values.get('heard', ''),),
        optional=False,
    )

# SPDX-License-Identifier: Apache-2.0
"""What the topics showed during a live trial."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from benchmarks.faults import BY_NAME
from trainid_ros.interface.records import BRAKE_RATE_TOPIC, MAY_BE_UNKNOWN, NS_PER_S, RESISTANCE_TOPIC, stamp_of
from trainid_ros.interface.results import Status

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from benchmarks.faults_live.cases import Case
    from benchmarks.faults_live.trial import Heard

_PERIOD_S: Final = 0.2
# The nodes must have published for this time before the fault [s].
_READY_S: Final = 3.0
_FIT: Final = (Status.VALID, Status.HOLDING)
_ESTIMATOR: Final = 'resistance_estimator: estimator'
_REJECTED: Final = 'rejected.'
_SINCE: Final = re.compile(r', since [-0-9: ]+ UTC')


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the topics showed; times from the start of the fault [s], infinite if it did not happen.

    Attributes:
        withdrawn_s: Until the resistance was neither VALID nor HOLDING.
        named_s: Until diagnostics, or an event of the middleware, named the fault.
        text: What named it.
        wrong_s: Time that the resistance or the brake rate was VALID at more than 3 std from the truth [s].
        worst: Largest error of a VALID resistance or brake rate [std].
        back_s: From the end of the fault until the resistance was VALID or HOLDING for good again [s].
        non_finite: Number of estimates with a number that is not finite.
        rejected: Records and samples of the resistance rejected since then, by reason.
        before: Diagnostics that were not OK just before the fault.
        resumed: Whether the nodes had continued from their checkpoints.
        ready: Whether they had published for some seconds before the fault.

    """

    withdrawn_s: float
    named_s: float
    text: str
    wrong_s: float
    worst: float
    back_s: float
    non_finite: int
    rejected: Counter[str]
    before: tuple[str, ...]
    resumed: bool
    ready: bool


def score(case: Case, heard: Heard) -> Outcome:
    """Return the outcome of a case."""
    listener, begin_ns = heard.listener, heard.begin_ns
    named_s, text = _naming(case, heard)
    ratios = np.array([abs(ratio) for ratio in _ratios(case, heard)])
    statuses = [
        ((at_ns - begin_ns) / NS_PER_S, message.status) for at_ns, message in listener.estimates[RESISTANCE_TOPIC.name]
    ]
    unfit_s = [at_s for at_s, status in statuses if at_s >= 0.0 and status not in _FIT]
    end_s = (heard.end_ns - begin_ns) / NS_PER_S
    is_back = bool(statuses) and statuses[-1][1] in _FIT
    return Outcome(
        withdrawn_s=min(unfit_s, default=math.inf),
        named_s=named_s,
        text=text,
        wrong_s=float(np.sum(ratios > 3.0)) * _PERIOD_S,
        worst=float(ratios.max(initial=0.0)),
        back_s=max([0.0, *(at_s - end_s for at_s in unfit_s)]) if is_back else math.inf,
        non_finite=sum(not _is_finite(message) for made in listener.estimates.values() for _, message in made),
        rejected=_counts(heard, after=True) - _counts(heard, after=False),
        before=tuple(sorted({_brief(text) for _, text in _troubles(heard, begin_ns - 2 * NS_PER_S, begin_ns)})),
        resumed=heard.resumed,
        ready=any(at_s < -_READY_S for at_s, _ in statuses),
    )


def _naming(case: Case, heard: Heard) -> tuple[float, str]:
    """Return when something named the fault [s], and what."""
    found = [
        *_troubles(heard, heard.begin_ns, math.inf),
        *((at_ns, str(text)) for at_ns, text in heard.listener.events),
    ]
    for at_ns, text in sorted(found):
        if at_ns >= heard.begin_ns and re.search(case.expected, text):
            return (at_ns - heard.begin_ns) / NS_PER_S, _brief(text)
    return math.inf, '-'


def _troubles(heard: Heard, begin_ns: float, end_ns: float) -> Iterator[tuple[int, str]]:
    """Return the diagnostics between two times that are not OK."""
    for at_ns, status in heard.listener.diagnostics:
        if begin_ns <= at_ns < end_ns and status.level != DiagnosticStatus.OK:
            yield at_ns, f'{status.name.partition(": ")[2]}: {status.message}'


def _brief(text: str) -> str:
    """Return what is the case in the first sentence of a diagnostic, without time and action."""
    return _SINCE.split(text)[0].partition('; ')[0]


def _ratios(case: Case, heard: Heard) -> Iterable[float]:
    """Return the errors of the VALID estimates since the start of the fault [std]."""
    step_ns = round(sum(BY_NAME[name].clock_step_s for name in case.faults) * NS_PER_S)
    for topic in (RESISTANCE_TOPIC, BRAKE_RATE_TOPIC):
        for at_ns, message in heard.listener.estimates[topic.name]:
            if at_ns < heard.begin_ns or message.status != Status.VALID:
                continue
            stamp_ns = stamp_of(message)
            # By which of the two clocks: what is VALID is not old.
            true_ns = min(stamp_ns, stamp_ns - step_ns, key=lambda time_ns: abs(at_ns - time_ns))
            yield _ratio(message, heard, true_ns)


def _ratio(message: Any, heard: Heard, time_ns: int) -> float:
    point = heard.truth.truth_at_ns(time_ns)
    if hasattr(message, 'brake_rate'):
        assert point.brake_rate is not None
        return float((message.brake_rate - point.brake_rate) / message.brake_rate_std)
    davis, v = point.resistance, message.speed
    return float((message.resistance - davis.a - davis.b * v - davis.c * v * v) / message.resistance_std)


def _is_finite(message: Any) -> bool:
    kinds = message.get_fields_and_field_types().items()
    names = [name for name, kind in kinds if kind.startswith('double') and name not in MAY_BE_UNKNOWN]
    return all(bool(np.isfinite(getattr(message, name)).all()) for name in names)


def _counts(heard: Heard, *, after: bool) -> Counter[str]:
    """Return what the resistance has rejected by reason: until the start of the fault, or until the end."""
    found: Counter[str] = Counter()
    for at_ns, status in heard.listener.diagnostics:
        if status.name == _ESTIMATOR and (after or at_ns < heard.begin_ns):
            pairs = (
                (item.key.removeprefix(_REJECTED), item.value)
                for item in status.values
                if item.key.startswith(_REJECTED)
            )
            found = Counter({reason: int(value) for reason, value in pairs})
    return found

# SPDX-License-Identifier: Apache-2.0
"""What a recording shows, collected during a replay: numbers, states and events, each with its stamp."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.plausible_stamps import PlausibleStamps
from trainid_ros.interface.records import KM_H, BrakeRecord, ForceRecord, GradientRecord, SpeedRecord, output_topic
from trainid_ros.monitor.shown_estimates import SHOWN

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import AnyOutput, Pipelines
    from trainid_ros.bag.reader import LoggedRecord
    from trainid_ros.interface.records import Record

_SHOWN: Final = {item.topic.name: item for item in SHOWN}
_BY_NAME: Final = {item.name: item for item in SHOWN}
USED: Final = 'used'


@dataclass(slots=True)
class Series:
    """Numbers over time: stamps [ns], and one or several numbers for each."""

    stamps: array[int] = field(default_factory=lambda: array('q'))
    values: array[float] = field(default_factory=lambda: array('d'))

    def add(self, stamp_ns: int, *values: float) -> None:
        """Add the numbers of a stamp; the same count each time."""
        self.stamps.append(stamp_ns)
        self.values.extend(values)


@dataclass(slots=True)
class States:
    """A text over time; equal ones in a row are stored once."""

    changes: list[tuple[int, str]] = field(default_factory=list)

    def add(self, stamp_ns: int, text: str) -> bool:
        """Add the text of a stamp; return whether it is a new one."""
        if self.changes and self.changes[-1][1] == text:
            return False
        self.changes.append((stamp_ns, text))
        return True


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened: when [ns], whether it is bad, and what."""

    stamp_ns: int
    is_bad: bool
    text: str


class Tracks:
    """Collects a replay.

    Attributes:
        inputs: Speed [km/h], force [kN], gradient [per mille] and brake command [m/s^2] by name.
        estimates: Stamp and estimate of each output, by name of what is estimated.
        status: Status of each estimate by its name.
        rejected: Why the newest sample was not used, by the same name.
        events: Changes of status, and contradictions between the inputs.
    """

    def __init__(self, pipelines: Pipelines) -> None:
        """Set the estimators that run."""
        self._stream = pipelines.resistance.stream
        self.inputs = {name: Series() for name in ('speed', 'force', 'gradient', 'brake_command')}
        self.estimates: dict[str, list[tuple[int, Any]]] = {item.name: [] for item in SHOWN}
        self.status = {item.name: States() for item in SHOWN}
        self.rejected = {item.name: States() for item in SHOWN}
        self.events: list[Event] = []
        self._finding = ''
        self._stamps = PlausibleStamps()

    def on_record(self, entry: LoggedRecord) -> None:
        """Take in an input; one without a plausible stamp is left out."""
        record = entry.record
        if self._stamps.accept(record.stamp_ns) and (found := _number(record)) is not None:
            name, value = found
            self.inputs[name].add(record.stamp_ns, value)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002 - the axis has the stamps
        """Take in an output; those without a sample are left out."""
        stamp_ns = output.stamp_ns
        if stamp_ns <= 0:
            return
        self._stamps.follow(stamp_ns)
        name = _SHOWN[output_topic(output.estimate).name].name
        self.estimates[name].append((stamp_ns, output.estimate))
        before = self.status[name].changes[-1:]
        if self.status[name].add(stamp_ns, output.status.name):
            text = f'{before[0][1]} to {output.status.name}' if before else output.status.name
            self.events.append(Event(stamp_ns, output.status.name in {'STALE', 'FAULT'}, f'{name}: {text}'))
        rejection = output.last_rejection
        newest = rejection is not None and rejection.stamp_ns == stamp_ns
        self.rejected[name].add(stamp_ns, rejection.reason.name if newest and rejection is not None else USED)
        self._note_finding(stamp_ns)

    def _note_finding(self, stamp_ns: int) -> None:
        """Note that inputs contradict each other, or no longer do."""
        finding = self._stream.finding
        if finding == self._finding:
            return
        text = f'inputs contradict each other: {finding}' if finding else f'inputs agree again: {self._finding}'
        self.events.append(Event(stamp_ns, bool(finding), text))
        self._finding = finding

    def title(self, name: str) -> str:
        """Return what is shown of an estimate, with its unit."""
        if not self.estimates[name]:
            return name
        shown, newest = _BY_NAME[name], self.estimates[name][-1][1]
        unit = f' [{shown.unit}]' if shown.unit else ''
        return f'{name}: {shown.quantity(newest)}{unit}'

    def series(self, name: str) -> Series:
        """Return value and standard deviation of an estimate over time.

        A resistance is shown at the middle of the speeds learned from at the end.
        """
        series = Series()
        for stamp_ns, estimate in self.estimates[name]:
            series.add(stamp_ns, *_BY_NAME[name].value(estimate, self.estimates[name][-1][1]))
        return series


def _number(record: Record) -> tuple[str, float] | None:
    """Return the name and the number of an input in the unit of the plots, None for others."""
    match record:
        case SpeedRecord():
            return 'speed', KM_H * record.speed
        case ForceRecord():
            return 'force', record.force / 1000.0
        case GradientRecord():
            return 'gradient', record.gradient
        case BrakeRecord():
            return 'brake_command', record.target_acceleration
    return None

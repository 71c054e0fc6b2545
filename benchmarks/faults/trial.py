# SPDX-License-Identifier: Apache-2.0
"""Run the three pipelines on a drive with faults and score what they publish."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.faults.catalogue import BY_NAME
from benchmarks.faults.injection import injected
from benchmarks.rides import DAY, Ride, ride
from trainid_ros.estimators.pipeline import EstimatorPipeline, share_streams
from trainid_ros.interface.records import MAY_BE_UNKNOWN, NS_PER_S, Row, SpeedRecord
from trainid_ros.interface.results import Output, Reason, Status
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[Any]

# A part of the day without changes of the resistance, with several runs and stops.
LENGTH_S: Final = 1250.0
MID_DRIVE_S: Final = (590.0, 640.0, 700.0, 760.0)
DURATION_S: Final = 60.0
# Motion after the end of a fault at which what is left is measured [s].
_AFTER_S: Final = 60.0
_ABOUT_S: Final = 10.0
_MOVING: Final = 1.0
_PERIOD_S: Final = 0.2
_SIGMAS: Final = 3.0
# A controller uses both.
_FIT: Final = (int(Status.VALID), int(Status.HOLDING))
# Reasons that reject a sample without saying what is wrong.
_UNTOLD: Final = frozenset({Reason.OUTLIER, Reason.CONTRADICTION, Reason.NUMERICAL, Reason.BRAKE_UNCERTAIN})


@dataclass(frozen=True, slots=True)
class Injection:
    """Faults by name, from the first message or in mid-drive, on a day or on a drive of a world."""

    faults: tuple[str, ...]
    seed: int
    from_start: bool
    train: str = DAY


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was published under a fault.

    Attributes:
        seen_s: Motion from the start of the fault until a finding, a status or a reason of rejection shows up that the
            healthy drive does not have [s]; infinite if none does.
        named_s: The same without reasons that do not say what is wrong.
        name: The first finding; without one, the status or the reason that named it.
        wrong_s: Time that the resistance or the brake rate was VALID or HOLDING at more than 3 std from the truth [s].
        added_s: The same at times at which it was not without the fault [s].
        worst: Largest error of a VALID or HOLDING resistance or brake rate [std].
        resistance_left: |error of w| a minute of motion after the fault, less that without the fault [N/kN].
        brake_left: The same of the brake rate [1].
        rejected: Records and samples of the resistance rejected by each reason, less those without the fault.
        non_finite: Number of outputs with a number that is not finite.

    """

    seen_s: float
    named_s: float
    name: str
    wrong_s: float
    added_s: float
    worst: float
    resistance_left: float
    brake_left: float
    rejected: dict[Reason, int]
    non_finite: int


@dataclass(frozen=True, slots=True)
class Course:
    """Outputs of one pipeline as arrays.

    Attributes:
        time_s: Time [s].
        moved_s: Motion so far [s].
        status: Status; UNINITIALIZED where the estimate says nothing: a brake rate while the train really stands.
        error: Error of the estimate.
        std: Its standard deviation.

    """

    time_s: Array
    moved_s: Array
    status: Array
    error: Array
    std: Array

    @property
    def wrong(self) -> Array:
        """Where the estimate was VALID or HOLDING at more than 3 std from the truth."""
        return np.isin(self.status, _FIT) & (np.abs(self.error) > _SIGMAS * self.std)


class Drive:
    """The three pipelines on one stream, with what they have published.

    Attributes:
        outputs: Outputs in the order of the pipelines.
        findings: Findings with the stamp at which they appeared [ns].

    """

    def __init__(self, train: TrainFile, states: Sequence[str] = ()) -> None:
        """Begin, from saved states of the pipelines if they are given."""
        settings = EstimatorSettings()
        makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
        self._pipelines: list[EstimatorPipeline[Any]] = [make(train, settings) for make in makers]
        for pipeline, state in zip(self._pipelines, states, strict=False):
            pipeline.restore(state)
        (self._stream,) = share_streams(self._pipelines)
        self.outputs: tuple[list[Output[Any]], ...] = ([], [], [])
        self.findings: list[tuple[int, str]] = []

    def feed(self, rows: Sequence[Row]) -> None:
        """Take in rows."""
        stream = self._stream
        for row in rows:
            events = stream.push_row(*row)
            for pipeline, made in zip(self._pipelines, self.outputs, strict=True):
                pipeline.take(events, made.append)
            if stream.finding and (not self.findings or self.findings[-1][1] != stream.finding):
                self.findings.append((stream.newest_ns, stream.finding))

    def save(self) -> tuple[str, ...]:
        """Return the states of the pipelines."""
        return tuple(pipeline.save() for pipeline in self._pipelines)

    @property
    def rejected(self) -> Counter[Reason]:
        """Records and samples that the resistance has rejected, by reason."""
        return self._pipelines[0].rejections

    def signs(self) -> Iterator[tuple[int, Reason | Status]]:
        """Return the reasons of rejection and the statuses that show up, each with its first stamp [ns]."""
        for made in self.outputs:
            seen: set[tuple[type, int]] = set()
            for output in made:
                rejection = output.last_rejection
                for sign in (output.status, *((rejection.reason,) if rejection is not None else ())):
                    if (type(sign), int(sign)) not in seen:
                        seen.add((type(sign), int(sign)))
                        yield output.stamp_ns, sign


@dataclass(frozen=True, slots=True)
class Healthy:
    """A drive without faults, and what its pipelines held after so many rows, just before the fault."""

    drive: Drive
    count: int
    states: tuple[str, ...]


def run(injection: Injection) -> Outcome:
    """Return the outcome of a fault."""
    kind, seed = injection.train, injection.seed
    rows, source = _rows(kind, seed)
    begin_s = 0.0 if injection.from_start else _mid_drive_s(seed)
    end_s = LENGTH_S if injection.from_start else begin_s + DURATION_S
    faults = [BY_NAME[name] for name in injection.faults]
    start_ns = rows[0][1]
    sent = injected(rows, faults, start_ns + round(begin_s * NS_PER_S), start_ns + round(end_s * NS_PER_S))
    healthy = _healthy(kind, seed)
    found = Drive(source.train_file, () if injection.from_start else healthy.states)
    found.feed(sent if injection.from_start else sent[healthy.count :])
    shift_s = sum(fault.clock_step_s for fault in faults)
    courses = [_course(found.outputs[k], source, start_ns, k, begin_s, shift_s) for k in (0, 2)]
    references = [_course(healthy.drive.outputs[k], source, start_ns, k, begin_s, 0.0) for k in (0, 2)]
    seen_s, named_s, name = _naming(found, healthy.drive, courses[0], start_ns, begin_s)
    wrong = [c.wrong & (c.time_s >= begin_s) for c in courses]
    ratios = [np.abs(c.error / c.std)[np.isin(c.status, _FIT) & (c.time_s >= begin_s)] for c in courses]
    after = [_left(c, end_s) - _left(r, end_s) for c, r in zip(courses, references, strict=True)]
    return Outcome(
        seen_s=seen_s,
        named_s=named_s,
        name=name,
        wrong_s=max(float(np.sum(mask)) for mask in wrong) * _PERIOD_S,
        added_s=max(_added_s(c, mask, r) for c, mask, r in zip(courses, wrong, references, strict=True)),
        worst=max((float(values.max()) for values in ratios if len(values)), default=0.0),
        resistance_left=after[0],
        brake_left=after[1],
        rejected={reason: n - healthy.drive.rejected[reason] for reason, n in found.rejected.items()},
        non_finite=sum(not _is_finite(output) for made in found.outputs for output in made),
    )


def _mid_drive_s(seed: int) -> float:
    return MID_DRIVE_S[seed % len(MID_DRIVE_S)]


@cache
def _rows(kind: str, seed: int) -> tuple[tuple[Row, ...], Ride]:
    source = ride(kind, seed)
    rows = tuple(record.row() for record in source.records)
    last_ns = rows[0][1] + round(LENGTH_S * NS_PER_S)
    return tuple(row for row in rows if row[1] < last_ns), source


@cache
def _healthy(kind: str, seed: int) -> Healthy:
    rows, source = _rows(kind, seed)
    begin_ns = rows[0][1] + round(_mid_drive_s(seed) * NS_PER_S)
    # The first record after a restore is followed wherever it lies, so it must be a healthy one.
    count = sum(row[1] < begin_ns for row in rows) - 1
    drive = Drive(source.train_file)
    drive.feed(rows[:count])
    states = drive.save()
    drive.feed(rows[count:])
    return Healthy(drive, count, states)


def _course(
    outputs: Sequence[Output[Any]], source: Ride, start_ns: int, place: int, begin_s: float, shift_s: float
) -> Course:
    """Return the outputs of the resistance (place 0) or brake rate pipeline (2) as arrays, with their errors."""
    time_s = np.array([(o.stamp_ns - start_ns) / NS_PER_S for o in outputs])
    # After a step of the clock, count from it on by the count of outputs, not by the stamps.
    stepped = np.maximum.accumulate(np.abs(np.diff(time_s, prepend=0.0)) > 0.9 * abs(shift_s)) & (shift_s != 0.0)
    time_s = np.where(stepped, time_s - shift_s, time_s)
    davis, rates = source.truths(start_ns + np.round(time_s * NS_PER_S).astype(np.int64))
    speed = np.array([o.estimate.speed for o in outputs])
    if place == 0:
        error = np.array([o.estimate.resistance for o in outputs])
        error -= davis[:, 0] + davis[:, 1] * speed + davis[:, 2] * speed * speed
        std = np.array([o.estimate.resistance_std for o in outputs])
    else:
        error = np.array([o.estimate.brake_rate for o in outputs]) - rates
        std = np.array([o.estimate.brake_rate_std for o in outputs])
    status = np.array([int(o.status) for o in outputs])
    if place == 2:
        status[_speeds(source, start_ns, time_s) < _MOVING] = Status.UNINITIALIZED
    moved_s = np.cumsum((speed >= _MOVING) & (time_s >= begin_s)) * _PERIOD_S
    return Course(time_s, moved_s, status, error, std)


def _speeds(source: Ride, start_ns: int, time_s: Array) -> Array:
    """Return the measured speeds of the drive without faults at times [s]."""
    records = [record for record in source.records if isinstance(record, SpeedRecord)]
    stamps_s = [(record.stamp_ns - start_ns) / NS_PER_S for record in records]
    return np.interp(time_s, stamps_s, [record.speed for record in records])


def _added_s(course: Course, wrong: Array, healthy: Course) -> float:
    """Return for how long an estimate was wrong at times at which it was not without the fault [s]."""
    if not len(healthy.time_s):
        return float(np.sum(wrong)) * _PERIOD_S
    nearest = np.minimum(np.searchsorted(healthy.time_s, course.time_s - 0.5 * _PERIOD_S), len(healthy.time_s) - 1)
    return float(np.sum(wrong & ~healthy.wrong[nearest])) * _PERIOD_S


def _left(course: Course, end_s: float) -> float:
    """Return the mean |error| over 20 s around a minute of motion after a time [s]; NaN if the drive ends before."""
    if not len(course.time_s) or course.time_s[-1] < end_s:
        return math.nan
    then = float(np.interp(end_s, course.time_s, course.moved_s))
    about = np.abs(course.moved_s - then - _AFTER_S) < _ABOUT_S
    return float(np.abs(course.error[about]).mean()) if about.any() else math.nan


def _naming(found: Drive, healthy: Drive, course: Course, start_ns: int, begin_s: float) -> tuple[float, float, str]:
    """Return when a fault is seen and when it is named, in seconds of motion, and by what."""
    usual = {(type(sign), sign) for _, sign in healthy.signs()}
    signs = [(stamp_ns, sign) for stamp_ns, sign in found.signs() if (type(sign), sign) not in usual]
    telling = [(stamp_ns, sign.name) for stamp_ns, sign in signs if sign not in _UNTOLD]
    names = [*found.findings[:1], *telling]
    moved = [_moved_s(stamp_ns, course, start_ns, begin_s) for stamp_ns, _ in (*found.findings[:1], *signs)]
    if not names:
        return min(moved, default=math.inf), math.inf, '-'
    return min(moved), _moved_s(min(names)[0], course, start_ns, begin_s), (found.findings or [min(names)])[0][1]


def _moved_s(stamp_ns: int, course: Course, start_ns: int, begin_s: float) -> float:
    """Return the motion between the start of the fault and a stamp [s]."""
    time_s = (stamp_ns - start_ns) / NS_PER_S
    return float(np.interp(time_s, course.time_s, course.moved_s)) if time_s > begin_s else 0.0


def _is_finite(output: Output[Any]) -> bool:
    names = (item.name for item in fields(output.estimate) if item.name not in MAY_BE_UNKNOWN)
    return all(bool(np.isfinite(getattr(output.estimate, name)).all()) for name in names)

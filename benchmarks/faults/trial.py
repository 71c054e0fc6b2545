# SPDX-License-Identifier: Apache-2.0
"""Run the three pipelines on a drive with faults and score what they publish."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.days import assumed_train, simulated_day
from benchmarks.faults.injection import FAULTS, injected
from trainid_ros.estimators.pipeline import (
    EstimatorPipeline,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    share_streams,
    speed_model_pipeline,
)
from trainid_ros.records import NS_PER_S, Row
from trainid_ros.results import Output, Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.sim.truth import Truth, TruthPoint

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


@dataclass(frozen=True, slots=True)
class Injection:
    """A fault by its places in FAULTS, from the first message or in mid-drive."""

    faults: tuple[int, ...]
    seed: int
    from_start: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was published under a fault.

    Attributes:
        named_s: Time from the start of the fault until something names it, in motion [s]; infinite if nothing does.
        name: The first thing that names it: a finding, a status, or the main reason of rejections.
        wrong_s: Time that the resistance or the brake rate was VALID at more than 3 std from the truth [s].
        worst: Largest error of a VALID resistance or brake rate [std].
        resistance_left: |error of w| a minute of motion after the fault, less that without the fault [N/kN].
        brake_left: The same of the brake rate [1].
        non_finite: Number of outputs with a number that is not finite.

    """

    named_s: float
    name: str
    wrong_s: float
    worst: float
    resistance_left: float
    brake_left: float
    non_finite: int


@dataclass(frozen=True, slots=True)
class Course:
    """Outputs of one pipeline as arrays: time [s], motion so far [s], status, error and its standard deviation."""

    time_s: Array
    moved_s: Array
    status: Array
    error: Array
    std: Array


@dataclass(frozen=True, slots=True)
class Published:
    """Outputs, in the order of the pipelines, and findings with the time they appeared [ns]."""

    outputs: tuple[tuple[Output[Any], ...], ...]
    findings: tuple[tuple[int, str], ...]


def run(injection: Injection) -> Outcome:
    """Return the outcome of a fault."""
    rows, truth = _drive(injection.seed)
    begin_s = 0.0 if injection.from_start else MID_DRIVE_S[injection.seed % len(MID_DRIVE_S)]
    end_s = LENGTH_S if injection.from_start else begin_s + DURATION_S
    faults = [FAULTS[k] for k in injection.faults]
    start_ns = truth.start_ns
    sent = injected(rows, faults, start_ns + round(begin_s * NS_PER_S), start_ns + round(end_s * NS_PER_S))
    found, healthy = _publish(sent), _healthy(injection.seed)
    shift_s = sum(fault.clock_step_s for fault in faults)
    courses = [_course(found.outputs[k], truth, k, begin_s, shift_s) for k in (0, 2)]
    references = [_course(healthy.outputs[k], truth, k, begin_s, 0.0) for k in (0, 2)]
    named_s, name = _naming(found, healthy, courses[0], begin_s)
    wrong = [(c.status == Status.VALID) & (np.abs(c.error) > 3.0 * c.std) & (c.time_s >= begin_s) for c in courses]
    ratios = [np.abs(c.error / c.std)[(c.status == Status.VALID) & (c.time_s >= begin_s)] for c in courses]
    after = [_left(c, end_s) - _left(r, end_s) for c, r in zip(courses, references, strict=True)]
    return Outcome(
        named_s=named_s,
        name=name,
        wrong_s=max(float(np.sum(mask)) for mask in wrong) * _PERIOD_S,
        worst=max((float(values.max()) for values in ratios if len(values)), default=0.0),
        resistance_left=after[0],
        brake_left=after[1],
        non_finite=sum(not _is_finite(output) for made in found.outputs for output in made),
    )


@cache
def _drive(seed: int) -> tuple[tuple[Row, ...], Truth]:
    day = simulated_day(seed)
    last_ns = day.truth.start_ns + round(LENGTH_S * NS_PER_S)
    return tuple(record.row() for record in day.records if record.stamp_ns < last_ns), day.truth


@cache
def _healthy(seed: int) -> Published:
    return _publish(_drive(seed)[0])


def _publish(rows: Sequence[Row]) -> Published:
    train, settings = assumed_train(), EstimatorSettings()
    makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    pipelines: list[EstimatorPipeline[Any]] = [make(train, settings) for make in makers]
    (stream,) = share_streams(pipelines)
    outputs: tuple[list[Output[Any]], ...] = ([], [], [])
    findings: list[tuple[int, str]] = []
    for row in rows:
        events = stream.push_row(*row)
        for pipeline, made in zip(pipelines, outputs, strict=True):
            pipeline.take(events, made.append)
        if stream.finding and (not findings or findings[-1][1] != stream.finding):
            findings.append((stream.newest_ns, stream.finding))
    return Published(tuple(map(tuple, outputs)), tuple(findings))


def _course(outputs: Sequence[Output[Any]], truth: Truth, place: int, begin_s: float, shift_s: float) -> Course:
    """Return the outputs of the resistance (place 0) or brake rate pipeline (2) as arrays, with their errors."""
    time_s = np.array([(o.stamp_ns - truth.start_ns) / NS_PER_S for o in outputs])
    # After a step of the clock, count from it on by the count of outputs, not by the stamps.
    stepped = np.maximum.accumulate(np.abs(np.diff(time_s, prepend=time_s[0])) > 0.9 * abs(shift_s)) & (shift_s != 0.0)
    time_s = np.where(stepped, time_s - shift_s, time_s)
    points = [truth.truth_at(t) for t in time_s]
    if place == 0:
        error = np.array([o.estimate.resistance - _w(p, o) for o, p in zip(outputs, points, strict=True)])
        std = np.array([o.estimate.resistance_std for o in outputs])
    else:
        error = np.array([o.estimate.brake_rate - _rate(p) for o, p in zip(outputs, points, strict=True)])
        std = np.array([o.estimate.brake_rate_std for o in outputs])
    speed = np.array([o.estimate.speed for o in outputs])
    moved_s = np.cumsum((speed >= _MOVING) & (time_s >= begin_s)) * _PERIOD_S
    return Course(time_s, moved_s, np.array([int(o.status) for o in outputs]), error, std)


def _w(point: TruthPoint, output: Output[Any]) -> float:
    davis, v = point.resistance, output.estimate.speed
    return float(davis.a + davis.b * v + davis.c * v * v)


def _rate(point: TruthPoint) -> float:
    return math.nan if point.brake_rate is None else point.brake_rate


def _left(course: Course, end_s: float) -> float:
    """Return the mean |error| over 20 s around a minute of motion after a time [s]; NaN if the drive ends before."""
    if not len(course.time_s) or course.time_s[-1] < end_s:
        return math.nan
    then = float(np.interp(end_s, course.time_s, course.moved_s))
    about = np.abs(course.moved_s - then - _AFTER_S) < _ABOUT_S
    return float(np.abs(course.error[about]).mean()) if about.any() else math.nan


def _naming(found: Published, healthy: Published, course: Course, begin_s: float) -> tuple[float, str]:
    """Return when a fault is named, in seconds of motion, and by what."""
    candidates = []
    if found.findings:
        candidates.append((found.findings[0][0], found.findings[0][1]))
    for made, usual in zip(found.outputs, healthy.outputs, strict=True):
        reasons = {o.last_rejection.reason for o in usual if o.last_rejection is not None}
        for output in made:
            rejection = output.last_rejection
            if rejection is not None and rejection.reason not in reasons:
                candidates.append((output.stamp_ns, rejection.reason.name))
                break
        statuses = {o.status for o in usual}
        fault = next((o for o in made if o.status not in statuses), None)
        if fault is not None:
            candidates.append((fault.stamp_ns, fault.status.name))
    if not candidates:
        return math.inf, '-'
    stamp_ns, name = min(candidates)
    start_ns = found.outputs[0][0].stamp_ns
    time_s = (stamp_ns - start_ns) / NS_PER_S
    moved_s = float(np.interp(time_s, course.time_s, course.moved_s))
    return (moved_s if time_s > begin_s else 0.0), found.findings[0][1] if found.findings else name


def _is_finite(output: Output[Any]) -> bool:
    numbers = [getattr(output.estimate, item.name) for item in fields(output.estimate)]
    unknown = {'position', 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'}
    names = [item.name for item in fields(output.estimate)]
    return all(name in unknown or bool(np.isfinite(value).all()) for name, value in zip(names, numbers, strict=True))

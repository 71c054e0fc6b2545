# SPDX-License-Identifier: Apache-2.0
"""The runner of all scored drives: a train, its unknowns, topic rates and faults; algorithms; what they published.

A drive is simulated once, and all algorithms take in the same records through their pipelines, as in the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.days import assumed_train, simulated_day
from benchmarks.seeds import over_seeds
from benchmarks.worlds import FIELD, Rates, Truth, drive
from trainid_ros.estimators.pipeline import EstimatorPipeline, SharedRecord, share_streams
from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.records import BRAKE, NS_PER_S, SPEED, Row
from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    Output,
    Reason,
    Rejection,
    ResistanceEstimate,
    Status,
)
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan
from trainid_ros.resistance.hypotheses import A, C
from trainid_ros.setup.pipelines import (
    BRAKE_RATE,
    RESISTANCE,
    SPEED_MODEL,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.speed_model.am_vff_rls import resistance_variance
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import specific_inertia
from trainid_ros.train.train_file import TrainFile

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DAY: Final = 'Yizhuang days'
"""Days of the package's own simulator, whose train file is exact but for the resistance; all others are worlds."""
INFORMED: Final = 'informed filter'
EVERY_TOPIC_5_HZ: Final = Rates()
# Below this speed no algorithm updates [m/s].
MOVING: Final = 1.0
# Time in motion after the start and after each change by which a resistance should have settled [s].
SETTLED_S: Final = 300.0
# Errors of the brake rate count while it acts above this speed [m/s].
_MIN_BRAKED: Final = 0.5
# They count from this time on [s] after the first braking above this speed [m/s].
_LEARNED_S: Final = 7.0
_MIN_FIRST: Final = 3.0
_PERIOD_S: Final = 0.2
# Two-sided normal quantile of 95 %.
_SIGMA_95: Final = 1.96
FAR: Final = 3.0
"""Error in standard deviations from which an estimate is wrong."""
_MINUTE_S: Final = 60.0


class Method(NamedTuple):
    job: str
    name: str


_JOBS: Final[Mapping[str, tuple[Any, Callable[..., EstimatorPipeline[Any]]]]] = {
    'resistance': (RESISTANCE, resistance_pipeline),
    'speed_model': (SPEED_MODEL, speed_model_pipeline),
    'brake_rate': (BRAKE_RATE, brake_rate_pipeline),
}
DEFAULTS: Final = tuple(Method(job, algorithms.default) for job, (algorithms, _) in _JOBS.items())


def methods_of(job: str, names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Return algorithms of one kind by name, all that are registered without names."""
    return tuple(Method(job, name) for name in names or _JOBS[job][0].names)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A drive and the algorithms that are scored on it; ``duration`` [s] as in :func:`benchmarks.worlds.drive`."""

    train: str
    seed: int
    unknowns: frozenset[str] = FIELD
    rates: Rates = EVERY_TOPIC_5_HZ
    methods: tuple[Method, ...] = field(default=DEFAULTS, compare=False)
    duration: float | None = field(default=None, compare=False)


class Known(NamedTuple):
    """Truth at some times: a, b, c, shape (n, 3), brake rate, speed [m/s], and whether the brake acts."""

    davis: Array
    rate: Array
    speed: Array
    braking: Mask


@dataclass(frozen=True, slots=True)
class Ride:
    """A drive: what the engineer states, the rows of its records, and the truth."""

    train_file: TrainFile  # The stated train
    rows: tuple[Row, ...]  # Rows in the order of their arrival
    changes: tuple[float, ...]  # Times of the changes of the resistance [s]
    known: Callable[[Array], Known]  # Returns the truth at times since the first row [s]
    truth: Truth | None = None  # Truth of a world, None of a day

    @property
    def start_ns(self) -> int:
        """Stamp of the first row [ns]."""
        return self.rows[0][1]


@lru_cache(maxsize=4)
def ride(
    train: str,
    seed: int,
    unknowns: frozenset[str] = FIELD,
    rates: Rates = EVERY_TOPIC_5_HZ,
    duration: float | None = None,
) -> Ride:
    return _day(seed) if train == DAY else _drive(train, seed, unknowns, rates, duration)


def _day(seed: int) -> Ride:
    day = simulated_day(seed)
    rows, truth = tuple(record.row() for record in day.records), day.truth
    late_s = (rows[0][1] - truth.start_ns) / NS_PER_S
    columns = {topic: np.array([row[1:3] for row in rows if row[0] == topic]).T for topic in (SPEED, BRAKE)}
    (at_speed, speeds), (at_brake, commands) = (
        ((stamps - rows[0][1]) / NS_PER_S, values) for stamps, values in columns.values()
    )
    resistance, rates = (np.array(table) for table in (truth.resistance, truth.brake_rate))

    def known(time_s: Array) -> Known:
        speed = np.interp(time_s, at_speed, speeds)
        braking = (_before(at_brake, commands, time_s) < 0.0) & (speed > 0.0)
        davis, rate = (_before(table[:, 0], table[:, 1:], time_s + late_s) for table in (resistance, rates))
        return Known(davis, rate[:, 0], speed, braking)

    return Ride(assumed_train(), rows, tuple(row[0] - late_s for row in truth.resistance[1:]), known)


def _before(starts: Array, values: Array, time_s: Array) -> Array:
    """Return the values that hold at some times, from their starts on."""
    held: Array = values[np.maximum(np.searchsorted(starts, time_s, side='right') - 1, 0)]
    return held


def _drive(world: str, seed: int, unknowns: frozenset[str], rates: Rates, duration: float | None) -> Ride:
    found = drive(world, seed, unknowns, rates, duration)
    truth, rows = found.truth, tuple(record.row() for record in found.records)
    late_s = (rows[0][1] - int(truth.time_ns[0])) / NS_PER_S
    grid = (truth.time_ns - truth.time_ns[0]) / NS_PER_S

    def known(time_s: Array) -> Known:
        at = np.maximum(np.searchsorted(grid, time_s + late_s, side='right') - 1, 0)
        davis = np.stack((truth.a[at], truth.b[at], truth.c[at]), axis=1)
        return Known(davis, truth.brake_rate[at], np.interp(time_s + late_s, grid, truth.speed), truth.braking[at])

    return Ride(found.train_file, rows, tuple(change - late_s for change in truth.changes), known, truth)


class InformedFilter:
    """One filter of the bank that is given the sizes of gusts and map errors, and the times of the changes.

    It shows what the search over hypotheses costs. It is not a bound: force scale and delay remain unknown, and which
    coefficient changes, and by how much, is not given either.
    """

    def __init__(self, train_file: TrainFile, truth: Truth) -> None:
        config = FilterBankConfig()
        plan = bank_plan(train_file, config, KnownForce(train_file).inertia)
        self._plan = replace(
            plan,
            gust_stds=(truth.gust_std,),
            map_stds=(truth.map_std,),
            # No branching into further hypotheses.
            branch_interval=math.inf,
            noise=replace(plan.noise, gust_time=truth.gust_time, map_length=truth.map_length),
        )
        self._bank = FilterBank(train_file, config, self._plan)
        self._changes_ns = [int(truth.time_ns[0]) + round(change * NS_PER_S) for change in truth.changes]

    def __getattr__(self, name: str) -> Any:
        """Return all else from the filter bank."""
        return getattr(self._bank, name)

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; each change of resistance before it adds the step variances to a and c."""
        while self._changes_ns and sample.stamp_ns >= self._changes_ns[0]:
            self._changes_ns.pop(0)
            for state, variance in zip((A, C), self._plan.step_variances, strict=True):
                self._bank.bank.inflate_variance(state, variance, math.inf)
        return self._bank.step(sample)


def pipeline_of(method: Method, source: Ride, seed: int) -> EstimatorPipeline[Any]:
    """Return the pipeline of an algorithm; only the informed filter is given the truth."""
    algorithms, make = _JOBS[method.job]
    if method.name != INFORMED:
        settings = EstimatorSettings(**{method.job: algorithms.choose(method.name)}, seed=seed)
        return make(source.train_file, settings)
    assert source.truth is not None
    pipeline = make(source.train_file, EstimatorSettings())
    return EstimatorPipeline(InformedFilter(source.train_file, source.truth), pipeline.stream, pipeline.config)


class Trace:
    """What one pipeline has published.

    Attributes:
        is_rate: Whether it estimates the brake rate.
        rows: Stamp [ns], then a, b, c, or the brake rate and zeros, standard deviation and status of each output.
        signs: Each status, and each reason of a rejection, with the stamp of the first output that shows it [ns].

    """

    def __init__(self, inertia: float) -> None:
        self.is_rate = False
        self.rows: list[tuple[float, ...]] = []
        self.signs: dict[tuple[str, Status | Reason], int] = {}
        self._k = 1.0 / inertia

    def add(self, output: Output[Any], speed: float) -> None:
        """Add an output at a measured speed [m/s]."""
        now = output.estimate
        if isinstance(now, AdhesionEstimate):  # comes with each brake rate
            return
        if isinstance(now, BrakeRateEstimate):
            self.is_rate = True
            values = (now.brake_rate, 0.0, 0.0, now.brake_rate_std)
        elif isinstance(now, ResistanceEstimate):
            values = (now.a, now.b, now.c, now.resistance_std)
        else:
            s11, s12, s13, s14, _, s22, s23, s24, _, _, s33, s34, _, _, _, s44 = now.covariance
            variance = resistance_variance((s11, s12, s13, s14, s22, s23, s24, s33, s34, s44), speed, self._k)
            values = (now.a, now.b, now.c, math.sqrt(max(variance, 1e-12)))
        self.rows.append((output.stamp_ns, *values, output.status))
        self.signs.setdefault(('status', output.status), output.stamp_ns)
        if output.last_rejection is not None:
            self.signs.setdefault(('reason', output.last_rejection.reason), output.stamp_ns)


@dataclass(frozen=True, slots=True)
class Published:
    """What all pipelines have published, the rejections of the first by reason, its findings by first stamp [ns]."""

    traces: tuple[Trace, ...]
    rejected: Mapping[Reason, int]
    findings: tuple[tuple[int, str], ...]


def publish(source: Ride, rows: Sequence[Row], methods: Sequence[Method], seed: int) -> Published:
    """Return what algorithms publish on the rows of a drive, with or without faults."""
    pipelines = [pipeline_of(method, source, seed) for method in methods]
    share_streams(pipelines)
    inertia = specific_inertia(1.0, source.train_file.train.rotary_mass)
    traces, findings, speed = tuple(Trace(inertia) for _ in pipelines), list[tuple[int, str]](), 0.0
    for row in rows:
        speed = row[2] if row[0] == SPEED and math.isfinite(row[2]) else speed
        shared = SharedRecord(row)
        for pipeline, trace in zip(pipelines, traces, strict=True):
            pipeline.take(shared.events(pipeline.stream), partial(trace.add, speed=speed))
        stream = pipelines[0].stream
        if stream.finding and (not findings or findings[-1][1] != stream.finding):
            findings.append((stream.newest_ns, stream.finding))
    return Published(traces, pipelines[0].rejections, tuple(findings))


@dataclass(frozen=True, slots=True)
class Course:
    """Outputs of one algorithm beside the truth, as arrays."""

    time_s: Array  # Time since the first row [s]
    moving: Mask  # The train moves
    moved_s: Array  # Time in motion so far [s]
    status: NDArray[np.int_]  # Status of each output
    error: Array  # |error| of w at the true speed [N/kN], or of the brake rate [1]
    std: Array  # Stated standard deviation of it
    counted: Mask  # Where errors count: settled, or while the brake acts

    @property
    def valid(self) -> Mask:
        return np.asarray(self.status == Status.VALID)

    @property
    def usable(self) -> Mask:
        """Where the estimate was VALID or HOLDING: a controller uses both."""
        return np.asarray(self.valid | (self.status == Status.HOLDING))

    @property
    def wrong(self) -> Mask:
        return np.asarray(self.error > FAR * self.std)


def course_of(trace: Trace, source: Ride, shift_s: float = 0.0) -> Course:
    """Return what was published beside the truth; from ``shift_s`` [s] in the stamps on, a clock has stepped."""
    rows = np.array(trace.rows, dtype=np.float64).reshape(-1, 6)
    time_s = np.array([(row[0] - source.start_ns) / NS_PER_S for row in trace.rows])
    # By the count of outputs, not by the stamps.
    stepped = np.maximum.accumulate(np.abs(np.diff(time_s, prepend=0.0)) > 0.9 * abs(shift_s)) & (shift_s != 0.0)
    time_s = np.where(stepped, time_s - shift_s, time_s)
    known = source.known(time_s)
    v, moving = known.speed, known.speed >= MOVING
    moved_s = motion_time(time_s, moving)
    if trace.is_rate:
        error = np.abs(rows[:, 1] - known.rate)
        first = np.flatnonzero(known.braking & (v > _MIN_FIRST))
        after = time_s >= (time_s[first[0]] + _LEARNED_S if first.size else math.inf)
        counted = known.braking & (v > _MIN_BRAKED) & after
    else:
        off = rows[:, 1:4] - known.davis
        error = np.abs(off[:, 0] + v * (off[:, 1] + v * off[:, 2]))
        counted = moving & (motion_since_change(time_s, moved_s, source.changes) >= SETTLED_S)
    return Course(time_s, moving, moved_s, rows[:, 5].astype(np.int_), error, rows[:, 4], counted)


def motion_time(time_s: Array, moving: Mask) -> Array:
    """Return the time in motion so far [s]."""
    return np.cumsum(np.diff(time_s, prepend=0.0) * moving)


def motion_since_change(time_s: Array, moved_s: Array, changes: Sequence[float]) -> Array:
    """Return the time in motion since the start or the last change before each output [s]."""
    begins = np.array([-math.inf, *changes])
    then = np.array([0.0, *np.interp(begins[1:], time_s, moved_s)])
    since: Array = moved_s - then[np.searchsorted(begins, time_s, side='right') - 1]
    return since


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one algorithm on one drive; NaN where there was nothing to score."""

    error: float  # Mean |error| where it counts
    std: float  # Median standard deviation there
    cover: float  # Share of these errors within 1.96 standard deviations
    valid: float  # Share of the time in motion with status VALID
    first_valid_min: float  # Time in motion to the first VALID [min], infinite if there is none
    wrong: float  # Share of the VALID outputs in motion that are beyond 3 standard deviations
    held: float  # The same of VALID and HOLDING ones
    longest_s: float  # Longest stretch of VALID outputs in motion beyond 3 standard deviations [s]


def score(course: Course) -> Score:
    """Score what one algorithm has published on a drive."""
    c, moving = course.counted, course.moving
    error, std, valid = course.error, course.std, course.valid & moving
    return Score(
        error=_mean(error[c]),
        std=float(np.median(std[c])) if c.any() else math.nan,
        cover=_mean((error <= _SIGMA_95 * std)[c]),
        valid=_mean(valid[moving]),
        first_valid_min=float(course.moved_s[np.argmax(valid)]) / _MINUTE_S if valid.any() else math.inf,
        wrong=_mean(course.wrong[valid]),
        held=_mean(course.wrong[course.usable & moving]),
        longest_s=_longest((valid & course.wrong)[moving]) * _PERIOD_S,
    )


def _mean(values: Array | Mask) -> float:
    return float(np.mean(values)) if values.size else math.nan


def _longest(marks: Mask) -> int:
    """Return the length of the longest row of marks."""
    ends = np.flatnonzero(np.diff(np.concatenate(([0], marks.astype(np.int8), [0]))))
    return int(np.max(ends[1::2] - ends[::2], initial=0))


def run(scenario: Scenario) -> dict[Method, Score]:
    source = ride(scenario.train, scenario.seed, scenario.unknowns, scenario.rates, scenario.duration)
    published = publish(source, source.rows, scenario.methods, scenario.seed)
    return {
        method: score(course_of(trace, source))
        for method, trace in zip(scenario.methods, published.traces, strict=True)
    }


Results = Mapping[Scenario, Mapping[Method, Score]]


def results_of(scenarios: Sequence[Scenario], name: str) -> Results:
    """Return the scores of all scenarios, run on all cores; progress is printed under ``name``."""
    return dict(zip(scenarios, over_seeds(run, scenarios, f'{name}: drives'), strict=True))

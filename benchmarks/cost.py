# SPDX-License-Identifier: Apache-2.0
"""CPU time per tick or record of all estimators and pipelines, compared with a plain RLS in the same run.

The clock counts the CPU time of this thread only, so other load does not enter directly but still affects the speed
of the machine. Therefore all subjects take turns in short blocks, and the ratio to the reference is the number to
compare.
"""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.days import assumed_train, simulated_day, ticks_of
from benchmarks.tables import Table
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.pipeline import SharedRecord, share_streams
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.results import Rejection
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.stream.alignment import Aligner, AlignmentConfig

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from benchmarks.days import TickOfRecords
    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Output
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

_SEED: Final = 1
_BLOCK: Final = 400
# Particles for which the project has a target.
_MANY: Final = 500
_REFERENCE: Final = 'reference: plain RLS, 3 parameters'


@dataclass(frozen=True, slots=True)
class Subject:
    """A function to time, with the argument of each call."""

    name: str
    items: Sequence[Any]
    call: Callable[[Any], object]


@dataclass(frozen=True, slots=True)
class Cost:
    """CPU time of one call [us]; ``accepted_...`` over the calls whose sample was not rejected."""

    name: str
    calls: int
    mean: float
    p50: float
    p99: float
    accepted_share: float
    accepted_p50: float


class PlainRls:
    """Recursive least squares on [1, v, v^2] in plain numpy, the reference."""

    def __init__(self) -> None:
        self.theta = np.zeros(3)
        self.P = np.eye(3) * 1e3

    def step(self, sample: Sample) -> float:
        """Process one sample; return its innovation."""
        phi = np.array([1.0, sample.speed, sample.speed * sample.speed])
        K = self.P @ phi / (1.0 + phi @ self.P @ phi)
        error = float(sample.gradient_mean - phi @ self.theta)
        self.theta = self.theta + K * error
        self.P = self.P - np.outer(K, phi @ self.P)
        return error


def measure() -> tuple[Table, ...]:
    """Time all subjects; return the table."""
    costs = time_in_turns(_subjects())
    reference = next(cost for cost in costs if cost.name == _REFERENCE)
    header = ('us of CPU time', 'calls', 'mean', 'p50', 'p99', 'mean / reference', 'accepted', 'p50 accepted')
    rows = tuple(_row(cost, reference) for cost in costs)
    note = (
        f'Day of seed {_SEED}. "accepted": calls whose sample was not rejected (at standstill, brake on or off). '
        'A tick is the four or five records that complete one sample.'
    )
    return (Table('CPU time of one call', header, rows, note),)


def _row(cost: Cost, reference: Cost) -> tuple[str, ...]:
    numbers = (f'{value:.1f}' for value in (cost.mean, cost.p50, cost.p99, cost.mean / reference.mean))
    return cost.name, str(cost.calls), *numbers, f'{cost.accepted_share:.0%}', f'{cost.accepted_p50:.1f}'


def _subjects() -> tuple[Subject, ...]:
    train, settings = assumed_train(), EstimatorSettings()
    records = simulated_day(_SEED).records
    ticks = ticks_of(records)
    samples = [tick.sample for tick in ticks]
    steps = (
        Subject('filter bank step, per sample', samples, resistance_pipeline(train, settings).estimator.step),
        Subject('AM-VFF-RLS step, per sample', samples, speed_model_pipeline(train, settings).estimator.step),
        Subject('GSMA step, per sample', samples, brake_rate_pipeline(train, settings).estimator.step),
    )
    pipelines = (
        Subject('filter bank pipeline, per tick', ticks, _push_all(resistance_pipeline(train, settings).push)),
        Subject('AM-VFF-RLS pipeline, per tick', ticks, _push_all(speed_model_pipeline(train, settings).push)),
        Subject('GSMA pipeline, per tick', ticks, _push_all(brake_rate_pipeline(train, settings).push)),
    )
    aligner = Subject('Aligner push, per record', records, Aligner(AlignmentConfig()).push)
    live = Subject('live tick, target 30: three pipelines on one stream', ticks, _push_to_three(train, settings))
    many = Gsma(train, GsmaConfig(particles=_MANY), np.random.default_rng(_SEED))
    step = Subject(f'GSMA step with {_MANY} particles, target 130 where accepted', samples, many.step)
    return (Subject(_REFERENCE, samples, PlainRls().step), *steps, step, aligner, *pipelines, live)


def _push_to_three(train: TrainFile, settings: EstimatorSettings) -> Callable[[TickOfRecords], object]:
    """Return a function that takes in a tick as the nodes of ``trainid run`` do, estimates included."""
    makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    pipelines: list[EstimatorPipeline[Any]] = [maker(train, settings) for maker in makers]
    share_streams(pipelines)

    def call(tick: TickOfRecords) -> object:
        outputs: list[Output[Any]] = []
        for record in tick.records:
            shared = SharedRecord(record.row())
            for pipeline in pipelines:
                pipeline.take(shared.events(pipeline.stream), outputs.append)
        return outputs

    return call


def _push_all(push: Callable[[Any], object]) -> Callable[[TickOfRecords], object]:
    def call(tick: TickOfRecords) -> object:
        return [push(record) for record in tick.records]

    return call


def time_in_turns(subjects: Sequence[Subject]) -> tuple[Cost, ...]:
    """Time every call of all subjects, taking turns block by block."""
    times: list[list[int]] = [[] for _ in subjects]
    accepted: list[list[bool]] = [[] for _ in subjects]
    longest = max(len(subject.items) for subject in subjects)
    overhead = _clock_cost()
    gc.disable()
    for start in range(0, longest, _BLOCK):
        for subject, spent, accepted_calls in zip(subjects, times, accepted, strict=True):
            _time_block(subject, start, spent, accepted_calls)
        gc.collect()
    gc.enable()
    results = zip(subjects, times, accepted, strict=True)
    return tuple(_summary(subject.name, spent, accepted_calls, overhead) for subject, spent, accepted_calls in results)


def _time_block(subject: Subject, start: int, spent: list[int], accepted_calls: list[bool]) -> None:
    call, clock = subject.call, time.thread_time_ns
    for item in subject.items[start : start + _BLOCK]:
        before = clock()
        result = call(item)
        spent.append(clock() - before)
        accepted_calls.append(not isinstance(result, Rejection))


def _clock_cost() -> float:
    clock = time.thread_time_ns
    return float(np.median([-(clock() - clock()) for _ in range(20_000)]))


def _summary(name: str, spent: list[int], accepted_calls: list[bool], overhead: float) -> Cost:
    us = np.maximum(np.array(spent, dtype=np.float64) - overhead, 0.0) / 1e3
    good = np.array(accepted_calls)
    p50, p99 = np.percentile(us, (50.0, 99.0))
    return Cost(name, len(us), float(us.mean()), float(p50), float(p99), float(good.mean()), float(np.median(us[good])))

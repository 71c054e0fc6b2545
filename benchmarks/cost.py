# SPDX-License-Identifier: Apache-2.0
"""CPU time of steps and pipelines per tick or record, compared with a plain RLS in the same run, and of whole commands.

The clock counts the CPU time of this thread only, so other load does not enter directly but still affects the speed
of the machine. Therefore all subjects take turns in short blocks, and the ratio to the reference is the number to
compare. Commands count with their start-up, beside the targets of the project.
"""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.days import REPOSITORY, TRAIN_FILE, TickOfRecords, assumed_train, simulated_day, ticks_of, write_bag
from benchmarks.processes import command_cpu_s
from benchmarks.tables import Table
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.pipeline import EstimatorPipeline, SharedRecord, share_streams
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.results import Output, Rejection
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Array = NDArray[np.float64]
_SEED: Final = 1
_BLOCK: Final = 400
_NAMES: Final = ('filter bank', 'AM-VFF-RLS', 'GSMA')
# Particles for which the project has a target.
_MANY: Final = 500
_REFERENCE: Final = 'reference: plain RLS, 3 parameters'
# Of commands: repetitions, and duration of all bags together [h].
_ROUNDS: Final = 5
_HOURS: Final = 10
_TINY: Final = REPOSITORY / 'bags' / 'tiny'
_DAY: Final = REPOSITORY / 'bags' / 'yizhuang_day'


@dataclass(slots=True)
class Subject:
    """A function to time, with the argument of each call."""

    name: str
    items: Sequence[Any]
    call: Callable[[Any], object]
    spent_ns: list[int] = field(default_factory=list)  # CPU time of each call so far
    accepted: list[bool] = field(default_factory=list)  # Whether its sample was not rejected

    def time_block(self, start: int) -> None:
        call, clock = self.call, time.thread_time_ns
        for item in self.items[start : start + _BLOCK]:
            before = clock()
            result = call(item)
            self.spent_ns.append(clock() - before)
            self.accepted.append(not isinstance(result, Rejection))

    def spent_us(self, overhead_ns: float) -> Array:
        """Return the CPU time of each call without that of the clock [us]."""
        return np.maximum(np.array(self.spent_ns, dtype=np.float64) - overhead_ns, 0.0) / 1e3


class PlainRls:
    """Recursive least squares on [1, v, v^2] in plain numpy, the reference."""

    def __init__(self) -> None:
        self.theta = np.zeros(3)
        self.P = np.eye(3) * 1e3

    def step(self, sample: Sample) -> float:
        phi = np.array([1.0, sample.speed, sample.speed * sample.speed])
        K = self.P @ phi / (1.0 + phi @ self.P @ phi)
        error = float(sample.gradient_mean - phi @ self.theta)
        self.theta = self.theta + K * error
        self.P = self.P - np.outer(K, phi @ self.P)
        return error


def measure() -> tuple[Table, ...]:
    subjects = _subjects()
    overhead_ns = _clock_cost_ns()
    gc.disable()
    for start in range(0, max(len(subject.items) for subject in subjects), _BLOCK):
        for subject in subjects:
            subject.time_block(start)
        gc.collect()
    gc.enable()
    us = {subject.name: subject.spent_us(overhead_ns) for subject in subjects}
    rows = []
    for subject in subjects:
        spent, good = us[subject.name], np.array(subject.accepted)
        p50, p99 = np.percentile(spent, (50.0, 99.0))
        numbers = (spent.mean(), p50, p99, spent.mean() / us[_REFERENCE].mean())
        accepted = (f'{good.mean():.0%}', f'{np.median(spent[good]):.1f}')
        rows.append((subject.name, str(len(spent)), *(f'{value:.1f}' for value in numbers), *accepted))
    header = ('us of CPU time', 'calls', 'mean', 'p50', 'p99', 'mean / reference', 'accepted', 'p50 accepted')
    note = (
        f'Day of seed {_SEED}. "accepted": calls whose sample was not rejected (at standstill, brake on or off). '
        'A tick is the four or five records that complete one sample.'
    )
    return (Table('CPU time of one call', header, tuple(rows), note),)


def _subjects() -> tuple[Subject, ...]:
    train, settings = assumed_train(), EstimatorSettings()
    records = simulated_day(_SEED).records
    ticks = ticks_of(records)
    samples = [tick.sample for tick in ticks]
    steps, pipelines = list[Subject](), list[Subject]()
    for name, kind in zip(_NAMES, KINDS, strict=True):
        step, push = kind.pipeline(train, settings).estimator.step, kind.pipeline(train, settings).push
        steps.append(Subject(f'{name} step, per sample', samples, step))
        pipelines.append(Subject(f'{name} pipeline, per tick', ticks, partial(_push_all, push)))
    aligner = Subject('Aligner push, per record', records, Aligner(AlignmentConfig()).push)
    live = Subject('live tick, target 30: three pipelines on one stream', ticks, _push_to_three(train, settings))
    many = Gsma(train, GsmaConfig(particles=_MANY), np.random.default_rng(_SEED))
    crowd = Subject(f'GSMA step with {_MANY} particles, target 130 where accepted', samples, many.step)
    return (Subject(_REFERENCE, samples, PlainRls().step), *steps, crowd, aligner, *pipelines, live)


def _push_to_three(train: TrainFile, settings: EstimatorSettings) -> Callable[[TickOfRecords], object]:
    """Return a function that takes in a tick as the nodes of ``trainid run`` do, estimates included."""
    pipelines: list[EstimatorPipeline[Any]] = [kind.pipeline(train, settings) for kind in KINDS]
    share_streams(pipelines)

    def call(tick: TickOfRecords) -> object:
        outputs: list[Output[Any]] = []
        for record in tick.records:
            shared = SharedRecord(record.row())
            for pipeline in pipelines:
                pipeline.take(shared.events(pipeline.stream), outputs.append)
        return outputs

    return call


def _push_all(push: Callable[[Any], object], tick: TickOfRecords) -> object:
    return [push(record) for record in tick.records]


def _clock_cost_ns() -> float:
    clock = time.thread_time_ns
    return float(np.median([-(clock() - clock()) for _ in range(20_000)]))


def commands() -> tuple[Table, ...]:
    small: tuple[tuple[str, tuple[object, ...], str], ...] = (
        ('--help', ('--help',), '0.15'),
        ('replay --help', ('replay', '--help'), ''),
        ('fit --help', ('fit', '--help'), ''),
        ('explain --help', ('explain', '--help'), ''),
        ('info, tiny', ('info', _TINY), '0.6'),
        ('replay, tiny', ('replay', _TINY, '--train', _TINY / 'train.yaml'), '0.6'),
        ('info, yizhuang_day', ('info', _DAY), ''),
        ('replay, yizhuang_day', ('replay', _DAY, '--train', _DAY / 'train.yaml'), ''),
    )
    rows = []
    for name, command, target in small:
        median_s = statistics.median(command_cpu_s(command) for _ in range(_ROUNDS))
        rows.append((name, f'{median_s:.2f}', target))
    with tempfile.TemporaryDirectory() as folder:
        bags, hours = _hours_of_bags(Path(folder))
        size = f'{len(bags)} bags of {hours:.1f} h together'
        fitted_s = sum(command_cpu_s(('fit', bag, '--train', TRAIN_FILE)) for bag in bags)
        rows.append((f'fit, one by one, {size}', f'{fitted_s:.1f}', '10'))
        rows.append((f'explain, {size}', f'{command_cpu_s(("explain", *bags, "--train", TRAIN_FILE)):.1f}', '10'))
    note = f'User and system time; medians of {_ROUNDS}, {_HOURS} hours once. Simulated days of seeds 1 to {len(bags)}.'
    return (Table('CPU time of commands, s', ('trainid', 'CPU s', 'target'), tuple(rows), note),)


def _hours_of_bags(folder: Path) -> tuple[list[Path], float]:
    """Write simulated days of ten hours together; return the bags and their duration [h]."""
    bags: list[Path] = []
    hours = 0.0
    while hours < _HOURS:
        records = simulated_day(len(bags) + 1).records
        bags.append(write_bag(folder / f'day{len(bags) + 1}', records))
        hours += (records[-1].stamp_ns - records[0].stamp_ns) / 3.6e12
    return bags, hours

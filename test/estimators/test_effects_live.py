# SPDX-License-Identifier: Apache-2.0
"""A train with an effect, estimated with a train file that contains the effect and with one that does not."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from test.estimators.makers import NAMES, make, run
from trainid_ros.explain.dataset import RunCollector
from trainid_ros.explain.model import Model
from trainid_ros.explain.proof import read_gap
from trainid_ros.interface.records import Record
from trainid_ros.interface.results import Reason, Status
from trainid_ros.resistance.davis_fit import PieceCollector
from trainid_ros.sim.scenario import Scenario, Simulation, simulate
from trainid_ros.stream.sample_stream import DriveHistory, SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import EFFECTS, parse_effects
from trainid_ros.train.train_file import Effect, TrainFile

SPEEDS = np.linspace(4.0, 20.0, 9)
# Allowed increase of the error over that of a train without any effect: N/kN, N/kN, brake rate [1].
ALLOWANCE = {'resistance': 0.2, 'speed_model': 0.5, 'brake_rate': 0.015}


@dataclass(frozen=True)
class Case:
    """An effect, the estimate that it degrades most while it is not modelled, and by how much at least.

    ``named``: what the checks of the inputs say of it; nothing is learned then.
    """

    text: str
    degrades: str
    by: float
    named: str = ''


CASES = {
    'curve_resistance': Case('curve_resistance:coefficient=1500', 'resistance', 0.15),  # its error is learned
    'tunnel_drag': Case('tunnel_drag:factor=2.5', 'resistance', 0.3),
    'headwind': Case('headwind:speed=6', 'resistance', 1.0),
    'local_drag': Case('local_drag:start=1000,end=4000,permille=5', 'resistance', 0.3),
    'gradient_error': Case('gradient_error:start=1000,end=4000,permille=5', 'resistance', 0.3),
    'resistance_step': Case('resistance_step:time=100,a=1.5', 'resistance', 0.4),
    'brake_slope': Case('brake_slope:slope=-0.012', 'brake_rate', 0.02),
    'run_drag': Case('run_drag:size=1.5', 'resistance', 0.7),
    'starting_resistance': Case('starting_resistance:value=9,speed=5', 'speed_model', 0.4),
    'higher_order_drag': Case('higher_order_drag:coefficient=3e-4', 'resistance', 0.4),
    'bearing_warmup': Case('bearing_warmup:value=3,distance=4000', 'resistance', 0.7),
    'dragging_brake': Case('dragging_brake:permille=4,time=20', 'resistance', 1.0),
    'mass_error': Case('mass_error:ratio=1.1', 'brake_rate', 0.05),
    'traction_scale': Case('traction_scale:ratio=0.88', 'speed_model', 0.5),
    'brake_fade': Case('brake_fade:loss=0.3,energy=150', 'brake_rate', 0.1),
    'brake_delay': Case('brake_delay:extra=0.8', 'brake_rate', 0.005),  # the dead time is learned
    'wheel_diameter': Case('wheel_diameter:ratio=1.06', 'brake_rate', 0.02),
    'map_shift': Case('map_shift:distance=80', 'resistance', 0.25),
    'stamp_skew': Case('stamp_skew:delay=0.6', 'resistance', 0.0, 'ato/force is late by about 0.6 s'),
}


def with_effect(file: TrainFile, text: str) -> TrainFile:
    return replace(file, effects=parse_effects([text]))


@pytest.fixture(scope='module')
def line(metro: TrainFile) -> TrainFile:
    """The metro line with curves and tunnels."""
    curve = ((0.0, 0.0), (1300.0, 500.0), (2300.0, 0.0), (2900.0, 400.0), (3300.0, 0.0))
    return replace(metro, line=replace(metro.line, curve=curve, tunnel=((800.0, 1900.0), (2700.0, 3400.0))))


def day(file: TrainFile, runs: int) -> Simulation:
    return simulate(Scenario(file, runs=runs), np.random.default_rng(99))


def error(job: str, train_file: TrainFile, simulation: Simulation) -> float:
    """Mean error over the second half: rms of w over speeds [N/kN], or of the brake rate while it brakes."""
    outputs = run(make(job, train_file), simulation.records)
    late = outputs[len(outputs) // 2 :]
    if job == 'brake_rate':
        rates = [(o.estimate, simulation.truth.truth_at_ns(o.stamp_ns).brake_rate or 0.0) for o in late]
        return float(np.mean([abs(e.brake_rate - rate) for e, rate in rates if e.observable and e.speed > 3.0]))
    errors = [np.array([getattr(o.estimate, key) - getattr(train_file.resistance, key) for key in 'abc']) for o in late]
    return float(np.mean([np.sqrt(np.mean((a + SPEEDS * (b + SPEEDS * c)) ** 2)) for a, b, c in errors[::20]]))


def last_finding(job: str, file: TrainFile, records: Iterable[Record]) -> str:
    pipeline = make(job, file)
    run(pipeline, records)
    return pipeline.stream.last_finding


@pytest.fixture(scope='module')
def plain(line: TrainFile) -> dict[str, float]:
    """Errors on the same drives without any effect."""
    simulation = day(line, 2)
    return {job: error(job, line, simulation) for job in NAMES}


@pytest.mark.slow
@pytest.mark.parametrize('name', CASES)
def test_a_modelled_effect_adds_no_error_and_a_missing_one_does(
    name: str, line: TrainFile, plain: dict[str, float]
) -> None:
    case = CASES[name]
    true = with_effect(line, case.text)
    simulation = day(true, 2)
    known = {job: error(job, true, simulation) for job in NAMES}
    unknown = error(case.degrades, line, simulation)
    print(name, {job: round(e, 4) for job, e in known.items()}, 'unknown:', case.degrades, round(unknown, 4))
    for job, found in known.items():
        assert found < plain[job] + ALLOWANCE[job], job
    if case.named:
        assert case.named in last_finding(case.degrades, line, simulation.records)
        assert last_finding(case.degrades, true, simulation.records) == ''
    else:
        assert unknown > known[case.degrades] + case.by


def test_every_effect_is_tested() -> None:
    # Slip cannot be corrected, and a brake scale is learned as the brake rate.
    assert {*CASES, 'wheel_slip', 'brake_scale'} == set(EFFECTS)


@pytest.mark.parametrize(
    ('text', 'job', 'low', 'high'),
    [
        ('bearing_warmup:value=4,distance=3000', 'resistance', 0.5, 0.7),
        # The dead time is learned, so a missing delay degrades little more than the first braking.
        ('brake_delay:extra=0.8', 'brake_rate', 0.03, 0.01),
    ],
)
def test_one_run_suffices_to_show_the_difference(text: str, job: str, low: float, high: float, line: TrainFile) -> None:
    true = with_effect(line, text)
    simulation = day(true, 1)
    known, unknown = (error(job, file, simulation) for file in (true, line))
    assert known < low
    assert unknown > known + high


def test_a_brake_scale_is_the_prior_brake_rate(line: TrainFile) -> None:
    pipeline = make('brake_rate', with_effect(line, 'brake_scale:ratio=0.8'))
    assert pipeline.current().estimate.brake_rate == pytest.approx(0.8)


@pytest.mark.parametrize('delay', [-1.2, 1.2])
def test_a_stamp_skew_makes_no_estimate_stale(delay: float, line: TrainFile) -> None:
    true = with_effect(line, f'stamp_skew:delay={delay}')
    outputs = run(make('resistance', true), day(true, 1).records)
    assert Status.STALE not in {output.status for output in outputs[20:]}
    assert outputs[-1].used > 100


def test_a_restored_pipeline_remembers_how_far_the_train_has_run(line: TrainFile) -> None:
    true = with_effect(line, 'bearing_warmup:value=4,distance=3000')
    records = day(true, 1).records
    half = len(records) // 2
    first, second = (make('resistance', true) for _ in range(2))
    for record in records[:half]:
        first.push(record)
    saved = first.save()
    first.restore(saved)
    second.restore(saved)
    outputs = [[o.estimate for r in records[half:] for o in p.push(r)] for p in (first, second)]
    assert outputs[0] == outputs[1]
    assert second.save() == first.save()
    # Without the drive history the bearings would be assumed cold again.
    fresh = make('resistance', true)
    fresh.estimator.restore(first.estimator.save())
    fresh.push(records[-1])
    assert fresh.save() != first.save()


def test_simulator_stream_and_explain_count_runs_alike(metro: TrainFile) -> None:
    true = replace(metro, effects=(Effect('run_drag', (('size', 4.0),), runs=(2,)),))
    stream, collector, seen = SampleStream(StreamConfig(true)), RunCollector(true), set[tuple[int, float]]()
    for record in day(true, 3).records:
        for event in stream.push(record):
            if isinstance(event, Sample):
                collector.add(event)
                seen.add((event.motion.run, event.extra))
    collector.end_run()
    assert seen - {(0, 0.0)} == {(1, 0.0), (2, 4.0), (3, 0.0)}
    assert [run.number for run in collector.runs] == [1, 2, 3]
    gaps = {}
    for file in (true, metro):
        model = Model.of(collector.runs, file)
        gaps[file] = np.square(read_gap(model))[model.dataset.point_run == 1].mean()
    assert gaps[true] < 0.01 * gaps[metro]


def test_a_fit_uses_the_drive_history_too(train_file: TrainFile, sample: Callable[..., Sample]) -> None:
    true = with_effect(train_file, 'bearing_warmup:value=4,distance=300')
    collector, rejected, history = PieceCollector(true, 1.0, 2.0), Counter[Reason](), DriveHistory(true)
    for i in range(200):  # 3 m each
        moved = sample(i, dt=0.2, speed=15.0 + 0.001 * (i % 2))
        moved.motion = history.follow(moved)
        collector.add(moved, rejected)
    assert not rejected
    known = collector.trajectory().known
    assert (known[0], known[100], known[199]) == pytest.approx((-4.0, -4.0 / math.e, -4.0 * math.exp(-1.99)), rel=1e-3)

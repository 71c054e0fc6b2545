# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the estimates and coverage of their standard deviations.

One test per data set, so that each is run through the estimators once. The numbers are printed (-rP).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.yizhuang_day import DRAG_S, RAIN_S, yizhuang_day
from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import Truth, load_truth
from trainid_ros.train.train_file import Davis, TrainFile, load_train_file

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
SETTLED_S = 300.0
# Below this speed [m/s] the only braking seen is the brake release at departure.
DRIVING = 3.0
FRESH_DAYS, FRESH_RUNS = 4, 6
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """Estimates and true values at one sample."""

    time_s: float
    resistance: ResistanceEstimate
    brake: BrakeRateEstimate
    davis: Davis
    rate: float

    def error(self, speed: float) -> float:
        """Error of w at a speed [N/kN]."""
        a, b, c = (getattr(self.resistance, key) - getattr(self.davis, key) for key in 'abc')
        return float(a + b * speed + c * speed * speed)

    @property
    def braking(self) -> bool:
        return self.brake.observable and self.brake.speed > DRIVING


def estimate(records: Iterable[Record], train_file: TrainFile, truth: Truth) -> list[Moment]:
    settings = EstimatorSettings()
    resistance, brake = resistance_pipeline(train_file, settings), brake_rate_pipeline(train_file, settings)
    moments = []
    for record in records:
        # Both align the same records, so both output the same samples.
        for first, second in zip(resistance.push(record), brake.push(record), strict=True):
            point = truth.truth_at_ns(first.stamp_ns)
            time_s = (first.stamp_ns - truth.start_ns) / NS_PER_S
            rate = np.nan if point.brake_rate is None else point.brake_rate
            moments.append(Moment(time_s, first.estimate, second.estimate, point.resistance, rate))
    return moments


def replayed(name: str) -> list[Moment]:
    bag = REPOSITORY / 'bags' / name
    with BagReader(bag) as reader:
        return estimate(reader.records(), load_train_file(bag / 'train.yaml'), load_truth(bag / 'truth.yaml'))


def w(davis: Davis, speed: float) -> float:
    return davis.a + davis.b * speed + davis.c * speed * speed


def test_freight_run_of_an_independent_simulator() -> None:
    moments = replayed('altrios_manifest')
    last = moments[-1]
    at_end = [100.0 * last.error(v) / w(last.davis, v) for v in np.linspace(6.7, 20.0, 15).tolist()]
    # During the run only at the current speed: the resistance at speeds not yet seen is unknown.
    current = [
        100.0 * abs(m.error(m.resistance.speed)) / w(m.davis, m.resistance.speed)
        for m in moments
        if m.time_s > SETTLED_S and m.resistance.speed >= 6.7
    ]
    print(f'w at the end, 6.7 to 20 m/s: errors {min(at_end):.2f} to {max(at_end):.2f} %')
    print(f'w at the current speed after 5 min: mean error {np.mean(current):.2f} %, largest {max(current):.1f} %')
    assert max(map(abs, at_end)) < 2.0
    assert np.mean(current) < 2.0


def test_recorded_metro_day() -> None:
    moments = replayed('yizhuang_day')
    mean_errors = {}
    periods = {'start': (0.0, RAIN_S), 'rain': (RAIN_S, DRAG_S), 'drag': (DRAG_S, np.inf)}
    for name, (begin, end) in periods.items():
        inside = [m for m in moments if begin + SETTLED_S <= m.time_s < end and m.resistance.speed >= 1.0]
        assert len(inside) > 1000
        mean_errors[name, '10'] = float(np.mean([abs(m.error(10.0)) for m in inside]))
        mean_errors[name, '15'] = float(np.mean([abs(m.error(15.0)) for m in inside]))
        mean_errors[name, 'current'] = float(np.mean([abs(m.error(m.resistance.speed)) for m in inside]))
    print('mean error of w, N/kN:', {' '.join(key): round(value, 3) for key, value in mean_errors.items()})
    first_s = next(m.time_s for m in moments if m.braking)
    brake = [abs(m.brake.brake_rate - m.rate) for m in moments if m.braking and m.time_s >= first_s + 7.0]
    print(f'brake rate: error {brake[0]:.4f} after 7 s of braking, mean {np.mean(brake):.4f} from then on')
    assert max(mean_errors.values()) < 0.1
    assert brake[0] < 0.05
    assert np.mean(brake) < 0.03


def fresh_day(stated: TrainFile, rng: np.random.Generator) -> Scenario:
    """A day with a random constant brake rate, while the train file states 1, so that the estimate must move."""
    day = yizhuang_day(stated, runs=FRESH_RUNS)
    brake = replace(day.train_file.brake, rate=float(rng.uniform(0.8, 1.15)))
    changes = tuple(change for change in day.changes if change.brake_rate is None)
    return replace(day, train_file=replace(day.train_file, brake=brake), changes=changes)


def coverage(what: str, z: list[float]) -> tuple[str, float, float]:
    size = np.abs(np.array(z))
    in_68, in_95 = float(np.mean(size < 1.0)), float(np.mean(size < 1.959964))
    rms = float(np.sqrt(np.mean(np.square(z))))
    summary = f'{what}: the 68 % band covers {100 * in_68:.0f} %, the 95 % band {100 * in_95:.0f} %, rms {rms:.2f}'
    return summary, in_68, in_95


@pytest.mark.long
def test_days_with_random_seeds_are_accurate_with_consistent_standard_deviations() -> None:
    """Set ACCURACY_SEED to repeat a run.

    The limits of the coverage are wide: errors within a day are correlated, so a few days contain only a few dozen
    independent errors.
    """
    given = os.environ.get('ACCURACY_SEED')
    seed = int(given) if given else int(np.random.SeedSequence().generate_state(1)[0])
    print(f'ACCURACY_SEED={seed}')
    stated = load_train_file(REPOSITORY / 'config' / 'trains' / 'yizhuang.yaml')
    w_errors, w_z, rate_errors, rate_z, first_errors = [], [], [], [], []
    for k in range(FRESH_DAYS):
        rng = np.random.default_rng([seed, k])
        simulation = simulate(fresh_day(stated, rng), rng)
        moments = estimate(simulation.records, stated, simulation.truth)
        first_s = next(m.time_s for m in moments if m.braking)
        after = [m for m in moments if m.braking and m.time_s >= first_s + 7.0]
        first_errors.append(abs(after[0].brake.brake_rate - after[0].rate))
        for m in after:
            rate_errors.append(abs(m.brake.brake_rate - m.rate))
            rate_z.append((m.brake.brake_rate - m.rate) / m.brake.brake_rate_std)
        for m in moments:
            if m.time_s > SETTLED_S and m.resistance.speed > 1.0:
                error = m.error(m.resistance.speed)
                w_errors.append(abs(error))
                w_z.append(error / m.resistance.resistance_std)
    summary_w, w_68, w_95 = coverage('w at the current speed', w_z)
    summary_rate, rate_68, rate_95 = coverage('brake rate', rate_z)
    print(summary_w, summary_rate, sep='\n')
    print(f'mean error of w {np.mean(w_errors):.3f} N/kN, of the brake rate {np.mean(rate_errors):.4f}')
    print(f'error of the brake rate after 7 s of the first braking: {np.round(first_errors, 3)}')
    assert np.mean(w_errors) < 0.1
    assert np.mean(rate_errors) < 0.03
    assert np.median(first_errors) < 0.05
    # Standard deviations that allow for future steps, drift and a coarse map are too wide on days without them: for w
    # twice on average over 18 seeds (4.2 times on the calmest), for the brake rate twice.
    assert w_68 >= 0.55
    assert rate_68 >= 0.55
    assert min(w_95, rate_95) >= 0.88
    assert np.sqrt(np.mean(np.square(w_z))) > 1.0 / 5.0
    assert np.sqrt(np.mean(np.square(rate_z))) > 1.0 / 3.0

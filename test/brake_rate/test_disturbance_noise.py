# SPDX-License-Identifier: Apache-2.0
"""The estimated size of the disturbance: correct for its model, slow, bounded, and robust to outliers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.days import assumed_train, samples_of
from benchmarks.yizhuang_day import yizhuang_day
from trainid_ros.brake_rate.brake_rate_estimator import Candidate, DisturbanceNoise
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.brake_rate.motion_model import Transition
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.sim.scenario import simulate

DT, LENGTH, SPEED, R = 0.2, 200.0, 15.0, 0.025**2
RHO = math.exp(-SPEED * DT / LENGTH)
FREE = Transition(DT, 0.0, 0.6, 0.0, 0.0, RHO, 0.0, 0.002**2 * DT, 0.0)


def rolled(std: float, seconds: float, seed: int, declared: float = 0.006, slip: float = 0.0) -> DisturbanceNoise:
    """Return the estimate from a train that runs at about 15 m/s, with a share of samples that slip by 1 m/s."""
    rng = np.random.default_rng([seed, 9])
    noise, b, v = DisturbanceNoise.declared(declared), std * float(rng.standard_normal()), SPEED
    for _ in range(round(seconds / DT)):
        v += DT * b - 0.1 * (v - SPEED) * DT + 0.002 * math.sqrt(DT) * float(rng.standard_normal())
        b = RHO * b + std * math.sqrt(1.0 - RHO * RHO) * float(rng.standard_normal())
        measured = v + math.sqrt(R) * float(rng.standard_normal()) + (1.0 if rng.random() < slip else 0.0)
        noise.add(FREE, -0.1 * (v - SPEED) * DT, measured, R)
    return noise


def std_of(noise: DisturbanceNoise) -> float:
    return math.sqrt(noise.variance)


@pytest.mark.parametrize('std', [0.004, 0.01, 0.03])
def test_the_estimate_is_independent_of_the_configured_value(std: float) -> None:
    found = [std_of(rolled(std, 500.0, seed, declared)) for seed, declared in ((7001, 0.006), (7002, 0.012))]
    print(found)
    assert np.mean(found) == pytest.approx(std, rel=0.3)


def test_with_little_data_the_estimate_stays_at_the_prior() -> None:
    first = DisturbanceNoise.declared(0.006)
    assert 0.006 < std_of(first) < 0.03
    assert std_of(rolled(0.02, 2.0, 7003)) == pytest.approx(std_of(first), rel=0.6)


def test_the_estimate_stays_within_bounds() -> None:
    assert std_of(rolled(0.0, 400.0, 7004, declared=0.05)) == pytest.approx(0.3 * 0.05, rel=0.2)
    assert std_of(rolled(0.05, 200.0, 7005, declared=0.001)) == pytest.approx(10.0 * 0.001, rel=0.01)


def test_slip_is_not_a_disturbance() -> None:
    """One sample in a hundred is off by 40 standard deviations; it is clipped at three."""
    clean, slipping = rolled(0.006, 300.0, 7006), rolled(0.006, 300.0, 7006, slip=0.01)
    assert std_of(slipping) < 2.5 * std_of(clean)


def test_a_pause_restarts_the_filters_and_keeps_the_estimate() -> None:
    noise = rolled(0.02, 60.0, 7007)
    variance, known = noise.variance, DisturbanceNoise.declared(0.0)
    noise.running = False
    noise.add(FREE, 0.0, 3.0, R)
    assert noise.variance == variance
    assert {(item.v, item.b, item.vv) for item in noise.candidates} == {(3.0, 0.0, R)}
    known.add(FREE, 0.0, 3.0, R)
    assert not known.running


def test_each_filter_equals_the_kalman_filter() -> None:
    variances = 9e-5, 9e-3
    items = tuple(Candidate(1.0, 0.0, 0.0, 15.0, 0.004, 4e-4, 1e-5, bb) for bb in variances)
    DisturbanceNoise(0.01, 0.0, items, running=True).add(FREE, -0.02, 15.01, R)
    F, likelihoods = np.array([[1.0, DT], [0.0, RHO]]), []
    for item, bb in zip(items, variances, strict=True):
        m = F @ [15.0, 0.004] + [-0.02, 0.0]
        P = F @ [[4e-4, 1e-5], [1e-5, bb]] @ F.T + np.diag([FREE.q_v, (1.0 - RHO * RHO) * 0.01**2])
        S, nu = P[0, 0] + R, 15.01 - m[0]
        m, P = m + P[:, 0] / S * nu, P - np.outer(P[:, 0], P[:, 0]) / S
        likelihoods.append(-0.5 * (nu * nu / S + math.log(S)))
        assert (item.v, item.b, item.vv, item.vb, item.bb) == pytest.approx((*m, P[0, 0], P[0, 1], P[1, 1]), rel=1e-9)
    found = [item.evidence for item in items]
    assert found == pytest.approx([x - max(likelihoods) for x in likelihoods], rel=1e-9, abs=1e-12)


def test_estimators_update_it_between_brakings_and_save_it() -> None:
    train = assumed_train()
    day = yizhuang_day(train, runs=3)
    # A map that is wrong by 2 per mille: .02 m/s^2.
    day = replace(day, sensors=replace(day.sensors, map_error=2.0))
    samples = samples_of(simulate(day, np.random.default_rng(7008)).records)
    first, second = (Gsma(train, GsmaConfig(), np.random.default_rng(1)) for _ in range(2))
    seen = set()
    for sample in samples:
        before = first.state.disturbance.variance
        first.step(sample)
        if first.state.observable:
            assert first.state.disturbance.variance == before
            assert not first.state.disturbance.running
        seen.add(first.state.disturbance.running)
    assert seen == {True, False}
    assert 0.01 < std_of(first.state.disturbance) < 0.035
    second.restore(first.save())
    assert second.state.disturbance == first.state.disturbance

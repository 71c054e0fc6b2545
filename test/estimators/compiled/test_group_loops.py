# SPDX-License-Identifier: Apache-2.0
"""GSMA in loops: compiled and not compiled to the bit alike, and the same as in NumPy but for rounding."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from benchmarks.papers.brake_runs import metro_run, metro_train
from trainid_lab.brake_rate.particles import correction
from trainid_ros.brake_rate.group_cloud import GroupCloud, Strata, branch, prune, weigh
from trainid_ros.brake_rate.gsma import Gsma, GsmaConfig
from trainid_ros.brake_rate.particles import SPEED, speed_step
from trainid_ros.brake_rate.posterior import STATES, Transition
from trainid_ros.errors import InputError
from trainid_ros.estimators.compiled import group_loops
from trainid_ros.estimators.compiled.jit import compiled, compiler_present
from trainid_ros.estimators.protocol import step_and_estimate
from trainid_ros.results import Rejection

if TYPE_CHECKING:
    from numpy.typing import NDArray

needs_compiler = pytest.mark.skipif(not compiler_present(), reason='numba is not installed')

LEAN = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
INTERVAL = Transition(0.2, 0.1, 0.6, 0.012, 0.37, 0.99, 0.01, 1e-5, 1e-6, LEAN, KEEP, Q_E)
R, LARGEST = 7e-4, 3.0
Q = np.array([1e-5, 0.04])
CHAIN = np.array([[0.999, 0.001], [0.1, 0.9]])


def a_cloud(seed: int, sizes: tuple[int, ...] = (20, 10)) -> tuple[GroupCloud, Strata, NDArray[np.float64]]:
    """Return particles with values in order within each stratum, and a covariance."""
    rng, strata = np.random.default_rng(seed), Strata.divide(sizes)
    f = np.concatenate([np.sort(rng.normal(0.9, 0.1, size)) for size in sizes])
    weight = rng.dirichlet(np.ones(len(sizes)))
    mean = f @ strata.average
    variance = np.square(f - mean[strata.of]) @ strata.average
    slope = rng.normal(0.0, 0.3, (STATES, len(sizes)))
    middle = np.zeros((STATES, 1))
    middle[:2, 0] = 10.0, -0.5
    x = middle + slope[:, strata.of] * (f - 0.9) + rng.normal(0.0, 0.01, (STATES, len(f)))
    root = rng.normal(0.0, 0.02, (STATES, STATES))
    return GroupCloud.of(f, x, weight, mean, variance, slope), strata, root @ root.T


def arguments(cloud: GroupCloud, strata: Strata, P: NDArray[np.float64], speed: float) -> tuple[Any, ...]:
    M = len(strata.sizes)
    edges = np.concatenate([[0], np.cumsum(strata.sizes)]).astype(np.intp)
    uniforms = np.array([0.3, 0.8])[:M]
    parts = (cloud.z, cloud.weight, cloud.mean, cloud.variance, cloud.line, edges)
    return (*parts, INTERVAL, Q[:M], P, speed, R, LARGEST, CHAIN[:M, :M], uniforms)


def in_numpy(cloud: GroupCloud, strata: Strata, P: NDArray[np.float64], speed: float) -> GroupCloud:
    M = len(strata.sizes)
    step, fix = speed_step(INTERVAL), correction(P, SPEED, np.array([[R]]))
    groups = branch(cloud, strata, step, Q[:M] * INTERVAL.dt)
    children, weights = weigh(groups, fix, SPEED, np.array([speed]), LARGEST)
    return prune(children, weights, strata, CHAIN[:M, :M], np.array([0.3, 0.8])[:M])


@pytest.mark.parametrize('sizes', [(20, 10), (7,)])
@pytest.mark.parametrize('speed', [10.0, 10.3, 9.0])
def test_a_step_is_that_of_numpy(sizes: tuple[int, ...], speed: float) -> None:
    cloud, strata, P = a_cloud(31, sizes)
    expected = in_numpy(cloud, strata, P, speed)
    found = group_loops.learn(*arguments(cloud, strata, P, speed))
    for mine, theirs in zip(found[:5], expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[5], correction(P, SPEED, np.array([[R]])).P, rtol=1e-9, atol=1e-15)
    assert found[7][:2] == pytest.approx((expected.rate, expected.total_variance), rel=1e-9)


def test_prediction_is_that_of_numpy() -> None:
    cloud, _, P = a_cloud(32)
    step = speed_step(INTERVAL)
    z, line, ahead = group_loops.predict(cloud.z, cloud.line, P, INTERVAL)
    np.testing.assert_allclose(z[2:], step.predict(cloud.x, cloud.f), rtol=1e-12)
    np.testing.assert_allclose(line[2:], step.Phi @ cloud.slope + step.gamma[:, None], rtol=1e-12, atol=1e-15)
    assert np.array_equal(z[:2], cloud.z[:2])
    assert np.array_equal(line[:2], cloud.line[:2])
    np.testing.assert_allclose(ahead, step.predict_covariance(P), rtol=1e-12, atol=1e-18)


def test_values_out_of_order_are_put_in_order() -> None:
    base, edges = np.array([0.3, 0.1, 0.2, 0.25, 0.15]), np.array([0, 3, 5])
    h = np.array([0.06, 0.3])
    order = group_loops.merged(base, h, edges)
    f = base + np.array([[-1.0], [0.0], [1.0]]) * h[[0, 0, 0, 1, 1]]
    assert (np.diff(f.ravel()[order]) >= 0.0).all()
    assert sorted(order.tolist()) == list(range(15))


@needs_compiler
@pytest.mark.slow
def test_compiled_loops_give_the_same_bits() -> None:
    fast_learn, fast_predict = compiled(group_loops.learn), compiled(group_loops.predict)
    for seed in range(40, 50):
        cloud, strata, P = a_cloud(seed)
        given = arguments(cloud, strata, P, 10.0 + 0.05 * (seed - 45))
        slow, fast = group_loops.learn(*given), fast_learn(*given)
        assert all(np.array_equal(one, other) for one, other in zip(slow[:7], fast[:7], strict=True))
        assert slow[7] == fast[7]
        ahead = (cloud.z, cloud.line, P, INTERVAL)
        for before, after in zip(group_loops.predict(*ahead), fast_predict(*ahead), strict=True):
            assert np.array_equal(before, after)


@needs_compiler
@pytest.mark.slow
def test_a_drive_gives_the_same_estimates_and_compiles_only_once() -> None:
    run, config = metro_run(77, stops=2), GsmaConfig(particles=60)
    fast_config = GsmaConfig(particles=60, compiled=1)
    plain = Gsma(metro_train(), config, np.random.default_rng(5))
    fast = Gsma(metro_train(), fast_config, np.random.default_rng(5))
    learned = 0
    for k, sample in enumerate(run.samples):
        if k == len(run.samples) // 2:
            fast.restore(fast.save())
        expected, found = step_and_estimate(plain, sample), step_and_estimate(fast, sample)
        assert type(expected) is type(found)
        if not isinstance(expected, Rejection) and not isinstance(found, Rejection):
            learned += 1
            assert found.brake_rate == pytest.approx(expected.brake_rate, abs=1e-9)
            assert found.brake_rate_std == pytest.approx(expected.brake_rate_std, rel=1e-6)
    assert learned > 100
    compiled_learn: Any = compiled(group_loops.learn)
    assert len(compiled_learn.signatures) == 1


def test_without_a_compiler_it_is_told_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'numba', None)
    with pytest.raises(InputError, match=r'compiled = 1 needs numba, which comes with trainid_ros\[fast\]'):
        Gsma(metro_train(), GsmaConfig(particles=30, compiled=1), np.random.default_rng(5))
    Gsma(metro_train(), GsmaConfig(particles=30), np.random.default_rng(5))

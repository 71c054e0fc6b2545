# SPDX-License-Identifier: Apache-2.0
"""Yuan et al. 2017 on fresh lines: lockstep equals the product, and targets are met with statistical margins."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from research.papers.line_scores import identify, over_bound, score
from research.papers.lockstep import ManyIntegral, ManyMethod, ManyRls, drive, drive_many
from research.papers.station_lines import NOISES, ONE_RUN, LineShape, Noise, measured, station_lines
from research.papers.yuan_methods import (
    LOAD,
    P0,
    THETA0,
    Auxiliary,
    all_methods,
    am_tuning,
    am_vff,
    ekf,
    oracle,
    scaled,
)
from trainid_lab.speed_model import integral_rls, rls
from trainid_lab.speed_model.speed_model_ekf import ekf_tuning
from trainid_ros.speed_model.am_vff_rls import Method

pytestmark = pytest.mark.slow

WHITE, _, _, MISSING, OUTLIERS = NOISES
SHORT = LineShape(samples=700, distance=(500.0, 700.0), first=0.0)


def fresh(count: int) -> range:
    start = int.from_bytes(os.urandom(4)) + 10_000
    print(f'lines of seeds from {start}')
    return range(start, start + count)


def pairs(variance: float) -> list[tuple[str, Method, ManyMethod, bool]]:
    """Return each method of the product with its lockstep version."""
    change = integral_rls.Tuning(25, 5, 0.3, 4.0, 1e-6, 1e-7, LOAD)
    config = rls.RlsConfig(kappa=0.1, forgetting_scale=100.0, min_forgetting=0.9, gate=5.0, prior_scale=1.0)
    P, tuning = scaled(P0, 1.0 / variance), rls.Tuning(0.1, 100.0 * variance, 0.9, 5.0)
    return [
        (
            'integral',
            integral_rls.IntegralRls(THETA0, P0, change),
            ManyIntegral(THETA0, P0, change, variance),
            True,
        ),
        ('repaired', rls.Rls(THETA0, P0, config), ManyRls(THETA0, P, tuning, variance), True),
        (
            'as printed but for the clamp',
            rls.Rls(THETA0, P0, replace(config, kappa=0.0, gate=1e9)),
            ManyRls(THETA0, P, tuning._replace(kappa=0.0, gate=1e9), variance),
            False,
        ),
    ]


@pytest.mark.parametrize('noise', [WHITE, MISSING, replace(OUTLIERS, missing=0.1)], ids=['white', 'missing', 'both'])
def test_lockstep_equals_the_product(noise: Noise) -> None:
    seeds = fresh(2)
    lines = station_lines(seeds, SHORT)
    assert (lines.x == 0.0).any()
    y, variance = measured(lines, noise, seeds), noise.std**2
    for name, method, many, freeze in pairs(variance):
        together = drive_many(many, y, lines.u, freeze=freeze).state
        for k in range(len(seeds)):
            alone = drive(method, y[:, k], lines.u[:, k], variance, freeze=freeze).state
            # Sums in another order round differently; rejections and forgetting must be identical.
            assert together[:, :, k] == pytest.approx(alone, rel=1e-6, abs=1e-8), name


def test_default_and_ekf_meet_their_targets() -> None:
    """With 40 lines instead of 200, and limits a few standard errors wider."""
    seeds = fresh(40)
    lines = station_lines(seeds)
    y, variance = measured(lines, WHITE, seeds), WHITE.std**2
    vff = score(lines, all_methods(WHITE)[1].drive(lines, y))
    best = score(lines, oracle(lines, y))
    for method in (am_vff(variance), ekf(variance)):
        found = score(lines, method.drive(lines, y))
        assert found.five[0] < 0.5 * vff.five[0], method.name
        assert found.five[0] < 1.3 * best.five[0], method.name
        assert found.five[1] < 0.45 * vff.five[1], method.name
        assert found.ahead < 0.6 * WHITE.std, method.name
        assert found.step[1] < 8.0, method.name
        assert found.lost == 0.0, method.name


def test_no_line_is_lost_with_outliers_and_missing_samples() -> None:
    seeds = fresh(24)
    lines = station_lines(seeds)
    clean = score(lines, am_vff(WHITE.std**2).drive(lines, measured(lines, WHITE, seeds)))
    for noise, most in ((MISSING, 1.25), (OUTLIERS, 1.4)):
        found = score(lines, am_vff(WHITE.std**2).drive(lines, measured(lines, noise, seeds)))
        assert found.lost == 0.0, noise.name
        assert found.five[0] < most * clean.five[0], noise.name


def test_bound_is_attained_with_constant_parameters() -> None:
    """A root mean square over 60 runs has a standard error of 9 %, the mean of four correlated ones little less."""
    seeds = fresh(60)
    lines = station_lines(seeds, ONE_RUN)
    y, variance, wide = measured(lines, WHITE, seeds), WHITE.std**2, scaled(P0, 1e4)
    run = identify(lines, y, WHITE.std)
    scored = [0, 1, 3, 4]
    assert over_bound(run, run.one_step)[scored].mean() > 2.5
    assert over_bound(run, run.integral)[scored].mean() < 2.0
    ends = [int(np.nonzero(column >= 0.5)[0][-1]) for column in y.T]
    for tuning in (replace(am_tuning(drift=0.0, load=0.0), gate=1e3), ekf_tuning(0.0, 0.0, 0.0, 1e3)):
        state = Auxiliary('', tuning, variance, wide).drive(lines, y).state
        theta = np.stack([state[end, 1:, k] for k, end in enumerate(ends)])
        ratio = over_bound(run, theta)[scored].mean()
        assert 0.65 < ratio < 1.45

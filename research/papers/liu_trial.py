# SPDX-License-Identifier: Apache-2.0
"""All experiments of Liu et al. 2018 on one seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from research.papers import coasts as data
from research.papers.liu_errata import Errata, errata
from research.papers.liu_streams import FAULTS, Prepared, Settling, prepared, settling, spoiled, tracked
from research.papers.liu_table1 import Batch, Shape, batch, shape
from trainid_ros.setup.pipelines import RESISTANCE

TRUTHS: Final = (('eq. (8)', data.PAPER), ('large a', data.LARGE_A))
PLANS: Final = (
    ('no gusts', data.CoastPlan()),
    ('gusts 0.3 N/kN', data.CoastPlan(gust_std=0.3)),
    ('gusts, map error 0.3 permille', data.CoastPlan(gust_std=0.3, grade_std=0.3)),
)
SETTLINGS: Final = tuple(
    (truth, single, penalty) for truth in (0, 1) for single in (False, True) for penalty in (0, 50)
)
"""Truth, one coast or 24, penalty."""
STREAMS: Final = ('RLS', 'MILS', 'V-MILS-printed')


@dataclass(frozen=True, slots=True)
class Trial:
    """Results of one seed.

    Attributes:
        errata: Errors of the equations.
        shape: Table 1 and 2.
        full: Batch estimators on the full record, by :data:`TRUTHS`.
        narrow: The same on four short coasts.
        prepared: Preparations, by :data:`PLANS`.
        settled: Convergence, by :data:`SETTLINGS`.
        spoiled: Errors with bad data over the bound, by fault and estimator.
        delays: Observations until a jump is followed.
        before: Curve errors before the jump [N/kN].
        nees: Squared error over covariance, per parameter, of the streaming estimators, by :data:`STREAMS`.

    """

    errata: Errata
    shape: Shape
    full: tuple[Batch, ...]
    narrow: tuple[Batch, ...]
    prepared: tuple[Prepared, ...]
    settled: tuple[Settling, ...]
    spoiled: tuple[tuple[float, ...], ...]
    delays: tuple[float, ...]
    before: tuple[float, ...]
    nees: tuple[float, ...]


def trial(seed: int) -> Trial:
    """Run all experiments on one seed."""
    delays, before = tracked(seed)
    return Trial(
        errata=errata(seed),
        shape=shape(seed),
        full=tuple(batch(seed, truth, narrow=False) for _, truth in TRUTHS),
        narrow=tuple(batch(seed, truth, narrow=True) for _, truth in TRUTHS),
        prepared=tuple(prepared(seed, plan) for _, plan in PLANS),
        settled=tuple(
            settling(seed, TRUTHS[truth][1], single=single, penalty=penalty) for truth, single, penalty in SETTLINGS
        ),
        spoiled=tuple(spoiled(seed, fault) for fault in FAULTS),
        delays=delays,
        before=before,
        nees=tuple(nees(seed, name) for name in STREAMS),
    )


def nees(seed: int, name: str) -> float:
    """Return the squared error of a streaming estimator over its covariance, per parameter, in gusts."""
    generator = np.random.default_rng(seed)
    coasts = data.drive(data.CoastPlan(gust_std=0.3), generator)
    estimator = RESISTANCE.make(RESISTANCE.choose(name), data.train_file(), generator)
    for sample in data.samples(coasts):
        estimator.step(sample)
    estimate, truth = estimator.estimate(15.0), data.in_si(data.PAPER)
    error = np.array([estimate.a - truth.a, estimate.b - truth.b, estimate.c - truth.c])
    P = np.array(estimate.covariance).reshape(3, 3)
    return float(error @ np.linalg.solve(P, error)) / 3.0

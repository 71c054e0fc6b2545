# SPDX-License-Identifier: Apache-2.0
"""What a bank of hypotheses would know after drives that have not been made: its recursion over planned runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.state import encode, restore
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.hypotheses import Bank, Mixture
from trainid_ros.resistance.planned_drive import STEP_S
from trainid_ros.resistance.speed_states import Interval

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from trainid_ros.resistance.hypotheses import Array
    from trainid_ros.resistance.planned_drive import Run, Step

# Step of the traction interpolation [s].
_SPACING_S: Final = 0.2


def usual_deviations(run: Run, times: int) -> Array:
    """Return innovations over their standard deviations, shape (2, times, steps): two sequences, one the other negated.

    How soon a step can be excluded that may just have happened depends on them.
    """
    one = np.random.default_rng(times).standard_normal((times, len(run.steps)))
    return np.stack([one, -one])


def foreseen_mixtures(
    now: Bank, run: Run, deviations: Array, first: int, slowest: float, variances: tuple[float, float]
) -> Iterator[Mixture]:
    """Yield the mixture after each of some runs from a stop.

    Args:
        now: The bank, which stays as it is.
        run: The run, driven once or more.
        deviations: Innovations over their standard deviations, shape (runs, steps).
        first: Index of the first step from which is learned, at least 1.
        slowest: Speed at which the train is taken to stop [m/s].
        variances: Variance of the speed at the end of a step [(m/s)^2], and that by which the force scale may change
            at a stop [1].
    """
    bank, (speed_variance, scale_variance) = Bank(now.plan), variances
    restore(bank, encode(now))
    for row in deviations.tolist():
        bank.inflate_force_scale_variance(scale_variance)
        bank.restart(run.steps[first - 1].speed, speed_variance)
        for step, deviation in zip(run.steps[first:], row[first:], strict=True):
            if not bank.simulate_step(_planned(step, speed_variance), deviation, slowest):
                break
        yield bank.mixture(bank.plan.young_weight)


def mean_covariance(mixtures: Sequence[Mixture]) -> vec[float]:
    """Return the mean of the covariances of mixtures, 15 numbers."""
    columns = zip(*(mixture.covariance for mixture in mixtures), strict=True)
    return vec[float](np.mean(list(columns), axis=1).tolist())


def _planned(step: Step, variance: float) -> Interval:
    """Return a planned step as an interval; ``variance`` is that of the speed at its end [(m/s)^2]."""
    T, change = step.traction, step.ramp * _SPACING_S
    return Interval(
        dt=STEP_S,
        traction=(T - change, T, T + change, T + 2.0 * change),
        track=0.0,
        curve=0.0,
        speed=step.speed,
        speed_variance=variance,
        spacing=_SPACING_S,
        force_interval=_SPACING_S,
    )

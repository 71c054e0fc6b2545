# SPDX-License-Identifier: Apache-2.0
"""The robust kernel of V-MILS on observations (v, y) with unknown noise, as in the tables of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.change_points import ChangePointConfig, Tracker, independent, robust_fit

if TYPE_CHECKING:
    from trainid_ros.resistance.change_points import Normal

# Prior standard deviation of the term of each parameter in w at 22 m/s [N/kN].
PRIOR_STD: Final = (2.0, 4.0, 4.0)
_FAST: Final = 22.0
PLAN: Final = ChangePointConfig(
    p=4,
    outliers=0.2,
    step_variances=(1.0, (0.2 / _FAST) ** 2, (0.5 / _FAST**2) ** 2),
    hazard=1.0 / 2000.0,
    spacing=10,
    hypotheses=5,
    min_age=60,
    lockout=120,
)
# Observations before the initial fit, and before a refit: in bursts most data of a short period may be bad.
_WARM_UP: Final = 100
_SECOND_LOOK: Final = 500
_MEMORY: Final = 0.01
_UNCERTAIN: Final = 0.1
_MAX_SCALED_SQUARE: Final = 9.0
_TINY: Final = 1e-8


class RobustStream:
    """Robust multi-innovation least squares with warm-up and estimated noise.

    Attributes:
        estimate: Mean and covariance of a, b, c [N/kN, v in m/s].

    """

    def __init__(self, prior_mean: tuple[float, float, float], plan: ChangePointConfig = PLAN) -> None:
        self._prior = independent(prior_mean, [(std / _FAST**i) ** 2 for i, std in enumerate(PRIOR_STD)])
        self._tracker = Tracker(self._prior, plan)
        self._rows: list[tuple[float, ...]] = []
        self._seen = 0
        self._variance = 0.0

    @property
    def estimate(self) -> Normal:
        """The estimate; the prior while warming up."""
        return self._tracker.estimate

    @property
    def steps_found(self) -> int:
        """Number of parameter steps detected."""
        return self._tracker.steps_found

    def update(self, v: float, y: float) -> None:
        """Process one observation, speed v [m/s] and resistance y [N/kN]."""
        self._seen += 1
        if self._seen <= _SECOND_LOOK:
            self._rows.append((1.0, v, v * v, y, _TINY, 1.0))
        if self._seen in (_WARM_UP, _SECOND_LOOK):
            self._refit()
        elif self._seen > _WARM_UP:
            self._learn(v, y)

    def _refit(self) -> None:
        """Start from a robust fit of all observations so far."""
        # The row variances are tiny, so the fit takes the scale from the residuals.
        fit = robust_fit(tuple(self._rows), self._prior)
        start = self._prior if fit is None else fit
        rows = np.array(self._rows)
        residuals = np.abs(rows[:, 3] - rows[:, :3] @ start.theta)
        # One-sided errors raise the median; the variance is rather set too small, since it is updated later.
        self._variance = max((1.2 * float(np.median(residuals))) ** 2, _TINY)
        if fit is not None:
            self._tracker.begin(fit)
        if self._seen == _SECOND_LOOK:
            self._rows.clear()

    def _learn(self, v: float, y: float) -> None:
        phi = vec[float]([1.0, v, v * v])
        expected, variance = self._tracker.estimate.predict(phi)
        nu = y - expected
        weight = self._tracker.update(phi, y, self._variance)
        if self._tracker.change_probability < _UNCERTAIN:
            S = variance + self._variance
            known = self._variance / S
            self._variance += _MEMORY * weight * known * (min(nu * nu / S, _MAX_SCALED_SQUARE) - 1.0) * self._variance

# SPDX-License-Identifier: Apache-2.0
"""The robust kernel of V-MILS on plain observations (v, y) whose noise nobody knows, as in the tables of the paper."""

from __future__ import annotations

from typing import Final

import numpy as np

from trainid_ros.estimators.resistance.robust import Belief, predict
from trainid_ros.estimators.resistance.robust_fit import robust_fit
from trainid_ros.estimators.resistance.run_lengths import RunLengths, Tracker

# Deviation of w from what is believed of each parameter, at 22 m/s [N/kN].
PRIOR_STD: Final = (2.0, 4.0, 4.0)
_FAST: Final = 22.0
PLAN: Final = RunLengths(
    p=4,
    outliers=0.2,
    step_variances=(1.0, (0.2 / _FAST) ** 2, (0.5 / _FAST**2) ** 2),
    hazard=1.0 / 2000.0,
    spacing=10,
    watchers=5,
    patience=60,
    lockout=120,
)
# A first belief, and another look at all so far: in bursts most of a short stretch may be bad.
_WARM_UP: Final = 100
_SECOND_LOOK: Final = 500
_MEMORY: Final = 0.01
_DOUBTFUL: Final = 0.1
_MOST: Final = 9.0
_TINY: Final = 1e-8


class RobustStream:
    """Robust multi-innovation least squares with warm-up and learned noise.

    Attributes:
        belief: a, b, c (v in m/s) and the upper triangle of their covariance.

    """

    def __init__(self, believed: tuple[float, float, float], plan: RunLengths = PLAN) -> None:
        variances = ((std / _FAST**i) ** 2 for i, std in enumerate(PRIOR_STD))
        A, D, F = variances
        self._prior: Belief = (*believed, A, 0.0, 0.0, D, 0.0, F)
        self._tracker = Tracker(self._prior, plan)
        self._rows: list[tuple[float, ...]] = []
        self._seen = 0
        self._variance = 0.0

    @property
    def belief(self) -> Belief:
        """What is believed; the prior while warming up."""
        return self._tracker.belief

    @property
    def steps_found(self) -> int:
        """How often the parameters were found to have stepped."""
        return self._tracker.steps_found

    def update(self, v: float, y: float) -> None:
        """Take one observation in."""
        self._seen += 1
        if self._seen <= _SECOND_LOOK:
            self._rows.append((v, v * v, y, _TINY, 1.0))
        if self._seen in (_WARM_UP, _SECOND_LOOK):
            self._look()
        elif self._seen > _WARM_UP:
            self._learn(v, y)

    def _look(self) -> None:
        """Begin from what most observations so far agree on."""
        # Variances so small that the fit takes the scale from the residuals.
        fit = robust_fit(tuple(self._rows), self._prior)
        start = self._prior if fit is None else fit
        residuals = [abs(y - predict(start, v, s)[0]) for v, s, y, _, _ in self._rows]
        # The median of one-sided errors lies higher than that of noise: rather too small, since it is learned.
        self._variance = max((1.2 * float(np.median(residuals))) ** 2, _TINY)
        if fit is not None:
            self._tracker.begin(fit)
        if self._seen == _SECOND_LOOK:
            self._rows.clear()

    def _learn(self, v: float, y: float) -> None:
        expected, doubt = predict(self._tracker.belief, v, v * v)
        nu = y - expected
        weight = self._tracker.update(v, v * v, y, self._variance)
        if self._tracker.change_probability < _DOUBTFUL:
            S = doubt + self._variance
            known = self._variance / S
            self._variance += _MEMORY * weight * known * (min(nu * nu / S, _MOST) - 1.0) * self._variance

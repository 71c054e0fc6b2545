# SPDX-License-Identifier: Apache-2.0
"""Statistics of residuals: noise variance, autocorrelation and outliers.

The P of Liu et al. 2018 is a covariance only after multiplication by the noise variance, which the paper never
estimates, and only for white noise; with overlapping windows and gusts the noise is correlated.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Final

_LAGS: Final = 8
_MEMORY: Final = 51
# Weight of the declared noise, in observations.
_DECLARED: Final = 4
# Ratio of the standard deviation to the median absolute deviation of a Gaussian.
_MAD: Final = 1.4826


@dataclass(frozen=True, slots=True)
class Residuals:
    """Sums over the residuals so far.

    Attributes:
        count: Number of residuals.
        squares: Sum of their squares [(N/kN)^2].
        products: Sums of products of residuals at lags 1, 2, ... [(N/kN)^2].
        last: Latest residuals, oldest first [N/kN].
        recent: Latest innovations, including those of bad observations, used by :meth:`is_outlier` [N/kN].

    """

    count: int = 0
    squares: float = 0.0
    products: tuple[float, ...] = (0.0,) * _LAGS
    last: tuple[float, ...] = ()
    recent: tuple[float, ...] = ()

    def add(self, residual: float) -> Residuals:
        """Return the sums after one more residual of a good observation [N/kN]."""
        products = list(self.products)
        for lag, earlier in enumerate(reversed(self.last)):
            products[lag] += residual * earlier
        return Residuals(
            self.count + 1,
            self.squares + residual * residual,
            tuple(products),
            (*self.last, residual)[-_LAGS:],
            self.recent,
        )

    def remember(self, innovation: float) -> Residuals:
        """Return the statistics after one more innovation [N/kN] for :meth:`is_outlier`; the sums do not change."""
        return Residuals(self.count, self.squares, self.products, self.last, (*self.recent, innovation)[-_MEMORY:])

    def is_outlier(self, innovation: float, gate: float) -> bool:
        """Return whether an innovation [N/kN] lies more than ``gate`` robust standard deviations from the median."""
        if len(self.recent) < _MEMORY:
            return False
        middle = statistics.median(self.recent)
        spread = _MAD * statistics.median(abs(value - middle) for value in self.recent)
        return abs(innovation - middle) > gate * spread

    def variance(self, declared_std: float) -> float:
        """Return the variance of one observation [(N/kN)^2]; the declared std [N/kN] counts as a few residuals."""
        return (_DECLARED * declared_std**2 + self.squares) / (_DECLARED + self.count)

    def long_run_variance(self, declared_std: float) -> float:
        """Return the long-run variance per observation [(N/kN)^2] (Newey and West 1987); declared std in N/kN."""
        if self.squares <= 0.0:
            return self.variance(declared_std)
        taper = (1.0 - lag / (_LAGS + 1) for lag in range(1, _LAGS + 1))
        factor = 1.0 + 2.0 * math.fsum(w * p for w, p in zip(taper, self.products, strict=True)) / self.squares
        # The tapered sum is never negative; near zero it would be overconfident for a finite record.
        return self.variance(declared_std) * max(factor, 0.1)

# SPDX-License-Identifier: Apache-2.0
"""Check of the brake rate over speed against the train file.

While a brake holds its level, its specific force is, with the rate r(v) of the train file and the lagged command z,

    y = x (f + e p + h q),    x = r(v) z,    p = min(v / v_max, 1) - 1/2,    q = p^2 - 1/12.

f differs from braking to braking; e and h are zero where the train file is right. They follow from each braking by
least squares, with f eliminated, and from all brakings by their weighted mean, which forgets. What is judged is the
largest change of e p + h q between two speeds of the last braking.

Estimators learn small changes by themselves, but take large ones for changes of the brake from one moment to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

# Smallest change that contradicts the train file [1]: the estimator learns half of it, see `slope_std`.
_MIN_CHANGE: Final = 0.15
# Smallest change in standard deviations that does [1].
_KNOWN: Final = 4.0
# A contradiction ends below this share of the smallest change [1].
_ENDS: Final = 0.75
# A braking over a smaller range of p says nothing of a change over speed [1].
_NARROW: Final = 0.2
# Smallest number of blocks of a braking that are compared.
_MIN_BLOCKS: Final = 8
# Smallest standard deviation of their residuals [N/kN].
_RESIDUAL: Final = 2.0
# Standard deviation from braking to braking of e, and of h, by fade, changes of the brake and gradients [1].
_SCATTER_E: Final = 0.1
_SCATTER_H: Final = 0.3
# Standard deviations of e and h before the first braking: they may be anything [1].
_PRIOR_E: Final = 2.0
_PRIOR_H: Final = 6.0
# Share of the information that is kept at each further braking: about ten of them count.
_KEPT: Final = 0.9
_MEAN_Q: Final = 1.0 / 12.0


@dataclass(slots=True)
class ShapeSums:
    """Sums over the blocks of one braking during which the brake held its level."""

    count: float = 0.0  # Number of blocks
    yy: float = 0.0  # Sum of y^2 [(N/kN)^2]
    products: tuple[float, ...] = (0.0,) * 3  # Sums of y x, y x p and y x q [(N/kN)^2]
    moments: tuple[float, ...] = (0.0,) * 6  # Sums of x^2 times 1, p, q, p^2, p q and q^2 [(N/kN)^2]
    slowest: float = 0.5  # Smallest p
    fastest: float = -0.5  # Largest p

    def add(self, y: float, x: float, p: float) -> None:
        """Add a block with force and nominal force [N/kN]."""
        q = p * p - _MEAN_Q
        yx, xx, x2 = self.products, self.moments, x * x
        self.count += 1.0
        self.yy += y * y
        self.products = (yx[0] + y * x, yx[1] + y * x * p, yx[2] + y * x * q)
        self.moments = (
            xx[0] + x2, xx[1] + x2 * p, xx[2] + x2 * q, xx[3] + x2 * p * p, xx[4] + x2 * p * q, xx[5] + x2 * q * q
        )  # fmt: skip
        self.slowest, self.fastest = min(self.slowest, p), max(self.fastest, p)

    def information(self) -> ShapeInformation:
        """Return what this braking says of e and h, scatter from braking to braking included; nothing if too short."""
        if self.count < _MIN_BLOCKS or not self.moments[0] > 0.0:
            return ShapeInformation()
        (y0, y1, y2), (x0, x1, x2, x11, x12, x22) = self.products, self.moments
        # Without f (Schur complement): M (e, h)' = r
        m11, m12, m22 = x11 - x1 * x1 / x0, x12 - x1 * x2 / x0, x22 - x2 * x2 / x0
        r1, r2 = y1 - x1 * y0 / x0, y2 - x2 * y0 / x0
        det = m11 * m22 - m12 * m12
        explained = (m22 * r1 * r1 - 2.0 * m12 * r1 * r2 + m11 * r2 * r2) / det if det > 0.0 else 0.0
        variance = max((self.yy - y0 * y0 / x0 - explained) / (self.count - 3.0), _RESIDUAL * _RESIDUAL)
        m11, m12, m22, r1, r2 = m11 / variance, m12 / variance, m22 / variance, r1 / variance, r2 / variance
        # I = (M^-1 + S)^-1 = (1 + M S)^-1 M with the scatter S; its vector is (1 + M S)^-1 r.
        s1, s2 = _SCATTER_E * _SCATTER_E, _SCATTER_H * _SCATTER_H
        k11, k12, k21, k22 = 1.0 + m11 * s1, m12 * s2, m12 * s1, 1.0 + m22 * s2
        scale = k11 * k22 - k12 * k21
        return ShapeInformation(
            (k22 * m11 - k12 * m12) / scale,
            (k22 * m12 - k12 * m22) / scale,
            (k11 * m22 - k21 * m12) / scale,
            (k22 * r1 - k12 * r2) / scale,
            (k11 * r2 - k21 * r1) / scale,
        )


@dataclass(slots=True)
class ShapeInformation:
    """Information matrix of (e, h), and its product with them [1]; none by default."""

    ee: float = 0.0
    eh: float = 0.0
    hh: float = 0.0
    e: float = 0.0
    h: float = 0.0

    def add(self, other: ShapeInformation, kept: float) -> None:
        """Add the information of a further braking, after forgetting a share of that of the brakings before."""
        self.ee = kept * self.ee + other.ee
        self.eh = kept * self.eh + other.eh
        self.hh = kept * self.hh + other.hh
        self.e = kept * self.e + other.e
        self.h = kept * self.h + other.h

    def change(self, slowest: float, fastest: float) -> ShapeChange:
        """Return the largest change of e p + h q between two values of p in a range."""
        ee, hh = self.ee + 1.0 / (_PRIOR_E * _PRIOR_E), self.hh + 1.0 / (_PRIOR_H * _PRIOR_H)
        det = ee * hh - self.eh * self.eh
        e, h = (hh * self.e - self.eh * self.h) / det, (ee * self.h - self.eh * self.e) / det
        least = most = slowest
        places = [slowest, fastest]
        if h != 0.0 and slowest < -0.5 * e / h < fastest:
            places.append(-0.5 * e / h)
        for p in places:
            if (e + h * p) * p < (e + h * least) * least:
                least = p
            if (e + h * p) * p > (e + h * most) * most:
                most = p
        dp, dq = most - least, most * most - least * least
        variance = (hh * dp * dp - 2.0 * self.eh * dp * dq + ee * dq * dq) / det
        return ShapeChange(least, most, e * dp + h * dq, math.sqrt(max(0.0, variance)))


@dataclass(slots=True)
class ShapeChange:
    """Largest change of the brake rate against the train file."""

    least: float = 0.0  # p where the rate is lowest against the train file
    most: float = 0.0  # p where it is highest
    size: float = 0.0  # The change [1]
    std: float = 0.0  # Its standard deviation [1]

    @property
    def contradicts(self) -> bool:
        """True if the change is larger than errors of train files are."""
        return self.size > max(_MIN_CHANGE, _KNOWN * self.std)


@dataclass(slots=True)
class BrakeShapeCheck:
    """Change of the brake rate over speed against the train file."""

    known: ShapeInformation = field(default_factory=ShapeInformation)  # What all brakings say
    slowest: float = 0.0  # Smallest p of the last braking over a range of speeds
    fastest: float = 0.0  # Largest p of it
    found: ShapeChange = field(default_factory=ShapeChange)  # The last change that contradicts the train file
    is_wrong: bool = False  # Whether the brakings contradict it
    is_odd: bool = False  # Whether the braking that is observed does
    sums: ShapeSums = field(default_factory=ShapeSums)  # The braking that is observed

    def warning(self, max_speed: float) -> str:
        """Return what is wrong with the brake rate over speed, empty if nothing is."""
        if not self.is_wrong:
            return ''
        change = self.found
        low, high = (max_speed * (0.5 + p) for p in sorted((change.least, change.most)))
        sense = 'rises' if change.most > change.least else 'falls'
        return (
            f'from {low:.0f} to {high:.0f} m/s the brake rate {sense} by about {change.size:.2f} against brake.rate of '
            'the train file: it needs another table over speed, see trainid fit --brake'
        )

    def add(self, y: float, x: float, p: float) -> None:
        """Add a block of a braking, with force and nominal force [N/kN]; judge what there is of it."""
        sums = self.sums
        sums.add(y, x, p)
        self.is_odd = sums.count >= _MIN_BLOCKS and sums.information().change(sums.slowest, sums.fastest).contradicts

    def end(self) -> None:
        """End the braking, if there is one, and learn from it."""
        sums = self.sums
        if sums.count == 0.0:
            return
        self.sums, self.is_odd = ShapeSums(), False
        if sums.count < _MIN_BLOCKS:
            return
        self.known.add(sums.information(), _KEPT)
        if sums.fastest - sums.slowest > _NARROW:
            self.slowest, self.fastest = sums.slowest, sums.fastest
        change = self.known.change(self.slowest, self.fastest)
        if change.contradicts:
            self.found = change
        self.is_wrong = change.contradicts or (self.is_wrong and change.size > _ENDS * _MIN_CHANGE)

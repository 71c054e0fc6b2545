# SPDX-License-Identifier: Apache-2.0
"""Steps of the acceleration against earlier and later steps of the traction: which of them is late."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

MAX_SHIFT: Final = 6
"""Shifts are tried up to this many blocks."""
# Smallest step of x, and sum of squared steps, that show a shift [N/kN].
_SHIFTS: Final = 2 * MAX_SHIFT + 1
_EDGE: Final = 6.0
_EDGES: Final = 2000.0
_SHIFT_KEPT: Final = 0.998
# Standard deviations by which a shift must stand out from chance, and from no shift.
_SHIFT_KNOWN: Final = 5.0
_SHIFT_BETTER: Final = 3.0


@dataclass(slots=True)
class ShiftCheck:
    """Steps of the acceleration against earlier and later steps of the traction: which of them is late.

    Attributes:
        finding: What is wrong, empty if nothing is.
        delay: How much later the acceleration is than the traction by it [s].
        edges: Sum of squared steps of the traction [(N/kN)^2].
        jerks: Sum of squared steps of the acceleration, as a specific force [(N/kN)^2].
        count: Number of steps, with forgetting.
        products: Sums of products of both, the acceleration -6 to 6 blocks later [(N/kN)^2].
        recent: Acceleration and traction of the last blocks, in turn, oldest first [N/kN].

    """

    finding: str = ''
    delay: float = 0.0
    edges: float = 0.0
    jerks: float = 0.0
    count: float = 0.0
    products: tuple[float, ...] = (0.0,) * _SHIFTS
    recent: tuple[float, ...] = ()

    @property
    def is_valid(self) -> bool:
        """True if products and blocks have possible numbers."""
        return len(self.products) == _SHIFTS and len(self.recent) % 2 == 0 and len(self.recent) <= 2 * (MAX_SHIFT + 2)

    @property
    def is_suspected(self) -> bool:
        """True where a delay was found before the check began anew, and no steps have contradicted it since."""
        return self.delay != 0.0 and self.finding == ''

    def interrupt(self) -> None:
        """Start a new run of blocks."""
        self.recent = ()

    def add(self, y: float, x: float, block_s: float) -> None:
        """Add the next block: acceleration y and traction x [N/kN], and its length [s]."""
        run = (*self.recent, y, x)[-2 * (MAX_SHIFT + 2) :]
        self.recent = run
        if len(run) < 2 * (MAX_SHIFT + 2):
            return
        dy, dx = run[-2] - run[-4], run[-1] - run[-3]
        edge = abs(dx) > _EDGE
        products = [_SHIFT_KEPT * product for product in self.products]
        for k in range(MAX_SHIFT + 1):
            end = len(run) - 2 * k
            earlier_dy, earlier_dx = run[end - 2] - run[end - 4], run[end - 1] - run[end - 3]
            if abs(earlier_dx) > _EDGE:
                products[MAX_SHIFT + k] += dy * earlier_dx
            if k and edge:
                products[MAX_SHIFT - k] += earlier_dy * dx
        self.products = tuple(products)
        self.edges = _SHIFT_KEPT * self.edges + (dx * dx if edge else 0.0)
        self.jerks = _SHIFT_KEPT * self.jerks + dy * dy
        self.count = _SHIFT_KEPT * self.count + 1.0
        if self.edges >= _EDGES:
            self._judge(block_s)

    @property
    def best(self) -> int:
        """Place of the largest product."""
        best = 0
        for k in range(_SHIFTS):
            if self.products[k] > self.products[best]:
                best = k
        return best

    def _judge(self, block_s: float) -> None:
        chance, best = math.sqrt(self.jerks / self.count * self.edges), self.best
        if self.products[best] < max(_SHIFT_KNOWN * chance, 0.5 * self.edges):
            return
        if self.products[best] - self.products[MAX_SHIFT] < _SHIFT_BETTER * chance:
            self.finding, self.delay = '', 0.0
            return
        self.delay = (best - MAX_SHIFT) * block_s
        later, sooner = ('ato/speed', 'ato/force') if best > MAX_SHIFT else ('ato/force', 'ato/speed')
        self.finding = f'{later} is about {abs(self.delay):.1f} s late, or {sooner} early'

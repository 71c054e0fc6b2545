# SPDX-License-Identifier: Apache-2.0
"""Variables that a missing force may depend on if no effect of the library is its cause.

The missing resistance is ``f(x) m``. x is a variable such as the speed; m is one, a mode of driving, or the force of
traction or brake, of which f is then a share. f is linear between knots, few of them in the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.dataset import BRAKING, PULLING, Array
from trainid_ros.train.forces import davis

if TYPE_CHECKING:
    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.model import Model

_KNOTS: Final = 32  # Knots of a curve
_PLACES_M: Final = 50.0  # Distance of knots along the line [m]: waves of 200 m are resolved
_MOST_KNOTS: Final = 160  # Most knots along the line, to bound the time
_COARSE, _FINER = 4, 7  # Knots in the search, at quantiles; the latter over speeds and times, which vary all the time
_MOST_COARSE: Final = 60  # Most knots in the search over places and runs
_USUAL_FORCE: Final = 30.0  # Force of which the missing one may be a share [N/kN]
_SIZES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)  # Prior std of a curve [N/kN, or over _USUAL_FORCE]
_LENGTHS: Final = (0.03, 0.1, 0.3, 1.0)  # Correlation length of a curve as a share of the range of x [1]
OF_CURVES: Final = frozenset({'brake-time', 'release', 'traction-place'})
"""Variables of curves alone: effects of the library depend on them, or they have many knots."""
_LONGEST_S: Final = 120.0  # Time beyond which nothing depends on it any more [s]


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable that the missing force may depend on, with its values at n stages; x and m of the module."""

    name: str
    text: str  # What it is, as text
    unit: str  # Unit of x
    x: Array  # Shape (n,)
    source: str = ''  # x as an expression of a TrackPoint ``at``; empty if that does not know it
    factor: Array | float = 1.0  # m, shape (n,) [1 or N/kN]
    factor_source: str = '1.0'  # m in the same way
    of: str = ''  # Force of which f is a share; empty if f is in N/kN

    @property
    def weight(self) -> Array:
        """Values of m, shape (n,)."""
        return np.asarray(self.factor * np.ones(self.x.size))

    @property
    def has_level(self) -> bool:
        """Whether a constant f differs from Davis a."""
        return bool(np.ptp(self.weight))

    @property
    def knots(self) -> Array:
        """Knots over the range of x where m is not zero, shape (k,); none if x does not vary."""
        seen = self.x[self.weight != 0.0]
        if seen.size == 0 or np.ptp(seen) == 0.0:
            return np.zeros(0)
        low, high = float(seen.min()), float(seen.max())
        if not self.unit:  # runs
            return np.arange(low, high + 1.0)
        count = min(max(int((high - low) / _PLACES_M), _KNOTS), _MOST_KNOTS) if self.unit == 'm' else _KNOTS
        return np.linspace(low, high, count)

    def coarse(self) -> Array:
        """Return the resistance of few coefficients of x [N/kN], shape (n, k); shares are of the usual force."""
        if self.unit in {'', 'm'}:
            knots = self.knots[:: max(2 if self.unit else 1, math.ceil(self.knots.size / _MOST_COARSE))]
        else:
            count = _FINER if self.unit in {'m/s', 's'} else _COARSE
            knots = np.unique(np.quantile(self.x[self.weight != 0.0], np.linspace(0.0, 1.0, count)))
        shares = hats(self.x, knots)
        if self.of:  # a gain of the force is an effect
            size = np.abs(self.weight) / _USUAL_FORCE
            shares = (shares - size @ shares / size.sum()) / _USUAL_FORCE
        return shares * self.weight[:, None]

    def hats(self, knots: Array) -> Array:
        """Return the resistance of each coefficient of a curve with these knots [N/kN], shape (n, k)."""
        return hats(self.x, knots) * self.weight[:, None]

    def roots(self, knots: Array) -> Iterator[Array]:
        """Yield L with L L' a prior covariance of the curve at its knots, shape (k, k); runs are independent."""
        scale = 1.0 / _USUAL_FORCE if self.of else 1.0
        apart = np.abs(knots[:, None] - knots[None, :]) / (knots[-1] - knots[0])
        for length in _LENGTHS if self.unit else (1e-6,):
            r = math.sqrt(3.0) * apart / length  # Matern covariance of order 3/2: a curve with kinks
            root = np.linalg.cholesky((1.0 + r) * np.exp(-r) + 1e-6 * np.eye(knots.size))
            yield from (size * scale * root for size in _SIZES)


def variables(model: Model) -> tuple[Variable, ...]:
    """Return all variables that vary on the dataset of a model, with their values."""
    d, length = model.dataset, model.train_file.train.length
    v, way = d.speed, d.direction.astype(float)
    pull, brake, gradient, radius = map(d.joined, ('traction', 'brake', 'gradient', 'radius'))
    pulls, brakes = (pull > PULLING).astype(float), (brake < BRAKING).astype(float)
    acceleration = (pull + brake - gradient - davis(model.train_file.resistance, v)) / d.inertia
    curvature = np.where(radius > 0.0, 1.0 / np.maximum(radius, 1.0), 0.0)
    times = (d.time - d.time[d.starts][d.run_of], _time_since(brakes, d), d.joined('since_release'))
    departed, applied, released = (np.minimum(time, _LONGEST_S) for time in times)
    front, middle = d.joined('position') - 0.5 * way * d.dt * v, 'at.position - 0.5 * at.direction * at.length'
    bend = '(1.0 / at.curve_radius if at.curve_radius > 0.0 else 0.0)'
    # m, and m as an expression; of a share its force too.
    traction, braking = (pull, 'at.traction', 'the traction'), (brake, 'at.brake', 'the brake force')
    coasts = (1 - pulls) * (1 - brakes), f'({BRAKING} <= at.brake and at.traction <= {PULLING})'
    released_for, releases = f'min(at.since_release, {_LONGEST_S})', (1 - brakes, f'(at.brake >= {BRAKING})')
    rising, falling = (
        (pulls * (sign * way > 0), f'(at.traction > {PULLING} and at.direction == {sign})') for sign in (1, -1)
    )
    towards = 'the speed under traction towards {} positions'
    found = (
        Variable('place', 'the place', 'm', front - 0.5 * way * length, middle),
        Variable('place', 'the place', 'm', front, 'at.position'),
        Variable('traction-place', 'the place under traction', 'm', front, 'at.position', *traction),
        Variable('traction-rising', towards.format('rising'), 'm/s', v, 'at.speed', *rising),
        Variable('traction-falling', towards.format('falling'), 'm/s', v, 'at.speed', *falling),
        Variable('run', 'the run', '', d.run_of.astype(float)),
        Variable('time', 'the time', 's', d.time - 0.5 * d.dt, 'at.time_s'),
        Variable('start', 'the time since departure', 's', departed),
        Variable('speed', 'the speed', 'm/s', v, 'at.speed'),
        Variable('traction-speed', 'the speed under traction', 'm/s', v, 'at.speed', *traction),
        Variable('coast-speed', 'the speed while coasting', 'm/s', v, 'at.speed', *coasts),
        Variable('traction', 'the tractive force', 'N/kN', pull, 'at.traction', pulls, f'(at.traction > {PULLING})'),
        Variable('brake-speed', 'the speed while braking', 'm/s', v, 'at.speed', *braking),
        Variable('brake', 'the braking force', 'N/kN', brake, 'at.brake', brakes, f'(at.brake < {BRAKING})'),
        Variable('brake-heat', 'the heat of the brake', 'J/kg', d.joined('heat'), 'at.heat', *braking),
        Variable('brake-time', 'the time since the brake was applied', 's', applied, '', *braking),
        Variable('release', 'the time since the brake was released', 's', released, released_for, *releases),
        Variable('direction', 'the direction', 'm/s', v, 'at.speed', way, 'at.direction'),
        Variable('inertia', 'the acceleration', 'm/s²', acceleration, 'at.acceleration'),
        Variable('tunnel', 'the speed in tunnels', 'm/s', v, 'at.speed', d.joined('tunnel'), 'at.tunnel'),
        Variable('curve', 'the curvature', '1/m', curvature, bend),
        Variable('curve-speed', 'the lateral acceleration', 'm/s²', curvature * v * v, f'at.speed**2 * {bend}'),
        Variable('gradient', 'the gradient', 'per mille', gradient, 'at.gradient_ahead(0.0)'),
    )
    of_one_way = set() if np.ptp(way) else {'traction-rising', 'traction-falling', 'direction'}
    known = (v for v in found if (d.positioned or v.unit != 'm') and v.name not in of_one_way)
    return tuple(v for v in known if v.knots.size)


def _time_since(on: Array, dataset: Dataset) -> Array:
    """Return the driving time since a flag has become one [s], shape (n,); 0 where it is zero."""
    total = np.cumsum(dataset.dt)
    begun = np.maximum.accumulate(np.where(np.diff(on, prepend=0.0) > 0.0, total - dataset.dt, 0.0))
    return np.where(on > 0.0, total - begun, 0.0)


def hats(x: Array, knots: Array) -> Array:
    """Return functions linear between knots (k,), each one at one of them, constant beyond, shape (n, k)."""
    return np.stack([np.interp(x, knots, values) for values in np.eye(knots.size)], axis=1)

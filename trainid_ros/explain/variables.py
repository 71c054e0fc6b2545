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
    factor: Array | float = 1.0  # m, shape (n,) [1 or N/kN]
    source: str = ''  # x as an expression of a TrackPoint ``at``; empty if that does not know it
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


_MIDDLE: Final = 'at.position - 0.5 * at.direction * at.length'
_CURVATURE: Final = '(1.0 / at.curve_radius if at.curve_radius > 0.0 else 0.0)'
_LATERAL: Final = f'at.speed**2 * {_CURVATURE}'
_RELEASED: Final = f'min(at.since_release, {_LONGEST_S})'
_RELEASES: Final = f'(at.brake >= {BRAKING})'
_TRACTION: Final = ('at.traction', 'the traction')
_BRAKE: Final = ('at.brake', 'the brake force')
_COASTS: Final = f'({BRAKING} <= at.brake and at.traction <= {PULLING})'
_OF_ONE_WAY: Final = ('traction-rising', 'traction-falling', 'direction')  # No others in runs of one direction
_ONE_WAY: Final = f'(at.traction > {PULLING} and at.direction == %d)'


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
    front, one_way = d.joined('position') - 0.5 * way * d.dt * v, 'the speed under traction towards {} positions'
    found = (
        Variable('place', 'the place', 'm', front - 0.5 * way * length, source=_MIDDLE),
        Variable('place', 'the place', 'm', front, source='at.position'),
        Variable('traction-place', 'the place under traction', 'm', front, pull, 'at.position', *_TRACTION),
        Variable('traction-rising', one_way.format('rising'), 'm/s', v, pulls * (way > 0), 'at.speed', _ONE_WAY % 1),
        Variable('traction-falling', one_way.format('falling'), 'm/s', v, pulls * (way < 0), 'at.speed', _ONE_WAY % -1),
        Variable('run', 'the run', '', d.run_of.astype(float)),
        Variable('time', 'the time', 's', d.time - 0.5 * d.dt, source='at.time_s'),
        Variable('start', 'the time since departure', 's', departed),
        Variable('speed', 'the speed', 'm/s', v, source='at.speed'),
        Variable('traction-speed', 'the speed under traction', 'm/s', v, pull, 'at.speed', *_TRACTION),
        Variable('coast-speed', 'the speed while coasting', 'm/s', v, (1 - pulls) * (1 - brakes), 'at.speed', _COASTS),
        Variable('traction', 'the tractive force', 'N/kN', pull, pulls, 'at.traction', f'(at.traction > {PULLING})'),
        Variable('brake-speed', 'the speed while braking', 'm/s', v, brake, 'at.speed', *_BRAKE),
        Variable('brake', 'the braking force', 'N/kN', brake, brakes, 'at.brake', f'(at.brake < {BRAKING})'),
        Variable('brake-heat', 'the heat of the brake', 'J/kg', d.joined('heat'), brake, 'at.heat', *_BRAKE),
        Variable('brake-time', 'the time since the brake was applied', 's', applied, brake, '', *_BRAKE),
        Variable('release', 'the time since the brake was released', 's', released, 1 - brakes, _RELEASED, _RELEASES),
        Variable('direction', 'the direction', 'm/s', v, way, 'at.speed', 'at.direction'),
        Variable('inertia', 'the acceleration', 'm/s²', acceleration, source='at.acceleration'),
        Variable('tunnel', 'the speed in tunnels', 'm/s', v, d.joined('tunnel'), 'at.speed', 'at.tunnel'),
        Variable('curve', 'the curvature', '1/m', curvature, source=_CURVATURE),
        Variable('curve-speed', 'the lateral acceleration', 'm/s²', curvature * v * v, source=_LATERAL),
        Variable('gradient', 'the gradient', 'per mille', gradient, source='at.gradient_ahead(0.0)'),
    )
    both_ways = bool(np.ptp(way))
    known = (v for v in found if (d.positioned or v.unit != 'm') and (both_ways or v.name not in _OF_ONE_WAY))
    return tuple(v for v in known if v.knots.size)


def _time_since(on: Array, dataset: Dataset) -> Array:
    """Return the driving time since a flag has become one [s], shape (n,); 0 where it is zero."""
    total = np.cumsum(dataset.dt)
    begun = np.maximum.accumulate(np.where(np.diff(on, prepend=0.0) > 0.0, total - dataset.dt, 0.0))
    return np.where(on > 0.0, total - begun, 0.0)


def hats(x: Array, knots: Array) -> Array:
    """Return functions linear between knots (k,), each one at one of them, constant beyond, shape (n, k)."""
    return np.stack([np.interp(x, knots, values) for values in np.eye(knots.size)], axis=1)

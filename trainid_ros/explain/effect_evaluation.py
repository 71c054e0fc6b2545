# SPDX-License-Identifier: Apache-2.0
"""Evaluate effects along the runs, with the functions that the simulator and the live estimators use."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.errors import InputError
from trainid_ros.train.davis import davis
from trainid_ros.train.effects import EFFECTS, TrackPoint

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.run_data import Run
    from trainid_ros.train.train_file import Davis, Effect, TrainFile

    Array = NDArray[np.float64]

_DAVIS_STEPS: Final = (0.1, 0.01, 0.0002)
_PROBES: Final = 60
"""Points used to test whether an effect depends on a, b, c."""
_CACHE_SIZE: Final = 400
"""Resistances kept in the cache, to bound the memory."""


class EffectEvaluator:
    """Resistances of effects at all stages of a dataset.

    Attributes:
        dataset: The dataset.
        davis: Davis parameters a, b, c of the train file.

    """

    def __init__(self, dataset: Dataset, train_file: TrainFile) -> None:
        self.dataset, self.davis = dataset, train_file.resistance
        self._cache: dict[tuple[str, tuple[tuple[str, float], ...], Davis], Array] = {}
        length = train_file.train.length
        self._points: list[TrackPoint] = []
        for run, start in zip(dataset.runs, dataset.starts.tolist(), strict=True):
            speed = dataset.speed[start : start + run.time.size]
            self._points += _points_of(run, speed, length, dataset.inertia, self.davis)

    def resistance(self, name: str, parameters: Mapping[str, float], davis: Davis | None = None) -> Array:
        """Return the resistance of an effect on each stage [N/kN], shape (n,).

        Args:
            name: The effect.
            parameters: Its parameters.
            davis: Davis parameters, where they differ from the train file: headwind and tunnel act through c.

        Raises:
            InputError: The resistance is not finite or cannot be calculated.

        """
        key = name, tuple(parameters.items()), davis or self.davis
        if key not in self._cache:
            if len(self._cache) >= _CACHE_SIZE:
                self._cache.clear()
            self._cache[key] = self._evaluate(name, parameters, davis or self.davis)
        return self._cache[key]

    def _evaluate(self, name: str, parameters: Mapping[str, float], davis: Davis) -> Array:
        function = EFFECTS[name].resistance
        if function is None:
            return np.zeros(len(self._points))
        try:
            values = np.array([function(parameters, davis, point) for point in self._points], dtype=float)
        except (ArithmeticError, ValueError, TypeError, LookupError, AttributeError) as error:
            msg = f'effect {name}: its resistance cannot be calculated for {_formatted(parameters)}: {error}'
            raise InputError(msg) from error
        if not np.isfinite(values).all():
            msg = f'effect {name}: its resistance is not finite for {_formatted(parameters)}'
            raise InputError(msg)
        return values

    def by_davis(self, name: str, parameters: Mapping[str, float], davis: Davis) -> Array | None:
        """Return the derivative of an effect's resistance by a, b, c, shape (n, 3); None if independent of them."""
        function = EFFECTS[name].resistance
        some = self._points[:: max(1, len(self._points) // _PROBES)]
        changed = [
            replace(davis, **{key: getattr(davis, key) + step}) for key, step in zip('abc', _DAVIS_STEPS, strict=True)
        ]
        if function is None or all(
            function(parameters, other, point) == function(parameters, davis, point)
            for other in changed
            for point in some
        ):
            return None
        here = self.resistance(name, parameters, davis)
        rows = zip(changed, _DAVIS_STEPS, strict=True)
        return np.stack([(self.resistance(name, parameters, other) - here) / step for other, step in rows], axis=1)

    def total(self, effects: Sequence[Effect]) -> Array:
        """Return the total resistance of effects, except those on the records, on each stage [N/kN], shape (n,)."""
        total = np.zeros(len(self._points))
        for effect in effects:
            if not EFFECTS[effect.name].on_records:
                total += self.resistance(effect.name, dict(effect.parameters))
        return total


def _formatted(parameters: Mapping[str, float]) -> str:
    return ', '.join(f'{key}={value:g}' for key, value in parameters.items())


def _points_of(run: Run, speed: Array, length: float, inertia: float, resistance: Davis) -> list[TrackPoint]:
    """Return the track points at mid-stage of a run; ``speed`` [m/s] is the mean over each stage, shape (n,)."""
    middle = run.time - 0.5 * run.dt
    place = run.position - 0.5 * run.direction * run.dt * speed
    # Acceleration implied by the forces: the measured one would bring the noise of the speed into the regressors.
    acceleration = (run.traction + run.brake - run.gradient - davis(resistance, speed)) / inertia
    brake, traction = _before(middle, run.brake), _before(middle, run.traction)
    travelled = np.maximum.accumulate(run.direction * place + 1e-6 * np.arange(place.size))
    ahead = _ahead(travelled, run.gradient)
    rows = zip(
        middle.tolist(), place.tolist(), speed.tolist(), run.radius.tolist(), run.tunnel.tolist(),
        run.distance_run.tolist(), run.since_release.tolist(), run.traction.tolist(), run.brake.tolist(),
        run.heat.tolist(), acceleration.tolist(), travelled.tolist(), strict=True,
    )  # fmt: skip
    return [
        TrackPoint(
            time_s=t,
            position=s,
            direction=run.direction,
            speed=v,
            curve_radius=radius,
            tunnel=tunnel > 0.5,
            length=length,
            distance_run=distance,
            since_release=release,
            traction=pull,
            brake=push,
            heat=heat,
            acceleration=a,
            brake_before=brake(t),
            traction_before=traction(t),
            gradient_ahead=ahead(way),
        )
        for t, s, v, radius, tunnel, distance, release, pull, push, heat, a, way in rows
    ]


def _before(time: Array, value: Array) -> Callable[[float], Callable[[float], float]]:
    """Return a function of the time [s] that returns the value a number of seconds earlier."""
    at = _Line(time, value)
    return lambda t: lambda seconds: at(t - seconds)


def _ahead(travelled: Array, value: Array) -> Callable[[float], Callable[[float], float]]:
    """Return a function of the distance travelled [m] that returns the value a number of metres ahead."""
    at = _Line(travelled, value)
    return lambda way: lambda metres: at(way + metres)


class _Line:
    """Linear interpolation at a single point, constant beyond both ends; faster than numpy's for one point."""

    def __init__(self, x: Array, y: Array) -> None:
        self._x: list[float] = x.tolist()
        self._y: list[float] = y.tolist()

    def __call__(self, x: float) -> float:
        right = bisect_right(self._x, x)
        if right in {0, len(self._x)}:
            return self._y[min(right, len(self._x) - 1)]
        low, high = self._x[right - 1], self._x[right]
        share = (x - low) / (high - low)
        return self._y[right - 1] + share * (self._y[right] - self._y[right - 1])

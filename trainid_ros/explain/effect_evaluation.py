# SPDX-License-Identifier: Apache-2.0
"""Effects evaluated along a drive, by the same functions as simulator and live estimators use."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.errors import InputError
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
"""So many points tell whether an effect depends on a, b, c."""
_MOST_KNOWN: Final = 400
"""So many resistances are kept; memory is bounded."""


class EffectEvaluator:
    """All stages of a drive as points of the track, and the resistances of effects at them."""

    def __init__(self, dataset: Dataset, train_file: TrainFile) -> None:
        self.dataset, self.davis = dataset, train_file.resistance
        self._known: dict[tuple[str, tuple[tuple[str, float], ...], Davis], Array] = {}
        length = train_file.train.length
        self._evaluator: list[TrackPoint] = []
        for run, start in zip(dataset.runs, dataset.starts.tolist(), strict=True):
            speed = dataset.speed[start : start + run.time.size]
            self._evaluator += _points_of(run, speed, length, dataset.inertia, self.davis)

    def resistance(self, name: str, parameters: Mapping[str, float], davis: Davis | None = None) -> Array:
        """Return the resistance of an effect on each stage [N/kN], shape (n,).

        Args:
            name: The effect.
            parameters: Its parameters.
            davis: Of the train, where it is not as believed: headwind and tunnel act by its c.

        Raises:
            InputError: The effect is not finite, or cannot be calculated.

        """
        key = name, tuple(parameters.items()), davis or self.davis
        if key not in self._known:
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            self._known[key] = self._evaluate(name, parameters, davis or self.davis)
        return self._known[key]

    def _evaluate(self, name: str, parameters: Mapping[str, float], davis: Davis) -> Array:
        function = EFFECTS[name].resistance
        if function is None:
            return np.zeros(len(self._evaluator))
        try:
            values = np.array([function(parameters, davis, point) for point in self._evaluator], dtype=float)
        except (ArithmeticError, ValueError, TypeError, LookupError, AttributeError) as error:
            msg = f'effect {name}: its resistance cannot be calculated for {_formatted(parameters)}: {error}'
            raise InputError(msg) from error
        if not np.isfinite(values).all():
            msg = f'effect {name}: its resistance is not finite for {_formatted(parameters)}'
            raise InputError(msg)
        return values

    def by_davis(self, name: str, parameters: Mapping[str, float], davis: Davis) -> Array | None:
        """Return how the resistance of an effect changes with a, b, c, shape (n, 3); None if it does not."""
        function = EFFECTS[name].resistance
        some = self._evaluator[:: max(1, len(self._evaluator) // _PROBES)]
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
        """Return the resistance of effects that records do not show themselves, on each stage [N/kN], shape (n,)."""
        total = np.zeros(len(self._evaluator))
        for effect in effects:
            if not EFFECTS[effect.name].on_records:
                total += self.resistance(effect.name, dict(effect.parameters))
        return total


def _formatted(parameters: Mapping[str, float]) -> str:
    return ', '.join(f'{key}={value:g}' for key, value in parameters.items())


def _points_of(run: Run, speed: Array, length: float, inertia: float, resistance: Davis) -> list[TrackPoint]:
    """Return the middles of all stages of a run; ``speed`` [m/s] is the mean over each, shape (n,)."""
    middle = run.time - 0.5 * run.dt
    place = run.position - 0.5 * run.direction * run.dt * speed
    # Implied by the force: measured acceleration would carry the noise of the speed into both sides of a regression.
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
    """Return a function that gives, for a time, the value so many seconds before it."""
    at = _Line(time, value)
    return lambda t: lambda seconds: at(t - seconds)


def _ahead(travelled: Array, value: Array) -> Callable[[float], Callable[[float], float]]:
    """Return a function that gives, for a place by the way travelled, the value so many metres ahead of it."""
    at = _Line(travelled, value)
    return lambda way: lambda metres: at(way + metres)


class _Line:
    """Linear interpolation at one place at a time, held at both ends; numpy's is made for many."""

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

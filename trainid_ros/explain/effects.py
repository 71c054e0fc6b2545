# SPDX-License-Identifier: Apache-2.0
"""Effects in the model with their priors, evaluated by the functions that simulator and live estimators use."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import repeat
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.train.effects import EFFECTS, TrackPoint
from trainid_ros.train.forces import Interpolation, davis

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from trainid_ros.explain.dataset import Array, Dataset, Run
    from trainid_ros.train.effects import EffectKind
    from trainid_ros.train.train_file import Davis, Effect, NamedValues, TrainFile

SIGNIFICANT: Final = 2.5
"""Distance of the amplitude of an effect from its neutral value, by chance exceeded once in 80 times [std]."""
SHOWN: Final = 6.0
"""2 ln of a Bayes factor, or ratio of likelihoods of held-out runs, that is strong evidence (Kass, Raftery 1995)."""
SIZES: Final = (0.3, 1.0, 3.0)
"""Prior std of the amplitude of an effect, in units of its typical value; each is as probable."""
_BEYOND: Final = 0.5  # Std of the log of a parameter beyond the range of its search [1]; fits end at a factor of three
_DAVIS_STEPS: Final = {'a': 0.1, 'b': 0.01, 'c': 0.0002}  # Steps for derivatives [N/kN, ... per m/s, ... per (m/s)^2]
_MIN_LENGTH_M: Final = 50.0  # Minimum length of an effect: shorter ones cannot be resolved under a train [m]


@dataclass(frozen=True, slots=True)
class EffectTerm:
    """An effect in the model."""

    name: str  # Its name in train files
    parameters: Mapping[str, float]  # Its parameters, in the units of the effect
    covariance: Array | None = None  # Their covariance in the same order, None before a fit
    runs: tuple[int, ...] = ()  # Numbers of the runs on which it acts; empty: on all

    @property
    def kind(self) -> EffectKind:
        """Its definition."""
        return EFFECTS[self.name]

    @property
    def amount(self) -> float:
        """Distance of the amplitude from its neutral value, in its unit."""
        return self.parameters[self.kind.amplitude] - self.kind.neutral

    @property
    def size(self) -> float:
        """The same distance in units of the typical one [1], >= 0."""
        return abs(self.amount) / self.kind.typical_size

    @property
    def significance(self) -> float:
        """The same distance in standard deviations conditional on the shape [1]; infinite before a fit."""
        if self.covariance is None:
            return math.inf
        at = self.index(self.kind.amplitude)
        typical = self.kind.typical_size
        return self.size * typical * math.sqrt(max(float(np.linalg.pinv(self.covariance)[at, at]), 0.0))

    @property
    def shape(self) -> dict[str, float]:
        """All parameters except the amplitude."""
        return {name: self.parameters[name] for name in self.kind.shape}

    def index(self, name: str) -> int:
        """Return the place of a parameter in the covariance."""
        return list(self.parameters).index(name)

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations of the parameters; empty before a fit."""
        if self.covariance is None:
            return {}
        deviations = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        return dict(zip(self.parameters, deviations, strict=True))

    def moved(self, move: Array, covariance: Array) -> EffectTerm:
        """Return the effect with its parameters changed by a step, as far as admissible, and with their covariance."""
        parameters = {}
        for (name, value), step in zip(self.parameters.items(), move.tolist(), strict=True):
            limits = self.kind.parameters[name]
            low, high = limits.low, limits.high
            if limits.search is not None:  # at most a factor of about three outside
                low, high = max(low, 0.3 * limits.search[0]), min(high, 3.0 * limits.search[1])
            parameters[name] = min(max(value + step, low), high)
        start, end = parameters.get('start'), parameters.get('end')
        if start is not None and end is not None and end - start < _MIN_LENGTH_M:
            middle = 0.5 * (start + end)
            parameters |= {'start': middle - 0.5 * _MIN_LENGTH_M, 'end': middle + 0.5 * _MIN_LENGTH_M}
        return replace(self, parameters=parameters, covariance=covariance)


def prior_cost(term: EffectTerm, dataset: Dataset) -> float:
    """Return -2 ln of the prior of an effect relative to the priors of the fit, which are centred at its parameters.

    The prior of an amplitude is normal about its neutral value, with one of :data:`SIZES`; that of another parameter is
    uniform over its range, for a place or a time that of the data. Any set of runs of a size is as probable as any
    other.
    """
    cost = runs_cost(len(dataset.runs), len(term.runs))
    for name, value in term.parameters.items():
        width, limits = prior_width(term.kind, name, value), term.kind.parameters[name]
        if name == term.kind.amplitude:
            # That of the fit has the largest std; one side alone is twice as probable.
            square, widest = term.size**2, SIZES[-1]
            density = sum(widest / std * math.exp(0.5 * square * (widest**-2 - std**-2)) for std in SIZES) / len(SIZES)
            cost += square / widest**2 - 2.0 * math.log(2.0 * density if term.kind.sign else density)
            continue
        if limits.search is None:
            span = float(np.ptp(dataset.joined('position') if limits.is_place else dataset.time))
        else:
            low, high = limits.search
            span = high - low
            if limits.grid == 'log':
                span = math.log(high / low) * abs(value)
                # Less probable beyond its range, where it may look like another effect.
                cost += (math.log(max(low / value, value / high, 1.0)) / _BEYOND) ** 2
        # A uniform density as high as the peak of a normal one is sqrt(2 pi) std wide.
        cost += 2.0 * math.log(max(span / (math.sqrt(2.0 * math.pi) * width), 1.0))
    return cost


def runs_cost(runs: int, chosen: int) -> float:
    """Return -2 ln of the prior of one set of chosen runs, of any size up to half of all; 0 without a choice."""
    return 2.0 * math.log(math.comb(runs, chosen) * max(runs // 2, 1)) if chosen else 0.0


def prior_width(kind: EffectKind, name: str, value: float) -> float:
    """Return the prior std of a parameter about its initial value; 80 m for a position, 60 s for a time."""
    if name == kind.amplitude:
        return SIZES[-1] * kind.typical_size
    limits = kind.parameters[name]
    if limits.search is None:
        return 80.0 if limits.is_place else 60.0
    low, high = limits.search
    return max(abs(value), low if limits.grid == 'log' else 0.5 * (high - low))


class EffectEvaluator:
    """Resistances of effects at all stages of a dataset, by default with a, b, c of the train file."""

    def __init__(self, dataset: Dataset, train_file: TrainFile) -> None:
        self.dataset, self.davis = dataset, train_file.resistance
        self._cached = lru_cache(400)(self._evaluate)  # no more, to bound the memory
        self._number = np.array([run.number for run in dataset.runs])[dataset.run_of]
        length = train_file.train.length
        self._points: list[TrackPoint] = []
        for run, start in zip(dataset.runs, dataset.starts.tolist(), strict=True):
            speed = dataset.speed[start : start + run.time.size]
            self._points += track_points(run, speed, length, dataset.inertia, self.davis)

    def resistance(
        self, name: str, parameters: Mapping[str, float], davis: Davis | None = None, runs: Sequence[int] = ()
    ) -> Array:
        """Return the resistance of an effect on each stage [N/kN], shape (n,); 0 on other than ``runs`` if given.

        ``davis`` is given where it differs from the train file: headwind and tunnel act through c.

        Raises:
            InputError: The resistance is not finite or cannot be calculated.
        """
        if runs:
            return np.where(np.isin(self._number, runs), self.resistance(name, parameters, davis), 0.0)
        kind = EFFECTS[name]
        if not kind.linear:
            return self._cached(name, tuple(parameters.items()), davis or self.davis)
        # The shape alone decides: all amplitudes share one evaluation.
        size = (parameters[kind.amplitude] - kind.neutral) / kind.typical_size
        typical = {**parameters, kind.amplitude: kind.neutral + kind.typical_size}
        return size * self._cached(name, tuple(typical.items()), davis or self.davis)

    def _evaluate(self, name: str, parameters: NamedValues, davis: Davis) -> Array:
        function = EFFECTS[name].resistance
        if function is None:
            return np.zeros(len(self._points))
        shown = ', '.join(f'{key}={value:g}' for key, value in parameters)
        try:
            each = map(function, repeat(dict(parameters)), repeat(davis), self._points)
            values = np.fromiter(each, dtype=float, count=len(self._points))
        except (ArithmeticError, ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f'effect {name}: its resistance cannot be calculated for {shown}: {error}') from error
        if not np.isfinite(values).all():
            raise InputError(f'effect {name}: its resistance is not finite for {shown}')
        return values

    def by_davis(
        self, name: str, parameters: Mapping[str, float], davis: Davis, runs: Sequence[int] = ()
    ) -> Array | None:
        """Return the derivative of :meth:`resistance` by a, b, c, shape (n, 3); None if independent of them."""
        function = EFFECTS[name].resistance
        some = self._points[:: max(1, len(self._points) // 60)]  # tell whether the effect depends on a, b, c
        changed = [replace(davis, **{key: getattr(davis, key) + step}) for key, step in _DAVIS_STEPS.items()]
        if function is None or all(
            function(parameters, other, point) == function(parameters, davis, point)
            for other in changed
            for point in some
        ):
            return None
        here = self.resistance(name, parameters, davis, runs)
        rows = zip(changed, _DAVIS_STEPS.values(), strict=True)
        return np.stack(
            [(self.resistance(name, parameters, other, runs) - here) / step for other, step in rows], axis=1
        )

    def total(self, effects: Sequence[Effect]) -> Array:
        """Return the total of load and effects but those on the records, on each stage [N/kN], shape (n,)."""
        runs = self.dataset.runs
        total = np.concatenate([np.broadcast_to(run.load_drag, run.time.shape) for run in runs])
        for effect in effects:
            if not EFFECTS[effect.name].on_records:
                total += self.resistance(effect.name, dict(effect.parameters), runs=effect.runs)
        return total


def track_points(run: Run, speed: Array, length: float, inertia: float, resistance: Davis) -> list[TrackPoint]:
    """Return the inputs of effects at mid-stage of a run, by the mean speed of each stage [m/s], shape (n,).

    The train has a length [m], a specific force per acceleration [N/kN per m/s^2] and the resistance of its train file.
    """
    middle = run.time - 0.5 * run.dt
    place = run.position - 0.5 * run.direction * run.dt * speed
    # Acceleration implied by the forces: the measured one would bring the noise of the speed into the regressors.
    acceleration = (run.traction + run.brake - run.gradient - davis(resistance, speed)) / inertia
    travelled = np.maximum.accumulate(run.direction * place + 1e-6 * np.arange(place.size))
    times: list[float] = middle.tolist()
    brake, traction = (Interpolation(times, force.tolist()) for force in (run.brake, run.traction))
    gradient = Interpolation(travelled.tolist(), run.gradient.tolist())
    columns = (
        middle, place, speed, run.radius, run.tunnel > 0.5, run.distance_run, run.since_release, run.traction,
        run.brake, run.heat, acceleration, travelled,
    )  # fmt: skip
    return [
        TrackPoint(
            t, s, run.direction, v, radius, tunnel, length, distance, release, pull, push, heat, a,
            run.number, partial(brake.before, t), partial(traction.before, t), partial(gradient.ahead, way),
        )
        for t, s, v, radius, tunnel, distance, release, pull, push, heat, a, way in zip(
            *(column.tolist() for column in columns), strict=True
        )
    ]  # fmt: skip


def unit_resistance(
    evaluator: EffectEvaluator, kind: EffectKind, shape: Mapping[str, float], times: float = 1.0
) -> Array:
    """Return the resistance [N/kN] of an effect at ``times`` its typical size, per unit of amplitude, shape (n,)."""
    size = times * kind.typical_size
    parameters = {**shape, kind.amplitude: kind.neutral + size}
    return evaluator.resistance(kind.name, parameters) / size


def without_replaced(terms: Sequence[EffectTerm], train_file: TrainFile) -> TrainFile | None:
    """Return the train file without effects that were found again; None if none was.

    An effect that is found again has wrong values in the train file. Effects on the records themselves are
    kept: the records have already been corrected for them.
    """
    found = {term.name for term in terms if not term.runs}
    again = {name for name in found if not (EFFECTS[name].repeatable or EFFECTS[name].on_records)}
    rest = tuple(effect for effect in train_file.effects if effect.name not in again or effect.runs)
    return replace(train_file, effects=rest) if len(rest) < len(train_file.effects) else None


def merged(current: Sequence[Effect], added: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects of the train file and the added ones.

    An added effect on the records is what is left after the correction by the train file, so the two are combined into
    one effect. Records are never corrected for slip, so slip that was found replaces that of the train file.
    """
    before = {effect.name: effect for effect in current if EFFECTS[effect.name].on_records}
    total = tuple(_sum(before.get(new.name), new) for new in added)
    names = {effect.name for effect in total if effect.name in before}
    return (*(effect for effect in current if effect.name not in names), *total)


def _sum(before: Effect | None, new: Effect) -> Effect:
    """Return the combination of two effects of one kind: ratios are multiplied, other amplitudes are added."""
    kind = EFFECTS[new.name]
    if before is None or kind.resistance is None:
        return new
    old, parameters = dict(before.parameters)[kind.amplitude], dict(new.parameters)
    more = parameters[kind.amplitude]
    parameters[kind.amplitude] = more * old if kind.neutral else more + old
    return replace(new, parameters=tuple(parameters.items()))

# SPDX-License-Identifier: Apache-2.0
"""Score every effect and every generic dependence by how well it explains the residual of a model.

All columns pass through the same whitening and elimination of nuisances, so all hypotheses are compared by one number:
twice the log Bayes factor against the model without the hypothesis.

A named effect is a family of columns. It is nearly linear in its amplitude; its other parameters, the shape, are tried
on a grid, and the Bayes factor is averaged over the grid, which penalises flexible families. A generic dependence is a
group of columns without a physical name. If such a group explains far more than any effect of the library, no named
effect fits; the residual after the named effects is described by the group that explains most of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.special import logsumexp

from trainid_ros.explain.effects import shape_names, sign, unit_resistance
from trainid_ros.explain.likelihood import Hyperparameters, group_log_bayes, log_bayes
from trainid_ros.explain.model import WHEEL, Model
from trainid_ros.explain.noise import Bins
from trainid_ros.explain.run_data import BRAKING, PULLING
from trainid_ros.train.effects import EFFECTS, EffectKind, Parameter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.effects import EffectEvaluator

    Array = NDArray[np.float64]

_SHAPES: Final = 6
"""Grid points of a shape parameter."""
_MAX_TIMES: Final = 40
"""Maximum number of grid points of a time."""
_PLACES: Final = {1: 40, 2: 16}
"""Grid points of each position, by the number of positions in a shape."""
_PLACES_OF_MANY: Final = 6
"""Grid points of each position of shapes with more positions."""
_LASTING_S: Final = 60.0
"""Driving time needed before and after a change in time to detect it [s]."""
_SIZES: Final = (1.0, -1.0, 2.0, -2.0)
"""Amplitudes tried for an effect without shape parameters, in units of its typical value: it may be non-linear."""
_SAME: Final = 0.05
"""Relative tolerance within which two columns count as equal."""
SECTIONS: Final = ('gradient_error', 'local_drag')
"""Effects on a section of the line, scanned over all starts and ends at once by sums over bins."""


@dataclass(frozen=True, slots=True)
class Family:
    """Columns of one named effect.

    Attributes:
        name: Name of the effect.
        shapes: Shape parameters of each column, in the units of the effect.
        resistance: Resistance per unit of amplitude [N/kN], shape (n, k).
        std: Prior standard deviation of the amplitude, in its unit.
        sign: +1 or -1 if the amplitude can only lie above or below its neutral value, otherwise 0.

    """

    name: str
    shapes: tuple[Mapping[str, float], ...]
    resistance: Array
    std: float
    sign: int


def named_families(evaluator: EffectEvaluator) -> tuple[Family, ...]:
    """Return the families of all effects of the library except :data:`SECTIONS` and those without any response."""
    families = []
    for kind in EFFECTS.values():
        if kind.resistance is None or kind.name in SECTIONS:
            continue
        shapes, columns = _columns(kind, evaluator)
        seen = [i for i, column in enumerate(columns) if np.any(column)]
        if seen:
            resistance = np.stack([columns[i] for i in seen], axis=1)
            families.append(
                Family(kind.name, tuple(shapes[i] for i in seen), resistance, kind.typical_size, sign(kind))
            )
    return tuple(families)


def _columns(kind: EffectKind, evaluator: EffectEvaluator) -> tuple[list[dict[str, float]], list[Array]]:
    """Return shapes and their columns; a shape is repeated where the response is not linear in the amplitude."""
    shapes = _shapes(kind, evaluator.dataset)
    if shape_names(kind) or sign(kind):
        return shapes, [unit_resistance(evaluator, kind, shape) for shape in shapes]
    columns: list[Array] = []
    for times in _SIZES:
        column = unit_resistance(evaluator, kind, shapes[0], times)
        if not any(np.allclose(column, other, rtol=_SAME, atol=_SAME * np.abs(other).max()) for other in columns):
            columns.append(column)
    return shapes * len(columns), columns


def _shapes(kind: EffectKind, dataset: Dataset) -> list[dict[str, float]]:
    """Return the grid of all parameters except the amplitude."""
    names = shape_names(kind)
    axes = [_axis(kind.parameters[name], dataset, _place_count(kind, names)) for name in names]
    shapes = (dict(zip(names, values, strict=True)) for values in product(*axes))
    return [shape for shape in shapes if not ('start' in shape and 'end' in shape and shape['start'] >= shape['end'])]


def _place_count(kind: EffectKind, names: Sequence[str]) -> int:
    """Return the number of grid points of each position, which limits the number of combinations."""
    places = sum(kind.parameters[name].is_place for name in names)
    return _PLACES.get(places, _PLACES_OF_MANY)


def _axis(limits: Parameter, dataset: Dataset, places: int) -> list[float]:
    """Return the grid points of one parameter."""
    if limits.is_place:
        if not dataset.positioned:
            return []
        position = dataset.joined('position')
        # Positions outside the section driven have no effect on the data.
        tried = np.linspace(position.min(), position.max(), places + 2)[1:-1]
        return [float(place) for place in tried if limits.low <= place <= limits.high]
    if limits.search is None:
        # Times: while the train moves, with enough driving before and after for a change to be detectable.
        driven = np.cumsum(dataset.dt)
        moving = dataset.time[(driven > _LASTING_S) & (driven < driven[-1] - _LASTING_S)]
        return [float(t) for t in moving[:: max(1, moving.size // _MAX_TIMES)]]
    low, high = limits.search
    values = np.geomspace(low, high, _SHAPES) if limits.grid == 'log' else np.linspace(low, high, _SHAPES)
    return [float(value) for value in values]


_KNOTS: Final = 5
"""Knots of a piecewise-linear dependence."""
_MAX_RUNS: Final = 60
"""With more runs than this, the dependence on the run is replaced by one on time."""


@dataclass(frozen=True, slots=True)
class Group:
    """Columns of one dependence, with coefficients in N/kN.

    Attributes:
        name: Short name.
        text: What the resistance depends on, as text.
        resistance: Resistance per unit of each coefficient [1], shape (n, k).

    """

    name: str
    text: str
    resistance: Array


def generic_groups(dataset: Dataset, length: float) -> tuple[Group, ...]:
    """Return all groups for a dataset and the length of the train [m]."""
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    pulling, braking = traction > PULLING, brake < BRAKING
    coasting = ~pulling & ~braking
    direction = dataset.direction.astype(float)[:, None]
    tunnel, radius = dataset.joined('tunnel'), dataset.joined('radius')
    curvature = np.where(radius > 0.0, 300.0 / np.maximum(radius, 100.0), 0.0)
    since = dataset.time - dataset.time[dataset.starts][dataset.run_of]
    # Acceleration implied by the forces: the measured one would bring the noise of the speed into the regressors.
    acceleration = traction + brake - dataset.joined('gradient') - 2.0
    relative = v / max(float(v.max()), 1.0)
    heat = dataset.joined('heat')
    heat = heat / max(float(heat.max()), 1.0)
    powers = np.stack((np.ones_like(v), relative, relative**2), axis=1)
    heats = np.stack((heat, heat**2, heat * relative), axis=1)
    modes = np.stack((pulling, braking), axis=1)
    places = (
        (Group('place', 'the place', Bins.of(dataset, length).shares(dataset, length)),) if dataset.positioned else ()
    )
    return (
        Group('run', 'the run', _runs(dataset)),
        *places,
        Group('time', 'the time', _hats(dataset.time, 6)),
        Group('start', 'the time since departure', _hats(np.minimum(since, 120.0), 7)),
        Group('speed', 'the speed', _hats(v, 7)),
        Group('traction-speed', 'the speed in traction', _hats(v, _KNOTS) * pulling[:, None]),
        Group('coast-speed', 'the speed while coasting', _hats(v, _KNOTS) * coasting[:, None]),
        Group('traction', 'the tractive force', _hats(np.maximum(traction, 0.0), _KNOTS) * pulling[:, None]),
        Group('brake-speed', 'the speed while braking', _hats(v, _KNOTS) * brake[:, None] / 30.0),
        Group('brake', 'the braking force', _hats(brake, _KNOTS) * braking[:, None]),
        Group('brake-heat', 'the heat of the brake', heats * brake[:, None] / 30.0),
        Group('direction', 'the direction', direction * powers),
        Group('inertia', 'the acceleration', np.stack((acceleration, np.abs(acceleration)), axis=1) / 50.0),
        Group('tunnel', 'the tunnel', tunnel[:, None] * powers),
        Group('curve', 'curves', np.stack((curvature, curvature**2, curvature * relative**2), axis=1)),
        Group('gradient', 'the gradient', _gradient(dataset)),
        Group('mode-direction', 'the direction and the driving mode', direction * modes),
    )


def _runs(dataset: Dataset) -> Array:
    """Return a column for each run, or functions of time if there are many runs, shape (n, k)."""
    if len(dataset.runs) > _MAX_RUNS:
        return _hats(dataset.time, _MAX_RUNS)
    return np.asarray(dataset.run_of[:, None] == np.arange(len(dataset.runs)), dtype=float)


def _gradient(dataset: Dataset) -> Array:
    i = dataset.joined('gradient') / 10.0
    return np.stack((i, np.abs(i)), axis=1)


def _hats(x: Array, count: int) -> Array:
    """Return piecewise-linear hat functions with knots at quantiles, which sum to one; shape (n, up to count)."""
    knots = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count)))
    if knots.size < 2:
        return np.ones((x.size, 1))
    columns = [np.interp(x, knots, np.eye(knots.size)[i]) for i in range(knots.size)]
    return np.stack(columns, axis=1)


_GROUP_STD: Final = (0.1, 0.3, 1.0)
"""Prior std of the coefficients of a group [N/kN]; the Bayes factor is averaged over them."""
_SHARES: Final = (0.3, 1.0)
"""The same for the amplitude of an effect, in units of its typical value."""
# Limits of the section lengths that are tried.
_SHORTEST_M: Final = 60.0
_LONGEST_M: Final = 2500.0


@dataclass(frozen=True, slots=True)
class EffectScore:
    """Evidence of one hypothesis.

    Attributes:
        name: Effect, or group of columns.
        evidence: 2 ln of its Bayes factor [1].
        parameters: Best parameters tried, in the units of the effect; empty for a group.
        text: What a group depends on, as text; empty for an effect.

    """

    name: str
    evidence: float
    parameters: Mapping[str, float]
    text: str = ''


class EffectScorer:
    """Columns of all hypotheses for one dataset, at the grid points."""

    def __init__(self, model: Model) -> None:
        dataset, length = model.dataset, model.train_file.train.length
        self._families: tuple[Family, ...] = named_families(model.evaluator)
        self._groups: tuple[Group, ...] = generic_groups(dataset, length)
        self._bins = Bins.of(dataset, length, fine=True)
        shares = self._bins.shares(dataset, length)
        # In the order of SECTIONS: the sign of a gradient error depends on the direction, that of a drag does not.
        sections = (dataset.direction[:, None] * shares, shares) if dataset.positioned else ()
        self._sections = SECTIONS[: len(sections)]
        resistances = [*(f.resistance for f in self._families), *(g.resistance for g in self._groups)]
        self._columns = [dataset.column(r) for r in (*resistances, *sections)]

    def scores(self, model: Model, hyper: Hyperparameters) -> tuple[list[EffectScore], list[EffectScore]]:
        """Return the evidence of all named effects and of all groups when added to the model, best first."""
        blocks = iter([(found.A, found.b) for found in model.informations(hyper, self._columns)])
        named, groups = [], []
        for family in self._families:
            A, b = next(blocks)
            if family.name == WHEEL:
                A, b = A + model.odometry.precision, b + model.odometry.precision * model.odometer_excess
            named.append(_family(family, np.diag(A), b))
        for group in self._groups:
            A, b = next(blocks)
            values = [group_log_bayes(A, b, std) for std in _GROUP_STD]
            groups.append(EffectScore(group.name, _mean_evidence(np.array(values)), {}, group.text))
        named += [_section(name, self._bins, *next(blocks)) for name in self._sections]
        return sorted(named, key=_strongest), sorted(groups, key=_strongest)

    def group_columns(self, name: str) -> Array:
        """Return the columns of a group at the grid points, shape (m, k)."""
        k = next(i for i, group in enumerate(self._groups) if group.name == name)
        return self._columns[len(self._families) + k]


def stretch_sums(A: Array, b: Array, first: NDArray[np.intp], end: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return A and b of the sums of columns ``first`` to ``end - 1``, shapes (k, k) and (k,) to (s,) each."""
    n = len(b)
    corner = np.zeros((n + 1, n + 1))
    corner[1:, 1:] = A.cumsum(axis=0).cumsum(axis=1)
    sums = np.concatenate([[0.0], np.cumsum(b)])
    block = corner[end, end] - corner[first, end] - corner[end, first] + corner[first, first]
    return block, sums[end] - sums[first]


def _family(family: Family, A: Array, b: Array) -> EffectScore:
    """Return the evidence of an effect, averaged over its shapes; A is the diagonal of the matrix."""
    values = [log_bayes(A, b, share * family.std, family.sign) for share in _SHARES]
    best = int(np.argmax(values[-1]))
    kind = EFFECTS[family.name]
    size = b[best] / (A[best] + family.std**-2)
    parameters = {**family.shapes[best], kind.amplitude: kind.neutral + float(size)}
    return EffectScore(family.name, _mean_evidence(np.array(values)), parameters)


def _section(name: str, bins: Bins, A: Array, b: Array) -> EffectScore:
    """Return the evidence of a constant resistance over a section of the line, averaged over all sections of bins."""
    kind = EFFECTS[name]
    i, j = np.triu_indices(bins.count + 1, 1)
    length = (j - i) * bins.width
    usable = (length >= _SHORTEST_M) & (length <= max(_LONGEST_M, 2.0 * bins.width))
    i, j = i[usable], j[usable]
    block, along = stretch_sums(A, b, i, j)
    block = np.maximum(block, 1e-9)
    values = np.stack([log_bayes(block, along, share * kind.typical_size, sign(kind)) for share in _SHARES])
    # The prior of the length is uniform on a log scale.
    weight = 1.0 / (j - i)
    best = int(np.argmax(values[-1]))
    size = along[best] / (block[best] + kind.typical_size**-2)
    edges = bins.edges
    parameters = {
        'start': float(edges[i[best]]),
        'end': float(edges[j[best]]),
        kind.amplitude: kind.neutral + float(size),
    }
    return EffectScore(name, _mean_evidence(values, weight / weight.sum()), parameters)


def _mean_evidence(values: Array, weight: Array | None = None) -> float:
    """Return 2 ln of the weighted mean of Bayes factors, which are given as 2 ln B."""
    weights = np.full(values.shape, 1.0) if weight is None else np.broadcast_to(weight, values.shape)
    return float(2.0 * (logsumexp(0.5 * values, b=weights) - np.log(weights.sum())))


def _strongest(score: EffectScore) -> float:
    return -score.evidence

# SPDX-License-Identifier: Apache-2.0
"""Select the effects that the data support: scores of all hypotheses, forward selection with exchange, alternatives.

All columns pass through the same whitening and elimination of nuisances, so all hypotheses are compared by one number:
twice the log Bayes factor against the model without the hypothesis.

A named effect is a family of columns. It is nearly linear in its amplitude; its other parameters, the shape, are tried
on a grid, and the Bayes factor is averaged over the grid, which penalises flexible families. A generic dependence is a
group of columns without a physical name. If such a group explains far more than any effect of the library, no named
effect fits; the residual after the named effects is described by the group that explains most of it.

An effect at one place must show in all runs that pass it: a burst of slip or an unreported brake application causes a
gap at one place too, but in a single run. The onset time of an effect has the posterior over all times, since a
linearisation at one time is not valid at others: while the train stands, the likelihood is flat in it, and it changes
abruptly elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, product
from typing import Final

import numpy as np
from scipy.special import logsumexp

from trainid_ros.explain.dataset import Array, Dataset, Indices
from trainid_ros.explain.effects import (
    SHOWN,
    SIGNIFICANT,
    SIZES,
    EffectEvaluator,
    EffectTerm,
    prior_cost,
    runs_cost,
    unit_resistance,
)
from trainid_ros.explain.likelihood import Hyperparameters, Information, eliminate, group_log_bayes, log_bayes
from trainid_ros.explain.model import WHEEL, Model, preferred_point
from trainid_ros.explain.nuisances import Bins
from trainid_ros.explain.result import Hypothesis, dependence, noise, probabilities
from trainid_ros.explain.variables import OF_CURVES, variables
from trainid_ros.train.effects import EFFECTS, EffectKind, Parameter

_SHAPES: Final = 6  # Grid points of a shape parameter
_PLACES: Final = (40, 16, 6)  # Grid points of each position in shapes with one, two, and more positions
_LASTING_S: Final = 60.0  # Driving time needed before and after a change in time to detect it [s]
SECTIONS: Final = ('gradient_error', 'local_drag')
"""Effects on a section of the line, scanned over all starts and ends at once by sums over bins."""
RUN_DRAG: Final = 'run_drag'
"""The effect that is Davis a on the runs where it acts."""
_OF_RUNS: Final = ('brake_scale', 'headwind', 'mass_error', RUN_DRAG, 'traction_scale')  # What may differ by run
_SCATTER: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # Std of what differs from run to run at random [typical sizes]


@dataclass(frozen=True, slots=True)
class Family:
    """Columns of one named effect."""

    kind: EffectKind
    shapes: tuple[Mapping[str, float], ...]  # Shape parameters of each column, in the units of the effect
    resistance: Array  # Resistance per unit of amplitude [N/kN], shape (n, k)


def named_families(evaluator: EffectEvaluator) -> tuple[Family, ...]:
    """Return the families of all effects of the library except :data:`SECTIONS` and those without any response."""
    families = []
    for kind in EFFECTS.values():
        if kind.resistance is None or kind.name in (*SECTIONS, RUN_DRAG):
            continue
        seen = [(shape, column) for shape, column in _columns(kind, evaluator) if np.any(column)]
        if seen:
            shapes, columns = zip(*seen, strict=True)
            families.append(Family(kind, shapes, np.stack(columns, axis=1)))
    return tuple(families)


def _columns(kind: EffectKind, evaluator: EffectEvaluator) -> list[tuple[dict[str, float], Array]]:
    """Return shapes with their columns; a shape is repeated where the response is not linear in the amplitude."""
    shapes = _shapes(kind, evaluator.dataset)
    if kind.shape or kind.sign:
        return [(shape, unit_resistance(evaluator, kind, shape)) for shape in shapes]
    columns: list[Array] = []
    for times in (1.0, -1.0, 2.0, -2.0):  # typical amplitudes
        column = unit_resistance(evaluator, kind, shapes[0], times)
        if not any(np.allclose(column, other, rtol=0.05, atol=0.05 * np.abs(other).max()) for other in columns):
            columns.append(column)
    return [(shapes[0], column) for column in columns]


def _shapes(kind: EffectKind, dataset: Dataset) -> list[dict[str, float]]:
    names = kind.shape
    places = sum(kind.parameters[name].is_place for name in names)
    axes = [_axis(kind.parameters[name], dataset, _PLACES[min(places, len(_PLACES)) - 1]) for name in names]
    shapes = (dict(zip(names, values, strict=True)) for values in product(*axes))
    return [shape for shape in shapes if not ('start' in shape and 'end' in shape and shape['start'] >= shape['end'])]


def _axis(limits: Parameter, dataset: Dataset, places: int) -> list[float]:
    """Return the grid points of one parameter, as many as ``places`` of a position."""
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
        return [float(t) for t in moving[:: max(1, moving.size // 40)]]
    low, high = limits.search
    values = np.geomspace(low, high, _SHAPES) if limits.grid == 'log' else np.linspace(low, high, _SHAPES)
    return [float(value) for value in values]


# Prior std of the coefficients of a dependence without a name [N/kN]; the Bayes factor is averaged over them.
_GROUP_STDS: Final = (0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True, slots=True)
class EffectScore:
    """Evidence of one hypothesis."""

    name: str  # Effect, or group of columns
    evidence: float  # 2 ln of its Bayes factor [1]
    parameters: Mapping[str, float]  # Best parameters tried, in the units of the effect; empty for a group
    text: str = ''  # What a group depends on, as text; empty for an effect
    runs: tuple[int, ...] = ()  # Numbers of the runs on which an effect acts; empty: on all


class EffectScorer:
    """Columns of all hypotheses for one dataset, at the grid points."""

    def __init__(self, model: Model) -> None:
        dataset, length = model.dataset, model.train_file.train.length
        varied = (one for one in reversed(variables(model)) if one.name not in OF_CURVES)
        self._families, self._groups = named_families(model.evaluator), {one.name: one for one in varied}
        self._bins = Bins.of(dataset, length, fine=True)
        shares = self._bins.shares(dataset, length)
        # In the order of SECTIONS: the sign of a gradient error depends on the direction, that of a drag does not.
        sections = (dataset.direction[:, None] * shares, shares) if dataset.positioned else ()
        self._sections = SECTIONS[: len(sections)]
        resistances = [*(f.resistance for f in self._families), *(one.coarse() for one in self._groups.values())]
        self._columns = [dataset.column(r) for r in (*resistances, *sections)]

    def scores(self, model: Model, hyper: Hyperparameters) -> tuple[list[EffectScore], list[EffectScore]]:
        """Return the evidence of all named effects and of all groups when added to the model, best first."""
        blocks = iter([(found.A, found.b) for found in model.informations(hyper, self._columns)])
        named, groups = [], []
        for family in self._families:
            A, b = next(blocks)
            if family.kind.name == WHEEL:
                A, b = A + model.odometry.precision, b + model.odometry.precision * model.odometer_excess
            named.append(_score(family.kind, np.diag(A), b, family.shapes.__getitem__))
        for name, group in self._groups.items():
            A, b = next(blocks)
            groups.append(EffectScore(name, _group_evidence(A, b), {}, group.text))
        named += [_section(name, self._bins, *next(blocks)) for name in self._sections]
        return _by_evidence(named), _by_evidence(groups)

    def of_runs(self, model: Model, hyper: Hyperparameters) -> list[tuple[EffectScore, ...]]:
        """Return the evidence of single effects and pairs, each on two of the runs to half of them, those that differ.

        They are left out where it is as probable that all runs differ at random; load, brake and wind usually do, so
        that these need strong evidence. The evidence of a pair is that of both together.
        """
        dataset, scores = model.dataset, list[tuple[EffectScore, ...]]()
        of_run = np.array([run.number for run in dataset.runs])
        numbers = np.unique(of_run)
        if numbers[0] == 0 or numbers.size < 4:
            return []
        inside = of_run[dataset.run_of][:, None] == numbers
        kinds = [EFFECTS[name] for name in _OF_RUNS]
        units = [kind.typical_size * unit_resistance(model.evaluator, kind, {})[:, None] * inside for kind in kinds]
        (found,) = model.informations(hyper, [dataset.column(np.concatenate(units, axis=1))])
        places = np.arange(found.b.size).reshape(len(kinds), -1)
        alone = [_at_random(found, columns) for columns in places]
        for some in (*((k,) for k in range(len(kinds))), *combinations(range(len(kinds)), 2)):
            at, names = places[[*some]], [kinds[k].name for k in some]
            by_chance = max(_at_random(found, at.ravel()) if len(some) > 1 else -math.inf, *(alone[k] for k in some))
            if (best := _best_sets(found, at, names)) is None:
                continue
            evidence, sizes, sets = best
            if evidence < by_chance + (0.0 if names == [RUN_DRAG] else SHOWN):
                continue
            scores.append(
                tuple(
                    EffectScore(
                        kinds[k].name,
                        evidence,
                        {kinds[k].amplitude: kinds[k].neutral + size * kinds[k].typical_size},
                        runs=tuple(numbers[chosen > 0.0].tolist()),
                    )
                    for k, size, chosen in zip(some, sizes, sets, strict=True)
                )
            )
        return sorted(scores, key=lambda one: -one[0].evidence)

    def group_columns(self, name: str) -> Array:
        """Return the columns of a group at the grid points, shape (m, k)."""
        return self._columns[len(self._families) + [*self._groups].index(name)]


def _group_evidence(A: Array, b: Array) -> float:
    return _mean_evidence(np.array([group_log_bayes(A, b, std) for std in _GROUP_STDS]))


def _at_random(found: Information, columns: Indices) -> float:
    """Return the evidence that the effects of some columns differ from run to run at random."""
    A, b = found.A[np.ix_(columns, columns)], found.b[columns]
    return float(max(group_log_bayes(A, b, share) for share in _SCATTER))


def _best_sets(
    found: Information, places: Indices, names: Sequence[str]
) -> tuple[float, list[float], list[Array]] | None:
    """Return the best sets of runs for one or two effects: their evidence, sizes, and 1 or 0 for each run.

    ``places`` (k, n) are those of the columns of each effect, of typical size, on each of the n runs. None if an effect
    has no set.
    """
    at = places.ravel()
    A, b = found.A[np.ix_(at, at)], found.b[at]
    sizes = np.linalg.solve(A + np.eye(b.size), b).reshape(places.shape)
    sets = [_sets(size, name) for size, name in zip(sizes, names, strict=True)]
    if not all(one.size for one in sets):
        return None
    # A and b of the sums over sets: shapes (t1, ..., k, k) and (t1, ..., k) for t1, ... sets of each effect.
    shape, k, n = tuple(map(len, sets)), len(sets), places.shape[1]
    joint, along, cost = np.empty((*shape, k, k)), np.empty((*shape, k)), np.zeros(shape)
    for i, one in enumerate(sets):
        axis = [-1 if i == j else 1 for j in range(k)]
        along[..., i] = (one @ found.b[places[i]]).reshape(axis)
        cost = cost + np.array([runs_cost(n, int(count)) for count in one.sum(axis=1)]).reshape(axis)
        for j, other in enumerate(sets):
            sums = one @ found.A[np.ix_(places[i], places[j])] @ other.T
            joint[..., i, j] = sums.diagonal().reshape(axis) if i == j else sums if i < j else sums.T
    values = np.array([group_log_bayes(joint, along, share) for share in SIZES]) - cost
    evidence = 2.0 * (logsumexp(0.5 * values, axis=0) - math.log(len(SIZES)))
    best = np.unravel_index(int(np.argmax(evidence)), shape)
    amounts: list[float] = np.linalg.solve(joint[best] + np.eye(k), along[best]).tolist()
    return float(evidence[best]), amounts, [one[place] for one, place in zip(sets, best, strict=True)]


def _sets(sizes: Array, name: str) -> Array:
    """Return sets of two to half of n runs, those of the largest or smallest sizes, as 1 or 0 for each run, (t, n)."""
    order, n = np.argsort(sizes), sizes.size
    sets = [np.sort(ends[:k]) for ends in (order, order[::-1]) for k in range(2, n // 2 + 1)]
    if name == RUN_DRAG:  # on the first or the last runs it is a resistance_step
        sets = [one for one in sets if one[-1] >= one.size and one[0] < n - one.size]
    return np.array([np.isin(np.arange(n), one) for one in sets], dtype=float).reshape(-1, n)


def stretch_sums(A: Array, b: Array, first: Indices, end: Indices) -> tuple[Array, Array]:
    """Return A and b of the sums of columns ``first`` to ``end - 1``, shapes (k, k) and (k,) to (s,) each."""
    n = len(b)
    corner = np.zeros((n + 1, n + 1))
    corner[1:, 1:] = A.cumsum(axis=0).cumsum(axis=1)
    sums = np.concatenate([[0.0], np.cumsum(b)])
    block = corner[end, end] - corner[first, end] - corner[end, first] + corner[first, first]
    return block, sums[end] - sums[first]


def _score(
    kind: EffectKind, A: Array, b: Array, shape: Callable[[int], Mapping[str, float]], weight: Array | None = None
) -> EffectScore:
    """Return the evidence of an effect, averaged over its shapes; A is the diagonal of the matrix."""
    values = np.array([log_bayes(A, b, share * kind.typical_size, kind.sign) for share in SIZES])
    best = int(np.argmax(values[-1]))
    size = b[best] / (A[best] + kind.typical_size**-2)
    parameters = {**shape(best), kind.amplitude: kind.neutral + float(size)}
    return EffectScore(kind.name, _mean_evidence(values, weight), parameters)


def _section(name: str, bins: Bins, A: Array, b: Array) -> EffectScore:
    """Return the evidence of a constant resistance over a section of the line, averaged over all sections of bins."""
    i, j = np.triu_indices(bins.count + 1, 1)
    usable = (j - i) * bins.width >= 60.0  # m
    i, j = i[usable], j[usable]
    block, along = stretch_sums(A, b, i, j)
    # The prior of the length is uniform on a log scale.
    weight = 1.0 / (j - i)

    def shape(k: int) -> dict[str, float]:
        start, end = bins.edges[[i[k], j[k]]].tolist()
        return {'start': start, 'end': end}

    return _score(EFFECTS[name], np.maximum(block, 1e-9), along, shape, weight / weight.sum())


def _mean_evidence(values: Array, weight: Array | None = None) -> float:
    """Return 2 ln of the weighted mean of Bayes factors, which are given as 2 ln B."""
    weights = np.full(values.shape, 1.0) if weight is None else np.broadcast_to(weight, values.shape)
    return float(2.0 * (logsumexp(0.5 * values, b=weights) - np.log(weights.sum())))


def _by_evidence(scores: Iterable[EffectScore]) -> list[EffectScore]:
    return sorted(scores, key=lambda score: -score.evidence)


CERTAIN: Final = 0.75
"""Probability above which an effect is named. The largest is 0.93, since one in fourteen only looks like an effect."""
# Limits of evidence are in 2 ln of the Bayes factor.
_MAX_EFFECTS: Final = 3  # Maximum number of effects in a model
_MIN_SCORE: Final = 2.5  # Minimum evidence of effects and dependences that are fitted in full
_CERTAIN_SCORE: Final = 18.0  # Evidence of a dependence beside effects that needs no further fit to decide
_MAX_GROUPS: Final = 2  # Maximum number of generic dependences that are fitted in full


@dataclass(frozen=True, slots=True)
class State:
    """A model with the hyperparameters estimated with it."""

    model: Model
    hyper: Hyperparameters
    logs: Array  # Their logs, shape (7,)

    @property
    def names(self) -> tuple[str, ...]:
        """Effects of the model."""
        return tuple(term.name for term in self.model.terms)

    @property
    def excess(self) -> float:
        """How far the hyperparameters lie above the medians of their priors [1]."""
        return self.model.evidence().excess(self.logs)


@dataclass(frozen=True, slots=True)
class Selection:
    """Result of the selection."""

    base: State  # The model without effects
    final: State  # The model with the selected effects
    evidence: tuple[float, ...]  # 2 ln of the Bayes factor of each effect, given the others [1]
    # Name of the most probable alternative to each effect; empty if the effect is certain
    twins: tuple[tuple[str, ...], ...]
    groups: tuple[EffectScore, ...]  # Evidence of generic dependences, given all effects
    hypotheses: tuple[Hypothesis, ...]  # All sets of effects, and other causes, that were compared

    def without(self, k: int) -> Selection:
        """Return the same without effect k; what is left is fitted again."""
        final, evidence, twins = self.final, [*self.evidence], [*self.twins]
        del evidence[k], twins[k]
        state = replace(final, model=final.model.without(k).fit(final.hyper)) if evidence else self.base
        return replace(self, final=state, evidence=tuple(evidence), twins=tuple(twins))


class Search:
    """Search for the effects that explain a dataset; ``base`` is the model without effects."""

    def __init__(self, model: Model, advance: Callable[[str], None] = lambda _: None) -> None:
        self._advance = advance
        advance('noise')
        self.base = State(model, *model.evidence().maximise())
        self._scorer = EffectScorer(model)
        self._scores = cache(self._scorer.scores)
        self._fitted: list[Hypothesis] = []
        self._generic_of_base: list[EffectScore] | None = None

    def gradient_point(self) -> str | None:
        """Return the point of the train at which gradients are given, None if they are means under it."""
        model, hyper = self.base.model, self.base.hyper
        named, _ = self._scores(model, hyper)
        return preferred_point(model, hyper, next((s.evidence for s in named if s.name == 'map_shift'), 0.0))

    def run(self, *, slipping: bool) -> Selection:
        """Return the largest set of significant effects, each more probable than not, that is certain; none if none is.

        ``slipping`` says that wheels slip.
        """
        states = [self.base]
        while len(states[-1].names) < _MAX_EFFECTS and (extended := self._add(states[-1])) is not None:
            states.append(extended)
        while True:
            found = self._described(states.pop(), slipping=slipping)
            is_certain = probabilities(found.hypotheses).at_least(len(found.final.names)) >= CERTAIN
            if is_certain and all(term.significance > SIGNIFICANT for term in found.final.model.terms):
                return found

    def _described(self, state: State, *, slipping: bool) -> Selection:
        """Return the selection of a set of effects, with all that was compared with it."""
        groups = self._generic(state)
        state = replace(state, model=with_onsets(state.model, state.hyper))
        evidence = tuple(self._gain(state, k) for k in range(len(state.names)))
        hypotheses = tuple(self._hypotheses(state, evidence, groups, slipping=slipping))
        causes = probabilities(hypotheses)
        twins = tuple(
            () if causes.of(name) >= CERTAIN else _alternative(name, state.names, hypotheses) for name in state.names
        )
        return Selection(self.base, state, evidence, twins, tuple(groups), hypotheses)

    def _hypotheses(
        self, final: State, gains: Sequence[float], groups: Sequence[EffectScore], *, slipping: bool
    ) -> Iterator[Hypothesis]:
        """Yield what was compared: sets that were fitted, those with one effect more or another, and other causes."""
        yield Hypothesis((), 0.0)
        yield from self._fitted
        yield from self._scored((), 0.0, self._scores(self.base.model, self.base.hyper)[0])
        if self._generic_of_base is None:
            self._generic_of_base = list(groups) if not final.names else self._generic(self.base)
        for score in self._generic_of_base:
            yield dependence((), score.evidence)
        names, reached = final.names, self._beyond(final)
        for k, gain in enumerate(gains):
            rest = _less(names, k)
            yield Hypothesis(rest, reached - gain)
            yield from self._scored(rest, reached - gain, self._named(final.model.without(k), final.hyper))
        if names:
            yield Hypothesis(names, reached)
            yield from self._scored(names, reached, self._named(final.model, final.hyper))
        for score in groups:
            yield dependence(names, reached + score.evidence)
        if not slipping:  # whose bursts look like gusts
            yield noise(names, reached + final.excess)

    def _scored(self, names: Sequence[str], reached: float, scores: Iterable[EffectScore]) -> Iterator[Hypothesis]:
        """Yield sets with one effect more by its score; one that is not linear in its amplitude only if not fitted."""
        fitted = {frozenset(item.names) for item in self._fitted}
        for score in scores:
            if EFFECTS[score.name].linear or frozenset((*names, score.name)) not in fitted:
                yield Hypothesis((*names, score.name), reached + score.evidence)

    def _add(self, state: State) -> State | None:
        """Add the best effect; None if none is more probable than not, or others are no longer.

        Hyperparameters estimated without an effect have absorbed part of it, so each candidate is judged with
        hyperparameters estimated with it.
        """
        found = []
        for candidate in self._candidates(state):
            self._advance(' and '.join(score.name for score in candidate))
            found.append(self._extend(state.model, candidate, state))
        least = Hypothesis(state.names, self._beyond(state)).weight
        for extended in sorted(found, key=lambda one: -self._evidence(one)):
            if Hypothesis(extended.names, self._beyond(extended)).weight <= least:
                break
            if self._is_supported(exchanged := self._exchange(extended)):
                return exchanged
        return None

    def _candidates(self, state: State) -> list[tuple[EffectScore, ...]]:
        """Return the candidates: the best by the estimated hyperparameters, and the best by those at the prior median.

        Estimated variances of payload and brake can absorb all of an effect that is the same in all runs.
        """
        found: dict[tuple[str, tuple[int, ...]], EffectScore] = {}
        hyper = state.model.evidence().usual(state.hyper)
        # Hyperparameters, minimum evidence and maximum number; none far behind the best.
        for at, least, count in ((state.hyper, _MIN_SCORE, 3), (hyper, 30.0, 2)):
            named = self._named(state.model, at)
            for score in named[:count]:
                if score.evidence > max(least, named[0].evidence - 25.0):
                    found.setdefault((score.name, score.runs), score)
        candidates: list[tuple[EffectScore, ...]] = [(score,) for score in found.values()]
        # What lasts for whole runs looks like strong gusts.
        of_runs = self._scorer.of_runs(state.model, state.model.evidence().of_usual_gusts(state.hyper))
        # Effects of different runs hide each other, so two are also added at once.
        for count in (1, 2) if len(state.names) + 2 <= _MAX_EFFECTS else (1,):
            likely = [scores for scores in of_runs if len(scores) == count and scores[0].evidence > _MIN_SCORE]
            candidates += likely[: 3 - count]
        return candidates

    def _named(self, model: Model, hyper: Hyperparameters) -> list[EffectScore]:
        present = {term.name for term in model.terms} - set(SECTIONS)
        return [score for score in self._scores(model, hyper)[0] if score.name not in present]

    def _generic(self, state: State) -> list[EffectScore]:
        """Return the evidence of generic dependences, the best ones with hyperparameters estimated with each."""
        _, groups = self._scores(state.model, state.hyper)
        judged = []
        for score in groups[:_MAX_GROUPS]:
            found = score.evidence
            if found > _MIN_SCORE and (not state.names or found < _CERTAIN_SCORE):
                columns = self._scorer.group_columns(score.name)
                model = state.model.with_columns(columns, np.full(columns.shape[1], _GROUP_STDS[-1]))
                hyper, logs = model.evidence().maximise(state.logs)
                (alone,) = state.model.informations(hyper, [columns])
                lost = state.hyper.evidence - state.model.evidence().at(logs)
                found = max(found, _group_evidence(alone.A, alone.b) - lost)
            judged.append(replace(score, evidence=found))
        return _by_evidence([*judged, *groups[_MAX_GROUPS:]])

    def _extend(self, model: Model, scores: Sequence[EffectScore], before: State) -> State:
        """Add effects to a model: fit the parameters, estimate the hyperparameters again, and fit once more."""
        added = (EffectTerm(score.name, score.parameters, runs=score.runs) for score in scores)
        model = model.with_terms((*model.terms, *added)).fit(before.hyper)
        hyper, logs = model.evidence().maximise(before.logs)
        # Gusts that stood for the effect have hidden its onset, which no fit finds from afar.
        if (timed := with_onsets(model, hyper)) is not model:
            model = timed.fit(hyper)
            hyper, logs = model.evidence().maximise(logs)
        state = State(model.fit(hyper), hyper, logs)
        self._fitted.append(Hypothesis(state.names, self._beyond(state)))
        return state

    def _beyond(self, state: State) -> float:
        """Return 2 ln of the Bayes factor of a model against that without effects."""
        return self._evidence(state) - self._evidence(self.base)

    def _evidence(self, state: State) -> float:
        """Return 2 ln of the evidence of a model, with the full priors of its effects instead of those of the fit."""
        costs = sum(prior_cost(term, state.model.dataset) for term in state.model.terms)
        return state.hyper.evidence - state.model.odometry_cost - costs

    def _gain(self, state: State, k: int) -> float:
        """Return 2 ln of the Bayes factor of effect k given the others, at the hyperparameters of the full model."""
        model, without = state.model, state.model.without(k)
        cost = prior_cost(model.terms[k], model.dataset) + model.odometry_cost
        return model.evidence().at(state.logs) - cost - (without.evidence().at(state.logs) - without.odometry_cost)

    def _exchange(self, state: State) -> State:
        """Replace an effect by another one where the data prefer it, given the other effects."""
        if len(state.model.terms) < 2:
            return state
        for k in range(len(state.model.terms)):
            without = state.model.without(k)
            others = (one for one in self._named(without, state.hyper) if one.name != state.model.terms[k].name)
            best = next(others, None)
            if best is not None and best.evidence > self._gain(state, k) + 2.0:
                state = self._extend(without, (best,), state)
        return state

    def _is_supported(self, state: State) -> bool:
        """Return True if every effect of the joint fit is significant and probable, and shows in the other runs."""
        model, reached = state.model, self._beyond(state)
        return all(
            term.significance > SIGNIFICANT
            and Hypothesis(state.names, reached).weight
            > Hypothesis(_less(state.names, k), reached - self._gain(state, k)).weight
            and (term.name not in SECTIONS or is_confirmed_by_other_runs(model, k, state.hyper))
            for k, term in enumerate(model.terms)
        )


def _alternative(name: str, names: tuple[str, ...], hypotheses: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return the most probable effect beside several if one of them is not missing, empty if there is none."""
    others = probabilities(one for one in hypotheses if name not in one.names).present
    rivals = [(p, other) for other, p in others if other not in names]
    return (max(rivals)[1],) if rivals else ()


def _less(names: tuple[str, ...], k: int) -> tuple[str, ...]:
    return (*names[:k], *names[k + 1 :])


def with_onsets(model: Model, hyper: Hyperparameters) -> Model:
    """Return a fitted model in which effects have the posterior mean and variance of an onset or duration."""
    terms = model.terms
    timed = tuple(with_onset(term, model.without(k), hyper) for k, term in enumerate(terms))
    return model if all(a is b for a, b in zip(timed, terms, strict=True)) else model.with_terms(timed)


def with_onset(term: EffectTerm, without: Model, hyper: Hyperparameters) -> EffectTerm:
    """Return an effect fitted to a model ``without`` it, with posterior mean and variance of its onset or duration.

    The forces change by steps there, which a fit does not follow from afar.
    """
    kind = term.kind
    names = [n for n in kind.shape if kind.parameters[n].unit == 's']
    if len(names) != 1 or term.covariance is None or not kind.linear:
        return term
    name, dataset, limits = names[0], without.dataset, kind.parameters[names[0]].search
    is_log = limits is not None and kind.parameters[name].grid == 'log'
    if limits is None:
        grid = np.quantile(dataset.time, np.linspace(0.0, 1.0, 122)[1:-1])  # where the train moves
    else:
        grid = np.geomspace(*limits, 40) if is_log else np.linspace(*limits, 40)
    times = np.sort(np.append(grid, term.parameters[name]))
    columns = [unit_resistance(without.evaluator, kind, {**term.shape, name: float(t)}) for t in times]
    (information,) = without.informations(hyper, [dataset.column(np.stack(columns, axis=1))])
    value = log_bayes(np.diag(information.A), information.b, kind.typical_size, kind.sign)
    weight = np.exp(0.5 * (value - value.max()))
    weight = weight * np.gradient(np.log(times) if is_log else times)
    weight /= weight.sum()
    mean = float(weight @ times)
    variance = float(weight @ np.square(times - mean)) + float(np.interp(mean, grid, np.gradient(grid))) ** 2 / 12.0
    at = term.index(name)
    covariance = term.covariance.copy()
    covariance[at, at] = max(covariance[at, at], variance)
    return replace(term, parameters={**term.parameters, name: mean}, covariance=covariance)


def is_confirmed_by_other_runs(model: Model, k: int, hyper: Hyperparameters) -> bool:
    """Return False if effect k is detectable in all runs but the most evident one, and does not show there."""
    term, without = model.terms[k], model.without(k)
    column = without.dataset.column(unit_resistance(without.evaluator, term.kind, term.shape)[:, None])
    columns = np.concatenate([without.columns, column], axis=1)
    products = without.products_by_run(columns, hyper)
    size = term.amount
    most = int(np.argmax(size * products[:, 0, -1]))
    root = without.prior_factor(hyper.spread)
    others = eliminate(products.sum(axis=0) - products[most], root)
    A, b = float(others.A[0, 0]), float(others.b[0])
    # With three standard deviations, they must show at least 40 % of the amplitude.
    return A * size * size < 3.0**2 or b / (A * size) > 0.4

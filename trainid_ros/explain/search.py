# SPDX-License-Identifier: Apache-2.0
"""Select the effects that the data support: forward selection with exchange, and the alternatives of each effect.

An effect at one place must show in all runs that pass it: a burst of slip or an unreported brake application causes a
gap at one place too, but in a single run. The onset time of an effect has the posterior over all times, since a
linearisation at one time is not valid at others: while the train stands, the likelihood is flat in it, and it changes
abruptly elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.effect_scores import SECTIONS, EffectScore, EffectScorer
from trainid_ros.explain.effects import EffectTerm, prior_cost, shape_names, sign, unit_resistance
from trainid_ros.explain.likelihood import Hyperparameters, eliminate, log_bayes
from trainid_ros.explain.measurement_errors import preferred_point
from trainid_ros.explain.model import Model
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

NAMED: Final = 15.0
"""2 ln of the Bayes factor required to add an effect."""
NAMED_IN_GAP: Final = 6.0
"""The same while a generic dependence remains that exceeds :data:`GENERIC`."""
GENERIC: Final = 18.0
"""2 ln of the Bayes factor of a generic dependence for the verdict that no effect fits."""
LEFT_OVER: Final = 0.15
"""Share of the evidence that may remain after the named effects, since equations of real effects differ slightly."""
TWIN: Final = 6.0
"""Difference of evidence below which two effects are indistinguishable."""
MAX_EFFECTS: Final = 3
"""Maximum number of effects in a model."""
# Effects that are fitted in full: how many by the estimated hyperparameters and by those at the prior median, minimum
# evidence with each, and maximum difference from the best one.
_CANDIDATES: Final = 3
_MEDIAN_CANDIDATES: Final = 2
_MIN_SCORE: Final = 2.5
_MIN_AT_MEDIAN: Final = 30.0
_NEAR: Final = 25.0
# Minimum significance of the amplitude of an effect in standard deviations.
_SIGNIFICANT: Final = 2.5
# Generic dependences that are fitted in full, and the prior std of their coefficients [N/kN].
_GROUPS: Final = 2
_GROUP_STD: Final = 0.3


@dataclass(frozen=True, slots=True)
class State:
    """A model with the hyperparameters estimated with it.

    Attributes:
        model: The model.
        hyper: Its hyperparameters.
        logs: Their logs, shape (7,).

    """

    model: Model
    hyper: Hyperparameters
    logs: NDArray[np.float64]

    @property
    def excess(self) -> float:
        """How far the hyperparameters lie above the medians of their priors [1]."""
        return self.model.evidence().excess(self.logs)


@dataclass(frozen=True, slots=True)
class Selection:
    """Result of the selection.

    Attributes:
        base: The model without effects.
        final: The model with the selected effects.
        evidence: 2 ln of the Bayes factor of each effect, given the others [1].
        twins: Name of the effect that is indistinguishable from each effect; empty if there is none.
        groups: Evidence of generic dependences, given all effects.

    """

    base: State
    final: State
    evidence: tuple[float, ...]
    twins: tuple[tuple[str, ...], ...]
    groups: tuple[EffectScore, ...]


class Search:
    """Search for the effects that explain a dataset.

    Attributes:
        base: The model without effects.
        scorer: Scores of all effects and generic dependences.

    """

    def __init__(self, model: Model, advance: Callable[[str], None] = lambda _: None) -> None:
        self._advance = advance
        advance('noise')
        hyper, logs = model.evidence().maximise()
        self.base = State(model, hyper, logs)
        self.scorer = EffectScorer(model)
        self._known: dict[tuple[Model, Hyperparameters], tuple[list[EffectScore], list[EffectScore]]] = {}

    def _scores(self, model: Model, hyper: Hyperparameters) -> tuple[list[EffectScore], list[EffectScore]]:
        """Return the evidence of all effects and groups, calculated once."""
        if (model, hyper) not in self._known:
            self._known[model, hyper] = self.scorer.scores(model, hyper)
        return self._known[model, hyper]

    def gradient_point(self) -> str | None:
        """Return the point of the train at which gradients are given, None if they are means under it."""
        model, hyper = self.base.model, self.base.hyper
        named, _ = self._scores(model, hyper)
        return preferred_point(model, hyper, next((s.evidence for s in named if s.name == 'map_shift'), 0.0))

    def run(self) -> Selection:
        """Return the best set of effects found."""
        state = self.base
        while len(state.model.terms) < MAX_EFFECTS and (extended := self._add(state, NAMED)) is not None:
            state = extended
        groups = self._generic(state)
        if groups[0].evidence > GENERIC:
            # A dependence certainly remains, so an effect that accounts for it needs less evidence of its own.
            extended = self._add(state, NAMED_IN_GAP) if len(state.model.terms) < MAX_EFFECTS else None
            if extended is not None and (rest := self._generic(extended))[0].evidence < GENERIC:
                state, groups = extended, rest
        state = replace(state, model=with_onsets(state.model, state.hyper))
        results = [self._evidence_and_twins(state, k) for k in range(len(state.model.terms))]
        evidence, twins = (tuple(column) for column in zip(*results, strict=True)) if results else ((), ())
        return Selection(self.base, state, evidence, twins, tuple(groups))

    def _add(self, state: State, threshold: float) -> State | None:
        """Add the best effect; None if none has enough evidence or others lose theirs.

        Hyperparameters estimated without an effect have absorbed part of it, so each candidate is judged with
        hyperparameters estimated with it.
        """
        required, found = self._evidence(state) + threshold, []
        for candidate in self._candidates(state):
            self._advance(candidate.name)
            found.append(self._extend(state, candidate))
        for extended in sorted(found, key=lambda one: -self._evidence(one)):
            if self._evidence(extended) > required and self._is_supported(
                exchanged := self._exchange(extended), threshold
            ):
                return exchanged
        return None

    def _candidates(self, state: State) -> list[EffectScore]:
        """Return the candidates: the best by the estimated hyperparameters, and the best by those at the prior median.

        Estimated variances of payload and brake can absorb all of an effect that is the same in all runs.
        """
        found: dict[str, EffectScore] = {}
        hyper = state.model.evidence().usual(state.hyper)
        for at, least, count in ((state.hyper, _MIN_SCORE, _CANDIDATES), (hyper, _MIN_AT_MEDIAN, _MEDIAN_CANDIDATES)):
            named = self._named(state.model, at)
            for score in named[:count]:
                if score.evidence > max(least, named[0].evidence - _NEAR):
                    found.setdefault(score.name, score)
        return list(found.values())

    def _named(self, model: Model, hyper: Hyperparameters) -> list[EffectScore]:
        """Return the evidence of all effects that can be added to a model, best first."""
        present = {term.name for term in model.terms} - set(SECTIONS)
        return [score for score in self._scores(model, hyper)[0] if score.name not in present]

    def _generic(self, state: State) -> list[EffectScore]:
        """Return the evidence of generic dependences, the best ones with hyperparameters estimated with each."""
        _, groups = self._scores(state.model, state.hyper)
        judged = []
        for score in groups[:_GROUPS]:
            found = score.evidence
            if _MIN_SCORE < found < GENERIC:
                model = state.model.with_nuisances(self.scorer.group_columns(score.name), _GROUP_STD)
                hyper, _ = model.evidence().maximise(state.logs)
                found = max(found, hyper.evidence - state.hyper.evidence)
            judged.append(replace(score, evidence=found))
        return sorted([*judged, *groups[_GROUPS:]], key=lambda score: -score.evidence)

    def _extend(self, state: State, score: EffectScore) -> State:
        terms = (*state.model.terms, EffectTerm(score.name, score.parameters))
        return self._refit(state.model.with_terms(terms), state)

    def _refit(self, model: Model, before: State) -> State:
        """Fit the parameters, estimate the hyperparameters again, and fit once more."""
        model = model.fit(before.hyper)
        hyper, logs = model.evidence().maximise(before.logs)
        return State(model.fit(hyper), hyper, logs)

    def _evidence(self, state: State) -> float:
        """Return 2 ln of the evidence of a model, with the full priors of its effects instead of those of the fit."""
        costs = sum(prior_cost(term, state.model.dataset) for term in state.model.terms)
        return state.hyper.evidence - state.model.odometry_cost - costs

    def _gain(self, state: State, k: int) -> float:
        """Return 2 ln of the Bayes factor of effect k given the others, at the hyperparameters of the full model."""
        term, without = state.model.terms[k], state.model.without(k)
        cost = prior_cost(term, state.model.dataset) + state.model.odometry_cost
        return (
            state.model.evidence().at(state.logs) - cost - (without.evidence().at(state.logs) - without.odometry_cost)
        )

    def _exchange(self, state: State) -> State:
        """Replace an effect by another one where the data prefer it, given the other effects."""
        if len(state.model.terms) < 2:
            return state
        for k in range(len(state.model.terms)):
            without = state.model.without(k)
            best = self._best_alternative(state.model.terms[k].name, without, state.hyper)
            if best is not None and best.evidence > self._gain(state, k) + 2.0:
                state = self._refit(without.with_terms((*without.terms, EffectTerm(best.name, best.parameters))), state)
        return state

    def _is_supported(self, state: State, threshold: float) -> bool:
        """Return True if every effect of the joint fit is significant, has its evidence and shows in the other runs."""
        model = state.model
        return all(
            term.significance > _SIGNIFICANT
            and self._gain(state, k) > threshold
            and (term.name not in SECTIONS or is_confirmed_by_other_runs(model, k, state.hyper))
            for k, term in enumerate(model.terms)
        )

    def _evidence_and_twins(self, state: State, k: int) -> tuple[float, tuple[str, ...]]:
        """Return the evidence of effect k given the others, and its best alternative if that is indistinguishable."""
        own = self._gain(state, k)
        nearest = self._best_alternative(state.model.terms[k].name, state.model.without(k), state.hyper)
        return own, (nearest.name,) if nearest is not None and nearest.evidence > own - TWIN else ()

    def _best_alternative(self, name: str, model: Model, hyper: Hyperparameters) -> EffectScore | None:
        """Return the best effect other than ``name`` that can be added to a model."""
        return next((score for score in self._named(model, hyper) if score.name != name), None)


_TIMES: Final = 120
"""Grid points of the onset time."""


def with_onsets(model: Model, hyper: Hyperparameters) -> Model:
    """Return a fitted model in which effects with an onset time have the mean and variance of its posterior."""
    terms = model.terms
    timed = tuple(with_onset(term, model.without(k), hyper) for k, term in enumerate(terms))
    return model if all(a is b for a, b in zip(timed, terms, strict=True)) else model.with_terms(timed)


def with_onset(term: EffectTerm, without: Model, hyper: Hyperparameters) -> EffectTerm:
    """Return a fitted effect with the posterior mean and variance of its onset time; unchanged if it has none.

    Args:
        term: The fitted effect.
        without: The model without it.
        hyper: Hyperparameters of noise and nuisances.

    """
    kind = EFFECTS[term.name]
    names = [n for n in shape_names(kind) if kind.parameters[n].unit == 's' and kind.parameters[n].search is None]
    if len(names) != 1 or term.covariance is None:
        return term
    name, dataset = names[0], without.dataset
    times = np.linspace(dataset.time.min(), dataset.time.max(), _TIMES + 2)[1:-1]
    times = np.sort(np.append(times, term.parameters[name]))
    shape = {n: term.parameters[n] for n in shape_names(kind)}
    columns = [unit_resistance(without.evaluator, kind, {**shape, name: float(t)}) for t in times]
    (information,) = without.informations(hyper, [dataset.column(np.stack(columns, axis=1))])
    value = log_bayes(np.diag(information.A), information.b, kind.typical_size, sign(kind))
    weight = np.exp(0.5 * (value - value.max()))
    weight = weight * np.gradient(times)
    weight /= weight.sum()
    mean = float(weight @ times)
    variance = float(weight @ np.square(times - mean)) + float(np.median(np.diff(times))) ** 2 / 12.0
    at = list(term.parameters).index(name)
    covariance = term.covariance.copy()
    covariance[at, at] = max(covariance[at, at], variance)
    return replace(term, parameters={**term.parameters, name: mean}, covariance=covariance)


# Significance in standard deviations at which the other runs can detect the effect, and the share of its amplitude
# that they must show.
_VISIBLE: Final = 3.0
_SHARE: Final = 0.4


def is_confirmed_by_other_runs(model: Model, k: int, hyper: Hyperparameters) -> bool:
    """Return False if effect k is detectable in the other runs but does not show there.

    The other runs are all but the one that contributes most of its evidence.
    """
    term, kind = model.terms[k], EFFECTS[model.terms[k].name]
    without = model.without(k)
    shape = {name: term.parameters[name] for name in shape_names(kind)}
    column = without.dataset.column(unit_resistance(without.evaluator, kind, shape)[:, None])
    columns = np.concatenate([without.columns, column], axis=1)
    products = without.products_by_run(columns, hyper)
    size = term.parameters[kind.amplitude] - kind.neutral
    most = int(np.argmax(size * products[:, 0, -1]))
    root = without.prior_factor(hyper.spread)
    others = eliminate(products.sum(axis=0) - products[most], len(root), root)
    A, b = float(others.A[0, 0]), float(others.b[0])
    return A * size * size < _VISIBLE**2 or b / (A * size) > _SHARE

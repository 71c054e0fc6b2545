# SPDX-License-Identifier: Apache-2.0
"""Which effects the data call for: one after another, exchanged where another one fits better, with their twins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.explain.cross_run_check import is_seen_by_others
from trainid_ros.explain.effect_scores import EffectScorer
from trainid_ros.explain.families import SECTIONS
from trainid_ros.explain.gradient_reference import preferred_point
from trainid_ros.explain.model import EffectTerm, prior_cost
from trainid_ros.explain.onset import with_onsets

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from trainid_ros.explain.effect_scores import EffectScore
    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import Model

NAMED: Final = 15.0
"""2 ln of the Bayes factor an effect needs."""
NAMED_IN_GAP: Final = 6.0
"""The same where something without a name is certain otherwise."""
NAMELESS: Final = 18.0
"""The same of a dependence without a name, for the verdict that no effect fits."""
LEFT_OVER: Final = 0.15
"""Share of all evidence that may be left after the named effects, since equations of real effects differ a little."""
TWIN: Final = 6.0
"""Effects this near in evidence to a named one cannot be told from it."""
MOST: Final = 3
"""Effects in a model, at most."""
# Effects that get a closer look: so many by the sizes found and by usual ones, with so much evidence, and so near the
# best one.
_RIVALS: Final = 3
_USUAL_RIVALS: Final = 2
_WORTH_A_TRY: Final = 2.5
_PLAIN: Final = 30.0
_NEAR: Final = 25.0
# Standard deviations that the size of an effect must be away from none.
_SIGNIFICANT: Final = 2.5
# The same of dependences without a name, and the prior std of their sizes [N/kN].
_GROUPS: Final = 2
_GROUP_STD: Final = 0.3


@dataclass(frozen=True, slots=True)
class State:
    """A model, the sizes found with it, and their logs."""

    model: Model
    hyper: Hyperparameters
    logs: NDArray[np.float64]

    @property
    def excess(self) -> float:
        """How far sizes lie above what they usually are."""
        return self.model.evidence().excess(self.logs)


@dataclass(frozen=True, slots=True)
class Selection:
    """What was selected.

    Attributes:
        base: The model without effects.
        final: The model with them.
        evidence: 2 ln of the Bayes factor of each member, given the others.
        twins: The name that cannot be told from each member; empty if there is none.
        groups: Evidence of what has no name, given all members.

    """

    base: State
    final: State
    evidence: tuple[float, ...]
    twins: tuple[tuple[str, ...], ...]
    groups: tuple[EffectScore, ...]


class Search:
    """Looks for the effects that explain a drive."""

    def __init__(self, model: Model, advance: Callable[[str], None] = lambda _: None) -> None:
        self._advance = advance
        advance('noise')
        hyper, logs = model.evidence().maximise()
        self.base = State(model, hyper, logs)
        self.scorer = EffectScorer(model)
        self._of_base: dict[Hyperparameters, tuple[list[EffectScore], list[EffectScore]]] = {}

    def _scores(self, model: Model, hyper: Hyperparameters) -> tuple[list[EffectScore], list[EffectScore]]:
        """Return the evidence of all effects and groups; the base model is asked for several times."""
        if model is not self.base.model:
            return self.scorer.scores(model, hyper)
        if hyper not in self._of_base:
            self._of_base[hyper] = self.scorer.scores(model, hyper)
        return self._of_base[hyper]

    def gradient_point(self) -> str | None:
        """Return the point of the train that gradients are rather known at, None if they are means under it."""
        model, hyper = self.base.model, self.base.hyper
        named, _ = self._scores(model, hyper)
        return preferred_point(model, hyper, next((s.evidence for s in named if s.name == 'map_shift'), 0.0))

    def run(self) -> Selection:
        """Return the best set of effects found."""
        state = self.base
        while len(state.model.terms) < MOST and (grown := self._add(state, NAMED)) is not None:
            state = grown
        groups = self._nameless(state)
        if groups[0].evidence > NAMELESS:
            # Something is there for certain: an effect that accounts for it needs less evidence of its own.
            grown = self._add(state, NAMED_IN_GAP) if len(state.model.terms) < MOST else None
            if grown is not None and (left := self._nameless(grown))[0].evidence < NAMELESS:
                state, groups = grown, left
        state = replace(state, model=with_onsets(state.model, state.hyper))
        standings = [self._standing(state, k) for k in range(len(state.model.terms))]
        evidence, twins = (tuple(column) for column in zip(*standings, strict=True)) if standings else ((), ())
        return Selection(self.base, state, evidence, twins, tuple(groups))

    def _add(self, state: State, threshold: float) -> State | None:
        """Add the best effect; None if none has evidence enough or others lose theirs.

        Noise and nuisances that were estimated without an effect have taken part of it for their own, so what comes
        near is judged with sizes that are estimated with it.
        """
        worth, found = self._worth(state) + threshold, []
        for rival in self._rivals(state):
            self._advance(rival.name)
            found.append(self._grow(state, rival))
        for grown in sorted(found, key=lambda one: -self._worth(one)):
            if self._worth(grown) > worth and self._holds(exchanged := self._exchange(grown), threshold):
                return exchanged
        return None

    def _rivals(self, state: State) -> list[EffectScore]:
        """Return effects worth a closer look: the best with the sizes found, and the best with usual ones.

        Loads and brakes that differ from run to run can take all of an effect that is the same in all of them.
        """
        found: dict[str, EffectScore] = {}
        hyper = state.model.evidence().usual(state.hyper)
        for at, least, count in ((state.hyper, _WORTH_A_TRY, _RIVALS), (hyper, _PLAIN, _USUAL_RIVALS)):
            named = self._named(state.model, at)
            for score in named[:count]:
                if score.evidence > max(least, named[0].evidence - _NEAR):
                    found.setdefault(score.name, score)
        return list(found.values())

    def _named(self, model: Model, hyper: Hyperparameters) -> list[EffectScore]:
        """Return the evidence of all effects that can be added to a model, best first."""
        present = {term.name for term in model.terms} - set(SECTIONS)
        return [score for score in self._scores(model, hyper)[0] if score.name not in present]

    def _nameless(self, state: State) -> list[EffectScore]:
        """Return the evidence of what has no name beside a model, the best judged with sizes of noise of their own."""
        _, groups = self._scores(state.model, state.hyper)
        weighed = []
        for score in groups[:_GROUPS]:
            found = score.evidence
            if _WORTH_A_TRY < found < NAMELESS:
                model = state.model.beside(self.scorer.group_columns(score.name), _GROUP_STD)
                hyper, _ = model.evidence().maximise(state.logs)
                found = max(found, hyper.evidence - state.hyper.evidence)
            weighed.append(replace(score, evidence=found))
        return sorted([*weighed, *groups[_GROUPS:]], key=lambda score: -score.evidence)

    def _grow(self, state: State, score: EffectScore) -> State:
        terms = (*state.model.terms, EffectTerm(score.name, score.parameters))
        return self._settle(state.model.having(terms), state)

    def _settle(self, model: Model, before: State) -> State:
        """Refine parameters, estimate sizes anew, refine again."""
        model = model.fit(before.hyper)
        hyper, logs = model.evidence().maximise(before.logs)
        return State(model.fit(hyper), hyper, logs)

    def _worth(self, state: State) -> float:
        """Return 2 ln of the evidence of a model with its members, by priors wider than about where they were found."""
        costs = sum(prior_cost(term, state.model.dataset) for term in state.model.terms)
        return state.hyper.evidence - state.model.odometry_cost - costs

    def _gain(self, state: State, k: int) -> float:
        """Return 2 ln of the Bayes factor of member k given the others, at the sizes found with all."""
        term, without = state.model.terms[k], state.model.without(k)
        cost = prior_cost(term, state.model.dataset) + state.model.odometry_cost
        return (
            state.model.evidence().at(state.logs) - cost - (without.evidence().at(state.logs) - without.odometry_cost)
        )

    def _exchange(self, state: State) -> State:
        """Put another effect in the place of a member where the data prefer it, given the others."""
        if len(state.model.terms) < 2:
            return state
        for k in range(len(state.model.terms)):
            without = state.model.without(k)
            best = self._best_beside(state.model.terms[k].name, without, state.hyper)
            if best is not None and best.evidence > self._gain(state, k) + 2.0:
                state = self._settle(without.having((*without.terms, EffectTerm(best.name, best.parameters))), state)
        return state

    def _holds(self, state: State, threshold: float) -> bool:
        """Return True if every member keeps its evidence, a size and its witnesses, once all is estimated with it."""
        model = state.model
        return all(
            term.significance > _SIGNIFICANT
            and self._gain(state, k) > threshold
            and (term.name not in SECTIONS or is_seen_by_others(model, k, state.hyper))
            for k, term in enumerate(model.terms)
        )

    def _standing(self, state: State, k: int) -> tuple[float, tuple[str, ...]]:
        """Return the evidence of member k given the others, and the effect that comes nearest it, if it comes near."""
        mine = self._gain(state, k)
        nearest = self._best_beside(state.model.terms[k].name, state.model.without(k), state.hyper)
        return mine, (nearest.name,) if nearest is not None and nearest.evidence > mine - TWIN else ()

    def _best_beside(self, name: str, model: Model, hyper: Hyperparameters) -> EffectScore | None:
        """Return the best effect of another name that can be added to a model."""
        return next((score for score in self._named(model, hyper) if score.name != name), None)

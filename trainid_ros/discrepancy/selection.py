# SPDX-License-Identifier: Apache-2.0
"""Which effects the data call for: one after another, exchanged where another one fits better, with their twins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.discrepancy.families import SECTIONS
from trainid_ros.discrepancy.model import Member, prior_cost
from trainid_ros.discrepancy.onset import with_onsets
from trainid_ros.discrepancy.reading import preferred_point
from trainid_ros.discrepancy.screen import Screen
from trainid_ros.discrepancy.witnesses import is_seen_by_others

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Model
    from trainid_ros.discrepancy.screen import Score

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
    sizes: Sizes
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
    groups: tuple[Score, ...]


class Search:
    """Looks for the effects that explain a drive."""

    def __init__(self, model: Model, advance: Callable[[str], None] = lambda _: None) -> None:
        self._advance = advance
        advance('noise')
        sizes, logs = model.evidence().maximise()
        self.base = State(model, sizes, logs)
        self.screen = Screen(model)
        self._of_base: dict[Sizes, tuple[list[Score], list[Score]]] = {}

    def _scores(self, model: Model, sizes: Sizes) -> tuple[list[Score], list[Score]]:
        """Return the evidence of all effects and groups; the base model is asked for several times."""
        if model is not self.base.model:
            return self.screen.scores(model, sizes)
        if sizes not in self._of_base:
            self._of_base[sizes] = self.screen.scores(model, sizes)
        return self._of_base[sizes]

    def gradient_point(self) -> str | None:
        """Return the point of the train that gradients are rather known at, None if they are means under it."""
        model, sizes = self.base.model, self.base.sizes
        named, _ = self._scores(model, sizes)
        return preferred_point(model, sizes, next((s.evidence for s in named if s.name == 'map_shift'), 0.0))

    def run(self) -> Selection:
        """Return the best set of effects found."""
        state = self.base
        while len(state.model.members) < MOST and (grown := self._add(state, NAMED)) is not None:
            state = grown
        groups = self._nameless(state)
        if groups[0].evidence > NAMELESS:
            # Something is there for certain: an effect that accounts for it needs less evidence of its own.
            grown = self._add(state, NAMED_IN_GAP) if len(state.model.members) < MOST else None
            if grown is not None and (left := self._nameless(grown))[0].evidence < NAMELESS:
                state, groups = grown, left
        state = replace(state, model=with_onsets(state.model, state.sizes))
        standings = [self._standing(state, k) for k in range(len(state.model.members))]
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

    def _rivals(self, state: State) -> list[Score]:
        """Return effects worth a closer look: the best with the sizes found, and the best with usual ones.

        Loads and brakes that differ from run to run can take all of an effect that is the same in all of them.
        """
        found: dict[str, Score] = {}
        sizes = state.model.evidence().usual(state.sizes)
        for at, least, count in ((state.sizes, _WORTH_A_TRY, _RIVALS), (sizes, _PLAIN, _USUAL_RIVALS)):
            named = self._named(state.model, at)
            for score in named[:count]:
                if score.evidence > max(least, named[0].evidence - _NEAR):
                    found.setdefault(score.name, score)
        return list(found.values())

    def _named(self, model: Model, sizes: Sizes) -> list[Score]:
        """Return the evidence of all effects that can be added to a model, best first."""
        present = {member.name for member in model.members} - set(SECTIONS)
        return [score for score in self._scores(model, sizes)[0] if score.name not in present]

    def _nameless(self, state: State) -> list[Score]:
        """Return the evidence of what has no name beside a model, the best judged with sizes of noise of their own."""
        _, groups = self._scores(state.model, state.sizes)
        weighed = []
        for score in groups[:_GROUPS]:
            found = score.evidence
            if _WORTH_A_TRY < found < NAMELESS:
                model = state.model.beside(self.screen.group_columns(score.name), _GROUP_STD)
                sizes, _ = model.evidence().maximise(state.logs)
                found = max(found, sizes.evidence - state.sizes.evidence)
            weighed.append(replace(score, evidence=found))
        return sorted([*weighed, *groups[_GROUPS:]], key=lambda score: -score.evidence)

    def _grow(self, state: State, score: Score) -> State:
        members = (*state.model.members, Member(score.name, score.parameters))
        return self._settle(state.model.having(members), state)

    def _settle(self, model: Model, before: State) -> State:
        """Refine parameters, estimate sizes anew, refine again."""
        model = model.fit(before.sizes)
        sizes, logs = model.evidence().maximise(before.logs)
        return State(model.fit(sizes), sizes, logs)

    def _worth(self, state: State) -> float:
        """Return 2 ln of the evidence of a model with its members, by priors wider than about where they were found."""
        costs = sum(prior_cost(member, state.model.drive) for member in state.model.members)
        return state.sizes.evidence - state.model.odometry_cost - costs

    def _gain(self, state: State, k: int) -> float:
        """Return 2 ln of the Bayes factor of member k given the others, at the sizes found with all."""
        member, without = state.model.members[k], state.model.without(k)
        cost = prior_cost(member, state.model.drive) + state.model.odometry_cost
        return (
            state.model.evidence().at(state.logs) - cost - (without.evidence().at(state.logs) - without.odometry_cost)
        )

    def _exchange(self, state: State) -> State:
        """Put another effect in the place of a member where the data prefer it, given the others."""
        if len(state.model.members) < 2:
            return state
        for k in range(len(state.model.members)):
            without = state.model.without(k)
            best = self._best_beside(state.model.members[k].name, without, state.sizes)
            if best is not None and best.evidence > self._gain(state, k) + 2.0:
                state = self._settle(without.having((*without.members, Member(best.name, best.parameters))), state)
        return state

    def _holds(self, state: State, threshold: float) -> bool:
        """Return True if every member keeps its evidence, a size and its witnesses, once all is estimated with it."""
        model = state.model
        return all(
            member.significance > _SIGNIFICANT
            and self._gain(state, k) > threshold
            and (member.name not in SECTIONS or is_seen_by_others(model, k, state.sizes))
            for k, member in enumerate(model.members)
        )

    def _standing(self, state: State, k: int) -> tuple[float, tuple[str, ...]]:
        """Return the evidence of member k given the others, and the effect that comes nearest it, if it comes near."""
        mine = self._gain(state, k)
        nearest = self._best_beside(state.model.members[k].name, state.model.without(k), state.sizes)
        return mine, (nearest.name,) if nearest is not None and nearest.evidence > mine - TWIN else ()

    def _best_beside(self, name: str, model: Model, sizes: Sizes) -> Score | None:
        """Return the best effect of another name that can be added to a model."""
        return next((score for score in self._named(model, sizes) if score.name != name), None)

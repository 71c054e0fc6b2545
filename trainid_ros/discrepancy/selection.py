# SPDX-License-Identifier: Apache-2.0
"""Which effects the data call for: one after another, exchanged where another one fits better, with their twins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.discrepancy.families import SECTIONS
from trainid_ros.discrepancy.model import Member, prior_cost
from trainid_ros.discrepancy.screen import Score, Screen

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Fit, Model

NAMED: Final = 15.0
"""2 ln of the Bayes factor an effect needs."""
NAMELESS: Final = 20.0
"""The same of a dependence without a name, for the verdict that no effect fits."""
LEFT_OVER: Final = 0.15
"""Share of all evidence that may be left after the named effects, since equations of real effects differ a little."""
TWIN: Final = 6.0
"""Effects this near in evidence to a named one cannot be told from it."""
MOST: Final = 3
_RIVALS: Final = 3
_WORTH_A_TRY: Final = 2.5
_NEAR: Final = 25.0
_GROUPS: Final = 2
_GROUP_STD: Final = 0.3


@dataclass(frozen=True, slots=True)
class State:
    """A model, the sizes found with it, and their logs."""

    model: Model
    sizes: Sizes
    logs: NDArray
    fit: Fit | None


@dataclass(frozen=True, slots=True)
class Selection:
    """What was selected.

    Attributes:
        base: The model without effects.
        final: The model with them.
        evidence: 2 ln of the Bayes factor of each member, given the others.
        twins: Names that cannot be told from each member, nearest first.
        named: Evidence of what else has a name, given all members.
        groups: Evidence of what has no name, given all members.
        total: 2 ln of the Bayes factor of all members together.

    """

    base: State
    final: State
    evidence: tuple[float, ...]
    twins: tuple[tuple[str, ...], ...]
    named: tuple[Score, ...]
    groups: tuple[Score, ...]
    total: float


class Search:
    """Looks for the effects that explain a drive."""

    def __init__(self, model: Model, advance: Callable[[str], None] = lambda _: None) -> None:
        self._advance = advance
        advance('noise')
        sizes, logs = model.evidence().maximise()
        self.base = State(model, sizes, logs, None)
        self._base_evidence = model.evidence()
        self.screen = Screen(model)

    def run(self) -> Selection:
        """Return the best set of effects found."""
        state, total = self.base, 0.0
        named, groups = self.screen.scores(state.model, state.sizes)
        while len(state.model.members) < MOST:
            grown = self._add(state, named)
            if grown is None or not self._holds(grown := self._exchange(grown)):
                break
            state = grown
            named, groups = self.screen.scores(state.model, state.sizes)
        groups = self._weigh_groups(state, groups)
        evidence, twins = [], []
        for k in range(len(state.model.members)):
            own, near = self._standing(state, k)
            evidence.append(own)
            twins.append(near)
        total = self._total(state)
        return Selection(
            self.base, state, tuple(evidence), tuple(twins), tuple(named), tuple(groups), total
        )

    def _add(self, state: State, named: list[Score]) -> State | None:
        """Add the best effect; None if none has evidence enough.

        Noise and nuisances that were estimated without an effect have taken part of it for their own, so what comes
        near is judged with sizes that are estimated with it.
        """
        present = {member.name for member in state.model.members} - set(SECTIONS)
        rest = [score for score in named if score.name not in present]
        rivals = [s for s in rest[:_RIVALS] if s.evidence > max(_WORTH_A_TRY, rest[0].evidence - _NEAR)]
        best, worth = None, self._worth(state) + NAMED
        for rival in rivals:
            self._advance(rival.name)
            grown = self._grow(state, rival)
            if (found := self._worth(grown)) > worth:
                best, worth = grown, found
        return best

    def _weigh_groups(self, state: State, groups: list[Score]) -> list[Score]:
        """Judge the best nameless dependences with sizes of noise of their own, as named effects are."""
        weighed = []
        for score in groups[:_GROUPS]:
            found = score.evidence
            if _WORTH_A_TRY < found < NAMELESS:
                model = state.model.beside(self.screen.group_columns(score.name), _GROUP_STD)
                sizes, _ = model.evidence().maximise(state.logs)
                found = max(found, sizes.evidence - state.sizes.evidence)
            weighed.append(Score(score.name, found, score.parameters))
        return sorted([*weighed, *groups[_GROUPS:]], key=lambda score: -score.evidence)

    def _grow(self, state: State, score: Score) -> State:
        members = (*state.model.members, Member(score.name, score.parameters))
        return self._settle(state.model.having(members), state)

    def _settle(self, model: Model, before: State) -> State:
        """Refine parameters, estimate sizes anew, refine again."""
        model, _ = model.fit(before.sizes)
        sizes, logs = model.evidence().maximise(before.logs)
        model, fit = model.fit(sizes)
        return State(model, sizes, logs, fit)

    def _worth(self, state: State) -> float:
        """Return 2 ln of the evidence of a model with its members, whose priors are wider than where they were found."""
        return state.sizes.evidence - sum(prior_cost(member, state.model.drive) for member in state.model.members)

    def _gain(self, state: State, k: int) -> float:
        """Return 2 ln of the Bayes factor of member k given the others, at the sizes found with all."""
        member, without = state.model.members[k], self._without(state, k)
        with_all = state.model.evidence().at(state.logs) - prior_cost(member, state.model.drive)
        return with_all - without.evidence().at(state.logs)

    def _without(self, state: State, k: int) -> Model:
        members = state.model.members
        return state.model.having((*members[:k], *members[k + 1 :]))

    def _exchange(self, state: State) -> State:
        """Put another effect in the place of a member where the data prefer it, given the others."""
        if len(state.model.members) < 2:
            return state
        for k in range(len(state.model.members)):
            without = self._without(state, k)
            named, _ = self.screen.scores(without, state.sizes)
            best = next(score for score in named if score.name != state.model.members[k].name)
            if best.evidence > self._gain(state, k) + 2.0:
                state = self._settle(without.having((*without.members, Member(best.name, best.parameters))), state)
        return state

    def _holds(self, state: State) -> bool:
        """Return True if every member keeps its evidence once sizes and parameters have been estimated with it."""
        return all(self._gain(state, k) > NAMED for k in range(len(state.model.members)))

    def _standing(self, state: State, k: int) -> tuple[float, tuple[str, ...]]:
        """Return the evidence of member k given the others, and which effects come near it."""
        named, _ = self.screen.scores(self._without(state, k), state.sizes)
        name = state.model.members[k].name
        mine = self._gain(state, k)
        near = [score.name for score in named if score.name != name and score.evidence > mine - TWIN]
        return mine, tuple(near)

    def _total(self, state: State) -> float:
        if not state.model.members:
            return 0.0
        return state.sizes.evidence - self.base.sizes.evidence

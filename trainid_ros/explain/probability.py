# SPDX-License-Identifier: Apache-2.0
"""Probability of each cause, averaged over all sets of effects that the search has compared (Bayesian model averaging).

With E the evidence of a hypothesis, 2 ln of its Bayes factor against the model without effects, and k its number of
effects, its weight is

    prior(k) exp(E / (2 T)).

The temperature T > 1 allows for real effects whose equations differ from those of the library. Beside sets of effects
there are other causes: a dependence without a name, which is added to a set, or more noise than is usual with it. The
probability of a set is divided equally among its effects, so that all of them add up to one.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from trainid_ros.train.effects import EFFECTS

NONE: Final = 'none'
"""Name of the hypothesis that no effect is missing."""
OTHER: Final = 'other'
"""Name of all causes outside the library."""
# Fitted by maximum likelihood to 180 cases of two generators (benchmarks/explain.py; seeds 31001 and 32001).
_TEMPERATURE: Final = 1.2
# Logarithms of the prior odds against a set of one effect: of none, of each further effect, of a dependence without a
# name, and of noise beyond the usual.
_LN_NONE, _LN_FURTHER, _LN_DEPENDENCE, _LN_NOISE = -1.1, -2.2, -6.4, -6.1


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A set of effects, or another cause beside it."""

    names: tuple[str, ...]  # Its effects
    evidence: float  # 2 ln of its Bayes factor against the model without effects [1]
    other: float = -math.inf  # Logarithm of the prior odds of a cause outside the library; none by default

    @property
    def is_other(self) -> bool:
        """Whether something outside the library belongs to it."""
        return math.isfinite(self.other)

    @property
    def weight(self) -> float:
        """Logarithm of its probability, up to a constant."""
        k, ln_any = len(self.names), math.log(len(EFFECTS))  # one effect is any of the library
        if self.is_other:
            prior = self.other - k * ln_any + k * _LN_FURTHER
        else:
            prior = -k * ln_any + (k - 1) * _LN_FURTHER if k else _LN_NONE
        return prior + 0.5 * self.evidence / _TEMPERATURE


def dependence(names: tuple[str, ...], evidence: float) -> Hypothesis:
    """Return the hypothesis of a dependence without a name beside effects."""
    return Hypothesis(names, evidence, _LN_DEPENDENCE)


def noise(names: tuple[str, ...], evidence: float) -> Hypothesis:
    """Return the hypothesis of unmeasured forces beside effects, whose noise is above the usual by the evidence."""
    return Hypothesis(names, evidence, _LN_NOISE)


@dataclass(frozen=True, slots=True)
class Probabilities:
    """Probabilities of causes."""

    shares: tuple[tuple[str, float], ...]  # Cause and probability, largest first; they add up to one
    present: tuple[tuple[str, float], ...]  # Effect and probability that it is among the causes
    counts: tuple[tuple[int, float], ...]  # Number of effects and its probability

    def of(self, name: str) -> float:
        """Return the probability that an effect is among the causes."""
        return dict(self.present).get(name, 0.0)

    def at_least(self, count: int) -> float:
        """Return the probability that so many effects or more are missing."""
        return sum(p for number, p in self.counts if number >= count)

    @property
    def other(self) -> float:
        """Probability that something outside the library is missing."""
        return dict(self.shares).get(OTHER, 0.0)


def probabilities(hypotheses: Iterable[Hypothesis], certain: tuple[str, ...] = ()) -> Probabilities:
    """Return the probabilities of all causes; ``certain`` effects belong to each set."""
    best: dict[tuple[tuple[str, ...], float], Hypothesis] = {}
    for item in hypotheses:  # the same set may have been fitted from several starts
        key = tuple(sorted(item.names)), item.other
        if key not in best or item.evidence > best[key].evidence:
            best[key] = item
    most = max(item.weight for item in best.values())
    share, present = defaultdict[str, float](float), defaultdict[str, float](float)
    counts = defaultdict[int, float](float)
    for item in best.values():
        p, names = math.exp(item.weight - most), {*item.names, *certain}
        causes = [OTHER] if item.is_other else sorted(names) or [NONE]
        for cause in causes:
            share[cause] += p / len(causes)
        counts[len(item.names)] += p
        for name in names:
            present[name] += p
    total = sum(share.values())
    ordered = sorted(share.items(), key=lambda one: (-one[1], one[0]))
    return Probabilities(
        tuple((name, p / total) for name, p in ordered),
        tuple((name, min(p / total, 1.0)) for name, p in present.items()),
        tuple((count, p / total) for count, p in counts.items()),
    )

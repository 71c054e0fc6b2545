# SPDX-License-Identifier: Apache-2.0
"""Result of the workflow: verdict, effects, probabilities of all causes, where the gap is, and the data that show it.

The probability of each cause is averaged over all sets of effects that the search has compared (Bayesian model
averaging). With E the evidence of a hypothesis, 2 ln of its Bayes factor against the model without effects, and k its
number of effects, its weight is

    prior(k) exp(E / (2 T)).

The temperature T > 1 allows for real effects whose equations differ from those of the library. Beside sets of effects
there are other causes: a dependence without a name, which is added to a set, more noise than is usual with it, or
something that only looks like the set. A dependence or noise may also be an illusion of the model. The probability of a
set is divided equally among its effects and another cause, so that all causes add up to one.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from trainid_ros.explain.likelihood import Noise
    from trainid_ros.explain.nuisances import Spread
    from trainid_ros.train.effects import Twin
    from trainid_ros.train.train_file import Davis, NamedValues, TrainFile

    Array = NDArray[np.float64]


NONE: Final = 'none'
"""Name of the hypothesis that no effect is missing."""
OTHER: Final = 'other'
"""Name of all causes outside the library."""
# Fitted by maximum likelihood to 180 cases of two generators (benchmarks/explain.py; seeds 31001 and 32001).
_TEMPERATURE: Final = 1.2
# Logarithms of the prior odds against a set of one effect: of none, of each further effect, of a dependence without a
# name, and of noise beyond the usual.
_LN_NONE, _LN_FURTHER, _LN_DEPENDENCE, _LN_NOISE = -1.1, -2.2, -6.4, -6.1
# Logarithms of the odds that something else only looks like a set of effects, and that a cause outside the library is
# an illusion, 1 to 13 and 1 to 4: the smallest Brier score of 1004 cases of three generators (seeds 110001, 130001).
_LN_ALIKE, _LN_ILLUSION = -2.6, -1.4


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
    other: float  # Probability that something outside the library is missing, alone or with effects

    def of(self, name: str) -> float:
        """Return the probability that an effect is among the causes."""
        return dict(self.present).get(name, 0.0)

    def at_least(self, count: int) -> float:
        """Return the probability that so many effects or more are missing."""
        return sum(p for number, p in self.counts if number >= count)


def probabilities(hypotheses: Iterable[Hypothesis], certain: tuple[str, ...] = ()) -> Probabilities:
    """Return the probabilities of all causes; ``certain`` effects belong to each set."""
    best: dict[tuple[tuple[str, ...], float], Hypothesis] = {}
    for item in hypotheses:  # the same set may have been fitted from several starts
        key = tuple(sorted(item.names)), item.other
        if key not in best or item.evidence > best[key].evidence:
            best[key] = item
    sets = [item for item in best.values() if item.names and not item.is_other]
    weighed = [(item, item.weight) for item in best.values()]
    weighed += [(dependence((), item.evidence), item.weight + _LN_ALIKE) for item in sets]
    others = [item for item in best.values() if item.is_other]
    weighed += [(Hypothesis(item.names, item.evidence), item.weight + _LN_ILLUSION) for item in others]
    most = max(weight for _, weight in weighed)
    share, present = defaultdict[str, float](float), defaultdict[str, float](float)
    counts, other = defaultdict[int, float](float), 0.0
    for item, weight in weighed:
        p, names = math.exp(weight - most), {*item.names, *certain}
        causes = [*sorted(names), OTHER] if item.is_other else sorted(names) or [NONE]
        other += p * item.is_other
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
        other / total,
    )


class Verdict(Enum):
    """Outcome of the workflow."""

    EXPLAINED = 'explained'
    AMBIGUOUS = 'ambiguous'
    UNEXPLAINED = 'unexplained'
    NO_GAP = 'no_gap'


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that was added to the model."""

    name: str  # Its name in train files
    title: str  # Short description
    equation: str  # Its equation in one line
    origin: str  # 'physics' or 'sensor'
    parameters: NamedValues  # Its parameters, in the units of the effect
    std: NamedValues  # Their standard deviations
    evidence: float  # 2 ln of its Bayes factor, given the other effects [1]
    significance: float  # Distance of its amplitude from zero effect, for its other parameters as found [std]
    probability: float  # That it is among the causes [1]
    where: str  # Where and when it shows, as text
    twins: tuple[Twin, ...]  # The most probable alternative to an effect that is not certain
    runs: tuple[int, ...] = ()  # Numbers of the runs on which it acts; empty: on all


@dataclass(frozen=True, slots=True)
class Gap:
    """RMS of simulated less measured speed on runs held out of the fit [m/s], each simulated from its initial speed."""

    before: float  # Of the train file read
    after: float  # Of the train file written, with a, b, c and the effects as fitted to the other runs
    noise_floor: float  # That a correct train file leaves: noise, gusts, payload, errors of map and sensors
    runs_held_out: int  # Number of runs it was measured on
    fitted_before: float  # Without the effects, all nuisances and the initial speed fitted
    fitted_after: float  # With the effects, all nuisances and the initial speed fitted
    evidence: float  # 2 ln of the ratio of likelihoods of the held-out runs with and without the effects [1]


@dataclass(frozen=True, slots=True)
class Place:
    """Mean resistance that a model lacks in one part of the data."""

    label: str  # Name of the part
    low: float  # Lower edge on its axis, NaN for a category
    high: float  # Upper edge on its axis, NaN for a category
    before: float  # Missing resistance without the effects [N/kN]
    after: float  # Missing resistance with the effects [N/kN]
    std: float  # Standard deviation, allowing for errors that are correlated in time [N/kN]
    share: float  # Share of the driving time [1]


@dataclass(frozen=True, slots=True)
class Location:
    """Missing resistance along one axis: position, speed, driving mode and so on."""

    axis: str
    unit: str
    places: tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class RunTrace:
    """One run for plots, at the grid points (about one per second), shapes (n,)."""

    bag: int  # Number of its bag
    direction: int  # +1 for rising positions, -1 for falling ones
    time: Array  # Time since departure [s]
    position: Array  # Position [m]
    speed: Array  # Measured speed [m/s]
    before: Array  # Measured less simulated speed without the effects [m/s]
    after: Array  # Measured less simulated speed with the effects [m/s]
    band: Array  # Standard deviation expected of a correct model [m/s]


@dataclass(frozen=True, slots=True)
class Learned:
    """Missing resistance as a curve over one variable; no effect of the library is its cause."""

    name: str  # Short name of the variable
    text: str  # The variable as text
    unit: str  # Its unit; empty for the number of the run less one
    of: str  # Force of which the values are a share; empty if they are in N/kN
    evidence: float  # 2 ln of the Bayes factor of the curve [1]
    twins: tuple[str, ...]  # Variables that fit as well, as text
    x: Array  # Variable at the knots, shape (k,)
    value: Array  # Missing resistance there [N/kN or 1]; less its mean if it always acts, shape (k,)
    std: Array  # Its standard deviation, shape (k,)
    gap: Gap | None = None  # Gap on runs held out without and with it; None with too few runs
    is_confirmed: bool = False  # Whether they show it; the rest is empty if not
    function: str = ''  # Function of the variable x that is as good; empty if none is
    effect: str = ''  # Name of the effect
    source: str = ''  # Its file
    train_file: TrainFile | None = None  # Train file with it

    @property
    def sentence(self) -> str:
        """What the missing resistance depends on."""
        share = f' of {self.of}' if self.of else ' N/kN'
        function = f': {self.function}{share}, x in {self.unit}' if self.function else ''
        either = ' or '.join((self.text, *self.twins))
        return f'The missing resistance depends on {either}, and no effect of the library fits it{function}.'


def noise_floor(gap: Gap, learned: Learned | None) -> float:
    """Return the noise floor [m/s]; that of a confirmed curve, if lower, has no part of what is missing."""
    if learned is None or learned.gap is None or not learned.is_confirmed:
        return gap.noise_floor
    return min(gap.noise_floor, learned.gap.noise_floor)


@dataclass(frozen=True, slots=True)
class Explanation:
    """Result of the workflow."""

    verdict: Verdict  # Outcome
    # Effects added to the model, strongest first; empty if no fit is supported by the data
    effects: tuple[FoundEffect, ...]
    gap: Gap | None  # Gap before and after; None with too few runs to hold one out
    remaining: str  # One sentence on what the rest of the gap depends on
    train_file: TrainFile  # Train file with the effects added, and a, b, c as estimated if that is better
    davis: Davis  # a, b, c as estimated with the effects
    davis_std: tuple[float, float, float]  # Standard deviations of a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2]
    davis_distance: float  # Distance of all three from those of the train file, by their covariance [std]
    locations: tuple[Location, ...]  # Where the gap is
    traces: tuple[RunTrace, ...]  # All runs, for plots
    noise: Noise  # Standard deviations of the noise along a run
    spread: Spread  # Standard deviations of nuisances from run to run and from place to place
    outliers: float  # Share of speeds excluded as outliers [1]
    weighed: bool  # True if the mass was measured
    # Point of the train at which gradients were taken to be given; None if they are means under it
    gradient_point: str | None
    probabilities: NamedValues  # Cause ('none', 'other' or an effect) and probability, largest first; their sum is 1
    other: float  # Probability that something outside the library is missing, alone or with effects
    learned: Learned | None = None  # What is missing if nothing of the library is; None if the data do not show it


_KINDS: Final = {
    ('mode', 'traction'): 'under traction',
    ('mode', 'coasting'): 'while coasting',
    ('mode', 'braking'): 'while braking',
    ('mode', 'just released'): 'just after the brake is released',
    ('direction', 'rising'): 'towards rising positions',
    ('direction', 'falling'): 'towards falling positions',
    ('tunnel', 'open air'): 'outside tunnels',
    ('tunnel', 'tunnel'): 'in tunnels',
    ('curve', 'straight'): 'on straight track',
    ('curve', 'curve'): 'in curves',
}
_RANGES: Final = {
    'position': 'at {}',
    'position, rising': 'at {} towards rising positions',
    'position, falling': 'at {} towards falling positions',
    'speed': 'at speeds of {}',
    'heat of the brake': 'with {} of heat in the brake',
}


def place_text(axis: str, label: str) -> str:
    """Return one part of an axis of :func:`~trainid_ros.explain.proof.locate` as text."""
    return _KINDS.get((axis, label)) or _RANGES.get(axis, f'{axis} {{}}').format(label)

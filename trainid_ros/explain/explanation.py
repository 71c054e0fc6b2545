# SPDX-License-Identifier: Apache-2.0
"""What the discrepancy workflow tells: the verdict, the effects, where the gap is, and what shows it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from trainid_ros.train.train_file import NamedValues, TrainFile

    Array = NDArray[np.float64]


class Verdict(Enum):
    """Outcome of the workflow."""

    EXPLAINED = 'explained'
    AMBIGUOUS = 'ambiguous'
    UNEXPLAINED = 'unexplained'
    NO_GAP = 'no_gap'


@dataclass(frozen=True, slots=True)
class Likeness:
    """An effect that explains the data as well, and the drive that would tell the two apart."""

    name: str
    drive: str


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that was added to the model.

    Attributes:
        name: Its name in train files.
        title: What it is, in words.
        equation: Its equation in one line.
        origin: 'physics' or 'sensor'.
        parameters: Its parameters.
        std: Their standard deviations.
        evidence: Twice the log of its Bayes factor, given the other effects.
        where: Where and when it shows, in words.
        twins: Effects that explain the data as well, nearest first.

    """

    name: str
    title: str
    equation: str
    origin: str
    parameters: NamedValues
    std: NamedValues
    evidence: float
    where: str
    twins: tuple[Likeness, ...]


@dataclass(frozen=True, slots=True)
class Gap:
    """RMS of simulated less measured speed on runs that the fit never saw, with their best initial speeds [m/s].

    Attributes:
        before: Without the effects; a, b, c and nuisances are fitted.
        after: With them.
        noise_floor: What noise, gusts, map errors and payload leave of a model that is right.
        runs_held_out: Number of runs it was measured on, each by a fit to others.

    """

    before: float
    after: float
    noise_floor: float
    runs_held_out: int


@dataclass(frozen=True, slots=True)
class Place:
    """Mean resistance that a model lacks in one part of the data.

    Attributes:
        label: Which part.
        low: Where it begins on its axis, NaN for a kind.
        high: Where it ends.
        before: Missing resistance without the effects [N/kN].
        after: Missing resistance with them [N/kN].
        std: Standard deviation, which knows that errors last [N/kN].
        share: Share of the driving time.

    """

    label: str
    low: float
    high: float
    before: float
    after: float
    std: float
    share: float


@dataclass(frozen=True, slots=True)
class Location:
    """The gap along one axis: position, speed, driving mode and so on."""

    axis: str
    unit: str
    places: tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class RunTrace:
    """One run for plots, at the nodes (about one a second), shapes (n,).

    Attributes:
        bag: Number of its bag.
        direction: +1 while positions rise.
        time: Time since departure [s].
        position: Position [m].
        speed: Measured speed [m/s].
        before: Measured less simulated speed without the effects [m/s].
        after: The same with them.
        band: Standard deviation that a right model would have [m/s].

    """

    bag: int
    direction: int
    time: Array
    position: Array
    speed: Array
    before: Array
    after: Array
    band: Array


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Sizes of noise and nuisances found.

    Attributes:
        speed: Noise of one measured speed [m/s].
        gust: Standard deviation of gusts [N/kN].
        gust_time: Their correlation time [s].
        payload: Relative error of the mass of a run.
        brake: Relative change of the brake from run to run.
        map: Error of the map's gradient [per mille].

    """

    speed: float
    gust: float
    gust_time: float
    payload: float
    brake: float
    map: float


@dataclass(frozen=True, slots=True)
class Explanation:
    """All that the workflow found.

    Attributes:
        verdict: Outcome.
        effects: Effects added to the model, strongest first; empty without a fit that holds.
        gap: Before and after; None with too few runs to hold one out.
        remaining: One sentence on what the rest of the gap depends on.
        train_file: The model with the effects, and a, b, c as found with them.
        davis_std: Standard deviations of a, b, c.
        locations: Where the gap is.
        traces: All runs, for plots.
        noise: Sizes of noise and nuisances.
        outliers: Share of speeds that did not count.
        weighed: True if the mass was measured.
        gradient_point: Point of the train that gradients were read as known at; None where they are means under it.

    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    gap: Gap | None
    remaining: str
    train_file: TrainFile
    davis_std: tuple[float, float, float]
    locations: tuple[Location, ...]
    traces: tuple[RunTrace, ...]
    noise: NoiseLevels
    outliers: float
    weighed: bool
    gradient_point: str | None

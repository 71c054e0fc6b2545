# SPDX-License-Identifier: Apache-2.0
"""Result of the workflow: the verdict, the effects, where the gap is, and the data that show it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

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
class Alternative:
    """An alternative effect that explains the data equally well.

    Attributes:
        name: Its name in train files.
        drive: The test run that would distinguish the two.

    """

    name: str
    drive: str


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """An effect that was added to the model.

    Attributes:
        name: Its name in train files.
        title: Short description.
        equation: Its equation in one line.
        origin: 'physics' or 'sensor'.
        parameters: Its parameters, in the units of the effect.
        std: Their standard deviations.
        evidence: 2 ln of its Bayes factor, given the other effects [1].
        where: Where and when it shows, as text.
        twins: Alternative effects that explain the data equally well, nearest first.

    """

    name: str
    title: str
    equation: str
    origin: str
    parameters: NamedValues
    std: NamedValues
    evidence: float
    where: str
    twins: tuple[Alternative, ...]


@dataclass(frozen=True, slots=True)
class Gap:
    """RMS of simulated less measured speed on runs held out of the fit, with fitted initial speeds [m/s].

    Attributes:
        before: Without the effects; a, b, c and nuisances are fitted.
        after: With the effects.
        noise_floor: RMS expected of a correct model, from noise, gusts, map errors and payload.
        runs_held_out: Number of runs it was measured on, each simulated by a fit to other runs.

    """

    before: float
    after: float
    noise_floor: float
    runs_held_out: int


@dataclass(frozen=True, slots=True)
class Place:
    """Mean resistance that a model lacks in one part of the data.

    Attributes:
        label: Name of the part.
        low: Lower edge on its axis, NaN for a category.
        high: Upper edge on its axis, NaN for a category.
        before: Missing resistance without the effects [N/kN].
        after: Missing resistance with the effects [N/kN].
        std: Standard deviation, allowing for errors that are correlated in time [N/kN].
        share: Share of the driving time [1].

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
    """Missing resistance along one axis: position, speed, driving mode and so on."""

    axis: str
    unit: str
    places: tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class RunTrace:
    """One run for plots, at the grid points (about one per second), shapes (n,).

    Attributes:
        bag: Number of its bag.
        direction: +1 for rising positions, -1 for falling ones.
        time: Time since departure [s].
        position: Position [m].
        speed: Measured speed [m/s].
        before: Measured less simulated speed without the effects [m/s].
        after: Measured less simulated speed with the effects [m/s].
        band: Standard deviation expected of a correct model [m/s].

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
    """Estimated standard deviations of noise and nuisances.

    Attributes:
        speed: Noise of one measured speed [m/s].
        gust: Standard deviation of gusts [N/kN].
        gust_time: Correlation time of gusts [s].
        payload: Relative error of the mass of a run [1].
        brake: Relative change of the brake force from run to run [1].
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
    """Result of the workflow.

    Attributes:
        verdict: Outcome.
        effects: Effects added to the model, strongest first; empty if no fit is supported by the data.
        gap: Gap before and after; None with too few runs to hold one out.
        remaining: One sentence on what the rest of the gap depends on.
        train_file: Train file with the effects added, and a, b, c as estimated with them.
        davis_std: Standard deviations of a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2].
        locations: Where the gap is.
        traces: All runs, for plots.
        noise: Standard deviations of noise and nuisances.
        outliers: Share of speeds excluded as outliers [1].
        weighed: True if the mass was measured.
        gradient_point: Point of the train at which gradients were taken to be given; None if they are means under it.

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
    """Return one part of an axis of :func:`~trainid_ros.explain.gap_location.locate` as text."""
    return _KINDS.get((axis, label)) or _RANGES.get(axis, f'{axis} {{}}').format(label)

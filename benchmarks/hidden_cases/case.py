# SPDX-License-Identifier: Apache-2.0
"""A hidden case: what the workflow gets, and apart from it the truth for the scoring code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from trainid_ros.core.records import Record

Kind = Literal['none', 'single', 'pair', 'outside']


@dataclass(frozen=True, slots=True)
class EffectTruth:
    """One effect that is in the data and not in the believed train file.

    Attributes:
        name: Name of the interface, or one of ours for an effect outside the library.
        parameters: (name, value) in the form of the interface.
        comparable: Whether an estimate may be held against the parameters.
        near: For outside effects, names that would be an honest generic answer.
        gap: RMS speed that the believed model misses for want of this effect alone, after its refit [m/s].
        visible_percent: How much this raises the rms gap over the noise floor.

    """

    name: str
    parameters: tuple[tuple[str, float], ...]
    comparable: bool
    near: tuple[str, ...]
    gap: float
    visible_percent: float


@dataclass(frozen=True, slots=True)
class Truth:
    """What only the scoring code opens.

    Attributes:
        kind: None, one effect of the library, two of them, or one outside of it.
        effects: The effects in the data.
        one_way: All runs go up the line.
        mass_topic: The load is weighed and published.
        contamination: Any of outliers, dropouts, slip.
        davis: True a, b, c [N/kN, m/s].
        floor: RMS speed gap of the believed model with the effects known [m/s].
        gap: RMS speed that is missed for want of all effects, after the refit of a, b, c and initial speeds [m/s].
        visible_percent: ``100 (sqrt(floor^2 + gap^2) / floor - 1)``.

    """

    kind: Kind
    effects: tuple[EffectTruth, ...]
    one_way: bool
    mass_topic: bool
    contamination: tuple[str, ...]
    davis: tuple[float, float, float]
    floor: float
    gap: float
    visible_percent: float


@dataclass(frozen=True, slots=True)
class Case:
    """Bags in memory, the believed train file and the truth."""

    name: str
    seed: int
    believed: str
    bags: tuple[tuple[Record, ...], ...]
    truth: Truth

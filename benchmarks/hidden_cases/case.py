# SPDX-License-Identifier: Apache-2.0
"""A hidden case: input of the workflow, and separately the truth for the scoring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from trainid_ros.interface.records import Record

Kind = Literal['none', 'single', 'pair', 'outside']


@dataclass(frozen=True, slots=True)
class EffectTruth:
    """One effect that is in the data but not in the assumed train file.

    Attributes:
        name: Name in the interface, or a name of this generator for an effect outside the library.
        parameters: (name, value) in the form of the interface.
        comparable: Whether an estimate may be compared with the parameters.
        near: For outside effects, acceptable generic names.
        gap: RMS speed gap of the refitted assumed model due to this effect alone [m/s].
        visible_percent: Rise of the rms gap over the noise floor due to this effect [%].

    """

    name: str
    parameters: tuple[tuple[str, float], ...]
    comparable: bool
    near: tuple[str, ...]
    gap: float
    visible_percent: float


@dataclass(frozen=True, slots=True)
class Truth:
    """Truth of a case, for the scoring only.

    Attributes:
        kind: None, one effect of the library, two of them, or one outside of it.
        effects: The effects in the data.
        one_way: All runs go up the line.
        mass_topic: The load is weighed and published.
        contamination: Any of outliers, dropouts, slip.
        davis: True a, b, c [N/kN, v in m/s].
        floor: RMS speed gap of the assumed model with the effects known [m/s].
        gap: RMS speed gap due to all effects, after the refit of a, b, c and initial speeds [m/s].
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
    """Bags in memory, the assumed train file (YAML) and the truth."""

    name: str
    seed: int
    train_yaml: str
    bags: tuple[tuple[Record, ...], ...]
    truth: Truth

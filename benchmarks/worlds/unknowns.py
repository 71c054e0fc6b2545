# SPDX-License-Identifier: Apache-2.0
"""Unknowns of a real train and its sensors, each drawn independently so that it can be switched on alone."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

UNKNOWNS: Final = (
    'mass', 'force_gain', 'force_delay', 'curve', 'map', 'wheels', 'gusts', 'quantum', 'changes', 'brake',
)  # fmt: skip
FIELD: Final = frozenset(UNKNOWNS)
CLEAN: Final = frozenset({'changes'})


@dataclass(frozen=True, slots=True)
class Errors:
    """The drawn errors of a drive; the defaults are the values without the error.

    Attributes:
        mass: Relative error of the stated and weighed mass [1].
        weighing: Standard deviation of the relative weighing error, independent at each stop [1].
        force_gain: True over reported tractive effort, minus one [1].
        force_delay: Delay of the reported force relative to its stamp [s].
        curve: Relative error of the stated curve coefficient [1].
        map_std: Standard deviation of the error of the gradients [per mille].
        map_length: Correlation length of that error [m].
        wheels: Measured over true speed, minus one [1].
        gust_std: Standard deviation of the random specific resistance [N/kN].
        gust_time: Correlation time of the random resistance [s].
        speed_noise: Standard deviation of the speed noise [m/s].
        quantum: Resolution of the measured speed [m/s].
        brake_delay: True minus stated dead time of the brake [s].
        brake_lag: Stated over true time constant of the brake [1].
        brake_speed: Strength of the speed dependence of the brake rate, from 0 to 1.
        brake_step: Resolution of the brake force as a share of the greatest command, 0 = continuous.
        blend_speed: Speed of the change from electric to friction brake [m/s].
        blend_dip: Loss of brake rate at that speed [1].

    """

    mass: float = 0.0
    weighing: float = 0.0
    force_gain: float = 0.0
    force_delay: float = 0.0
    curve: float = 0.0
    map_std: float = 0.0
    map_length: float = 300.0
    wheels: float = 0.0
    gust_std: float = 0.03
    gust_time: float = 6.0
    speed_noise: float = 0.01
    quantum: float = 0.01
    brake_delay: float = 0.0
    brake_lag: float = 1.0
    brake_speed: float = 0.0
    brake_step: float = 0.0
    blend_speed: float = 2.5
    blend_dip: float = 0.0


def random_of(world: str, seed: int, purpose: str) -> np.random.Generator:
    """Return a generator for one purpose, so that switching on other unknowns does not change its numbers."""
    return np.random.default_rng([seed, zlib.crc32(f'{world}/{purpose}'.encode())])


def draw_errors(world: str, seed: int, unknowns: Collection[str]) -> Errors:
    """Draw the errors that are switched on.

    Raises:
        ValueError: A name is not among ``UNKNOWNS``.

    """
    wrong = sorted(set(unknowns) - FIELD)
    if wrong:
        raise ValueError(f'unknowns must be of {", ".join(UNKNOWNS)}, not {", ".join(wrong)}')
    values: dict[str, float] = {}
    for name in UNKNOWNS:
        if name in unknowns:
            values |= _draw(name, random_of(world, seed, f'error of {name}'))
    return Errors(**values)


def _draw(name: str, rng: np.random.Generator) -> dict[str, float]:
    out: dict[str, float] = {}
    match name:
        case 'mass':
            out = {'mass': _clipped(rng, 0.025, 0.05), 'weighing': 0.004}
        case 'force_gain':
            out = {'force_gain': _clipped(rng, 0.02, 0.03)}
        case 'force_delay':
            out = {'force_delay': float(rng.uniform(0.0, 0.3))}
        case 'curve':
            out = {'curve': _clipped(rng, 0.2, 0.4)}
        case 'map':
            out = {'map_std': float(rng.uniform(0.1, 0.5)), 'map_length': float(rng.uniform(100.0, 500.0))}
        case 'wheels':
            out = {'wheels': float(rng.uniform(-0.005, 0.005))}
        case 'gusts':
            out = {'gust_std': float(rng.uniform(0.1, 0.4)), 'gust_time': float(rng.uniform(3.0, 12.0))}
        case 'quantum':
            quantum = float(rng.choice((0.1, 0.2, 0.5))) / 3.6
            out = {'speed_noise': float(rng.uniform(0.02, 0.05)), 'quantum': quantum}
        case 'brake':
            out = _draw_brake(rng)
    return out


def _draw_brake(rng: np.random.Generator) -> dict[str, float]:
    return {
        'brake_delay': float(rng.uniform(-0.3, 0.3)),
        'brake_lag': float(rng.uniform(0.7, 1.3)),
        'brake_speed': float(rng.uniform(0.4, 1.0)),
        'brake_step': float(rng.uniform(0.01, 0.03)),
        'blend_speed': float(rng.uniform(2.0, 3.0)),
        'blend_dip': float(rng.uniform(0.05, 0.15)),
    }


def _clipped(rng: np.random.Generator, std: float, most: float) -> float:
    return float(np.clip(rng.normal(0.0, std), -most, most))

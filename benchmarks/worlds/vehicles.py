# SPDX-License-Identifier: Apache-2.0
"""The five kinds of train, and random vehicles of each kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np

G: Final = 9.80665
# Dead times are multiples of the step of the motion [s].
DELAY_STEP: Final = 0.02

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Kind:
    """Parameters of the trains of one world; ranges are those of uniform distributions.

    Attributes:
        mass: Mass without the variable load [kg].
        load: Greatest variable load as a share of that mass.
        rotary_mass: Rotating masses as a share of the mass.
        length: Length [m].
        cars: Number of cars.
        max_speed: Greatest speed [m/s].
        force: Greatest specific tractive effort [N/kN of the mass without load].
        power: Greatest specific tractive power [W/kg].
        traction_lag: Time constant of the tractive effort [s].
        davis: Nominal a, b, c [N/kN, v in m/s].
        curve: Curve resistance coefficient [N/kN m].
        brake_delay: Dead time of the brake [s].
        brake_lag: Time constant of the brake [s].
        brake_max: Greatest service brake command [m/s^2].

    """

    mass: Range
    load: float
    rotary_mass: float
    length: Range
    cars: int
    max_speed: float
    force: float
    power: float
    traction_lag: float
    davis: tuple[float, float, float]
    curve: Range
    brake_delay: Range
    brake_lag: Range
    brake_max: float


@dataclass(frozen=True, slots=True)
class Vehicle:
    """True parameters of one train, in the units of :class:`Kind`; max_force in N, max_power in W."""

    kind: Kind
    mass: float
    length: float
    max_force: float
    max_power: float
    davis: tuple[float, float, float]
    curve: float
    brake_delay: float
    brake_lag: float
    brake_rate: float


# Davis coefficients of metro and EMU: TTOBench (CN_Beijing_Subway, CH_Stadler_FLIRT_TPF with half its quadratic
# term); freight: loaded wagons after Strahl and ALTRIOS; high speed: eight-car trains of 300 km/h.
KINDS: Final = {
    'metro': Kind((190e3, 250e3), 0.15, 0.06, (115.0, 120.0), 6, 22.5, 114.0, 11.2, 0.4,
                  (1.45, 0.012, 0.0100), (450.0, 850.0), (0.5, 0.8), (0.3, 0.5), 1.3),
    'emu': Kind((115e3, 125e3), 0.12, 0.10, (58.6, 74.0), 4, 44.5, 167.0, 21.3, 0.5,
                (1.99, 0.051, 0.00505), (450.0, 850.0), (0.6, 1.0), (0.5, 0.8), 1.2),
    'high_speed': Kind((400e3, 450e3), 0.08, 0.05, (200.0, 202.0), 8, 83.4, 70.0, 20.5, 0.8,
                       (0.9, 0.020, 0.00145), (450.0, 850.0), (0.8, 1.2), (0.6, 1.0), 0.9),
    'freight': Kind((1500e3, 5000e3), 0.0, 0.04, (350.0, 750.0), 40, 27.8, 17.0, 2.1, 2.0,
                    (1.4, 0.015, 0.0030), (450.0, 850.0), (2.0, 4.0), (3.0, 6.0), 0.45),
    'tram': Kind((37e3, 41e3), 0.15, 0.09, (28.0, 33.0), 5, 16.7, 130.0, 12.0, 0.3,
                 (3.5, 0.050, 0.0120), (400.0, 600.0), (0.3, 0.5), (0.2, 0.4), 1.6),
}  # fmt: skip


def draw_vehicle(kind: Kind, rng: np.random.Generator) -> Vehicle:
    """Draw a train of a kind; mass grows with length."""
    place = float(rng.uniform())
    mass = kind.mass[0] + place * (kind.mass[1] - kind.mass[0])
    a, b, c = (value * float(rng.uniform(0.85, 1.15)) for value in kind.davis)
    return Vehicle(
        kind=kind,
        mass=mass,
        length=kind.length[0] + place * (kind.length[1] - kind.length[0]),
        max_force=kind.force * mass * G / 1000.0,
        max_power=kind.power * mass,
        davis=(a, b, c),
        curve=float(rng.uniform(*kind.curve)),
        brake_delay=round(float(rng.uniform(*kind.brake_delay)) / DELAY_STEP) * DELAY_STEP,
        brake_lag=float(rng.uniform(*kind.brake_lag)),
        brake_rate=float(rng.uniform(0.88, 1.1)),
    )

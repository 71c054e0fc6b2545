# SPDX-License-Identifier: Apache-2.0
"""Random trains of five kinds, the unknowns of a real train, and conditions that vary during a drive.

Each unknown is drawn so that it can be switched on alone.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np

UNKNOWNS: Final = (
    'mass', 'force_gain', 'force_delay', 'curve', 'map', 'wheels', 'gusts', 'quantum', 'changes', 'brake',
)  # fmt: skip
FIELD: Final = frozenset(UNKNOWNS)
CLEAN: Final = frozenset({'changes'})
G: Final = 9.80665
# Dead times are multiples of the step of the motion [s].
DELAY_STEP: Final = 0.02
# Changes fall in this part of the drive, so that there is data before and after each.
FIRST_CHANGE: Final = 0.3
LAST_CHANGE: Final = 0.8

Range = tuple[float, float]
Coefficients = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Errors:
    """The drawn errors of a drive; the defaults are the values without the error."""

    mass: float = 0.0  # Relative error of the stated and weighed mass [1]
    weighing: float = 0.0  # Standard deviation of the relative weighing error, independent at each stop [1]
    force_gain: float = 0.0  # True over reported tractive effort, minus one [1]
    force_delay: float = 0.0  # Delay of the reported force relative to its stamp [s]
    curve: float = 0.0  # Relative error of the stated curve coefficient [1]
    map_std: float = 0.0  # Standard deviation of the error of the gradients [per mille]
    map_length: float = 300.0  # Correlation length of that error [m]
    wheels: float = 0.0  # Measured over true speed, minus one [1]
    gust_std: float = 0.03  # Standard deviation of the random specific resistance [N/kN]
    gust_time: float = 6.0  # Correlation time of the random resistance [s]
    speed_noise: float = 0.01  # Standard deviation of the speed noise [m/s]
    quantum: float = 0.01  # Resolution of the measured speed [m/s]
    brake_delay: float = 0.0  # True minus stated dead time of the brake [s]
    brake_lag: float = 1.0  # Stated over true time constant of the brake [1]
    brake_speed: float = 0.0  # Strength of the speed dependence of the brake rate, from 0 to 1
    brake_step: float = 0.0  # Resolution of the brake force as a share of the greatest command, 0 = continuous
    blend_speed: float = 2.5  # Speed of the change from electric to friction brake [m/s]
    blend_dip: float = 0.0  # Loss of brake rate at that speed [1]


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


@dataclass(frozen=True, slots=True)
class Kind:
    """Parameters of the trains of one world; ranges are those of uniform distributions."""

    mass: Range  # Mass without the variable load [kg]
    load: float  # Greatest variable load as a share of that mass
    rotary_mass: float  # Rotating masses as a share of the mass
    length: Range  # Length [m]
    cars: int  # Number of cars
    max_speed: float  # Greatest speed [m/s]
    force: float  # Greatest specific tractive effort [N/kN of the mass without load]
    power: float  # Greatest specific tractive power [W/kg]
    traction_lag: float  # Time constant of the tractive effort [s]
    davis: tuple[float, float, float]  # Nominal a, b, c [N/kN, v in m/s]
    curve: Range  # Curve resistance coefficient [N/kN m]
    brake_delay: Range  # Dead time of the brake [s]
    brake_lag: Range  # Time constant of the brake [s]
    brake_max: float  # Greatest service brake command [m/s^2]


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


@dataclass(frozen=True, slots=True)
class Resistance:
    """Davis coefficients [N/kN, v in m/s] by time [s]; ``values[i]`` hold from ``times[i]`` on."""

    times: tuple[float, ...]
    values: tuple[Coefficients, ...]

    def at(self, time: float) -> Coefficients:
        """Return a, b, c [N/kN, v in m/s] at a time [s]."""
        return self.values[bisect_right(self.times, time) - 1]


@dataclass(frozen=True, slots=True)
class BrakeRate:
    """Brake rate by time: linear between the points (time [s], rate [1])."""

    times: tuple[float, ...]
    rates: tuple[float, ...]
    changes: tuple[float, ...]

    def at(self, time: float) -> float:
        """Return the rate [1] at a time [s]."""
        return float(np.interp(time, self.times, self.rates))


def draw_resistance(vehicle: Vehicle, duration: float, changes: bool, rng: np.random.Generator) -> Resistance:
    """Draw one or two steps of resistance: of a as by rain, or of c as by wind."""
    times, values = [0.0], [vehicle.davis]
    for at in _change_times(rng, duration) if changes else ():
        a, b, c = values[-1]
        if rng.uniform() < 0.5:
            step = float(rng.uniform(0.3, 0.6))
            a += step if a < vehicle.davis[0] + 0.1 else -step
        else:
            c *= float(rng.uniform(1.15, 1.3)) ** (1 if c < 1.05 * vehicle.davis[2] else -1)
        times.append(at)
        values.append((a, b, c))
    return Resistance(tuple(times), tuple(values))


def draw_brake_rate(vehicle: Vehicle, duration: float, changes: bool, rng: np.random.Generator) -> BrakeRate:
    """Draw a slow drift of the brake rate with one or two steps or ramps."""
    rate = vehicle.brake_rate
    if not changes:
        return BrakeRate((0.0,), (rate,), ())
    at = _change_times(rng, duration)
    ends = [start if rng.uniform() < 0.5 else start + float(rng.uniform(60.0, 240.0)) for start in at]
    times, rates = [0.0], [rate]
    drift = float(rng.uniform(-0.03, 0.03)) / 3600.0
    for start, end in zip(at, ends, strict=True):
        rate += drift * (start - times[-1])
        times.append(start)
        rates.append(rate)
        rate = _changed(rate, rng)
        times.append(end + 1e-3)
        rates.append(rate)
    times.append(2.0 * duration)
    rates.append(rate + drift * (times[-1] - times[-2]))
    return BrakeRate(tuple(times), tuple(rates), at)


def draw_gusts(errors: Errors, count: int, step: float, rng: np.random.Generator) -> list[float]:
    """Draw the random specific resistance [N/kN], one value per time step (first-order Gauss-Markov process)."""
    keep = float(np.exp(-step / errors.gust_time))
    noise = (errors.gust_std * np.sqrt(1.0 - keep**2) * rng.normal(size=count)).tolist()
    out, value = [], errors.gust_std * float(rng.normal())
    for shock in noise:
        value = keep * value + shock
        out.append(value)
    return out


def draw_loads(vehicle: Vehicle, count: int, rng: np.random.Generator) -> list[float]:
    """Draw the mass from each stop to the next one [kg]: part of the passengers changes."""
    most = vehicle.kind.load
    load, out = float(rng.uniform(0.0, most)), []
    for _ in range(count):
        out.append(vehicle.mass * (1.0 + load))
        load = float(np.clip(load + rng.uniform(-0.6, 0.6) * most, 0.0, most))
    return out


def _changed(rate: float, rng: np.random.Generator) -> float:
    """Return a rate in 0.75 to 1.1 that differs by more than 0.07."""
    while True:
        new = float(rng.uniform(0.75, 1.1))
        if abs(new - rate) > 0.07:
            return new


def _change_times(rng: np.random.Generator, duration: float) -> tuple[float, ...]:
    count = int(rng.integers(1, 3))
    width = (LAST_CHANGE - FIRST_CHANGE) / count
    return tuple(duration * (FIRST_CHANGE + width * (i + float(rng.uniform(0.1, 0.7)))) for i in range(count))

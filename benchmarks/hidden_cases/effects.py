# SPDX-License-Identifier: Apache-2.0
"""Hidden effects as independent physics: those of the interface, and others with acceptable generic names."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_case import log_uniform
from benchmarks.hidden_cases.world import World

if TYPE_CHECKING:
    from numpy.random import Generator


@dataclass(slots=True)
class Moment:
    """State of the true train on which effects depend; one object, updated at each step."""

    time: float = 0.0  # Time since the start of the bag [s]
    front: float = 0.0  # Position of the train's front [m]
    heading: int = 1  # +1 while positions rise, -1 while they fall
    speed: float = 0.0  # Speed [m/s]
    tunnel_share: float = 0.0  # Share of the train that is in a tunnel
    curvature: float = 0.0  # Mean curvature under the train [1/m]
    travelled: float = 0.0  # Distance since the start of the bag [m]
    released_for: float = math.inf  # Time since the brake was released [s], infinite before its first use
    applied_for: float = 0.0  # Time since the brake was applied [s], 0 while it is released
    pull: float = 0.0  # Reported traction over weight [N/kN]
    heat: float = 0.0  # Energy in the brake [J/kg]
    acceleration: float = 0.0  # Acceleration of the previous step [m/s^2]
    load: float = 1.0  # True mass over the mean mass of the case
    run: int = 0  # Number of the run in the bag


Law = Callable[[Moment], float]


@dataclass(frozen=True, slots=True)
class Hidden:
    """One effect with its size, as it acts in the ride."""

    name: str  # Name in the interface, or a name of this generator for an effect outside the library
    parameters: tuple[tuple[str, float], ...] = ()  # In the form of the interface, if the law is that one
    near: tuple[str, ...] = ()  # Acceptable generic names for an effect outside the library
    drag: Law | None = None  # Additional resistance [N/kN]
    pull_gain: Law | None = None  # True over reported traction
    brake_gain: Law | None = None  # True over nominal brake force
    mass_ratio: float = 1.0  # True over assumed mass
    inertia_ratio: float = 1.0  # True over assumed (1 + rotary mass)
    brake_wait: float = 0.0  # Additional dead time of the brake [s]
    wheel_ratio: float = 1.0  # Measured over true speed
    slip: tuple[float, float] = (0.0, 0.0)  # Share of the running time with slip [1] and greatest slip speed [m/s]


Draw = Callable[[World, 'Generator'], Hidden]


def tunnel_drag(world: World, rng: Generator) -> Hidden:
    # Higher aerodynamic drag of the part of the train inside the tunnel.
    factor = 1.0 + log_uniform(rng, 0.25, 3.5)
    more = (factor - 1.0) * world.vehicle.davis[2]
    return Hidden('tunnel_drag', (('factor', factor),), drag=lambda m: more * m.tunnel_share * m.speed * m.speed)


def curve_resistance(_: World, rng: Generator) -> Hidden:
    coefficient = log_uniform(rng, 200.0, 1300.0)
    return Hidden('curve_resistance', (('coefficient', coefficient),), drag=lambda m: coefficient * m.curvature)


def gradient_error(world: World, rng: Generator) -> Hidden:
    start, end = _section(world, rng)
    permille = _signed(rng, 0.4, 6.0)
    under = _share_of_train(start, end, world.vehicle.length)
    parameters = (('start', start), ('end', end), ('permille', permille))
    return Hidden('gradient_error', parameters, drag=lambda m: m.heading * permille * under(m))


def local_drag(world: World, rng: Generator) -> Hidden:
    start, end = _section(world, rng)
    permille = log_uniform(rng, 0.5, 7.0)
    under = _share_of_train(start, end, world.vehicle.length)
    parameters = (('start', start), ('end', end), ('permille', permille))
    return Hidden('local_drag', parameters, drag=lambda m: permille * under(m))


def headwind(world: World, rng: Generator) -> Hidden:
    wind, c = _signed(rng, 1.5, 14.0), world.vehicle.davis[2]

    def drag(m: Moment) -> float:
        relative = m.speed + m.heading * wind
        return c * (math.copysign(relative * relative, relative) - m.speed * m.speed)

    return Hidden('headwind', (('speed', wind),), drag=drag)


def mass_error(_: World, rng: Generator) -> Hidden:
    ratio = 1.0 + _signed(rng, 0.01, 0.15)
    return Hidden('mass_error', (('ratio', ratio),), mass_ratio=ratio)


def traction_scale(_: World, rng: Generator) -> Hidden:
    ratio = 1.0 + _signed(rng, 0.01, 0.15)
    return Hidden('traction_scale', (('ratio', ratio),), pull_gain=lambda _: ratio)


def brake_scale(_: World, rng: Generator) -> Hidden:
    ratio = 1.0 + _signed(rng, 0.01, 0.2)
    return Hidden('brake_scale', (('ratio', ratio),), brake_gain=lambda _: ratio)


def brake_fade(_: World, rng: Generator) -> Hidden:
    """Friction falls with the heat in the discs: linearly down to a floor, or exponentially."""
    loss, energy, bends = log_uniform(rng, 0.03, 0.3), log_uniform(rng, 80.0, 500.0), bool(rng.random() < 0.5)

    def gain(m: Moment) -> float:
        return 1.0 - loss * (min(1.0, m.heat / energy) if bends else 1.0 - math.exp(-m.heat / energy))

    return Hidden('brake_fade', (('loss', loss), ('energy', energy)) if bends else (), brake_gain=gain)


def brake_delay(_: World, rng: Generator) -> Hidden:
    extra = 0.02 * round(log_uniform(rng, 0.12, 1.6) / 0.02)
    return Hidden('brake_delay', (('extra', extra),), brake_wait=extra)


def dragging_brake(_: World, rng: Generator) -> Hidden:
    permille, seconds = log_uniform(rng, 0.5, 8.0), log_uniform(rng, 4.0, 30.0)
    return Hidden(
        'dragging_brake',
        (('permille', permille), ('time', seconds)),
        drag=lambda m: permille if 0.0 < m.released_for <= seconds else 0.0,
    )


def starting_resistance(_: World, rng: Generator) -> Hidden:
    value, speed, steep = log_uniform(rng, 3.0, 20.0), log_uniform(rng, 1.5, 6.0), bool(rng.random() < 0.7)

    def drag(m: Moment) -> float:
        if steep:
            return value * math.exp(-m.speed / speed)
        # Stribeck curve of a bearing.
        return value / (1.0 + (m.speed / speed) ** 2)

    return Hidden('starting_resistance', (('value', value), ('speed', speed)) if steep else (), drag=drag)


def bearing_warmup(_: World, rng: Generator) -> Hidden:
    value, distance = log_uniform(rng, 0.4, 5.0), log_uniform(rng, 1500.0, 7000.0)
    return Hidden(
        'bearing_warmup',
        (('value', value), ('distance', distance)),
        drag=lambda m: value * math.exp(-m.travelled / distance),
    )


def wheel_diameter(_: World, rng: Generator) -> Hidden:
    ratio = 1.0 + _signed(rng, 0.005, 0.06)
    return Hidden('wheel_diameter', (('ratio', ratio),), wheel_ratio=ratio)


def wheel_slip(_: World, rng: Generator) -> Hidden:
    share, speed = log_uniform(rng, 0.01, 0.12), log_uniform(rng, 0.4, 4.0)
    return Hidden('wheel_slip', (('share', share), ('speed', speed)), slip=(share, speed))


def resistance_step(world: World, rng: Generator) -> Hidden:
    day = world.duration
    time, size = round(day * float(rng.uniform(0.25, 0.7))), _signed(rng, 0.2, 3.0)
    if size < 0.0:
        size = max(size, -0.6 * world.vehicle.davis[0])
    return Hidden('resistance_step', (('time', time), ('a', size)), drag=lambda m: size if m.time >= time else 0.0)


def higher_order_drag(world: World, rng: Generator) -> Hidden:
    coefficient = log_uniform(rng, 1.0, 15.0) / world.vehicle.top_speed**3
    return Hidden('higher_order_drag', (('coefficient', coefficient),), drag=lambda m: coefficient * m.speed**3)


def _signed(rng: Generator, low: float, high: float) -> float:
    return log_uniform(rng, low, high) * (1.0 if rng.random() < 0.5 else -1.0)


def _section(world: World, rng: Generator) -> tuple[float, float]:
    stops = world.route.stops
    k = int(rng.integers(0, len(stops) - 1))
    span = stops[k + 1] - stops[k]
    start = stops[k] + span * float(rng.uniform(0.1, 0.6))
    return float(round(start)), float(round(start + min(float(rng.uniform(150.0, 800.0)), 0.5 * span)))


def _share_of_train(start: float, end: float, length: int) -> Callable[[Moment], float]:
    def share(m: Moment) -> float:
        rear = m.front - m.heading * length
        low, high = (rear, m.front) if rear < m.front else (m.front, rear)
        return max(0.0, min(high, end) - max(low, start)) / length

    return share


LIBRARY: dict[str, Draw] = {
    draw.__name__: draw for draw in (
        tunnel_drag, curve_resistance, gradient_error, headwind, mass_error, traction_scale, brake_scale, brake_fade,
        brake_delay, dragging_brake, starting_resistance, bearing_warmup, wheel_diameter, wheel_slip, resistance_step,
        local_drag, higher_order_drag,
    )
}  # fmt: skip
COUNTS_FROM_START = frozenset({'bearing_warmup', 'resistance_step', 'growing_drag'})


def wavy_drag(_: World, rng: Generator) -> Hidden:
    """Varying track stiffness: resistance that oscillates along the line, equal in both directions."""
    size, wave, phase = log_uniform(rng, 0.8, 6.0), float(rng.uniform(300.0, 900.0)), float(rng.uniform(0.0, 6.28))
    near = ('local_drag', 'gradient_error')
    return Hidden('wavy_drag', near=near, drag=lambda m: size * math.sin(2.0 * math.pi * m.front / wave + phase))


def growing_drag(world: World, rng: Generator) -> Hidden:
    """Overheating bearing: drag that grows all day."""
    rate = log_uniform(rng, 0.6, 5.0) / world.duration
    near = ('resistance_step', 'bearing_warmup')
    return Hidden('growing_drag', near=near, drag=lambda m: rate * m.time)


def brake_speed_rate(world: World, rng: Generator) -> Hidden:
    """Cast-iron brake blocks: friction falls with speed."""
    loss, top = log_uniform(rng, 0.05, 0.45), world.vehicle.top_speed
    near = ('brake_slope', 'brake_scale', 'brake_fade')
    return Hidden('brake_speed_rate', near=near, brake_gain=lambda m: 1.0 - loss * m.speed / top)


def field_weakening(world: World, rng: Generator) -> Hidden:
    """Drive with field weakening: reports the demanded force, but gives less above a speed."""
    loss, knee = log_uniform(rng, 0.05, 0.4), world.vehicle.top_speed * float(rng.uniform(0.35, 0.6))
    span = world.vehicle.top_speed - knee
    return Hidden(
        'field_weakening',
        near=('traction_scale', 'higher_order_drag'),
        pull_gain=lambda m: 1.0 - loss * max(0.0, m.speed - knee) / span,
    )


def sagging_voltage(world: World, rng: Generator) -> Hidden:
    """Voltage drop: on a section of the line the drive gives less than it reports."""
    loss, stops = log_uniform(rng, 0.05, 0.35), world.route.stops
    middle, width = float(rng.uniform(0.15, 0.85)) * stops[-1], float(rng.uniform(400.0, 1200.0))

    def gain(m: Moment) -> float:
        return 1.0 - loss * math.exp(-0.5 * ((m.front - middle) / width) ** 2)

    return Hidden('sagging_voltage', near=('traction_scale', 'local_drag'), pull_gain=gain)


def rotary_mass(world: World, rng: Generator) -> Hidden:
    gamma = world.vehicle.rotary
    wrong = gamma * float(rng.uniform(0.1, 0.6) if rng.random() < 0.5 else rng.uniform(1.5, 2.4))
    near = ('mass_error', 'traction_scale', 'wheel_diameter')
    return Hidden('rotary_mass', near=near, inertia_ratio=(1.0 + wrong) / (1.0 + gamma))


def jerked_drag(_: World, rng: Generator) -> Hidden:
    """Resistance proportional to |acceleration|, as by couplers and suspension."""
    size = log_uniform(rng, 0.8, 8.0)
    near = ('mass_error', 'traction_scale', 'brake_scale')
    return Hidden('jerked_drag', near=near, drag=lambda m: size * min(1.2, abs(m.acceleration)))


def pull_drag_one_way(_: World, rng: Generator) -> Hidden:
    """Extra drag under traction in one direction only."""
    size, heading = log_uniform(rng, 0.6, 5.0), 1 if rng.random() < 0.5 else -1
    near = ('traction_scale', 'headwind', 'gradient_error')
    return Hidden(
        'pull_drag_one_way',
        near=near,
        drag=lambda m: size if m.pull > 0.5 and m.heading == heading else 0.0,
    )


def random_runs(world: World, rng: Generator) -> Hidden:
    """Random resistance in each run."""
    size, runs = log_uniform(rng, 0.3, 2.0), sum(len(legs) for legs in world.bags)
    levels: list[float] = np.clip(size * rng.standard_normal(runs), -0.7, None).tolist()
    return Hidden('random_runs', near=('resistance_step',), drag=lambda m: levels[m.run])


def speed_band_drag(world: World, rng: Generator) -> Hidden:
    """Resonance of the running gear: drag in a speed band."""
    size, width = log_uniform(rng, 0.8, 7.0), float(rng.uniform(0.8, 2.0))
    centre = world.vehicle.top_speed * float(rng.uniform(0.35, 0.65))
    return Hidden('speed_band_drag', drag=lambda m: size * math.exp(-0.5 * ((m.speed - centre) / width) ** 2))


def wet_brake(_: World, rng: Generator) -> Hidden:
    """Wet discs: reduced friction at the start of each braking."""
    loss, seconds = log_uniform(rng, 0.08, 0.5), float(rng.uniform(3.0, 8.0))
    near = ('brake_delay', 'brake_scale')
    return Hidden('wet_brake', near=near, brake_gain=lambda m: 1.0 - loss * math.exp(-m.applied_for / seconds))


def crowded_drag(_: World, rng: Generator) -> Hidden:
    """Specific resistance that falls with the load."""
    slope = log_uniform(rng, 2.0, 15.0)
    near = ('resistance_step', 'mass_error')
    return Hidden('crowded_drag', near=near, drag=lambda m: slope * (1.0 - m.load))


OUTSIDE: dict[str, Draw] = {
    draw.__name__: draw for draw in (
        wavy_drag, growing_drag, brake_speed_rate, field_weakening, sagging_voltage, rotary_mass, jerked_drag,
        pull_drag_one_way, random_runs, speed_band_drag, wet_brake, crowded_drag,
    )
}  # fmt: skip

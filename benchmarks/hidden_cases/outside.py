# SPDX-License-Identifier: Apache-2.0
"""Effects outside the library of the interface; ``near`` lists acceptable generic names."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_cases.hidden import Hidden, Moment
from benchmarks.hidden_cases.world import World, log_uniform

if TYPE_CHECKING:
    from numpy.random import Generator

    from benchmarks.hidden_cases.library import Draw


def wavy_drag(_: World, rng: Generator) -> Hidden:
    """Varying track stiffness: resistance that oscillates along the line, equal in both directions."""
    size, wave, phase = log_uniform(rng, 0.8, 6.0), float(rng.uniform(300.0, 900.0)), float(rng.uniform(0.0, 6.28))
    parameters = (('size', size), ('wave', wave), ('phase', phase))
    near = ('local_drag', 'gradient_error')
    return Hidden(
        'wavy_drag', parameters, near=near, drag=lambda m: size * math.sin(2.0 * math.pi * m.front / wave + phase)
    )


def growing_drag(world: World, rng: Generator) -> Hidden:
    """Overheating bearing: drag that grows all day."""
    rate = log_uniform(rng, 0.6, 5.0) / world.duration
    near = ('resistance_step', 'bearing_warmup')
    return Hidden('growing_drag', (('rate', rate),), near=near, drag=lambda m: rate * m.time)


def brake_speed_rate(world: World, rng: Generator) -> Hidden:
    """Cast-iron brake blocks: friction falls with speed."""
    loss, top = log_uniform(rng, 0.05, 0.45), world.vehicle.top_speed
    return Hidden(
        'brake_speed_rate',
        (('loss', loss),),
        near=('brake_scale', 'brake_fade'),
        brake_gain=lambda m: 1.0 - loss * m.speed / top,
    )


def field_weakening(world: World, rng: Generator) -> Hidden:
    """Drive with field weakening: reports the demanded force, but gives less above a speed."""
    loss, knee = log_uniform(rng, 0.05, 0.4), world.vehicle.top_speed * float(rng.uniform(0.35, 0.6))
    span = world.vehicle.top_speed - knee
    return Hidden(
        'field_weakening',
        (('loss', loss), ('knee', knee)),
        near=('traction_scale', 'higher_order_drag'),
        pull_gain=lambda m: 1.0 - loss * max(0.0, m.speed - knee) / span,
    )


def sagging_voltage(world: World, rng: Generator) -> Hidden:
    """Voltage drop: on a section of the line the drive gives less than it reports."""
    loss, stops = log_uniform(rng, 0.05, 0.35), world.route.stops
    middle, width = float(rng.uniform(0.15, 0.85)) * stops[-1], float(rng.uniform(400.0, 1200.0))
    parameters = (('loss', loss), ('place', middle), ('width', width))

    def gain(m: Moment) -> float:
        return 1.0 - loss * math.exp(-0.5 * ((m.front - middle) / width) ** 2)

    return Hidden('sagging_voltage', parameters, near=('traction_scale', 'local_drag'), pull_gain=gain)


def rotary_mass(world: World, rng: Generator) -> Hidden:
    gamma = world.vehicle.rotary
    wrong = gamma * float(rng.uniform(0.1, 0.6) if rng.random() < 0.5 else rng.uniform(1.5, 2.4))
    near = ('mass_error', 'traction_scale', 'wheel_diameter')
    return Hidden('rotary_mass', (('gamma', wrong),), near=near, inertia_ratio=(1.0 + wrong) / (1.0 + gamma))


def jerked_drag(_: World, rng: Generator) -> Hidden:
    """Resistance proportional to |acceleration|, as by couplers and suspension."""
    size = log_uniform(rng, 0.8, 8.0)
    near = ('mass_error', 'traction_scale', 'brake_scale')
    return Hidden('jerked_drag', (('size', size),), near=near, drag=lambda m: size * min(1.2, abs(m.acceleration)))


def pull_drag_one_way(_: World, rng: Generator) -> Hidden:
    """Extra drag under traction in one direction only."""
    size, heading = log_uniform(rng, 0.6, 5.0), 1 if rng.random() < 0.5 else -1
    near = ('traction_scale', 'headwind', 'gradient_error')
    return Hidden(
        'pull_drag_one_way',
        (('size', size), ('heading', heading)),
        near=near,
        drag=lambda m: size if m.pull > 0.5 and m.heading == heading else 0.0,
    )


def random_runs(world: World, rng: Generator) -> Hidden:
    """Random resistance in each run."""
    size, runs = log_uniform(rng, 0.3, 2.0), sum(len(legs) for legs in world.bags)
    levels: list[float] = np.clip(size * rng.standard_normal(runs), -0.7, None).tolist()
    return Hidden('random_runs', (('size', size),), near=('resistance_step',), drag=lambda m: levels[m.run])


def speed_band_drag(world: World, rng: Generator) -> Hidden:
    """Resonance of the running gear: drag in a speed band."""
    size, width = log_uniform(rng, 0.8, 7.0), float(rng.uniform(0.8, 2.0))
    centre = world.vehicle.top_speed * float(rng.uniform(0.35, 0.65))
    parameters = (('size', size), ('centre', centre), ('width', width))
    return Hidden(
        'speed_band_drag', parameters, drag=lambda m: size * math.exp(-0.5 * ((m.speed - centre) / width) ** 2)
    )


def wet_brake(_: World, rng: Generator) -> Hidden:
    """Wet discs: reduced friction at the start of each braking."""
    loss, seconds = log_uniform(rng, 0.08, 0.5), float(rng.uniform(3.0, 8.0))
    near = ('brake_delay', 'brake_scale')

    def gain(m: Moment) -> float:
        return 1.0 - loss * math.exp(-m.applied_for / seconds)

    return Hidden('wet_brake', (('loss', loss), ('seconds', seconds)), near=near, brake_gain=gain)


def crowded_drag(_: World, rng: Generator) -> Hidden:
    """Specific resistance that falls with the load."""
    slope = log_uniform(rng, 2.0, 15.0)
    near = ('resistance_step', 'mass_error')

    def drag(m: Moment) -> float:
        return slope * (1.0 - m.load)

    return Hidden('crowded_drag', (('slope', slope),), near=near, drag=drag)


OUTSIDE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        wavy_drag,
        growing_drag,
        brake_speed_rate,
        field_weakening,
        sagging_voltage,
        rotary_mass,
        jerked_drag,
        pull_drag_one_way,
        random_runs,
        speed_band_drag,
        wet_brake,
        crowded_drag,
    )
}

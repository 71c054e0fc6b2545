# SPDX-License-Identifier: Apache-2.0
"""Effects named in the interface, as independent physics, with sizes from barely visible to large."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from benchmarks.hidden_cases.hidden import Hidden, Moment
from benchmarks.hidden_cases.world import World, log_uniform

if TYPE_CHECKING:
    from numpy.random import Generator

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

    return Hidden('brake_fade', (('loss', loss), ('energy', energy)), comparable=bends, brake_gain=gain)


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

    return Hidden('starting_resistance', (('value', value), ('speed', speed)), comparable=steep, drag=drag)


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
    draw.__name__: draw
    for draw in (
        tunnel_drag,
        curve_resistance,
        gradient_error,
        headwind,
        mass_error,
        traction_scale,
        brake_scale,
        brake_fade,
        brake_delay,
        dragging_brake,
        starting_resistance,
        bearing_warmup,
        wheel_diameter,
        wheel_slip,
        resistance_step,
        local_drag,
        higher_order_drag,
    )
}
COUNTS_FROM_START = frozenset({'bearing_warmup', 'resistance_step', 'growing_drag'})

# SPDX-License-Identifier: Apache-2.0
"""Lines, trains, drivers and days of the third generator, its effects by name, and its cases."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, pairwise
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np
from scipy.signal import fftconvolve, lfilter

from benchmarks.hidden_case import Case, HiddenEffect, Pairs, assumed_yaml, draw_mix, log_uniform
from benchmarks.hidden_cases_c import motion as m
from benchmarks.hidden_log import STEP, Array, G, Log, Sensors, answer_of, measure_gaps, observe

Rng = np.random.Generator
_APRON: Final = 1200  # Line beyond the last stops [m]
_EPOCH_NS, _BAG_NS = 1_780_000_000_000_000_000, 7_200_000_000_000


class Service(NamedTuple):
    """A kind of train; pairs are ranges of uniform distributions."""

    gap: tuple[float, float]  # Between stops [m]
    cars: tuple[int, int]
    car: int  # Length of a car [m]
    tonnes: tuple[float, float]  # Of a car
    engine: float  # Mass of an engine in front [t]; 0: the cars are driven
    top: tuple[float, float]  # Speed [m/s]
    start: float  # Acceleration [m/s^2]
    lag: tuple[float, float]  # Of the brake [s]
    steep: float  # Std of gradients [per mille]
    swing: float  # Std of the load
    runs: tuple[int, int]


SERVICES: Final = {
    'metro': Service((700, 1700), (4, 8), 20, (28, 40), 0, (17, 25), 1.0, (0.3, 0.7), 9, 0.06, (6, 12)),
    'tram': Service((400, 1000), (3, 5), 8, (8, 13), 0, (12, 19), 1.0, (0.3, 0.5), 12, 0.06, (8, 14)),
    'freight': Service((4000, 8000), (12, 27), 16, (35, 85), 90, (19, 27), 0.3, (1.0, 2.0), 3, 0.02, (4, 6)),
    'high_speed': Service((12000, 20000), (7, 12), 25, (45, 58), 0, (55, 80), 0.5, (0.4, 0.8), 6, 0.02, (4, 5)),
}


@dataclass(frozen=True, slots=True)
class Scene:
    """Days of one train, without effects and sensors."""

    stops: tuple[float, ...]  # [m]
    sections: Mapping[str, Pairs]  # Of the map
    cells: Array  # Per metre: slope of the map and its error [per mille], curvature [1/m], tunnel; shape (4, n)
    train: m.Leg  # With the usual load
    cars: Array  # Their masses [kg]
    bags: tuple[tuple[m.Leg, ...], ...]
    gusts: Array  # Speed of each second [m/s], a row per bag
    weighs: bool  # Whether the mass is measured
    one_way: bool
    flags: tuple[str, ...]

    def track(self, start: float, end: float) -> m.Track:
        """Return what a train feels with its front at each metre; the section is that of an effect."""
        length, origin = int(self.train.length), self.stops[0] - _APRON
        even, masses = np.full(length, 1.0 / length), np.repeat(self.cars, length // len(self.cars))
        place, heavy = origin + np.arange(self.cells.shape[1]) + 0.5, masses / masses.sum()
        (slope, error, bend, dark), section = self.cells, ((place >= start) & (place < end)).astype(float)
        felt = ((slope, even), (slope + error, heavy), (bend, even), (dark, even), (section, heavy))
        tables = np.array([np.column_stack([_behind(of, by, way) for of, by in felt]) for way in (1, -1)])
        tables[1, :, :2] *= -1.0
        return m.Track(origin, tables)


def _behind(cells: Array, weights: Array, way: int) -> Array:
    """Return the weighted mean of the cells behind a front at each edge of a cell."""
    means: Array = np.concatenate([[0.0], fftconvolve(cells[::way], weights)[: len(cells)]])[::way]
    return means


def _wander(rng: Rng, count: int, std: float, length: float) -> Array:
    """Return a stationary process of first order."""
    keep, shocks = math.exp(-1.0 / length), std * rng.standard_normal(count)
    shocks[1:] *= math.sqrt(1.0 - keep * keep)
    values: Array = lfilter([1.0], [1.0, -keep], shocks)
    return values


def _draw_line(rng: Rng, kind: Service) -> tuple[tuple[float, ...], dict[str, Pairs], Array]:
    """Return stops, sections of the map and cells; the pieces have lognormal lengths, every second one is curved."""
    gaps = rng.uniform(*kind.gap, int(rng.integers(1, 5 if kind.gap[0] < 2e3 else 3)))
    stops = np.round(np.cumsum([rng.uniform(0.0, 3e3), *gaps]), 1)
    place = np.arange(stops[0] - _APRON, stops[-1] + _APRON) + 0.5
    edges = place[0] - 0.5 + np.cumsum(rng.lognormal(0.0, 0.6, 500) * min(0.2 * kind.gap[0], 900.0))
    edges = np.concatenate([place[:1] - 0.5, np.round(edges[edges < place[-1]], 1)])
    slopes = np.round(kind.steep * np.clip(rng.standard_normal(len(edges)), -2.5, 2.5), 1)
    radii = np.round(np.clip(4.0 * kind.gap[0] ** 0.7 * rng.lognormal(0.0, 0.5, len(edges)), 150.0, 5e3))
    radii[:: 2 if rng.random() < 0.8 else 1] = 0.0
    bores = np.round(np.sort(rng.uniform(stops[0], stops[-1], 2 * int(rng.integers(0, 3)))), 1).reshape(-1, 2)
    at = np.searchsorted(edges, place) - 1
    bend = np.divide(1.0, radii, out=np.zeros(len(radii)), where=radii > 0.0)[at]
    dark = ((place >= bores[:, :1]) & (place < bores[:, 1:])).any(axis=0)
    error = _wander(rng, len(place), float(rng.uniform(0.1, 0.4)), float(rng.uniform(100.0, 400.0)))
    rows = {'gradient': np.column_stack((edges, slopes)), 'curve': np.column_stack((edges, radii)), 'tunnel': bores}
    sections = {name: tuple((start, value) for start, value in pairs.tolist()) for name, pairs in rows.items()}
    return tuple(stops.tolist()), sections, np.array((slopes[at], error, bend, dark))


def _draw_train(rng: Rng, kind: Service, *, blends: bool) -> tuple[m.Leg, Array]:
    """Return the train on no leg yet, and the masses of its cars [kg]."""
    cars = 1e3 * rng.uniform(*kind.tonnes) * rng.uniform(0.85, 1.15, int(rng.integers(*kind.cars, endpoint=True)))
    cars[0] = 1e3 * kind.engine or cars[0]
    mass, length, top = float(cars.sum()), float(kind.car * len(cars)), float(rng.uniform(*kind.top))
    # The brake differs from that of the train file by less than the least gap that counts.
    lag, later, slower = (float(rng.uniform(*of)) for of in (kind.lag, (-0.03, 0.03), (-0.03, 0.03)))
    effort, drag = mass * kind.start * float(rng.uniform(0.8, 1.2)), 1.8 + 0.03 * length * float(rng.uniform(0.7, 1.3))
    return m.Leg(
        length=length, mass=mass, weighed=mass, gamma=round(float(rng.uniform(0.05, 0.12)), 3),
        a=float(rng.uniform(0.7, 2.0)), b=float(rng.uniform(0.003, 0.03)), c=1e3 * drag / (mass * G), drag=drag,
        effort=effort, power=effort * top * float(rng.uniform(0.35, 0.6)),
        adhesive=G * (float(cars[0]) if kind.engine else mass * float(rng.uniform(0.5, 1.0))),
        jerk=float(rng.uniform(0.3, 0.9)) * kind.start, delay=round(lag * float(rng.uniform(0.7, 1.3)), 2),
        lag=round(lag, 2), later=later, slower=slower, electric=float(rng.uniform(0.2, 0.4)) * blends,
        serve=0.1 + 0.8 * kind.start, cruise=top,
    ), cars  # fmt: skip


def _for_leg(rng: Rng, driver: m.Leg, ends: tuple[float, float], swing: float, spread: float) -> m.Leg:
    """Return a leg with its load, weighing error (0: not weighed), speed, coasting, restriction and rain."""
    gap, load = abs(ends[1] - ends[0]), 1.0 + swing * float(np.clip(rng.standard_normal(), -2.0, 2.0))
    cruise = min(driver.cruise * float(rng.uniform(0.75, 1.0)), 0.75 * math.sqrt(driver.serve * gap))
    return driver._replace(
        start=ends[0], target=ends[1], way=math.copysign(1.0, ends[1] - ends[0]), mass=driver.mass * load, load=load,
        weighed=driver.mass * (load + spread * float(rng.standard_normal()) if spread else 1.0), cruise=cruise,
        coast=gap * float(rng.uniform(0.0, 0.5)), zone=gap * rng.uniform(0.3, 0.6) if rng.random() < 0.4 else -1e4,
        zone_v=cruise * float(rng.uniform(0.4, 0.75)), wet=float(rng.random() < 0.3),
    )  # fmt: skip


def draw_scene(rng: Rng, *, one_day: bool = False) -> Scene:
    """Draw a scene; ``one_day``: one bag in both directions."""
    service = str(rng.choice(list(SERVICES)))
    kind = SERVICES[service]
    weighs, overlaps, one_way, many, blends = (bool(rng.random() < share) for share in (0.7, 0.5, 0.15, 0.5, 0.6))
    one_way, many = one_way and not one_day, (many or one_way) and not one_day
    stops, sections, cells = _draw_line(rng, kind)
    train, cars = _draw_train(rng, kind, blends=blends and not kind.engine)
    spread, swing = (log_uniform(rng, 0.002, 0.015), kind.swing) if weighs else (0.0, 0.01)
    there, left, bags = list(pairwise(stops)), int(rng.integers(*kind.runs, endpoint=True)), list[tuple[m.Leg, ...]]()
    for trip in cycle([there] if one_way else [there, [(q, p) for p, q in reversed(there)]]):
        driver = train._replace(
            serve=train.serve * float(rng.uniform(0.8, 1.2)), band=float(rng.choice([0.0, rng.uniform(1.0, 3.0)])),
            notch=float(rng.choice([0.02, 0.1])), overlap=float(rng.choice([1.0, 2.0])) * overlaps,
        )  # fmt: skip
        legs = tuple(_for_leg(rng, driver, ends, swing, spread) for ends in trip[:left])
        bags = [*bags, legs] if many or not bags else [bags[0] + legs]
        left -= len(legs)
        if not left:
            break
    gust, count = log_uniform(rng, 0.5, 2.5), max(map(len, bags)) * int(m.LONGEST)
    # Of seconds, of minutes, and the wind of the day.
    winds = [_wander(rng, count, gust, float(rng.uniform(2.0, 8.0))) for _ in bags]
    winds = [wind + _wander(rng, count, 0.5 * gust, 150.0) + 0.3 * gust * rng.standard_normal() for wind in winds]
    words = {'overlap': overlaps, 'gusts': gust > 1.2, 'no_mass_topic': not weighs, 'blended': train.electric > 0.0}
    flags = service, *(word for word, holds in words.items() if holds)
    return Scene(stops, sections, cells, train, cars, tuple(bags), np.array(winds), weighs, one_way, flags)


class Effect(NamedTuple):
    """Names of the parameters that may be compared, and sizes: index, least and greatest in units of ``_units``."""

    parameters: str
    sizes: tuple[tuple[int, float, float], ...]
    near: str = ''  # Acceptable generic names for an effect outside the library


_SIGNED: Final = frozenset({m.SLOPE, m.WIND, m.HEAVY, m.PULL, m.BITE, m.WHEEL, m.SHIFT})
_RATIOS: Final = frozenset({m.BORE, m.HEAVY, m.PULL, m.BITE, m.WHEEL})  # The parameter is 1 without the effect
_PLACED: Final = frozenset({m.SLOPE, m.RUB, m.WIRE})
LIBRARY: Final[Mapping[str, Effect]] = {
    'tunnel_drag': Effect('factor', ((m.BORE, 0.25, 2.5),)),
    'curve_resistance': Effect('coefficient', ((m.FLANGE, 250.0, 2000.0),)),
    'gradient_error': Effect('permille start end', ((m.SLOPE, 0.5, 6.0),)),
    'local_drag': Effect('permille start end', ((m.RUB, 0.5, 6.0),)),
    'headwind': Effect('speed', ((m.WIND, 1.0, 12.0),)),
    'mass_error': Effect('ratio', ((m.HEAVY, 0.008, 0.12),)),
    'traction_scale': Effect('ratio', ((m.PULL, 0.008, 0.1),)),
    'brake_scale': Effect('ratio', ((m.BITE, 0.01, 0.2),)),
    # Only the friction brake heats up, so its parameters differ from those of the library.
    'brake_fade': Effect('', ((m.FADE, 0.05, 0.4), (m.FADE_HEAT, 0.2, 0.7))),
    'brake_delay': Effect('extra', ((m.LATE, 0.12, 1.5),)),
    'dragging_brake': Effect('permille time', ((m.CLING, 0.5, 6.0), (m.CLING_FOR, 6.0, 30.0))),
    'starting_resistance': Effect('value speed', ((m.STICK, 0.1, 0.4), (m.STICK_V, 1.5, 8.0))),
    'bearing_warmup': Effect('value distance', ((m.COLD, 0.3, 4.0), (m.COLD_RUN, 0.04, 0.15))),
    'wheel_diameter': Effect('ratio', ((m.WHEEL, 0.005, 0.04),)),
    'wheel_slip': Effect('', ((m.SLIP, 0.01, 0.1), (m.SLIP_V, 0.5, 4.0))),
    'resistance_step': Effect('a time', ((m.JUMP, 0.15, 2.0), (m.JUMP_AT, 0.25, 0.75))),
    'higher_order_drag': Effect('coefficient', ((m.CUBIC, 1.0, 12.0),)),
    'map_shift': Effect('distance', ((m.SHIFT, 15.0, 150.0),)),
    'stamp_skew': Effect('delay', ((m.SKEW, 0.15, 1.0),)),
}
OUTSIDE: Final[Mapping[str, Effect]] = {
    'iron_blocks': Effect('', ((m.IRON, 0.05, 0.4),), 'brake_slope brake_scale brake_fade'),
    'slow_release': Effect('', ((m.STUCK, 0.3, 3.0),), 'dragging_brake brake_delay'),
    'thinner_air': Effect('', ((m.THIN, 0.1, 0.7),), 'bearing_warmup resistance_step'),
    'wet_legs': Effect('', ((m.WET, 0.2, 2.0),), 'resistance_step'),
    'traction_creep': Effect('', ((m.CREEP, 0.03, 0.3),), 'traction_scale starting_resistance'),
    'gear_loss': Effect('', ((m.GEAR, 0.5, 6.0),), 'traction_scale mass_error'),
    'tight_flanges': Effect('', ((m.TIGHT, 1.0, 8.0),), 'curve_resistance'),
    'one_way_drag': Effect('', ((m.BIASED, 0.2, 2.0),), 'headwind gradient_error'),
    'long_stand': Effect('', ((m.PARKED, 0.8, 6.0),), 'starting_resistance dragging_brake'),
    'rotary_mass': Effect('', ((m.SPIN, 0.01, 0.06),), 'mass_error traction_scale wheel_diameter'),
    'axle_load': Effect('', ((m.AXLE, 0.2, 2.0),), 'resistance_step mass_error'),
    'weak_wire': Effect('', ((m.WIRE, 0.05, 0.35),), 'traction_scale local_drag'),
}
# They count from the start of the day, or need both directions.
_ONE_DAY: Final = frozenset({'bearing_warmup', 'resistance_step', 'thinner_air', 'one_way_drag'})
_CELLS: Final = {'tunnel_drag': 3, 'curve_resistance': 2, 'tight_flanges': 2}  # Row of the cells that it needs


def _units(scene: Scene) -> dict[int, float]:
    """Return the units of sizes that depend on top speed, duration of the day [s] and starting traction [N/kN]."""
    legs = [leg for bag in scene.bags for leg in bag]
    top, pull = max(leg.cruise for leg in legs), 1e3 * scene.train.effort / (scene.train.mass * G)
    day = sum(35.0 + 1.3 * abs(leg.target - leg.start) / leg.cruise for leg in legs)
    units = {m.FADE_HEAT: top**2, m.STICK: pull, m.COLD_RUN: day * top, m.JUMP_AT: day}
    return units | {m.CUBIC: top**-3, m.IRON: 1.0 / top, m.THIN: 3600.0 / day}


def _draw_sizes(rng: Rng, scene: Scene, effect: Effect) -> dict[int, float]:
    units, sizes = _units(scene), dict[int, float]()
    for at, low, high in effect.sizes:
        sign = float(rng.choice([1.0, -1.0])) if at in _SIGNED else 1.0
        sizes[at] = sign * log_uniform(rng, low, high) * units.get(at, 1.0)
    if not _PLACED.isdisjoint(sizes):
        low = int(rng.integers(len(scene.stops) - 1))
        span, share = scene.stops[low + 1] - scene.stops[low], float(rng.uniform(0.15, 0.4))
        sizes[m.START] = float(round(scene.stops[low] + span * float(rng.uniform(0.1, 0.85 - share))))
        sizes[m.END] = sizes[m.START] + round(min(share * span, 2500.0))
    return sizes


def draw_cases(seed: int, count: int) -> list[tuple[str, int]]:
    """Return names and seeds of a mix."""
    return draw_mix(seed, count, LIBRARY, OUTSIDE)


def make_case(name: str, seed: int) -> Case:
    """Return a case of no effect ('none') or some joined by '+'; equal names and seeds give equal cases.

    Raises:
        KeyError: The name is not known.
        RuntimeError: No scene was found that can be driven.

    """
    effects = {} if name == 'none' else {one: LIBRARY.get(one) or OUTSIDE[one] for one in name.split('+')}
    for attempt in range(30):
        rng = np.random.default_rng([seed, crc32(name.encode()), attempt])
        scene = draw_scene(rng, one_day=not _ONE_DAY.isdisjoint(effects))
        hidden, twists = list[HiddenEffect](), np.zeros((2 + len(effects), m.TWISTS))
        for row, (one, effect) in zip(twists[2:], effects.items(), strict=True):
            sizes = _draw_sizes(rng, scene, effect)
            row[list(sizes)] = list(sizes.values())
            values = [size + (at in _RATIOS) for at, size in sizes.items()]
            parameters = tuple(zip(effect.parameters.split(), values, strict=False))
            hidden.append(HiddenEffect(one, parameters, tuple(effect.near.split()), 0.0))
        twists[1] = twists[2:].sum(axis=0)
        track = scene.track(float(twists[1, m.START]), float(twists[1, m.END]))
        if all(scene.cells[row].any() for one, row in _CELLS.items() if one in effects):
            logs = _drive(scene, track, twists)
            if logs:
                return _observe(rng, scene, track, twists, logs, hidden)
    raise RuntimeError(f'{name} {seed}: no scene was found that can be driven')


def _drive(scene: Scene, track: m.Track, twists: Array) -> list[Log]:
    """Return the log of each bag; none if a stop is not reached."""
    logs, number = list[Log](), 0
    for bag, gusts in zip(scene.bags, scene.gusts, strict=True):
        parts, state = list[Array](), np.array([0.0, bag[0].start, 0.0, 0.0, 1e9])
        for leg in bag:
            part = np.empty((round(m.LONGEST / STEP), 6 + len(twists)))
            parts.append(part[: m.drive_leg(twists, leg, float(number), track, gusts, state, part)].copy())
            number += 1
        if not all(map(len, parts)):
            return []
        columns = np.concatenate(parts).T
        front, heading, run, speed, force, command, weighed, noise = columns[:8]
        logs.append(Log(front, heading, run, speed, force, command, weighed, noise, columns[8:]))
    return logs


def _observe(
    rng: Rng, scene: Scene, track: m.Track, twists: Array, logs: Sequence[Log], hidden: Sequence[HiddenEffect]
) -> Case:
    """Return the case as its sensors show it; the map may be read ahead and the force late."""
    train, period, step = scene.train, float(rng.choice([0.1, 0.2, 1.0])), float(rng.choice([0.1, 0.5, 1.0]))
    sensors = Sensors(
        mass_topic=scene.weighs, speed_noise=float(rng.uniform(0.005, 0.03)), speed_step=step / 3.6,
        force_noise=float(rng.uniform(0.05, 0.3)), jitter=float(rng.uniform(0.0, 0.002)), period=period,
        contamination=('dropouts',) if rng.random() < 0.15 else (),
    )  # fmt: skip
    nodes, skew, shift = track.origin + np.arange(track.tables.shape[1]), twists[1, m.SKEW], twists[1, m.SHIFT]

    def under(front: Array, way: Array) -> Array:
        up, down = ([np.interp(front + to * shift, nodes, table[:, k]) for k in (1, 0, 2, 3)]
                    for to, table in zip((1, -1), track.tables, strict=True))  # fmt: skip
        felt = np.where(way > 0.0, np.array(up), np.array(down))
        felt[:2] *= way
        return felt.T

    shown, bags, sensed = list[Log](), [], []
    falsified = [(1.0 + wheel, share, most) for wheel, share, most in twists[2:, m.WHEEL : m.SLIP_V + 1].tolist()]
    for k, log in enumerate(logs):
        time = np.arange(len(log.run)) * STEP
        force = np.interp(time - skew, time, log.force)
        ahead, here = (under(log.front - back * log.heading, log.heading)[:, 1] for back in (0.0, shift))
        wrong = (log.force - force) / log.weighed + G / 1e3 * log.heading * (ahead - here)
        misread = twists[2:, m.SKEW : m.SHIFT + 1].any(axis=1, keepdims=True)
        added = log.added + misread * (log.run >= 0.0) * wrong / (1.0 + train.gamma)
        shown.append(replace(log, force=force, added=added))
        own, records = observe(shown[-1], under, sensors, falsified, _EPOCH_NS + k * _BAG_NS, rng)
        sensed.append(own)
        bags.append(records)
    gaps = measure_gaps(shown, sensed, (train.a, train.b, train.c), train.gamma)
    flags = *scene.flags, f'{1.0 / period:.0f}_hz', *(['coarse_speed'] if step > 0.4 else [])
    answer = answer_of(hidden, OUTSIDE, gaps, sensors, flags, one_way=scene.one_way)
    davis = [f'{value * (1.0 + float(rng.uniform(-0.15, 0.15))):.5g}' for value in (train.a, train.b, train.c)]
    of_train = {'mass': round(train.mass), 'rotary_mass': train.gamma, 'length': train.length, 'cars': len(scene.cars)}
    assumed = assumed_yaml(of_train, davis, (train.lag, train.delay), scene.stops, scene.sections, str)
    return Case(assumed, tuple(bags), answer)

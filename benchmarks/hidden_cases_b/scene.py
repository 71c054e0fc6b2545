# SPDX-License-Identifier: Apache-2.0
"""One day of one train: line, vehicle, legs, loads, winds; drawn once, simulated with or without quirks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.hidden_cases_b.forces import Stock, Track
from benchmarks.hidden_cases_b.ground import Ground, draw_ground
from benchmarks.hidden_cases_b.motion import COLUMNS, S_FREED, S_HEAT, S_PLACE, S_TIME, STATES, Gusts, run_leg
from benchmarks.hidden_cases_b.quirks import Quirks

Array = NDArray[np.float64]
SERVICES: Final = ('metro', 'regional', 'freight', 'mainline')
_WAIT_LIMIT: Final = 2500.0


@dataclass(frozen=True, slots=True)
class Leg:
    """A run from stop to stop; ``bag`` is the number of its bag."""

    start: float
    target: float
    way: float
    dwell: float
    bag: int


@dataclass(frozen=True, slots=True)
class Scene:
    """All random parameters of a day."""

    service: str
    ground: Ground
    legs: tuple[Leg, ...]
    stocks: tuple[Stock, ...]
    assumed_mass: float
    mass_topic: bool
    weigh_error: float
    cars: int
    gust_air: Array
    gust_force: Array
    one_way: bool
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Wish:
    """Features of a scene that an effect needs to be observable."""

    tunnels: bool = False
    curves: bool = False
    zones: bool = False
    both_ways: bool = False
    single_bag: bool = False
    hold: bool = False


def draw_scene(seed: int, wish: Wish) -> Scene:
    """Draw a scene.

    Args:
        seed: Any integer.
        wish: Required features.

    """
    rng = np.random.default_rng([seed, 11])
    service = SERVICES[int(rng.choice(4, p=[0.3, 0.35, 0.15, 0.2]))]
    runs = int(rng.integers(3, 13))
    one_way = bool(rng.random() < 0.15) and not wish.both_ways
    runs = min(runs, 8) if service in {'freight', 'mainline'} else runs
    gaps, order, bags = _route(rng, service, runs, one_way=one_way, single=wish.single_bag)
    ground = _ground(rng, service, gaps, wish)
    legs = tuple(
        Leg(ground.stops[i], ground.stops[j], float(np.sign(j - i)), float(np.round(rng.uniform(15.0, 35.0))), bag)
        for (i, j), bag in zip(order, bags, strict=True)
    )
    base, usual, cars = _vehicle(rng, service, wish)
    mass_topic = bool(rng.random() < 2.0 / 3.0)
    weigh = float(np.exp(rng.uniform(np.log(0.002), np.log(0.02)))) if mass_topic else 0.0
    assumed = usual * float(1.0 + 0.01 * rng.standard_normal())
    swing = float(rng.uniform(0.02, 0.08)) if mass_topic else float(rng.uniform(0.01, 0.03))
    zoned = wish.zones or bool(rng.random() < 0.35)
    stocks, walk = [], 0.0
    for leg in legs:
        walk = 0.6 * walk + 0.8 * swing * float(rng.standard_normal())
        loaded = usual * (1.0 + walk)
        weighed = loaded * (1.0 + weigh * float(rng.standard_normal())) if mass_topic else assumed
        stocks.append(_for_leg(rng, base, leg, loaded=loaded, weighed=weighed, walk=walk, zoned=zoned))
    air, force = _winds(rng, base, len(legs))
    return Scene(
        service=service,
        ground=ground,
        legs=legs,
        stocks=tuple(stocks),
        assumed_mass=round(assumed, -1),
        mass_topic=mass_topic,
        weigh_error=weigh,
        cars=cars,
        gust_air=air,
        gust_force=force,
        one_way=one_way,
        flags=_flags(base, one_way=one_way, mass_topic=mass_topic, zoned=zoned),
    )


def _flags(base: Stock, *, one_way: bool, mass_topic: bool, zoned: bool) -> tuple[str, ...]:
    named = {
        'one_way': one_way,
        'no_mass_topic': not mass_topic,
        'restrictions': zoned,
        'electric_downhill': base.electric > 0.5,
        ('holding', 'on_off', 'coasting')[int(base.style)]: True,
        'force_filtered': base.filter > 0.0,
    }
    return tuple(name for name, holds in named.items() if holds)


def drive(scene: Scene, quirks: Quirks) -> Array:
    """Return the log of the whole day, shape (n, COLUMNS), 0.1 s per row.

    Raises:
        RuntimeError: A leg was not finished.

    """
    ground = scene.ground
    track = Track(ground.origin, ground.climb, ground.flaw, ground.bend, ground.bore)
    gusts = Gusts(scene.gust_air, scene.gust_force)
    log = np.empty((int(len(scene.legs) * _WAIT_LIMIT * 10.0), COLUMNS))
    state = np.zeros(STATES)
    state[S_FREED] = 1e6
    row, bag = 0, -1
    for k, (leg, stock) in enumerate(zip(scene.legs, scene.stocks, strict=True)):
        if leg.bag != bag:
            bag = leg.bag
            state[S_PLACE] = leg.start
            if k:
                state[S_TIME] += 600.0
                state[S_HEAT] *= 0.1
        row = run_leg(quirks, stock, track, gusts, state, leg.way, float(k), leg.target, leg.dwell, log, row)
        if row < 0:
            raise RuntimeError(f'leg {k} was not finished')
    return log[:row].copy()


def _ground(rng: np.random.Generator, service: str, gaps: list[float], wish: Wish) -> Ground:
    steepest = {'metro': 28.0, 'regional': 20.0, 'freight': 10.0, 'mainline': 12.0}[service] * rng.uniform(0.5, 1.0)
    return draw_ground(
        rng,
        gaps,
        steepest=float(steepest),
        tightest=float(rng.uniform(250.0, 600.0)),
        curves=wish.curves or rng.random() < 0.75,
        tunnels=wish.tunnels or rng.random() < 0.6,
        flaw_std=float(rng.uniform(0.1, 0.4)),
        flaw_length=float(rng.uniform(100.0, 400.0)),
    )


def _route(
    rng: np.random.Generator, service: str, runs: int, *, one_way: bool, single: bool
) -> tuple[list[float], list[tuple[int, int]], list[int]]:
    """Return distances between stops, legs as pairs of stops, and the bag of each leg."""
    span = {
        'metro': (900.0, 2500.0),
        'regional': (3000.0, 7000.0),
        'freight': (4000.0, 10000.0),
        'mainline': (6000.0, 12000.0),
    }[service]
    through = one_way and (single or rng.random() < 0.5)
    if through:
        count = runs
    elif one_way:
        count = int(rng.integers(1, 4))
    else:
        count = int(rng.integers(1, max(2, min(8 if service == 'metro' else 4, runs // 2) + 1)))
    gaps = [float(g) for g in rng.uniform(*span, count)]
    order: list[tuple[int, int]] = []
    bags: list[int] = []
    at, way, trip = 0, 1, 0
    many = not single and rng.random() < 0.5
    while len(order) < runs:
        order.append((at, at + way))
        bags.append(trip if many or one_way else 0)
        at += way
        if at in {0, count}:
            trip += 1
            if one_way:
                at = 0
            else:
                way = -way
    return gaps, order, bags


def _vehicle(rng: np.random.Generator, service: str, wish: Wish) -> tuple[Stock, float, int]:
    low, high = {
        'metro': (120e3, 300e3),
        'regional': (80e3, 260e3),
        'freight': (280e3, 450e3),
        'mainline': (200e3, 450e3),
    }[service]
    mass = float(rng.uniform(low, high))
    length = float(
        np.clip(
            mass
            / {'metro': 2000.0, 'regional': 1900.0, 'freight': 2400.0, 'mainline': 2100.0}[service]
            * rng.uniform(0.85, 1.15),
            60.0,
            200.0,
        )
    )
    top = {'metro': (15.0, 24.0), 'regional': (25.0, 40.0), 'freight': (19.0, 28.0), 'mainline': (32.0, 40.0)}[service]
    cruise = float(rng.uniform(*top))
    rise = {'metro': (0.8, 1.2), 'regional': (0.6, 1.0), 'freight': (0.3, 0.4), 'mainline': (0.35, 0.6)}[service]
    pull = mass * 1.08 * float(rng.uniform(*rise))
    area = float(rng.uniform(10.0, 20.0) if service == 'freight' else rng.uniform(6.0, 14.0))
    style = int(rng.choice(3, p=[0.35, 0.15, 0.5]))
    stock = Stock(
        length=round(length, 1),
        gamma=round(float(rng.uniform(0.05, 0.12)), 3),
        a=float(rng.uniform(0.7, 2.2)),
        b=float(rng.uniform(0.004, 0.04)),
        c=0.6 * area / (mass * 9.81 / 1000.0),
        lag=round(float(rng.uniform(0.25, 0.8)), 2),
        delay=round(float(rng.uniform(0.3, 1.2)) / 0.02) * 0.02,
        weighed=mass,
        loaded=mass,
        crowding=0.0,
        whim=0.0,
        pull_max=pull,
        power=pull * cruise * float(rng.uniform(0.35, 0.6)),
        jerk=float(rng.uniform(0.25, 0.9)),
        serve=float(rng.uniform(0.35, 0.5) if service == 'freight' else rng.uniform(0.5, 0.95)),
        cruise=cruise,
        band=float(rng.uniform(1.0, 3.5)) if style == 2 else 0.5,
        style=float(style),
        last_coast=0.0,
        zone_from=-1.0,
        zone_to=-1.0,
        zone_speed=0.0,
        notch=float(rng.choice([0.02, 0.05, 0.1])),
        beat=int(rng.integers(2, 7)),
        tick=10 if rng.random() < 0.8 else 5,
        hold=-0.5 if wish.hold or rng.random() < 0.6 else 0.0,
        electric=float(service == 'freight' and rng.random() < 0.5),
        filter=float(rng.uniform(0.02, 0.06)) if rng.random() < 0.5 else 0.0,
        wind_gust=1.0,
        still=float(rng.random() < 0.8),
    )
    return stock, mass, max(2, round(length / 22.0))


def _for_leg(
    rng: np.random.Generator, base: Stock, leg: Leg, *, loaded: float, weighed: float, walk: float, zoned: bool
) -> Stock:
    """Return the stock of a leg with its own load, speed, restriction and start of coasting."""
    gap = abs(leg.target - leg.start)
    # A short leg does not allow the top speed.
    cruise = min(base.cruise * float(rng.uniform(0.72, 1.0)), 0.75 * (base.serve * gap) ** 0.5)
    coast = float(rng.uniform(0.12, 0.5)) * gap if base.style > 1.5 else 0.0
    zone = (-1.0, -1.0, 0.0)
    if zoned and rng.random() < 0.8:
        start = float(rng.uniform(0.35, 0.55)) * gap
        zone = (start, start + float(rng.uniform(0.05, 0.12)) * gap, cruise * float(rng.uniform(0.45, 0.75)))
    return base._replace(
        loaded=loaded,
        weighed=weighed,
        crowding=100.0 * walk,
        whim=float(rng.standard_normal()),
        cruise=cruise,
        last_coast=coast,
        zone_from=zone[0],
        zone_to=zone[1],
        zone_speed=zone[2],
        serve=base.serve * float(rng.uniform(0.9, 1.1)),
    )


def _winds(rng: np.random.Generator, base: Stock, legs: int) -> tuple[Array, Array]:
    """Return gust speed [m/s] and other random resistance [N/kN], both Ornstein-Uhlenbeck, every 0.1 s."""
    count = int(legs * (_WAIT_LIMIT + 620.0) * 10.0)
    goal = float(rng.uniform(0.05, 0.25))
    tau = float(rng.uniform(3.0, 20.0))
    speed = 0.75 * base.cruise
    std = min(0.85 * goal / (2.0 * base.c * speed), 2.5)
    rest = max(goal**2 - (2.0 * base.c * speed * std) ** 2, 0.0) ** 0.5
    return _gauss_markov(rng, count, std, tau), _gauss_markov(rng, count, rest, tau)


def _gauss_markov(rng: np.random.Generator, count: int, std: float, tau: float) -> Array:
    keep = float(np.exp(-0.1 / tau))
    noise = rng.standard_normal(count) * std * (1.0 - keep * keep) ** 0.5
    noise[0] = std * rng.standard_normal()
    values: Array = lfilter([1.0], [1.0, -keep], noise)
    return values

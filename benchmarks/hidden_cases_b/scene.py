# SPDX-License-Identifier: Apache-2.0
"""One day of one train: line with its map, vehicle, legs, loads, winds; drawn once, driven with or without quirks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.hidden_cases_b.motion import (
    COLUMNS,
    S_FREED,
    S_HEAT,
    S_PLACE,
    S_TIME,
    STATES,
    Gusts,
    Quirks,
    Stock,
    Track,
    run_leg,
)

Array = NDArray[np.float64]
CELL: Final = 2.0
APRON: Final = 600.0
_WAIT_LIMIT: Final = 2500.0


@dataclass(frozen=True, slots=True)
class Ground:
    """The line; running integrals over position on a grid of ``CELL`` metres that starts at ``origin``."""

    stops: tuple[float, ...]  # Stopping points [m]
    gradient: tuple[tuple[float, float], ...]  # (position, per mille) of the map
    curve: tuple[tuple[float, float], ...]  # (position, radius) of the map
    tunnel: tuple[tuple[float, float], ...]  # (start, end)
    origin: float  # Position of the first grid node [m]
    climb: Array  # Integral of the map's gradient [per mille m]
    flaw: Array  # Integral of true minus map gradient [per mille m]
    bend: Array  # Integral of 1/R [-]
    bore: Array  # Integral of the tunnel indicator [m]

    def at(self, table: Array, x: Array) -> Array:
        return np.interp(x, self.origin + CELL * np.arange(len(table)), table)

    def mean_under(self, table: Array, front: Array, facing: Array, length: float) -> Array:
        """Return the mean of the integrand between rear and front."""
        return np.abs(self.at(table, front) - self.at(table, front - facing * length)) / length

    def signed_mean_under(self, table: Array, front: Array, facing: Array, length: float) -> Array:
        """Return the mean of the integrand under the train, with the sign of the direction of travel."""
        return (self.at(table, front) - self.at(table, front - facing * length)) / length


def draw_ground(
    rng: np.random.Generator, gaps: list[float], *, steepest: float, tightest: float, curves: bool, tunnels: bool,
    flaw_std: float, flaw_length: float,
) -> Ground:  # fmt: skip
    """Draw a line with these distances between its stops."""
    first = float(rng.uniform(0.0, 3000.0))
    stops = tuple(round(float(first + s), 1) for s in np.concatenate([[0.0], np.cumsum(gaps)]))
    low, high = stops[0] - APRON, stops[-1] + APRON
    gradient = _gradients(rng, low, high, steepest, float(np.mean(gaps)), stops)
    curve = _curves(rng, low, stops, tightest) if curves else ((round(low, 1), 0.0),)
    tunnel = _tunnels(rng, stops) if tunnels else ()
    nodes = np.arange(low, high + CELL, CELL)
    middle = nodes[:-1] + 0.5 * CELL
    return Ground(
        stops, gradient, curve, tunnel, float(low), _integral(_steps(gradient, middle)),
        _integral(_coloured(rng, len(middle), flaw_std, flaw_length)),
        _integral(np.where(_steps(curve, middle) > 0.0, 1.0 / np.maximum(_steps(curve, middle), 1.0), 0.0)),
        _integral(np.array([sum(1.0 for s, e in tunnel if s <= x < e) for x in middle])),
    )  # fmt: skip


def _gradients(
    rng: np.random.Generator, low: float, high: float, steepest: float, gap: float, stops: tuple[float, ...]
) -> tuple[tuple[float, float], ...]:
    """Draw gradients in pieces of lognormal length; they revert to level, so that the height stays bounded."""
    out, x, slope = [], low, 0.0
    typical = float(np.clip(0.12 * gap, 150.0, 700.0))
    while x < high:
        slope = float(np.clip(0.2 * slope + rng.standard_normal() * 0.5 * steepest, -steepest, steepest))
        if min(abs(x - s) for s in stops) < 150.0:
            slope *= 0.25
        out.append((round(x, 1), round(slope, 1)))
        x += typical * float(np.clip(rng.lognormal(0.0, 0.6), 0.3, 3.0))
    return tuple(out)


def _curves(
    rng: np.random.Generator, low: float, stops: tuple[float, ...], tightest: float
) -> tuple[tuple[float, float], ...]:
    out, x = [(round(low, 1), 0.0)], stops[0] + float(rng.uniform(50.0, 400.0))
    while x < stops[-1] - 200.0:
        length = float(rng.uniform(120.0, 700.0))
        radius = float(np.clip(tightest * rng.lognormal(0.5, 0.5), 250.0, 1500.0))
        out += [(round(x, 1), float(round(radius))), (round(x + length, 1), 0.0)]
        x += length + float(rng.uniform(150.0, 1500.0))
    return tuple(out)


def _tunnels(rng: np.random.Generator, stops: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """Draw a tunnel on one or two random legs."""
    legs = rng.permutation(len(stops) - 1)[: int(rng.integers(1, 3))]
    out = []
    for leg in sorted(legs.tolist()):
        gap = stops[leg + 1] - stops[leg]
        length = float(np.clip(rng.uniform(0.15, 0.45) * gap, 200.0, 2200.0))
        start = stops[leg] + float(rng.uniform(0.15, 0.8 - length / gap)) * gap
        out.append((round(start, 1), round(start + length, 1)))
    return tuple(out)


def _steps(pairs: tuple[tuple[float, float], ...], x: Array) -> Array:
    at = np.searchsorted(np.array([p for p, _ in pairs]), x, side='right') - 1
    values: Array = np.array([v for _, v in pairs])[np.maximum(at, 0)]
    return values


def _integral(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values) * CELL])


def _coloured(rng: np.random.Generator, count: int, std: float, length: float) -> Array:
    """Return a smooth stationary process: white noise filtered with a Gaussian window."""
    reach = int(3.0 * length / CELL)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * CELL / (0.7 * length)) ** 2)
    window /= np.sqrt(np.sum(window**2))
    noise = rng.standard_normal(count + 2 * reach)
    size = 1 << int(np.ceil(np.log2(len(noise) + len(window))))
    smooth = np.fft.irfft(np.fft.rfft(noise, size) * np.fft.rfft(window, size), size)
    values: Array = std * smooth[2 * reach : 2 * reach + count]
    return values


class Service(NamedTuple):
    """A kind of train; ranges are those of uniform distributions."""

    gap: tuple[float, float]  # Distance between stops [m]
    mass: tuple[float, float]  # Usual mass [kg]
    density: float  # Mass per length [kg/m]
    cruise: tuple[float, float]  # Highest speed [m/s]
    start: tuple[float, float]  # Acceleration at the start [m/s^2]
    steepest: float  # Upper limit of the steepest gradient [per mille]


SERVICES: Final = {
    'metro': Service((900.0, 2500.0), (120e3, 300e3), 2000.0, (15.0, 24.0), (0.8, 1.2), 28.0),
    'regional': Service((3000.0, 7000.0), (80e3, 260e3), 1900.0, (25.0, 40.0), (0.6, 1.0), 20.0),
    'freight': Service((4000.0, 10000.0), (280e3, 450e3), 2400.0, (19.0, 28.0), (0.3, 0.4), 10.0),
    'mainline': Service((6000.0, 12000.0), (200e3, 450e3), 2100.0, (32.0, 40.0), (0.35, 0.6), 12.0),
}


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
    service: str
    ground: Ground
    legs: tuple[Leg, ...]
    stocks: tuple[Stock, ...]
    assumed_mass: float
    mass_topic: bool
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
    """Draw a scene with the features wished for."""
    rng = np.random.default_rng([seed, 11])
    service = list(SERVICES)[int(rng.choice(4, p=[0.3, 0.35, 0.15, 0.2]))]
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
        service=service, ground=ground, legs=legs, stocks=tuple(stocks), assumed_mass=round(assumed, -1),
        mass_topic=mass_topic, cars=cars, gust_air=air, gust_force=force, one_way=one_way,
        flags=_flags(base, mass_topic=mass_topic, zoned=zoned),
    )  # fmt: skip


def _flags(base: Stock, *, mass_topic: bool, zoned: bool) -> tuple[str, ...]:
    named = {
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
    steepest = SERVICES[service].steepest * rng.uniform(0.5, 1.0)
    return draw_ground(
        rng, gaps, steepest=float(steepest), tightest=float(rng.uniform(250.0, 600.0)),
        curves=wish.curves or rng.random() < 0.75, tunnels=wish.tunnels or rng.random() < 0.6,
        flaw_std=float(rng.uniform(0.1, 0.4)), flaw_length=float(rng.uniform(100.0, 400.0)),
    )  # fmt: skip


def _route(
    rng: np.random.Generator, service: str, runs: int, *, one_way: bool, single: bool
) -> tuple[list[float], list[tuple[int, int]], list[int]]:
    """Return distances between stops, legs as pairs of stops, and the bag of each leg."""
    through = one_way and (single or rng.random() < 0.5)
    if through:
        count = runs
    elif one_way:
        count = int(rng.integers(1, 4))
    else:
        count = int(rng.integers(1, max(2, min(8 if service == 'metro' else 4, runs // 2) + 1)))
    gaps = [float(g) for g in rng.uniform(*SERVICES[service].gap, count)]
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
    kind = SERVICES[service]
    mass = float(rng.uniform(*kind.mass))
    length = float(np.clip(mass / kind.density * rng.uniform(0.85, 1.15), 60.0, 200.0))
    cruise = float(rng.uniform(*kind.cruise))
    pull = mass * 1.08 * float(rng.uniform(*kind.start))
    area = float(rng.uniform(10.0, 20.0) if service == 'freight' else rng.uniform(6.0, 14.0))
    style = int(rng.choice(3, p=[0.35, 0.15, 0.5]))
    stock = Stock(
        length=round(length, 1), gamma=round(float(rng.uniform(0.05, 0.12)), 3), a=float(rng.uniform(0.7, 2.2)),
        b=float(rng.uniform(0.004, 0.04)), c=0.6 * area / (mass * 9.81 / 1000.0),
        lag=round(float(rng.uniform(0.25, 0.8)), 2), delay=round(float(rng.uniform(0.3, 1.2)) / 0.02) * 0.02,
        weighed=mass, loaded=mass, crowding=0.0, whim=0.0, pull_max=pull,
        power=pull * cruise * float(rng.uniform(0.35, 0.6)), jerk=float(rng.uniform(0.25, 0.9)),
        serve=float(rng.uniform(0.35, 0.5) if service == 'freight' else rng.uniform(0.5, 0.95)), cruise=cruise,
        band=float(rng.uniform(1.0, 3.5)) if style == 2 else 0.5, style=float(style), last_coast=0.0, zone_from=-1.0,
        zone_to=-1.0, zone_speed=0.0, notch=float(rng.choice([0.02, 0.05, 0.1])), beat=int(rng.integers(2, 7)),
        tick=10 if rng.random() < 0.8 else 5, hold=-0.5 if wish.hold or rng.random() < 0.6 else 0.0,
        electric=float(service == 'freight' and rng.random() < 0.5),
        filter=float(rng.uniform(0.02, 0.06)) if rng.random() < 0.5 else 0.0, wind_gust=1.0,
        still=float(rng.random() < 0.8),
    )  # fmt: skip
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
        loaded=loaded, weighed=weighed, crowding=100.0 * walk, whim=float(rng.standard_normal()), cruise=cruise,
        last_coast=coast, zone_from=zone[0], zone_to=zone[1], zone_speed=zone[2],
        serve=base.serve * float(rng.uniform(0.9, 1.1)),
    )  # fmt: skip


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

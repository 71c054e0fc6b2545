# SPDX-License-Identifier: Apache-2.0
"""Random train, line and timetable of a case, and the line under the train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_case import Pairs, log_uniform
from benchmarks.hidden_log import Sensors

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_MARGIN = 400


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The true train without hidden effects; masses in kg, forces in N, powers in W, Davis in N/kN and m/s."""

    tare: float
    length: int
    rotary: float
    davis: tuple[float, float, float]
    brake_lag: float
    brake_dead: float
    start_acceleration: float
    power: float
    top_speed: float


@dataclass(frozen=True, slots=True)
class Route:
    """The line of the map: steps of gradient [per mille, rising position] and curve radius [m], tunnels [m]."""

    stops: tuple[float, ...]
    gradient: Pairs
    curve: Pairs
    tunnels: Pairs


@dataclass(frozen=True, slots=True)
class Leg:
    """One run from stop to stop, and its driving style."""

    start: float
    end: float
    heading: int
    mass: float
    weighed: float
    dwell: float
    cruise: float
    on_off: bool
    coast_from: float
    brake: float
    restriction: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class Nuisance(Sensors):
    """Sizes of unmodelled errors: gusts [N/kN, s], map error [per mille, m], weighing [1], lag of the force [s]."""

    gust: float
    gust_time: float
    map_error: float
    map_length: float
    weighing: float
    force_lag: float


@dataclass(frozen=True, slots=True)
class World:
    """A case without its effects; one tuple of legs per bag."""

    vehicle: Vehicle
    route: Route
    nuisance: Nuisance
    bags: tuple[tuple[Leg, ...], ...]
    mean_mass: float
    one_way: bool
    cooling: float

    @property
    def duration(self) -> float:
        """Approximate duration of the day [s]."""
        legs = [leg for bag in self.bags for leg in bag]
        return sum(leg.dwell + 40.0 + abs(leg.end - leg.start) / (0.8 * leg.cruise) for leg in legs)


def draw_world(rng: Generator, *, one_bag: bool = False) -> World:
    """Draw a case; ``one_bag``: the day is one bag, for effects that depend on time or distance since its start."""
    one_way = bool(rng.random() < 0.2)
    two_bags = bool(rng.random() < 0.35) and not one_bag
    # A fast train between towns, on which the shape of the drag curve is observable.
    fast = bool(rng.random() < 0.15) and not one_way
    count = int(rng.integers(3, 5)) if fast else _stop_count(rng, one_way=one_way, two_bags=two_bags)
    vehicle = _draw_vehicle(rng, fast=fast)
    route = _draw_route(rng, count, (3000, 6000) if fast else (1150, 2500))
    crawls = bool(rng.random() < 0.3)
    nuisance = _draw_nuisance(rng)
    full = float(rng.uniform(1.12, 1.4))
    mean = round(vehicle.tare * 0.5 * (1.0 + full), -2)
    there, back = list(pairwise(route.stops)), [(q, p) for p, q in reversed(list(pairwise(route.stops)))]
    trips = [there, there if one_way else back]
    if one_way and not two_bags:
        trips = [there]
    if not one_way and count <= 4:
        trips = [*trips, there, back] if count == 3 else [*trips, there]
    legs = [[_draw_leg(rng, vehicle, nuisance, mean, full, ends, crawls) for ends in trip] for trip in trips]
    half = (len(legs) + 1) // 2
    groups = [legs[:half], legs[half:]] if two_bags else [legs]
    bags = tuple(tuple(leg for trip in group for leg in trip) for group in groups)
    return World(vehicle, route, nuisance, bags, mean, one_way, float(rng.uniform(200.0, 500.0)))


def _stop_count(rng: Generator, *, one_way: bool, two_bags: bool) -> int:
    if one_way:
        return int(rng.integers(5, 7)) if two_bags else int(rng.integers(8, 10))
    return int(rng.choice([3, 4, 5, 6, 7], p=[0.2, 0.2, 0.3, 0.2, 0.1]))


def _draw_vehicle(rng: Generator, *, fast: bool) -> Vehicle:
    tare = round(log_uniform(rng, 75e3, 330e3), -3)
    c = log_uniform(rng, 0.0018, 0.004 if fast else 0.007)
    davis = (float(rng.uniform(0.8, 2.2)), float(rng.uniform(0.0, 0.05)), c)
    start = float(rng.uniform(0.6, 1.1))
    return Vehicle(
        tare=tare, length=round(min(200.0, max(60.0, tare / 2000.0 * float(rng.uniform(0.8, 1.4))))),
        rotary=round(float(rng.uniform(0.05, 0.12)), 3), davis=davis,
        brake_lag=round(float(rng.uniform(0.25, 0.8)), 2), brake_dead=0.02 * int(rng.integers(10, 46)),
        start_acceleration=start, power=tare * 1.2 * start * float(rng.uniform(8.0, 14.0)),
        top_speed=float(rng.uniform(110.0, 160.0) if fast else rng.uniform(60.0, 105.0)) / 3.6,
    )  # fmt: skip


def _draw_route(rng: Generator, count: int, spacing: tuple[int, int]) -> Route:
    stops = [0.0]
    for _ in range(count - 1):
        stops.append(stops[-1] + float(rng.integers(*spacing)))
    gradient = _draw_gradient(rng, stops)
    curve: list[tuple[float, float]] = [(-400.0, 0.0)]
    place = float(rng.integers(50, 300))
    while place < stops[-1]:
        curve.append((place, round(log_uniform(rng, 250.0, 1200.0), -1)))
        place += float(rng.integers(120, 450))
        curve.append((place, 0.0))
        place += float(rng.integers(150, 800))
    first = float(rng.integers(100, max(200, int(0.4 * stops[-1]))))
    tunnels = [(first, first + float(rng.integers(500, 1900)))]
    if rng.random() < 0.5:
        second = tunnels[0][1] + float(rng.integers(300, 1500))
        if second + 300.0 < stops[-1]:
            tunnels.append((second, min(second + float(rng.integers(300, 1500)), stops[-1] + 100.0)))
    return Route(tuple(stops), gradient, tuple(curve), tuple(tunnels))


def _draw_gradient(rng: Generator, stops: list[float]) -> Pairs:
    spread, most = float(rng.uniform(3.0, 12.0)), float(rng.uniform(20.0, 30.0))
    steps: list[tuple[float, float]] = []
    place = -400.0
    while place < stops[-1] + 400.0:
        value = min(most, max(-most, spread * float(rng.standard_normal())))
        if min(abs(place - stop) for stop in stops) < 150.0:
            value = min(3.0, max(-3.0, value))
        steps.append((place, round(value, 1)))
        place += float(rng.integers(90, 450))
    return tuple(steps)


def _draw_nuisance(rng: Generator) -> Nuisance:
    kinds = ('outliers', 'dropouts', 'slip')
    drawn = float(rng.random())
    contamination = (kinds[int(drawn / 0.06)],) if drawn < 0.18 else ()
    return Nuisance(
        gust=float(rng.uniform(0.05, 0.25)), gust_time=float(rng.uniform(3.0, 20.0)),
        map_error=float(rng.uniform(0.1, 0.4)), map_length=float(rng.uniform(100.0, 400.0)),
        weighing=log_uniform(rng, 0.002, 0.02), mass_topic=bool(rng.random() < 0.8),
        speed_noise=float(rng.uniform(0.01, 0.05)), speed_step=float(rng.choice([0.01, 0.03, 0.05, 0.1])) / 3.6,
        force_noise=float(rng.uniform(0.05, 0.4)), force_lag=float(rng.uniform(0.0, 0.06)),
        jitter=float(rng.uniform(0.0, 0.002)), period=0.1 if rng.random() < 0.15 else 0.2,
        contamination=contamination,
    )  # fmt: skip


def _draw_leg(
    rng: Generator, vehicle: Vehicle, nuisance: Nuisance, mean: float, full: float, ends: tuple[float, float],
    crawls: bool,
) -> Leg:  # fmt: skip
    start, end = ends
    span, heading = abs(end - start), 1 if end > start else -1
    if nuisance.mass_topic:
        mass = vehicle.tare * float(rng.uniform(1.0, full))
    else:
        # Without load weighing, effects are identifiable only in a narrow range of payloads.
        mass = mean * (1.0 + 0.02 * min(2.0, max(-2.0, float(rng.standard_normal()))))
    restriction = None
    if rng.random() < 0.35:
        begin = float(rng.uniform(0.3, 0.6)) * span
        restriction = (
            start + heading * begin,
            start + heading * (begin + float(rng.uniform(100.0, 250.0))),
            # Some lines have track works that are passed at walking pace.
            float(rng.uniform(3.0, 5.5)) if crawls else vehicle.top_speed * float(rng.uniform(0.4, 0.75)),
        )
    return Leg(
        start=start, end=end, heading=heading, mass=mass,
        weighed=mass * (1.0 + nuisance.weighing * float(rng.standard_normal())), dwell=float(rng.uniform(18.0, 35.0)),
        cruise=vehicle.top_speed * float(rng.uniform(0.75, 1.0)), on_off=bool(rng.random() < 0.3),
        coast_from=span * float(rng.uniform(0.3, 0.75)) if rng.random() < 0.6 else 0.0,
        brake=float(rng.uniform(0.6, 1.0)), restriction=restriction,
    )  # fmt: skip


class Track:
    """True gradient, mapped gradient, curvature and tunnel share, averaged over the train length."""

    def __init__(self, route: Route, length: int, nuisance: Nuisance, rng: Generator) -> None:
        count = int(route.stops[-1]) + 2 * _MARGIN + 1
        place: Array = np.arange(count, dtype=np.float64) - _MARGIN + 0.5
        mapped = _steps(route.gradient, place)
        radius = _steps(route.curve, place)
        curvature = np.divide(1.0, radius, out=np.zeros_like(radius), where=radius > 0.0)
        tunnel = np.zeros(count)
        for low, high in route.tunnels:
            tunnel[(place > low) & (place < high)] = 1.0
        true = mapped + _map_error(count, nuisance, rng)
        self.length = length
        # Row k: front at k - margin metres for rising positions, rear one train length lower.
        self._table = np.column_stack([_mean_behind(of, length) for of in (true, mapped, curvature, tunnel)])
        self.rows: list[list[float]] = self._table.tolist()

    def index(self, front: float, heading: int) -> float:
        """Return the index in the table; a train with falling positions extends one length above its front."""
        return front + _MARGIN + (self.length if heading < 0 else 0)

    def under(self, front: Array, heading: Array) -> Array:
        """Return true and map gradient for rising position [per mille], curvature [1/m], tunnel share; shape (n, 4)."""
        at = front + _MARGIN + np.where(heading < 0, self.length, 0)
        low = np.clip(at.astype(int), 0, len(self.rows) - 2)
        share = (at - low)[:, None]
        means: Array = self._table[low] * (1.0 - share) + self._table[low + 1] * share
        return means


def _steps(pairs: Pairs, place: Array) -> Array:
    starts, values = np.array(pairs).T
    chosen: Array = values[np.clip(np.searchsorted(starts, place, side='right') - 1, 0, None)]
    return chosen


def _mean_behind(values: Array, length: int) -> Array:
    total = np.concatenate([[0.0], np.cumsum(values)])
    front = np.arange(len(total))
    rear = np.maximum(front - length, 0)
    mean: Array = (total[front] - total[rear]) / length
    return mean


def _map_error(count: int, nuisance: Nuisance, rng: Generator) -> Array:
    keep = math.exp(-1.0 / nuisance.map_length)
    value = nuisance.map_error * float(rng.standard_normal())
    path = np.empty(count)
    shocks = nuisance.map_error * math.sqrt(1.0 - keep * keep) * rng.standard_normal(count)
    for k, shock in enumerate(shocks.tolist()):
        path[k] = value
        value = keep * value + shock
    return path

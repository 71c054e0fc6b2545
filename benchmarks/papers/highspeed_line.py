# SPDX-License-Identifier: Apache-2.0
"""High-speed records for the experiments of Xia et al. 2023, whose own data are not published.

Train: CRH380C of their Table 1 (981.7 t, 400.47 m, 8M8T). Assumed, because the paper does not say: car masses
63.0 / 59.71 t, gamma 0.06, 460 kN and 19.2 MW, a line of gradients up to 12 per mille with curves of 7 to 12 km, and
how the train is driven. `cruise` stays within 270 to 303 km/h, `full` starts at 60 km/h and obeys restrictions of 120
to 230 km/h. Data come from the differential equation (3) with the force held for a tick of the ATO (0.2 s), or, for the
inverse crime, from the scheme (7) itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.resistance.trajectory.multi_mass import Cars, MultiMassLine
from trainid_ros.resistance.trajectory.stages import Stages, reach
from trainid_ros.train.davis import G
from trainid_ros.train.train_file import Line

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

MASS_T: Final = 981.7
LENGTH: Final = 400.47
GAMMA: Final = 0.06
SPACING: Final = 100.0
TICK: Final = 0.2
INERTIA: Final = 1000.0 * (1.0 + GAMMA) / G
_WEIGHT: Final = MASS_T * G / 1000.0  # kN of force per N/kN
_MOST_FORCE: Final = 460.0 / _WEIGHT
_MOST_POWER: Final = 19200.0 / _WEIGHT
_LINE_KM: Final = 210.0
_START: Final = 1000.0
_SUBSTEPS: Final = 4

Law = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Plan:
    """How the train is driven: target speeds from positions on [m, m/s], first speed [m/s], braking allowed or not."""

    targets: tuple[tuple[float, float], ...]
    speed: float
    brakes: bool


@dataclass(frozen=True, slots=True)
class Record:
    """A record every 100 m; forces and resistances are specific [N/kN].

    Attributes:
        position: Of the head [m], shape (I + 1,).
        time: [s], shape (I + 1,).
        speed: True speed [m/s], shape (I + 1,).
        left: Force at the begin of each stage, shape (I,).
        mean: Its mean over the distance of the stage.
        time_mean: Its mean over the time of the stage.
        load_left: Additional resistance at the begin of each stage.
        load_mean: Its mean over the distance.
        load_time_mean: Its mean over the time.

    """

    position: NDArray[np.float64]
    time: NDArray[np.float64]
    speed: NDArray[np.float64]
    left: NDArray[np.float64]
    mean: NDArray[np.float64]
    time_mean: NDArray[np.float64]
    load_left: NDArray[np.float64]
    load_mean: NDArray[np.float64]
    load_time_mean: NDArray[np.float64]

    def stages(self, *, mean_force: bool = True, mean_load: bool = True) -> Stages:
        """Return the stages of (7), with means over the stage or, as printed, values where it begins."""
        force = self.mean if mean_force else self.left
        load = self.load_mean if mean_load else self.load_left
        return Stages(reach(np.diff(self.position), GAMMA), force - load)


def make_cars() -> Cars:
    """Return 16 cars, motor and trailer in turn."""
    return Cars.of_lengths(np.tile([63.0, 59.71], 8), np.full(16, LENGTH / 16.0))


def make_line(rng: np.random.Generator) -> Line:
    """Return 210 km with a gradient every 0.8 to 3 km, level on average, and curves between straights."""
    gradient, curve, x, height = [], [], 0.0, 0.0
    while x < 1000.0 * _LINE_KM:
        run = float(rng.uniform(800.0, 3000.0))
        # What was climbed comes down again.
        i = min(12.0, max(-12.0, round(float(rng.normal(0.0, 5.0)) - 0.15 * height / 10.0, 1)))
        gradient.append((x, i))
        height += i * run / 1000.0
        x += run
    x = 0.0
    while x < 1000.0 * _LINE_KM:
        curve.append((x, 0.0))
        x += float(rng.uniform(2000.0, 8000.0))
        curve.append((x, float(rng.uniform(7000.0, 12000.0))))
        x += float(rng.uniform(1000.0, 3000.0))
    return Line(gradient=tuple(gradient), curve=tuple(curve))


def cruise_plan(rng: np.random.Generator) -> Plan:
    """Return a drive between 272 and 300 km/h."""
    targets, x = [], 0.0
    while x < 1000.0 * _LINE_KM:
        targets.append((x, float(rng.uniform(272.0, 300.0)) / 3.6))
        x += float(rng.uniform(5000.0, 12000.0))
    return Plan(tuple(targets), 285.0 / 3.6, brakes=False)


def full_plan(rng: np.random.Generator) -> Plan:
    """Return a drive from 60 km/h to 303 km/h with three restrictions."""
    limits = (160.0, 303.0, 120.0, 303.0, 200.0, 303.0, 230.0, 303.0)
    targets, x = [], 0.0
    for limit in limits:
        targets.append((x, limit / 3.6))
        x += float(rng.uniform(5000.0, 9000.0)) if limit < 300.0 else float(rng.uniform(20000.0, 26000.0))
    return Plan(tuple(targets), 60.0 / 3.6, brakes=True)


class _Driver:
    """Proportional control about the believed resistance, within force and power."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._next = 0
        self._target = plan.speed

    def force(self, position: float, speed: float) -> float:
        while self._next < len(self._plan.targets) and self._plan.targets[self._next][0] <= position - _START:
            self._target = self._plan.targets[self._next][1]
            self._next += 1
        believed = 0.8 + speed * (0.02 + 0.0014 * speed)
        wanted = believed + 4.0 * (self._target - speed)
        most = min(_MOST_FORCE, _MOST_POWER / speed)
        return min(most, max(-most if self._plan.brakes else 0.0, wanted))


def drive_ode(line: Line, plan: Plan, law: Callable[[float], Law], distance: float, spacing: float = SPACING) -> Record:
    """Drive by (3): force held for a tick, resistance integrated with it.

    Args:
        line: Gradients and curves.
        plan: How to drive.
        law: a, b, c [N/kN, v in m/s] at a position since the start [m].
        distance: Length of the record [m].
        spacing: Distance between its points [m].

    """
    loaded = MultiMassLine(line, make_cars())
    grid = np.arange(0.0, _START + distance + 500.0, 1.0, dtype=np.float64)
    work = np.concatenate(([0.0], np.cumsum(loaded.means(grid)))).tolist()
    driver = _Driver(plan)
    log = _Log(spacing, plan.speed)
    s, v, t = _START, plan.speed, 0.0
    h = TICK / _SUBSTEPS
    while s < _START + distance:
        force = driver.force(s, v)
        for _ in range(_SUBSTEPS):
            load = _mean_load(work, s, s + v * h)
            acceleration = _acceleration(v, h, force - load, law(s - _START))
            log.run(_Stretch(s, v, t, acceleration, h, force, load))
            s += v * h + 0.5 * acceleration * h * h
            v += acceleration * h
            t += h
    return log.record(loaded, round(distance / spacing))


def _mean_load(work: list[float], start: float, end: float) -> float:
    def at(x: float) -> float:
        i = int(x)
        return work[i] + (x - i) * (work[i + 1] - work[i])

    return (at(end) - at(start)) / (end - start)


def _acceleration(v: float, h: float, force: float, law: Law) -> float:
    """Mean acceleration over a substep, by Runge's rule of fourth order."""
    a, b, c = law

    def rate(speed: float) -> float:
        return (force - a - speed * (b + c * speed)) / INERTIA

    k1 = rate(v)
    k2 = rate(v + 0.5 * h * k1)
    k3 = rate(v + 0.5 * h * k2)
    return (k1 + 2.0 * k2 + 2.0 * k3 + rate(v + h * k3)) / 6.0


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A substep: start, duration h and what acts in it."""

    s: float
    v: float
    t: float
    acceleration: float
    h: float
    force: float
    load: float

    def time_at(self, position: float) -> float:
        """Time since its start at which a position is passed."""
        run = position - self.s
        return 2.0 * run / (self.v + math.sqrt(max(0.0, self.v * self.v + 2.0 * self.acceleration * run)))


class _Log:
    """Points every so many metres, and means of force and load between them."""

    def __init__(self, spacing: float, speed: float) -> None:
        self._spacing = spacing
        self._points = [(0.0, speed)]
        self._means: list[tuple[float, ...]] = []
        self._left = math.nan
        self._sums = [0.0] * 4

    def run(self, part: _Stretch) -> None:
        """Take one substep in, split where it passes a point."""
        if math.isnan(self._left):
            self._left = part.force
        done, end = 0.0, part.s + part.v * part.h + 0.5 * part.acceleration * part.h**2
        while (mark := _START + len(self._points) * self._spacing) <= end:
            at = part.time_at(mark)
            self._add(part, done, at)
            self._points.append((part.t + at, part.v + part.acceleration * at))
            before = self._points[-2][0]
            time = self._points[-1][0] - before
            means = [self._sums[0] / self._spacing, self._sums[2] / time, self._sums[3] / time]
            self._means.append((self._left, *means))
            self._sums, self._left, done = [0.0] * 4, part.force, at
        self._add(part, done, part.h)

    def _add(self, part: _Stretch, start: float, end: float) -> None:
        time = end - start
        run = time * (part.v + 0.5 * part.acceleration * (start + end))
        for k, amount in enumerate((part.force * run, part.load * run, part.force * time, part.load * time)):
            self._sums[k] += amount

    def record(self, line: MultiMassLine, count: int) -> Record:
        time, speed = np.array(self._points[: count + 1]).T
        left, mean, time_mean, load_time_mean = np.array(self._means[:count]).T
        position = np.asarray(_START + self._spacing * np.arange(count + 1), dtype=np.float64)
        return Record(
            position=position,
            time=time,
            speed=speed,
            left=left,
            mean=mean,
            time_mean=time_mean,
            load_left=line.at(position)[:-1],
            load_mean=line.means(position),
            load_time_mean=load_time_mean,
        )


def drive_scheme(line: Line, plan: Plan, law: Callable[[float], Law], distance: float) -> Record:
    """Drive by (7) itself, force and load held over a stage: the data on which the scheme is exact."""
    loaded = MultiMassLine(line, make_cars())
    position = np.asarray(_START + SPACING * np.arange(round(distance / SPACING) + 1), dtype=np.float64)
    load = loaded.means(position)
    lam = float(reach(np.array([SPACING]), GAMMA)[0])
    driver, v, t = _Driver(plan), plan.speed, 0.0
    speeds, times, forces = [v], [t], []
    for s, w_add in zip(position[:-1].tolist(), load.tolist(), strict=True):
        a, b, c = law(s - _START)
        force = driver.force(s, v)
        after = math.sqrt(v * v + 2.0 * lam * (force - w_add - a - v * (b + c * v)))
        t += 2.0 * SPACING / (v + after)
        v = after
        speeds.append(v)
        times.append(t)
        forces.append(force)
    force_held = np.array(forces)
    held = (force_held, force_held, force_held, load, load, load)
    return Record(position, np.array(times), np.array(speeds), *held)

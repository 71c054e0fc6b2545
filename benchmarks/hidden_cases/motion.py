# SPDX-License-Identifier: Apache-2.0
"""The ride: the driver, and the true train's equation of motion in steps of 20 ms.

``(1 + gamma) dv/dt = F / M - g / 1000 (w(v) + i + w_hidden + gust)`` with the true force, mass and rotary mass.
Each step also logs the change of dv/dt due to the effects and nuisances at the present state: the residual of the
assumed equation with the reported force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_cases.effects import Moment
from benchmarks.hidden_log import STEP, G, Log

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from benchmarks.hidden_cases.effects import Hidden
    from benchmarks.hidden_cases.world import Leg, Track, Vehicle, World

    Array = NDArray[np.float64]

HOLD = -0.4
_JERK = 0.6
_WEIGHT = G / 1000.0
_TICK = 10
_APPLIED = -0.03
_MAX_S = 900.0
_STOP_WINDOW = 120.0


class Driver:
    """Decides every 0.2 s on traction [m/s^2, force over weighed mass] and brake command [m/s^2]."""

    def __init__(self, vehicle: Vehicle, leg: Leg, davis: tuple[float, float, float]) -> None:
        self._leg = leg
        self._lead = vehicle.brake_dead + vehicle.brake_lag + 0.2
        self._davis = davis
        self._stopping = self._slowing = self._resting = self._nearing = False
        self._last = 0.0

    def decide(self, front: float, speed: float, gradient: float) -> tuple[float, float]:
        """Return the demanded traction and brake command [m/s^2].

        Position of the front [m], speed [m/s], gradient in the direction of travel [per mille].
        """
        leg = self._leg
        left = leg.heading * (leg.end - front)
        if self._stopping or left <= speed * self._lead + speed * speed / (2.0 * leg.brake):
            return 0.0, self._stop(left, speed, gradient)
        limit = self._limit(front, speed)
        if self._slows(speed, limit):
            return 0.0, -0.5 if speed > limit + 2.0 else -0.3
        return self._pull(left, speed, limit, gradient), 0.0

    def _stop(self, left: float, speed: float, gradient: float) -> float:
        if not self._stopping or (left > 4.0 and speed > 1.5):
            wanted = speed * speed / (2.0 * max(left - 0.3 * speed, 1.0)) - G * gradient / 1000.0
            self._last = -round(min(1.2, max(0.2, wanted)), 2)
        self._stopping = True
        return self._last

    def _limit(self, front: float, speed: float) -> float:
        leg = self._leg
        if leg.restriction is None:
            return leg.cruise
        begin, end, slow = leg.restriction
        ahead = leg.heading * (begin - front)
        if leg.heading * (end - front) < 0.0 or slow >= leg.cruise:
            return leg.cruise
        near = speed * self._lead + max(0.0, speed * speed - slow * slow) / (2.0 * 0.45)
        self._nearing = self._nearing or ahead < near
        return slow if self._nearing else leg.cruise

    def _slows(self, speed: float, limit: float) -> bool:
        self._slowing = speed > (limit - 0.2 if self._slowing else limit + 0.8)
        return self._slowing

    def _pull(self, left: float, speed: float, limit: float, gradient: float) -> float:
        leg = self._leg
        if left < leg.coast_from and speed > 0.5 * limit:
            return 0.0
        if leg.on_off:
            if speed >= limit:
                self._resting = True
            elif speed < limit - 1.8:
                self._resting = False
            return 0.0 if self._resting else 2.0
        a, b, c = self._davis
        steady = G / 1000.0 * (a + b * speed + c * speed * speed + gradient)
        return max(0.0, steady + 0.4 * (limit - speed))


def slew(now: float, wanted: float, step: float) -> float:
    """Return the traction one step later, limited by jerk [m/s^2]."""
    most = _JERK * step
    return min(now + most, max(now - 2.0 * most, wanted))


@dataclass(slots=True)
class _Brake:
    """Dead time and first-order lag of the brake; the true dead time may exceed the nominal one."""

    dead: int
    dead_true: int
    keep: float
    nominal: float = HOLD
    true: float = HOLD

    def step(self, commands: list[float]) -> None:
        self.nominal = self._towards(self.nominal, commands, self.dead)
        self.true = self._towards(self.true, commands, self.dead_true)

    def _towards(self, value: float, commands: list[float], dead: int) -> float:
        target = commands[-1 - dead] if dead < len(commands) else HOLD
        return target + (value - target) * self.keep


class Ride:
    def __init__(self, world: World, track: Track, effects: Sequence[Hidden], seed: int) -> None:
        self._world = world
        self._track = track
        self._effects = tuple(effects)
        self._random = Random(seed)
        vehicle = world.vehicle
        dead, wait = round(vehicle.brake_dead / STEP), sum(effect.brake_wait for effect in effects)
        self._brake = _Brake(dead, dead + round(wait / STEP), math.exp(-STEP / vehicle.brake_lag))
        self._commands: list[float] = []
        self._rows: list[tuple[float, ...]] = []
        self._moment = Moment()
        self._gust = world.nuisance.gust * self._random.gauss(0.0, 1.0)
        lag = world.nuisance.force_lag
        self._force_keep = math.exp(-STEP / lag) if lag > 0.0 else 0.0
        self._reported = 0.0

    def drive(self, legs: Sequence[Leg], first_run: int) -> Log:
        """Drive the legs one after another; runs are numbered through all bags.

        Raises:
            RuntimeError: The train misses a stop, or does not reach it in a quarter of an hour.

        """
        front, before = legs[0].start, 0
        self._reported = legs[0].weighed * (1.0 + self._world.vehicle.rotary) * HOLD
        for number, leg in enumerate(legs, start=first_run):
            turned = before not in {0, leg.heading}
            front = leg.start if turned else front
            before = leg.heading
            self._stand(leg, front, leg.dwell + (40.0 if turned else 0.0))
            front = self._run(number, leg, front)
            if abs(front - leg.end) > _STOP_WINDOW:
                raise RuntimeError(f'run {number} of the ride ended at {front:.0f} m instead of {leg.end:.0f} m')
        self._stand(legs[-1], front, 8.0)
        columns = np.array(self._rows).T
        front, heading, run, speed, force, command, weighed, noise = columns[:8]
        return Log(front, heading, run, speed, force, command, weighed, noise, columns[8:])

    def _stand(self, leg: Leg, front: float, seconds: float) -> None:
        brake, commands, moment = self._brake, self._commands, self._moment
        inertia = leg.weighed * (1.0 + self._world.vehicle.rotary)
        nothing = (0.0,) * len(self._effects)
        # Aligns the next run with a tick of the driver.
        for _ in range(round(seconds / STEP / _TICK) * _TICK + -len(self._rows) % _TICK):
            commands.append(HOLD)
            brake.step(commands)
            self._report(inertia * brake.nominal)
            row = (front, leg.heading, -1.0, 0.0, self._reported, HOLD, leg.weighed, 0.0)
            self._rows.append(row + nothing)
        moment.heat *= math.exp(-seconds / self._world.cooling)
        moment.released_for, moment.acceleration = 0.0, 0.0
        moment.applied_for += seconds

    def _report(self, force: float) -> None:
        self._reported = force + (self._reported - force) * self._force_keep

    def _run(self, number: int, leg: Leg, front: float) -> float:
        world, brake, moment = self._world, self._brake, self._moment
        vehicle, rows, rotary = world.vehicle, self._rows, 1.0 + world.vehicle.rotary
        a, b, c = vehicle.davis
        driver, heading = Driver(vehicle, leg, vehicle.davis), leg.heading
        moment.load, moment.heading, moment.run = leg.mass / world.mean_mass, heading, number
        assumed_mass = leg.weighed if world.nuisance.mass_topic else world.mean_mass
        nothing = (0.0,) * len(self._effects)
        speed = pull = wanted = command = 0.0
        started = False
        for k in range(round(_MAX_S / STEP)):
            true, mapped = self._track_at(front, heading)
            if k % _TICK == 0:
                wanted, command = driver.decide(front, speed, mapped)
                self._update_gust()
            self._commands.append(command)
            brake.step(self._commands)
            most = min(vehicle.start_acceleration, vehicle.power / leg.weighed / max(speed, 1.0))
            pull = slew(pull, min(wanted, most) if command == 0.0 and brake.nominal > _APPLIED else 0.0, STEP)
            force = leg.weighed * (pull + rotary * brake.nominal)
            self._report(force)
            davis = a + b * speed + c * speed * speed
            base = (force / leg.mass - _WEIGHT * (davis + true + self._gust)) / rotary
            plain = (self._reported / assumed_mass - _WEIGHT * (davis + mapped)) / rotary
            moment.time, moment.front, moment.speed = len(rows) * STEP, front, speed
            moment.pull = pull / _WEIGHT
            acceleration, added = self._hidden(base, leg.weighed / leg.mass, pull)
            started = started or base + acceleration > 0.0
            gone = started and (speed > 0.0 or base + acceleration > 0.0)
            logged = ((base - plain), *added) if gone else (0.0, *nothing)
            rows.append((front, heading, number if gone else -1, speed, self._reported, command, leg.weighed, *logged))
            if gone:
                new = max(0.0, speed + STEP * (base + acceleration))
                moment.acceleration = (new - speed) / STEP
                moved = 0.5 * STEP * (speed + new)
                front, speed = front + heading * moved, new
                moment.travelled += moved
                if new <= 0.0 and command < 0.0:
                    return front
        raise RuntimeError(f'run {number} of the ride did not reach its stop within {_MAX_S:.0f} s')

    def _track_at(self, front: float, heading: int) -> tuple[float, float]:
        """Return true and mapped gradient in the direction of travel [per mille]; update curvature and tunnel share."""
        place = self._track.index(front, heading)
        low = int(place)
        part = place - low
        (true0, map0, bend0, tube0), (true1, map1, bend1, tube1) = self._track.rows[low : low + 2]
        self._moment.curvature = bend0 + part * (bend1 - bend0)
        self._moment.tunnel_share = tube0 + part * (tube1 - tube0)
        return heading * (true0 + part * (true1 - true0)), heading * (map0 + part * (map1 - map0))

    def _update_gust(self) -> None:
        nuisance = self._world.nuisance
        keep = math.exp(-_TICK * STEP / nuisance.gust_time)
        self._gust = keep * self._gust + nuisance.gust * math.sqrt(1.0 - keep * keep) * self._random.gauss(0.0, 1.0)

    def _hidden(self, base: float, scale: float, pull: float) -> tuple[float, tuple[float, ...]]:
        """Return the change of dv/dt by all effects and by each alone [m/s^2]; update the state of the brake."""
        moment, brake = self._moment, self._brake
        applied = brake.true < _APPLIED
        moment.applied_for = moment.applied_for + STEP if applied else 0.0
        moment.released_for = 0.0 if applied else moment.released_for + STEP
        moment.heat += STEP * (-brake.true * moment.speed - moment.heat / self._world.cooling)
        effects = self._effects
        alone = tuple(self._with((effect,), base, scale, pull) for effect in effects)
        return (self._with(effects, base, scale, pull) if len(effects) > 1 else sum(alone)), alone

    def _with(self, effects: tuple[Hidden, ...], base: float, scale: float, pull: float) -> float:
        moment, brake, rotary = self._moment, self._brake, 1.0 + self._world.vehicle.rotary
        drag, heavier, inertia, pulls, brakes, late = 0.0, 1.0, 1.0, 1.0, 1.0, False
        for effect in effects:
            heavier *= effect.mass_ratio
            inertia *= effect.inertia_ratio
            late = late or effect.brake_wait > 0.0
            drag += effect.drag(moment) if effect.drag else 0.0
            pulls *= effect.pull_gain(moment) if effect.pull_gain else 1.0
            brakes *= effect.brake_gain(moment) if effect.brake_gain else 1.0
        braked = brakes * (brake.true if late else brake.nominal)
        nominal, true = pull + rotary * brake.nominal, pulls * pull + rotary * braked
        # All terms but the force are proportional to the weight, so a heavier train has the same specific resistance.
        rest = base * rotary - scale * nominal - _WEIGHT * drag
        return (scale * true / heavier + rest) / (rotary * inertia) - base

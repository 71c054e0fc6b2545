# SPDX-License-Identifier: Apache-2.0
"""The simulated train and its driver.

Plant: the specific balance ``(1 + gamma) M dv/dt = F + f (1 + gamma) M u - M g / 1000 (w(v) + i + w_extra + gust)``,
with the reported traction F, the lagged and delayed brake target u <= 0, the brake rate f (times its table over speed
if there is one) and the assumed mass M: all effects act as extra resistance. The brake actuator is integrated exactly.
Speed and position use the midpoint rule, whose error at 20 ms steps is far below that of any sensor.

Driver: an ATO that drives from stop to stop: power, coast, brake to speed limits and stops, dwell. Braking follows
speed-over-distance curves: ``v_ref(d) = sqrt(v_end^2 + 2 b d)``. The regulator uses the train state predicted for the
time when the brake acts (dead time plus lag), which keeps the loop well damped; its feedback stops the train in place
with a brake that is weaker or stronger than nominal.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from copy import copy, deepcopy
from dataclasses import dataclass
from enum import Enum
from operator import itemgetter
from typing import Final

import numpy as np

from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, heat_after, resistance_terms
from trainid_ros.train.forces import (
    STANDING,
    BrakeActuator,
    BrakeCommandChange,
    CommandHistory,
    G,
    davis,
    load_drag,
    required_force,
    specific_force,
    specific_inertia,
)
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import TrainFile

STEP_NS: Final = 20_000_000
"""Step of the simulation [ns]."""


class Plant:
    """Simulated train, at rest at the first stop of the line; its public attributes are the true state.

    ``jerk`` is the maximum rate of change of the traction [m/s^3]. An invalid effect raises InputError.

    Attributes:
        now_ns: Time of the state [ns].
        position: Position of the front [m].
        direction: +1 while positions increase, -1 while they decrease.
        speed: Speed [m/s], never negative: a stopped train is held in place.
        acceleration: Mean acceleration over the last step [m/s^2].
        traction: Traction as reported by the drive [N].
        mass: Assumed mass [kg].
        resistance: Current Davis resistance.
        brake_rate: Current brake rate, or the factor on its table over speed [1].
        gust: Additional gust resistance [N/kN].
        distance_run: Distance run since the start [m].
        heat: Heat in the brake, calculated without fade [J/kg].
        work: Work of the traction since the start [J].
        run: Number of departures since the start.
    """

    def __init__(self, train_file: TrainFile, profile: LineProfile, start_ns: int, jerk: float) -> None:
        self.profile, self.now_ns = profile, start_ns
        self.position = train_file.line.stops[0] if train_file.line.stops else 0.0
        self.direction = 1
        self.speed = self.acceleration = self.traction = 0.0
        self.mass, self.resistance = train_file.train.mass, train_file.resistance
        self.brake_rate = train_file.brake.rate
        self.gust = self.distance_run = self.heat = self.work = 0.0
        self.run = 0
        self._train, self._brake, self._jerk, self._start_ns = train_file.train, train_file.brake, jerk, start_ns
        self._actuator = BrakeActuator(self._brake)
        self._terms = resistance_terms(train_file.effects)
        self._tractions, self._brakes = DelayLine(), DelayLine()
        self._since_release = 0.0  # it was held until now

    @property
    def brake(self) -> float:
        """Lagged and delayed brake target [m/s^2, <= 0]."""
        return self._actuator.output

    @property
    def reported_force(self) -> float:
        """Force reported by drive and brake control [N]; braking is reported as that of a nominal brake."""
        return self.traction + self.mass * (1.0 + self._train.rotary_mass) * self.brake

    def twin(self) -> Plant:
        """Return a train in the same state that goes on by itself."""
        other = copy(self)
        other._actuator = BrakeActuator(self._brake)
        other._actuator.commands, other._actuator.output = CommandHistory(self._actuator.commands.changes), self.brake
        other._tractions, other._brakes = deepcopy((self._tractions, self._brakes))
        return other

    def command(self, target_acceleration: float) -> None:
        """Set the brake target [m/s^2, <= 0] from now on."""
        self._actuator.commands.push(BrakeCommandChange(self.now_ns, target_acceleration))

    def step(self, traction_demand: float, dt_ns: int = STEP_NS) -> None:
        """Advance by one step [ns] while the traction ramps towards a demand [N]."""
        dt = dt_ns / NS_PER_S
        change = self._actuator.advance(self.now_ns, self.now_ns + dt_ns)
        self._since_release = 0.0 if self.brake < BRAKE_APPLIED else self._since_release + dt
        brake = self.brake_rate * self._brake.shape_at(self.speed) * change / dt
        ramp, start = self._jerk * self.mass * dt, self.traction
        self.traction = start + min(ramp, max(-ramp, traction_demand - start))
        traction = 0.5 * (start + self.traction)
        driven = traction / (self.mass * (1.0 + self._train.rotary_mass)) + brake
        if self._terms:
            middle_ns = self.now_ns + dt_ns // 2
            self._tractions.add(middle_ns, specific_force(traction, self.mass))
            self._brakes.add(middle_ns, specific_inertia(brake, self._train.rotary_mass))
        acceleration = driven - self._retardation(0.0)
        middle = max(0.0, self.speed + 0.5 * dt * acceleration)
        self.heat = heat_after(self.heat, brake, middle, dt)
        before = self.distance_run
        self._move(driven - self._retardation(0.5 * dt, middle), dt)
        self.work += traction * (self.distance_run - before)
        self.now_ns += dt_ns

    def _retardation(self, ahead_s: float, speed: float | None = None) -> float:
        """Return the deceleration by all resistances [m/s^2] a time [s] ahead of the state."""
        v = self.speed if speed is None else speed
        position = self.position + self.direction * ahead_s * v
        w = davis(self.resistance, v) + self.gust + self.profile.gradient(position, self.direction)
        w += load_drag(self._train.c_by_weight * self.resistance.c, self._train.mass, self.mass, v)
        if self._terms:
            point = self._track_point(position, v, ahead_s)
            for term in self._terms:
                w += term(self.resistance, point)
        return w * G / (1000.0 * (1.0 + self._train.rotary_mass))

    def _track_point(self, position: float, speed: float, ahead_s: float) -> TrackPoint:
        profile, direction = self.profile, self.direction
        return TrackPoint(
            (self.now_ns - self._start_ns) / NS_PER_S + ahead_s, position, direction, speed,
            curve_radius=profile.curve_radius(position, direction), tunnel=profile.tunnel(position, direction),
            length=profile.length, distance_run=self.distance_run, since_release=self._since_release,
            traction=self._tractions.before(0.0), brake=self._brakes.before(0.0), heat=self.heat,
            acceleration=self.acceleration, run=self.run,
            brake_before=self._brakes.before, traction_before=self._tractions.before,
            gradient_ahead=lambda ahead: profile.gradient(position + direction * ahead, direction),
        )  # fmt: skip

    def _move(self, acceleration: float, dt: float) -> None:
        before = self.speed
        after = before + acceleration * dt
        if after > 0.0:
            run = 0.5 * (before + after) * dt
        else:
            # The train stops within the step.
            run = 0.5 * before * before / -acceleration if before > 0.0 else 0.0
            after = 0.0
        self.run += before < STANDING <= after
        self.speed = after
        self.acceleration = (after - before) / dt
        self.position += self.direction * run
        self.distance_run += run


@dataclass(frozen=True, slots=True)
class GustModel:
    """Gust resistance [N/kN]: AR(1) process ``r(t + dt) = rho r(t) + noise`` with rho = exp(-dt / tau)."""

    std: float = setting(0.1, 'standard deviation of the gust resistance', 'N/kN', 0.0, 10.0)
    time_constant: float = setting(5.0, 'correlation time of the gust resistance', 's', 0.01, 1e4)


class Gust:
    """Gust resistance in time steps ``dt`` [s], stationary from the start; ``value`` is the current one [N/kN].

    A setting out of range raises InputError.
    """

    def __init__(self, model: GustModel, dt: float, rng: np.random.Generator) -> None:
        check_settings(model)
        self._rho = math.exp(-dt / model.time_constant)
        self._noise_std = model.std * math.sqrt(1.0 - self._rho**2)
        self._rng = rng
        self.value = model.std * float(rng.standard_normal())

    def step(self) -> float:
        """Advance by one step and return the resistance [N/kN]."""
        self.value = self._rho * self.value + self._noise_std * float(self._rng.standard_normal())
        return self.value


MAX_DELAY_S: Final = 12.0
"""Length of a :class:`DelayLine` [s]; no effect looks back further."""


class DelayLine:
    """Bounded history of values over time; 0 before the first one."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[float] = []

    def add(self, stamp_ns: int, value: float) -> None:
        """Append a value; stamps [ns] must increase."""
        self._stamps.append(stamp_ns)
        self._values.append(value)
        length_ns = round(MAX_DELAY_S * NS_PER_S)
        # Old values are deleted in batches, which is cheaper than one by one.
        if self._stamps[0] < stamp_ns - 2 * length_ns:
            count = bisect_right(self._stamps, stamp_ns - length_ns) - 1
            del self._stamps[:count], self._values[:count]

    def before(self, seconds: float) -> float:
        """Return the interpolated value a number of seconds before the newest one; the newest one if negative."""
        if not self._stamps or seconds <= 0.0:
            return self._values[-1] if self._values else 0.0
        at_ns = self._stamps[-1] - round(seconds * NS_PER_S)
        right = bisect_right(self._stamps, at_ns)
        if right == 0:
            return 0.0
        left_ns, left = self._stamps[right - 1], self._values[right - 1]
        return left + (self._values[right] - left) * (at_ns - left_ns) / (self._stamps[right] - left_ns)


TICK_S: Final = 0.2
"""Time between two decisions of the driver [s]."""


class Phase(Enum):
    """Driving phase."""

    DWELL = 'dwell'
    POWER = 'power'
    COAST = 'coast'
    BRAKE = 'brake'


@dataclass(frozen=True, slots=True)
class DriverModel:
    """Parameters of the driver."""

    acceleration: float = setting(0.9, 'maximum acceleration', 'm/s^2', 0.05, 2.0)
    deceleration: float = setting(0.65, 'deceleration of the braking curves', 'm/s^2', 0.05, 1.5)
    max_deceleration: float = setting(1.2, 'maximum brake command', 'm/s^2', 0.1, 3.0)
    jerk: float = setting(0.8, 'maximum jerk', 'm/s^3', 0.05, 10.0)
    speed_margin: float = setting(0.8, 'margin below speed limits', 'm/s', 0.0, 5.0)
    dwell_low: float = setting(22.0, 'minimum dwell time', 's', 0.0, 3600.0)
    dwell_high: float = setting(35.0, 'maximum dwell time', 's', 0.0, 3600.0)
    cruise_low: float = setting(5.0, 'minimum cruising time before coasting', 's', 0.0, 3600.0)
    cruise_high: float = setting(40.0, 'maximum cruising time before coasting', 's', 0.0, 3600.0)
    coast_floor: float = setting(0.82, 'share of the target speed at which coasting ends', '', 0.1, 1.0)
    holding: float = setting(0.6, 'brake command at standstill', 'm/s^2', 0.1, 3.0)
    brake_gain: float = setting(0.6, 'brake command per speed error', '1/s', 0.0, 3.0)
    brake_integral: float = setting(0.08, 'brake command per integral of the speed error', '1/s^2', 0.0, 1.0)
    stop_window: float = setting(
        1.0, 'distance before a stop within which a stationary train has arrived', 'm', 0.1, 4.5
    )


@dataclass(frozen=True, slots=True)
class Decision:
    """Demands until the next tick."""

    traction: float  # Traction demand [N]
    brake: float  # Brake command [m/s^2, <= 0]


@dataclass(frozen=True, slots=True)
class StopEvent:
    """An arrival: time since the start [s], stopping point [m], overshoot beyond it [m]."""

    time_s: float
    stop: float
    error: float


class Driver:
    """Driver with a period of ``TICK_S``; ``phase``, ``stop`` and ``arrivals`` show its progress.

    It starts with a dwell at the first stop, and takes the brake of the train file as nominal. A setting out of range
    raises InputError.
    """

    def __init__(
        self, model: DriverModel, train_file: TrainFile, profile: LineProfile, rng: np.random.Generator
    ) -> None:
        check_settings(model)
        self.phase = Phase.DWELL
        self.arrivals: list[StopEvent] = []
        self.stop = math.nan
        self._model, self._file, self._profile, self._rng = model, train_file, profile, rng
        self._lead = train_file.brake.delay + train_file.brake.time_constant
        # Share of the gains that a slow brake allows: a gain times dead time and lag of more than 1 would swing.
        self._share = 1.0 / max(model.brake_gain * self._lead, 1.0)
        self._depart_s = 0.5 * self._draw(model.dwell_low, model.dwell_high)
        self._brake = -model.holding
        self._cruise_left_s = self._coasting_s = self._integral = 0.0
        self._rolling = False

    def observe(self, _record: Record) -> None:
        """Ignore the sensors: the driver knows the state of the train."""

    def may_depart(self, time_s: float) -> bool:
        """Return whether the dwell is over at a time [s]."""
        return self.phase is Phase.DWELL and not self._rolling and time_s >= self._depart_s

    def depart(self, stop: float) -> None:
        """Depart for the next stop [m]."""
        self.stop, self.phase = stop, Phase.POWER
        self._cruise_left_s = self._draw(self._model.cruise_low, self._model.cruise_high)

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick; the time is in s since the start."""
        model, left = self._model, (self.stop - train.position) * train.direction
        is_there = (train.speed < 0.3 and left < 0.2) or (train.speed == 0.0 and left < model.stop_window)
        if self.phase is not Phase.DWELL and is_there:
            self.phase, self._rolling = Phase.DWELL, True
        if self.phase is Phase.DWELL:
            if self._rolling and train.speed == 0.0:
                self._rolling = False
                self._depart_s = time_s + self._draw(model.dwell_low, model.dwell_high)
                self.arrivals.append(StopEvent(time_s, self.stop, (train.position - self.stop) * train.direction))
            return Decision(0.0, self._slew(-model.holding))
        allowed, slope = self._allowed(train)
        excess = max(0.0, train.speed + self._lead * train.acceleration) - allowed
        self._choose_phase(train, allowed, excess)
        if self.phase is Phase.BRAKE:
            return Decision(0.0, self._slew(-self._brake_effort(train, excess, slope)))
        traction = self._traction(train, allowed) if self.phase is Phase.POWER else 0.0
        return Decision(traction, self._slew(0.0))

    def _allowed(self, train: Plant) -> tuple[float, float]:
        """Return the lowest reference speed [m/s] when the brake acts, and the deceleration [m/s^2] of its curve."""
        model = self._model
        run = max(0.0, self._lead * (train.speed + 0.5 * self._lead * train.acceleration))
        here = self._profile.speed_limit(train.position, train.direction)
        lowest, slope = min(here, self._file.train.max_speed) - model.speed_margin, 0.0
        reach = train.speed**2 / (2.0 * model.deceleration) + run + 50.0
        for distance, limit in self._profile.limits_ahead(train.position, train.direction, reach):
            end = limit - model.speed_margin
            curve = math.sqrt(end * end + 2.0 * model.deceleration * max(0.0, distance - run))
            if curve < lowest:
                lowest, slope = curve, model.deceleration
        left, b = (self.stop - train.position) * train.direction - run, model.deceleration
        if left > 1.0:
            at_stop = math.sqrt(2.0 * b * left), b
        else:  # the square root has infinite slope at the stop: the last metre follows a straight line
            speed = math.sqrt(2.0 * b) * max(0.0, left)
            at_stop = speed, math.sqrt(2.0 * b) * speed
        return min((lowest, slope), at_stop, key=itemgetter(0))

    def _choose_phase(self, train: Plant, allowed: float, excess: float) -> None:
        model = self._model
        # Brakes from 0.3 m/s below the allowed speed on, down to 0.8 m/s below it.
        if excess > -0.3:
            if self.phase is not Phase.BRAKE:
                self._integral = 0.0
            self.phase = Phase.BRAKE
        elif self.phase is Phase.BRAKE and excess < -0.8:
            self.phase = Phase.POWER if train.speed < 0.5 else Phase.COAST
            self._coasting_s = 0.0
        elif self.phase is Phase.POWER and train.speed > allowed - model.speed_margin - 0.7:
            self._cruise_left_s -= TICK_S
            if self._cruise_left_s <= 0.0:
                self.phase, self._coasting_s = Phase.COAST, 0.0
        elif self.phase is Phase.COAST:
            self._coasting_s += TICK_S
            if self._coasting_s > 3.0 and train.speed < model.coast_floor * (allowed - model.speed_margin):
                self.phase = Phase.POWER
                self._cruise_left_s = self._draw(model.cruise_low, model.cruise_high)

    def _brake_effort(self, train: Plant, excess: float, slope: float) -> float:
        model = self._model
        self._integral = min(0.3, max(-0.3, self._integral + self._share * model.brake_integral * excess * TICK_S))
        retardation = self._resistance(train) * G / (1000.0 * (1.0 + self._file.train.rotary_mass))
        demand = slope + self._share * model.brake_gain * excess + self._integral - retardation
        return min(model.max_deceleration, max(0.0, demand / self._file.brake.shape_at(train.speed)))

    def _traction(self, train: Plant, allowed: float) -> float:
        vehicle, model = self._file.train, self._model
        error = allowed - model.speed_margin - train.speed
        target = min(model.acceleration, 0.5 * error)
        force = required_force(target, train.mass, vehicle.rotary_mass, self._resistance(train))
        return min(vehicle.traction_limit(train.speed), max(0.0, force))

    def _resistance(self, train: Plant) -> float:
        gradient = self._profile.gradient(train.position, train.direction)
        return davis(self._file.resistance, train.speed) + gradient

    def _slew(self, target: float) -> float:
        max_change = self._model.jerk * TICK_S
        change = min(max_change, max(-max_change, target - self._brake))
        # Commands have a resolution of 0.01 m/s^2, as on a train bus.
        self._brake = min(0.0, round(self._brake + change, 2))
        return self._brake

    def _draw(self, low: float, high: float) -> float:
        return float(self._rng.uniform(min(low, high), max(low, high)))

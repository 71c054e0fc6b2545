# SPDX-License-Identifier: Apache-2.0
"""An ATO: it drives to the speed limits, brakes in steps, and stops by prediction.

Between stops the speed follows limits and braking curves by a proportional-integral law with feed-forward. Before a
stop, each command is chosen so that the train stops in place if it is kept (required deceleration), with all that is
known of brake and resistance. Commands change by one step at a time, which bounds the jerk.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from ato.brake_prediction import BrakePredictor, Motion
from ato.train_state import PositionModel, TrainState, stopping_curve
from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.records import GradientRecord, MassRecord, SpeedRecord
from trainid_ros.sim.plant import TICK_S, Decision, StopEvent
from trainid_ros.train.forces import acceleration, davis, required_force

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from ato.knowledge import TrainKnowledge
    from trainid_ros.interface.records import Record
    from trainid_ros.sim.plant import Plant
    from trainid_ros.train.line import LineProfile
    from trainid_ros.train.train_file import TrainFile

_POSITION: Final = PositionModel()
# Excess of the speed over its curve at which braking to a limit begins and ends [m/s].
_BRAKE_EXCESS: Final = 0.1
_RELEASE_EXCESS: Final = -0.6
# Largest correction by the integral [m/s^2].
_MAX_INTEGRAL: Final = 0.2
# A train that would stop this short without braking drives on [m].
_TOO_SHORT: Final = 0.5


class Phase(Enum):
    """What the controller does."""

    DWELL = 'dwell'
    DRIVE = 'drive'
    BRAKE = 'brake'
    STOP = 'stop'


@dataclass(frozen=True, slots=True)
class AtoModel:
    """Parameters of the controller."""

    acceleration: float = setting(0.9, 'maximum acceleration', 'm/s^2', 0.05, 2.0)
    deceleration: float = setting(0.65, 'deceleration of stops and braking curves', 'm/s^2', 0.05, 1.5)
    brake_step: float = setting(0.1, 'step of the brake command', 'm/s^2', 0.01, 0.5)
    strongest: float = setting(1.1, 'strongest brake command', 'm/s^2', 0.1, 3.0)
    step_interval: float = setting(0.6, 'least time between two single steps', 's', 0.0, 5.0)
    gain: float = setting(0.4, 'acceleration per speed error', '1/s', 0.01, 3.0)
    integral_gain: float = setting(0.02, 'acceleration per integral of the speed error', '1/s^2', 0.0, 1.0)
    speed_margin: float = setting(0.8, 'margin below speed limits', 'm/s', 0.0, 5.0)
    dead_band: float = setting(0.03, 'error of the stop that is accepted', 'm', 0.0, 1.0)
    dead_share: float = setting(0.015, 'further error accepted, as a share of the distance left', '1', 0.0, 0.5)
    holding: float = setting(0.6, 'brake command at standstill', 'm/s^2', 0.1, 3.0)
    dwell: float = setting(25.0, 'dwell time', 's', 1.0, 3600.0)


class Ato:
    """Controller with a period of ``TICK_S``.

    On the way it sees the records of the sensors, the balises it passes and whether the train stands; at a stop it
    takes over the position, as from a reading of the platform's balise.

    Attributes:
        stop: Stop that it drives to [m].
        arrivals: Stops so far.
        phase: What it does.
        follows: Whether it regulates the speed to that allowed, neither at full traction nor stopping.

    """

    def __init__(
        self,
        model: AtoModel,
        train_file: TrainFile,
        profile: LineProfile,
        known: TrainKnowledge,
        rng: np.random.Generator,
        offset: Callable[[], float] = lambda: 0.0,
        position: PositionModel = _POSITION,
    ) -> None:
        """Start with a dwell at the first stop.

        Args:
            model: Parameters.
            train_file: The train as stated: mass, traction, maximum speed.
            profile: The line as stated.
            known: What it takes for true of resistance and brake.
            rng: Random generator for the readings of balises; the controller takes ownership.
            offset: Returns how far beyond a stop to aim [m].
            position: How it measures, and the integral action of its observer.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self.phase, self.arrivals, self.stop = Phase.DWELL, list[StopEvent](), profile.line.stops[0]
        self._model, self._train, self._profile, self._known = model, train_file.train, profile, known
        self._offset, self.follows = offset, False
        self._state = TrainState(position, profile, rng)
        self._predictor = BrakePredictor(known.values(), self._state, self._train.rotary_mass, TICK_S)
        self._mass = self._train.mass
        # Steps of the brake command.
        self._steps, self._since_step_s, self._integral = self._nearest(-model.holding), 0.0, 0.0
        # Whether the brake is on its way to its usual command before a stop.
        self._applies = False
        self._depart_s = 0.5 * model.dwell

    def observe(self, record: Record) -> None:
        """Take in what a sensor has measured."""
        self._known.observe(record)
        if isinstance(record, SpeedRecord):
            self._state.measure_speed(record)
        elif isinstance(record, GradientRecord):
            self._state.measure_gradient(record)
        elif isinstance(record, MassRecord):
            self._mass = record.mass

    def may_depart(self, time_s: float) -> bool:
        """Return whether the dwell is over at a time [s]."""
        return self.phase is Phase.DWELL and time_s >= self._depart_s

    def depart(self, stop: float) -> None:
        """Depart for the next stop [m]."""
        self.stop, self.phase, self._integral = stop, Phase.DRIVE, 0.0

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick.

        Of the train itself it uses whether it stands, its direction, the balises passed and the position at a stop.
        """
        state = self._state
        self._predictor.values = self._known.values()
        if self.phase is Phase.DWELL:
            state.stand(train.position, train.direction)
            return self._demand(train, 0.0, self._nearest(-self._model.holding))
        state.direction = train.direction
        state.pass_balises(self.stop, train.position)
        if self.phase is Phase.STOP and train.speed == 0.0:
            self._arrive(time_s, train)
            return self._demand(train, 0.0, self._nearest(-self._model.holding))
        return self._demand(train, *self._choose())

    def _demand(self, train: Plant, traction: float, steps: int) -> Decision:
        """Give the commands, and follow what they do until the next tick."""
        self._since_step_s += TICK_S
        change = steps - self._steps
        # Several steps follow each other as fast as the jerk allows; a single one waits.
        interval = self._model.step_interval if abs(change) == 1 else TICK_S
        if change and self._since_step_s >= interval - 1e-9:
            self._steps += 1 if change > 0 else -1
            self._since_step_s = 0.0
        if self._steps > 0:
            # Interlock: no traction before the brake is released.
            traction = 0.0
        brake, force = self._command(self._steps), traction / (self._mass * (1.0 + self._train.rotary_mass))
        self._state.predict(self._predictor.acceleration + force, train.now_ns, TICK_S)
        self._predictor.command(brake)
        return Decision(traction, brake)

    def _choose(self) -> tuple[float, int]:
        """Return traction [N] and steps of the brake command."""
        self.follows = False
        ahead = self._predictor.when_next_acts()
        left, usual = self._left(), self._nearest(-self._model.deceleration)
        if self.phase is Phase.STOP:
            if self._applies and self._steps < usual:
                return 0.0, usual
            self._applies = False
            return 0.0, self._stopping_command(ahead, left)
        applying = 0.5 * max(0, usual - self._steps) * TICK_S * ahead.speed
        if self._predictor.stop_distance(ahead, self._command(usual)) + applying >= left:
            self.phase, self._applies = Phase.STOP, True
            return 0.0, usual
        return self._follow_limits(ahead, applying)

    def _left(self) -> float:
        state = self._state
        aim = self.stop + state.direction * self._offset()
        return (aim - state.position) * state.direction

    def _stopping_command(self, ahead: Motion, left: float) -> int:
        """Return the steps, at most one from the present ones, that stop the train best."""
        now = self._steps
        nearby = [steps for steps in (now, now + 1, now - 1) if 0 <= steps <= self._strongest]
        errors = {steps: left - self._predictor.stop_distance(ahead, self._command(steps)) for steps in nearby}
        best = min(errors, key=lambda steps: abs(errors[steps]))
        gain = abs(errors[now]) - abs(errors[best])
        if gain > self._model.dead_band + self._model.dead_share * left:
            return best
        if now == 0 and errors[now] > _TOO_SHORT:
            self.phase = Phase.DRIVE
        return now

    @property
    def _strongest(self) -> int:
        """Steps of the strongest brake command."""
        return int(self._model.strongest / self._model.brake_step + 1e-9)

    def _nearest(self, command: float) -> int:
        """Return the steps nearest to a brake command [m/s^2]."""
        return max(0, round(-command / self._model.brake_step))

    def _command(self, steps: int) -> float:
        """Return the brake command of a number of steps [m/s^2]."""
        return 0.0 - round(steps * self._model.brake_step, 6)

    def _follow_limits(self, ahead: Motion, applying: float) -> tuple[float, int]:
        """Return traction [N] and steps of the brake command that keep to the speed allowed.

        ``applying`` is the distance [m] that is lost while the brake is applied step by step.
        """
        model, values, state = self._model, self._predictor.values, self._state
        building_up = values.brake.time_constant * ahead.speed
        allowed, slope = self.allowed(state.position, state.speed, ahead.distance + applying + building_up)
        excess = ahead.speed - allowed
        if excess > _BRAKE_EXCESS:
            self.phase = Phase.BRAKE
        elif self.phase is Phase.BRAKE and excess < _RELEASE_EXCESS:
            self.phase, self._integral = Phase.DRIVE, 0.0
        gradient = state.gradient()
        change = self._integral - model.integral_gain * excess * TICK_S
        self._integral = min(_MAX_INTEGRAL, max(-_MAX_INTEGRAL, change))
        wanted = self._integral - slope - model.gain * excess
        self.follows = self.phase is Phase.BRAKE
        if self.follows:
            resistance = davis(values.resistance, ahead.speed) + gradient
            by_track = acceleration(0.0, self._mass, self._train.rotary_mass, resistance)
            brake = min(0.0, wanted - by_track) / values.brake.rate_at(ahead.speed)
            return 0.0, min(self._strongest, self._nearest(brake))
        wanted = min(model.acceleration, wanted - model.gain * model.speed_margin)
        resistance = davis(values.resistance, state.speed) + gradient
        force = required_force(wanted, self._mass, self._train.rotary_mass, resistance)
        most = self._train.traction_limit(state.speed)
        self.follows = wanted < model.acceleration and force < most
        return min(most, max(0.0, force)), 0

    def allowed(self, position: float, speed: float, ahead: float = 0.0) -> tuple[float, float]:
        """Return the highest speed [m/s] some distance ahead [m], and the deceleration [m/s^2] of its curve."""
        model, direction = self._model, self._state.direction
        here = self._profile.speed_limit(position, direction)
        lowest, slope = min(here, self._train.max_speed) - model.speed_margin, 0.0
        reach = speed**2 / (2.0 * model.deceleration) + ahead + 50.0
        for distance, limit in self._profile.limits_ahead(position, direction, reach):
            end = limit - model.speed_margin
            within = end * end / (2.0 * model.deceleration) + distance - ahead
            curve = stopping_curve(within, model.deceleration)
            if curve < lowest:
                lowest, slope = curve, model.deceleration
        return lowest, slope

    def _arrive(self, time_s: float, train: Plant) -> None:
        self.phase, self._depart_s = Phase.DWELL, time_s + self._model.dwell
        error = (train.position - self.stop) * train.direction
        self.arrivals.append(StopEvent(time_s, self.stop, error))
        self._state.stand(train.position, train.direction)

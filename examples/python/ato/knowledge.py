# SPDX-License-Identifier: Apache-2.0
"""What a controller takes for true of its train: resistance and brake, stated, true, estimated or learned at stops.

Learning from the last stops, without an estimator that runs while driving, is the usual practice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol

from trainid_ros.brake_rate.motion_model import true_brake
from trainid_ros.client import TrainModel
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, GradientRecord, SpeedRecord
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import BrakeActuator, BrakeCommandChange, acceleration, davis
from trainid_ros.train.train_file import Brake, Davis

if TYPE_CHECKING:
    from trainid_ros.interface.records import Record
    from trainid_ros.sim.plant import Plant
    from trainid_ros.train.train_file import TrainFile

# w(v) is asked for at 0, at this speed and at twice this speed [m/s]: three values determine a parabola.
_SPEED: Final = 10.0
# Share of the error of a stop that the next one corrects [1], and largest correction [m].
_GAIN: Final = 0.4
_MAX_AIM: Final = 5.0
# Share of the difference that the rate of one braking corrects [1].
_RATE_GAIN: Final = 0.5
# Only speeds above this [m/s] are compared, while the lagged command is stronger than this [m/s^2], and only if a
# nominal brake would have changed the speed by at least this [m/s].
_SLOWEST: Final = 0.7
_BRAKED: Final = -0.3
_MIN_CHANGE: Final = 2.0


@dataclass(frozen=True, slots=True)
class TrainValues:
    """Resistance and brake at the present time."""

    resistance: Davis
    brake: Brake


class TrainKnowledge(Protocol):
    """Where the values of a controller come from."""

    def observe(self, record: Record) -> None:
        """Take in what a sensor has measured."""

    def values(self) -> TrainValues:
        """Return the values that the controller uses at the present time."""


class StatedValues:
    """The values of a train file, on every day the same."""

    def __init__(self, train_file: TrainFile) -> None:
        """Take over the values."""
        self._values = TrainValues(train_file.resistance, train_file.brake)

    def observe(self, record: Record) -> None:
        """Learn nothing."""

    def values(self) -> TrainValues:
        """Return the values of the file."""
        return self._values


class TrueValues:
    """The values of the simulated train itself, without gusts: the best that any estimator could give."""

    def __init__(self, train_file: TrainFile, plant: Plant) -> None:
        """Read the values of a simulated train that was built from the true train file."""
        effects = train_file.effects
        self._brake, self._plant = train_file.brake, plant
        self._loss = effect_value(effects, 'brake_fade', 'loss', 0.0)
        self._energy = effect_value(effects, 'brake_fade', 'energy', math.inf)
        self._mass_ratio = effect_value(effects, 'mass_error', 'ratio', 1.0)

    def observe(self, record: Record) -> None:
        """Learn nothing."""

    def values(self) -> TrainValues:
        """Return the true values: the brake fades when hot, and a heavier train brakes less."""
        hot = 1.0 - self._loss * min(1.0, self._plant.heat / self._energy)
        rate = hot * self._plant.brake_rate / self._mass_ratio
        return TrainValues(self._plant.resistance, replace(self._brake, rate=rate))


class LiveValues:
    """The estimates as the client gives them.

    Attributes:
        model: The client.

    """

    def __init__(self, train_file: TrainFile) -> None:
        """Start from the train file."""
        self.model = TrainModel.offline(train_file)
        self._values = TrainValues(train_file.resistance, true_brake(train_file))

    def observe(self, record: Record) -> None:
        """Give a record to the estimators, and take over their present values."""
        if self.model.push(record):
            self._values = client_values(self.model, self._values.brake)

    def values(self) -> TrainValues:
        """Return the values of the client."""
        return self._values


def client_values(model: TrainModel, brake: Brake) -> TrainValues:
    """Return the present values of a client; timing and rate table of the brake stay those given.

    The resistance is the parabola through three speeds, which is that of the client if the train file states no effect.
    """
    still, medium, fast = (model.resistance(speed).value for speed in (0.0, _SPEED, 2.0 * _SPEED))
    c = (fast - 2.0 * medium + still) / (2.0 * _SPEED * _SPEED)
    b = (medium - still) / _SPEED - c * _SPEED
    return TrainValues(Davis(still, b, c), replace(brake, rate=model.brake_rate().value))


@dataclass(slots=True)
class StopBias:
    """Iterative learning of the bias of the stops: ``aim(k + 1) = aim(k) - gain error(k)``."""

    aim: float = 0.0

    def learn(self, error: float) -> None:
        """Take in the error of a stop, > 0 beyond it [m]."""
        self.aim = min(_MAX_AIM, max(-_MAX_AIM, self.aim - _GAIN * error))


class LearnedRate:
    """Knowledge of a controller that learns the brake rate from stop to stop; the rest is that of the train file.

    The rate of a braking is the loss of speed less what resistance and gradient cause, divided by the loss that a brake
    of rate 1 would cause, ``r(k) = sum(-dv - k (w + i) dt) / sum(s(v) U dt)``, and
    ``rate(k + 1) = rate(k) + gain (r(k) - rate(k))``.
    """

    def __init__(self, train_file: TrainFile) -> None:
        """Start from the train file."""
        self._file, self._actuator = train_file, BrakeActuator(train_file.brake)
        self._rate = train_file.brake.rate
        self._stamp_ns, self._speed, self._gradient = 0, math.nan, 0.0
        self._lost = self._nominal = 0.0

    def observe(self, record: Record) -> None:
        """Take in what a sensor has measured."""
        if isinstance(record, BrakeRecord):
            self._actuator.commands.follow((BrakeCommandChange(record.stamp_ns, record.target_acceleration),))
        elif isinstance(record, GradientRecord):
            self._gradient = record.gradient
        elif isinstance(record, SpeedRecord):
            self._follow(record)

    def values(self) -> TrainValues:
        """Return the values of the file, with the learned rate."""
        return TrainValues(self._file.resistance, replace(self._file.brake, rate=self._rate))

    def _follow(self, record: SpeedRecord) -> None:
        before, start_ns = self._speed, self._stamp_ns
        self._speed, self._stamp_ns = record.speed, record.stamp_ns
        if math.isnan(before):
            return
        integral = self._actuator.advance(start_ns, record.stamp_ns)
        if self._actuator.output < _BRAKED and min(before, record.speed) > _SLOWEST:
            dt, v = (record.stamp_ns - start_ns) / NS_PER_S, 0.5 * (before + record.speed)
            self._lost += before - record.speed + dt * self._by_track(v)
            self._nominal -= self._file.brake.shape_at(v) * integral
        if record.speed == 0.0:
            self._learn()

    def _by_track(self, speed: float) -> float:
        """Return the acceleration by resistance and gradient at a speed [m/s^2]."""
        train = self._file.train
        return acceleration(0.0, train.mass, train.rotary_mass, davis(self._file.resistance, speed) + self._gradient)

    def _learn(self) -> None:
        """Learn from the braking that has ended."""
        if self._nominal > _MIN_CHANGE:
            self._rate += _RATE_GAIN * (self._lost / self._nominal - self._rate)
        self._lost = self._nominal = 0.0

# SPDX-License-Identifier: Apache-2.0
"""What a controller takes for true of its train: resistance and brake."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Protocol

from trainid_ros.brake_rate.motion_model import true_brake
from trainid_ros.client import TrainModel
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.train.effects import effect_value
from trainid_ros.train.train_file import Brake, Davis

if TYPE_CHECKING:
    from trainid_ros.interface.records import Record
    from trainid_ros.interface.results import Output
    from trainid_ros.sim.plant import Plant
    from trainid_ros.train.train_file import TrainFile

# w(v) is asked for at 0, at this speed and at twice this speed [m/s]: three values determine a parabola.
_SPEED: Final = 10.0


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
    """The estimates of the pipelines as the client gives them.

    Attributes:
        model: The client.

    """

    def __init__(self, train_file: TrainFile) -> None:
        """Start from the train file."""
        settings = EstimatorSettings()
        pipelines = (resistance_pipeline(train_file, settings), brake_rate_pipeline(train_file, settings))
        self._group, self._now_s = PipelineGroup(pipelines), 0.0
        self.model = TrainModel(None, train_file, clock=lambda: self._now_s)
        self._values = TrainValues(train_file.resistance, true_brake(train_file))

    def observe(self, record: Record) -> None:
        """Give a record to the estimators, and take over their present values."""
        self._now_s = max(self._now_s, record.stamp_ns / NS_PER_S)
        outputs: list[Output[Any]] = []
        self._group.push_rows((record.row(),), outputs.append)
        for output in outputs:
            self.model.take(output)
        if outputs:
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

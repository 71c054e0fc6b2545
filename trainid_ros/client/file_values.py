# SPDX-License-Identifier: Apache-2.0
"""What the train file says of a train before anything is estimated, with the standard deviations of the estimators."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.motion_model import MotionModel
from trainid_ros.client.channel import Parameter
from trainid_ros.client.gradual import Normal
from trainid_ros.client.stopping import RateShape
from trainid_ros.estimators.prior import prior_variances
from trainid_ros.train.davis import G
from trainid_ros.train.train_file import LEAST_RATE, MOST_RATE

if TYPE_CHECKING:
    from trainid_ros.brake_rate.brake_rate_settings import BrakeRateConfig
    from trainid_ros.estimators.prior import PriorSettings
    from trainid_ros.train.train_file import TrainFile

DAVIS: Final = 'a, b, c'
FORCE_SCALE: Final = 'force scale'
BRAKE_RATE: Final = 'brake rate'
# No a, b or c of a train is below this [N/kN and per m/s, (m/s)^2].
_LEAST_DAVIS = -20.0
# Actual over reported force, whichever reads wrong [1].
_LEAST_SCALE, _MOST_SCALE = 0.1, 10.0


class FileValues:
    """Values and standard deviations of a train file, as the estimators start with them.

    Attributes:
        train_file: The train file.
        inertia: Deceleration by a resistance of 1 N/kN, g / (1000 (1 + gamma)) [m/s^2].
        brake: Brake with the effects of the train file applied.
        shape: Its rate over speed.
        config: Settings of the brake rate estimator.
        timing_stds: Standard deviations of dead time and time constant [s].

    """

    def __init__(self, train_file: TrainFile, prior: PriorSettings, config: BrakeRateConfig) -> None:
        self.train_file, self.config, self._prior = train_file, config, prior
        model = MotionModel(train_file, config)
        self.brake, self.timing_stds = model.brake, model.timing_stds
        self.inertia = G / (1000.0 * (1.0 + train_file.train.rotary_mass))
        table = self.brake.rate_table
        max_speed, blend_speed = train_file.train.max_speed, self.config.blend_speed
        self.shape = RateShape([v for v, _ in table], [rate for _, rate in table], max_speed, blend_speed, self.inertia)

    def resistance(self) -> dict[str, Parameter]:
        """Return (a, b, c) and the force scale."""
        w, train = self.train_file.resistance, self.train_file.train
        a, b, c = prior_variances((w.a, w.b, w.c), self._prior)
        davis = Normal((w.a, w.b, w.c), (a, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c))
        scale = Normal((1.0,), (math.hypot(train.mass_std, train.force_std) ** 2,))
        speeds = (0.0, 0.5 * train.max_speed, train.max_speed)
        return {
            DAVIS: Parameter(davis, tuple((1.0, v, v * v) for v in speeds), _LEAST_DAVIS),
            FORCE_SCALE: Parameter(scale, ((1.0,),), _LEAST_SCALE, _MOST_SCALE),
        }

    def brake_rate(self) -> dict[str, Parameter]:
        """Return the brake rate, or the factor on its table."""
        rate = Normal((self.brake.rate,), (self.config.prior_std**2,))
        return {BRAKE_RATE: Parameter(rate, ((1.0,),), LEAST_RATE, MOST_RATE)}

    def rate_direction(self, speed: float) -> tuple[float, float]:
        """Return s(v), and the standard deviation of e p(v) + h m(v) [1]; see ``stopping``."""
        shape, config = self.shape, self.config
        by_speed = math.hypot(config.slope_std * shape.slope(speed), config.blend_std * shape.changeover(speed))
        return shape.table(speed), by_speed

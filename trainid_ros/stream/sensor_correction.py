# SPDX-License-Identifier: Apache-2.0
"""Correct records for sensor errors in the train file: a wrong wheel diameter, delayed stamps of the force."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from trainid_ros.interface.records import FORCE, NS_PER_S, SPEED
from trainid_ros.state import State, declare, unknown
from trainid_ros.train.effects import effect_value

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.stream.alignment import AlignmentConfig
    from trainid_ros.train.train_file import Effect


class SensorCorrection:
    """Corrects records for the effects ``wheel_diameter`` and ``stamp_skew``.

    Attributes:
        skew_s: Delay of the stamps of the force [s].
        stop_position: Measured position of the last stop [m], NaN while unknown.
        is_needed: True if any record needs a correction.
    """

    STATE: ClassVar[State] = declare(unknown('stop_position'))

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.skew_s = effect_value(effects, 'stamp_skew', 'delay', 0.0)
        self._skew_ns = round(self.skew_s * NS_PER_S)
        self._ratio = effect_value(effects, 'wheel_diameter', 'ratio', 1.0)
        self.is_needed = self._ratio != 1.0 or self._skew_ns != 0
        self.reset()

    def reset(self) -> None:
        """Forget the position of the last stop."""
        self.stop_position = math.nan

    def widen(self, alignment: AlignmentConfig) -> AlignmentConfig:
        """Return alignment settings whose ``max_lag`` allows for the shift of the corrected stamps."""
        return replace(alignment, max_lag=alignment.max_lag + abs(self.skew_s))

    def correct(self, topic: int, stamp_ns: int, x: float, y: float) -> tuple[int, float, float]:
        """Return stamp and numbers of a record, corrected where needed; see ``Row`` of the records."""
        if topic == SPEED and self._ratio != 1.0:
            speed, position = self._correct_speed(x, y)
            return stamp_ns, speed, position
        if topic == FORCE and stamp_ns > 0:  # a zero stamp stays one, to be rejected
            return stamp_ns - self._skew_ns, x, y
        return stamp_ns, x, y

    def _correct_speed(self, speed: float, position: float) -> tuple[float, float]:
        """Correct speed and distance since the last stop; the position at rest is that of the platform."""
        if speed == 0.0 or math.isnan(self.stop_position):
            self.stop_position = position
        return speed / self._ratio, self.stop_position + (position - self.stop_position) / self._ratio

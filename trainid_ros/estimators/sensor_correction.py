# SPDX-License-Identifier: Apache-2.0
"""Records mended of what the train file says of sensors: a wrong wheel diameter, late stamps of the force."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from trainid_ros.core.records import NS_PER_S, ForceRecord, Record, SpeedRecord
from trainid_ros.train.effects import effect_value

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.core.alignment import AlignmentConfig
    from trainid_ros.train.train_file import Effect


class SensorCorrection:
    """Gives records as they would be without the effects ``wheel_diameter`` and ``stamp_skew``."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.skew_s = effect_value(effects, 'stamp_skew', 'delay', 0.0)
        self._skew_ns = round(self.skew_s * NS_PER_S)
        self._ratio = effect_value(effects, 'wheel_diameter', 'ratio', 1.0)
        self.reset()

    def reset(self) -> None:
        """Forget where the train stood."""
        self._stood_at = math.nan

    def widen(self, alignment: AlignmentConfig) -> AlignmentConfig:
        """Return an alignment that bears mended stamps lying apart from those of the other topics."""
        return replace(alignment, max_lag=alignment.max_lag + abs(self.skew_s))

    def correct(self, record: Record) -> Record:
        """Return a record, mended if it needs to be."""
        if self._ratio != 1.0 and isinstance(record, SpeedRecord):
            return self._correct_speed(record)
        if self._skew_ns and isinstance(record, ForceRecord) and record.stamp_ns > 0:  # a zero stamp is a fault
            return replace(record, stamp_ns=record.stamp_ns - self._skew_ns)
        return record

    def _correct_speed(self, record: SpeedRecord) -> SpeedRecord:
        """The position of a standing train is that of the platform; from there on the wheel counts."""
        if record.speed == 0.0 or math.isnan(self._stood_at):
            self._stood_at = record.position
        position = self._stood_at + (record.position - self._stood_at) / self._ratio
        return replace(record, speed=record.speed / self._ratio, position=position)

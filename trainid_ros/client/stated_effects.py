# SPDX-License-Identifier: Apache-2.0
"""Effects of the train file at a speed: the estimators remove them from their estimates, the client adds them again.

Of a speed alone, place, time and history are not known. So effects are evaluated on level, open, straight track, long
after the last brake release, with warm bearings and at the start of the record: what depends on anything else adds
nothing. The exception is a hot brake, which is the worst case of a bound.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.errors import InputError
from trainid_ros.train.effects import TrackPoint, resistance_terms

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile

# Traction or braking force for which shares are calculated: effects are (nearly) linear in it [N/kN].
_REFERENCE: Final = 100.0
# Distance after which any bearing is warm [m], and heat with which any brake fades fully [J/kg].
_FAR: Final = 1e12
_HOT: Final = 1e6


class StatedEffects:
    """The effects of a train file that act at a speed, but for those of the brake's rate and delay.

    ``brake_scale`` and ``brake_delay`` are part of the brake, see ``brake_rate.motion_model.true_brake``.

    Args:
        train_file: The train file.

    Raises:
        InputError: An effect is not known or cannot be evaluated.

    """

    def __init__(self, train_file: TrainFile) -> None:
        effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
        self._terms, self._davis = resistance_terms(effects), train_file.resistance
        self._names = ', '.join(effect.name for effect in effects)
        self._length = train_file.train.length

    def resistance(self, speed: float, direction: int) -> float:
        """Return what they add to the running resistance [N/kN] at a speed [m/s]."""
        return math.fsum(self._values(speed, direction))

    def traction_share(self, speed: float, direction: int) -> float:
        """Return the share of the reported traction that they leave [1]."""
        before, after = self._values(speed, direction), self._values(speed, direction, traction=_REFERENCE)
        return 1.0 - math.fsum(map(_difference, after, before)) / _REFERENCE

    def brake_share(self, speed: float, *, hot: bool = False) -> float:
        """Return the share of the brake force that they leave [1]: of a cold brake, or of a hot one if that is less.

        Raises:
            InputError: They leave nothing.

        """
        shares = []
        for heat in (0.0, _HOT) if hot else (0.0,):
            before, after = self._values(speed, 1, heat=heat), self._values(speed, 1, brake=-_REFERENCE, heat=heat)
            shares.append(1.0 + math.fsum(map(_difference, after, before)) / _REFERENCE)
        share = min(shares)
        if share <= 0.0:
            msg = f'effects ({self._names}) of the train file leave no brake force at {speed:g} m/s: share {share:.2f}'
            raise InputError(msg)
        return share

    def _values(
        self, speed: float, direction: int, *, traction: float = 0.0, brake: float = 0.0, heat: float = 0.0
    ) -> list[float]:
        """Return the resistance of each effect with a traction and a braking force [N/kN]."""
        if not self._terms:
            return []
        point = TrackPoint(
            time_s=0.0,
            position=math.nan,
            direction=direction,
            speed=speed,
            length=self._length,
            distance_run=_FAR,
            traction=traction,
            brake=brake,
            heat=heat,
            # As in the live estimators, which shift the dead time instead.
            brake_before=lambda _: brake,
            traction_before=lambda _: traction,
        )
        return [term(self._davis, point) for term in self._terms]


def _difference(x: float, y: float) -> float:
    return x - y

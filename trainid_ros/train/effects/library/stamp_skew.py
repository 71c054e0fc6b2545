# SPDX-License-Identifier: Apache-2.0
"""The force is stamped late or early."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis

# Slower changes of the traction [N/kN/s] do not identify the delay: they come from the speed control, which reacts
# after the train has slowed down, so they appear late regardless of the stamps.
_MIN_SLOPE: Final = 3.0


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``T(t) - T(t + delay)`` [N/kN] where traction T changes sharply, else 0; stamps are ``delay`` [s] late."""
    change = at.traction_before(0.0) - at.traction_before(-p['delay'])
    return change if abs(change) > _MIN_SLOPE * abs(p['delay']) else 0.0


EFFECT: Final = EffectKind(
    name='stamp_skew',
    title='late force stamps',
    equation='w = T(t) - T(t + delay): the force that acts at t is stamped t + delay',
    parameters={'delay': Parameter('s', -1.5, 1.5)},
    amplitude='delay',
    usual=0.15,
    resistance=resistance,
    origin='sensor',
    on_records=True,
    needs='sharp changes of traction',
    twins=(
        Twin('traction_scale', 'long steady traction, and sharp changes of traction'),
        Twin('map_shift', 'sharp changes of traction on level track'),
    ),
)

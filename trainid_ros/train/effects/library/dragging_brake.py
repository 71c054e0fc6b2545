# SPDX-License-Identifier: Apache-2.0
"""The brake still drags for some time after its release."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``permille`` [N/kN] for ``time`` [s] after a release while the train moves, else 0."""
    return p['permille'] if at.speed > 0.0 and 0.0 < at.since_release <= p['time'] else 0.0


EFFECT: Final = EffectKind(
    name='dragging_brake',
    title='dragging brake after release',
    equation='w = permille for time seconds after a release',
    parameters={
        'permille': Parameter('per mille', 0.0, 1000.0),
        'time': Parameter('s', 0.0, 1e5, search=(2.0, 120.0), grid='log'),
    },
    amplitude='permille',
    usual=2.0,
    resistance=resistance,
    needs='brake releases at speed, and motion long after them',
    twins=(
        Twin('starting_resistance', 'releases at high speed: starting resistance is not visible there'),
        Twin('brake_delay', 'releases at high speed followed by long coasting'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""The stamps of the force are late or early."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis

# Slower changes of the traction [N/kN/s] do not tell the delay: a speed control makes them, after what slowed the
# train, and so they look late however they are stamped.
_SHARP: Final = 3.0


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``T(t) - T(t + delay)`` where traction T changes sharply: what acts now is stamped later."""
    change = at.traction_before(0.0) - at.traction_before(-p['delay'])
    return change if abs(change) > _SHARP * abs(p['delay']) else 0.0


EFFECT: Final = EffectKind(
    name='stamp_skew',
    title='late stamps of the force',
    equation='w = T(t) - T(t + delay): the force that acts at t is stamped t + delay',
    parameters={'delay': Parameter('s', -1.5, 1.5)},
    amplitude='delay',
    usual=0.15,
    resistance=resistance,
    origin='sensor',
    on_records=True,
    needs='sharp changes of traction',
    twins=(
        Twin('traction_scale', 'long steady traction, and sharp changes of it'),
        Twin('map_shift', 'sharp changes of traction on level track'),
    ),
)

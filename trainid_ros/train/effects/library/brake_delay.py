# SPDX-License-Identifier: Apache-2.0
"""The brake responds later than assumed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``B(t) - B(t - extra)`` [N/kN], ``extra`` in s: less braking at the onset, more after the release."""
    return at.brake_before(0.0) - at.brake_before(p['extra'])


EFFECT: Final = EffectKind(
    name='brake_delay',
    title='additional dead time of the brake',
    equation='w = B(t) - B(t - extra), B <= 0',
    parameters={'extra': Parameter('s', 0.0, 10.0)},
    amplitude='extra',
    usual=0.5,
    resistance=resistance,
    needs='sharp brake onsets and releases at speed',
    twins=(
        Twin('brake_scale', 'long steady braking, with sharp onsets and releases'),
        Twin('dragging_brake', 'sharp brake onsets: a delay has the opposite sign there'),
        Twin('brake_fade', 'sharp onsets and releases with a cold brake'),
    ),
)

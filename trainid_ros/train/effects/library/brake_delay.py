# SPDX-License-Identifier: Apache-2.0
"""The brake answers later than believed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``B(t) - B(t - extra)``: less braking at the onset, more after the release."""
    return at.brake_before(0.0) - at.brake_before(p['extra'])


EFFECT: Final = EffectKind(
    name='brake_delay',
    title='further dead time of the brake',
    equation='w = B(t) - B(t - extra), B <= 0',
    parameters={'extra': Parameter('s', 0.0, 10.0)},
    amplitude='extra',
    usual=0.5,
    resistance=resistance,
    needs='sharp onsets and releases of the brake at speed',
    twins=(
        Twin('brake_scale', 'long steady braking, with sharp onsets and releases'),
        Twin('dragging_brake', 'sharp onsets too: a delay shows there with the other sign'),
        Twin('brake_fade', 'sharp onsets and releases with a cold brake'),
    ),
)

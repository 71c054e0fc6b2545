# SPDX-License-Identifier: Apache-2.0
"""The map is read at a wrong position."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``i(s - distance) - i(s)`` [per mille] with the reported gradient i, which is ``distance`` [m] early."""
    return at.gradient_ahead(-p['distance']) - at.gradient_ahead(0.0)


EFFECT: Final = EffectKind(
    name='map_shift',
    title='map read at a wrong position',
    equation='w = i(s - distance) - i(s): the reported gradient is early by distance',
    parameters={'distance': Parameter('m', -1000.0, 1000.0)},
    amplitude='distance',
    usual=60.0,
    resistance=resistance,
    origin='sensor',
    needs='runs over changes of gradient in both directions',
    twins=(
        Twin('gradient_error', 'runs over other changes of gradient'),
        Twin('stamp_skew', 'coasting over changes of gradient, and sharp changes of traction on level track'),
    ),
)

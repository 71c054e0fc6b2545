# SPDX-License-Identifier: Apache-2.0
"""The map is read at a wrong place."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``i(s - distance) - i(s)`` with the reported gradient i: the true one was reported that much earlier."""
    return at.gradient_ahead(-p['distance']) - at.gradient_ahead(0.0)


EFFECT: Final = EffectKind(
    name='map_shift',
    title='map read at a wrong place',
    equation='w = i(s - distance) - i(s): the gradient is reported distance too early on the way',
    parameters={'distance': Parameter('m', -1000.0, 1000.0)},
    amplitude='distance',
    usual=60.0,
    resistance=resistance,
    origin='sensor',
    needs='places where the gradient changes, driven in both directions',
    twins=(
        Twin('gradient_error', 'runs over other places where the gradient changes'),
        Twin('stamp_skew', 'coasting over changes of gradient, and sharp changes of traction on level track'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Wrong gradient in a section of the map."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint, share_inside
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return the true gradient minus that of the map [per mille]; ``permille`` is + uphill in increasing position."""
    return at.direction * p['permille'] * share_inside(at, p['start'], p['end'])


EFFECT: Final = EffectKind(
    name='gradient_error',
    title='wrong gradient in the map',
    equation='w = +- permille between start and end: uphill in one direction, downhill in the other',
    parameters={'start': Parameter('m'), 'end': Parameter('m'), 'permille': Parameter('per mille')},
    amplitude='permille',
    usual=3.0,
    resistance=resistance,
    origin='sensor',
    needs='runs through the section in both directions, and beyond it; over the entire line it acts like Davis a',
    twins=(
        Twin('local_drag', 'runs through the section in both directions: a gradient error changes sign'),
        Twin('curve_resistance', 'runs through the section in both directions, and through other curves'),
        Twin('headwind', 'runs in still air, or at clearly different speeds'),
        Twin('map_shift', 'runs over other gradient changes: a shift is visible at each of them'),
    ),
)

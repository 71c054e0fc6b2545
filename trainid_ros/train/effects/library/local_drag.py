# SPDX-License-Identifier: Apache-2.0
"""Additional resistance in one section, equal in both directions."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint, share_inside
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``permille`` times the share of the train between start and end [N/kN]; same sign in both directions."""
    return p['permille'] * share_inside(at, p['start'], p['end'])


EFFECT: Final = EffectKind(
    name='local_drag',
    title='additional drag in one section',
    equation='w = permille between start and end, in both directions',
    parameters={'start': Parameter('m'), 'end': Parameter('m'), 'permille': Parameter('per mille', search=(0.0, 50.0))},
    amplitude='permille',
    usual=3.0,
    resistance=resistance,
    needs='runs through the section and beyond it',
    twins=(
        Twin('gradient_error', 'runs through the section in both directions: a drag keeps its sign'),
        Twin('curve_resistance', 'runs through other curves: a local drag is not visible there'),
        Twin('tunnel_drag', 'runs through the section at clearly different speeds, and through other tunnels'),
    ),
)

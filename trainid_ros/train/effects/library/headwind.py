# SPDX-License-Identifier: Apache-2.0
"""Air resistance of wind along the line."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    """Return ``c ((v + u) |v + u| - v^2)`` [N/kN] with the headwind u [m/s].

    ``speed`` > 0 is a headwind in the direction of increasing position and a tailwind in the opposite direction.
    """
    air = at.speed + at.direction * p['speed']
    return davis.c * (air * abs(air) - at.speed * at.speed)


EFFECT: Final = EffectKind(
    name='headwind',
    title='wind along the line',
    equation='w = c ((v + u) |v + u| - v^2), u = headwind: speed in increasing position, -speed in decreasing position',
    parameters={'speed': Parameter('m/s', -60.0, 60.0)},
    amplitude='speed',
    usual=5.0,
    resistance=resistance,
    needs='runs in both directions, at different speeds',
    twins=(
        Twin('tunnel_drag', 'runs in both directions'),
        Twin('gradient_error', 'runs at clearly different speeds, or on a day without wind'),
        Twin('resistance_step', 'runs in both directions before and after'),
    ),
)

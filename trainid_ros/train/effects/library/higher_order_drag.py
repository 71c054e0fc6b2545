# SPDX-License-Identifier: Apache-2.0
"""Drag that grows faster than the square of the speed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``coefficient v^3`` [N/kN], with the coefficient in N/kN/(m/s)^3."""
    return p['coefficient'] * at.speed**3


EFFECT: Final = EffectKind(
    name='higher_order_drag',
    title='drag beyond the square of the speed',
    equation='w = coefficient v^3',
    parameters={'coefficient': Parameter('N/kN/(m/s)^3', -1.0, 1.0, search=(0.0, 0.01))},
    amplitude='coefficient',
    usual=0.0001,
    resistance=resistance,
    needs='runs over the full speed range, preferably coasting',
    twins=(
        Twin('starting_resistance', 'runs at low and at maximum speed'),
        Twin('tunnel_drag', 'equally fast runs inside and outside tunnels'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Additional air drag in tunnels."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    """Return ``(factor - 1) c v^2`` [N/kN] in tunnels, else 0: the drag coefficient rises from c to ``factor`` c."""
    return (p['factor'] - 1.0) * davis.c * at.speed * at.speed if at.tunnel else 0.0


EFFECT: Final = EffectKind(
    name='tunnel_drag',
    title='air drag in tunnels',
    equation='w = (factor - 1) c v^2 in tunnels',
    parameters={'factor': Parameter('', 0.0, 20.0, search=(1.0, 10.0))},
    amplitude='factor',
    usual=0.6,
    neutral=1.0,
    resistance=resistance,
    needs='fast runs inside and outside tunnels, with the tunnel flag set',
    twins=(
        Twin('headwind', 'runs through the tunnels in both directions'),
        Twin('local_drag', 'runs through one tunnel at clearly different speeds, and through other tunnels'),
        Twin('higher_order_drag', 'equally fast runs inside and outside tunnels'),
    ),
)

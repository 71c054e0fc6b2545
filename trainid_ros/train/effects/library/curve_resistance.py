# SPDX-License-Identifier: Apache-2.0
"""Curve resistance of flanges and bogies."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``coefficient / R`` [N/kN], with the coefficient in N/kN m (600 in the usual formula) and R in m."""
    return p['coefficient'] / at.curve_radius if at.curve_radius > 0.0 else 0.0


EFFECT: Final = EffectKind(
    name='curve_resistance',
    title='curve resistance',
    equation='w = coefficient / R',
    parameters={'coefficient': Parameter('N/kN m', 0.0, 20000.0)},
    amplitude='coefficient',
    usual=500.0,
    resistance=resistance,
    needs='runs through curves of known radius and on straight track',
    twins=(
        Twin('gradient_error', 'runs through the curve in both directions: curve resistance keeps its sign'),
        Twin('local_drag', 'runs through other curves with other radii'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Flanges and bogies resist in curves."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``coefficient / R``; the coefficient in N/kN m (600 in the usual formula), R in m."""
    return p['coefficient'] / at.curve_radius if at.curve_radius > 0.0 else 0.0


EFFECT: Final = EffectKind(
    name='curve_resistance',
    title='resistance of curves',
    equation='w = coefficient / R',
    parameters={'coefficient': Parameter('N/kN m', 0.0, 20000.0)},
    amplitude='coefficient',
    usual=500.0,
    resistance=resistance,
    needs='runs through curves of known radius and on straight track',
    twins=(
        Twin('gradient_error', 'runs through the curve in both directions: a curve resists both ways'),
        Twin('local_drag', 'runs through other curves, of other radii'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Speed and distance are measured with a wrong wheel diameter."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.davis import davis
from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, resistance: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) (T + B - i - w(v) + v w'(v))`` [N/kN]: it makes the balance of the measured speed hold."""
    v = at.speed
    free = at.traction + at.brake - at.gradient_ahead(0.0) - davis(resistance, v)
    return -(p['ratio'] - 1.0) * (free + v * (resistance.b + 2.0 * resistance.c * v))


EFFECT: Final = EffectKind(
    name='wheel_diameter',
    title='wrong wheel diameter of the odometer',
    equation='v measured = ratio v, s measured = ratio s between stops',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.02,
    resistance=resistance,
    neutral=1.0,
    origin='sensor',
    on_records=True,
    needs='positions between stops with a known distance',
    twins=(
        Twin('traction_scale', 'comparison of the distance between two stops with the line data'),
        Twin('mass_error', 'comparison of the distance between two stops with the line data'),
        Twin('brake_scale', 'comparison of the distance between two stops with the line data'),
    ),
)

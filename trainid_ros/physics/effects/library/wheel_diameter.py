# SPDX-License-Identifier: Apache-2.0
"""Speed and distance are measured with a wrong wheel diameter."""

from __future__ import annotations

from typing import Final

from trainid_ros.physics.effects.kind import EffectKind, Parameter, Twin

EFFECT: Final = EffectKind(
    name='wheel_diameter',
    title='wrong wheel diameter of the odometer',
    equation='v measured = ratio v, s measured = ratio s between stops',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    neutral=1.0,
    origin='sensor',
    on_records=True,
    needs='positions between stops whose distance is known',
    twins=(
        Twin('traction_scale', 'compare the distance between two stops with the line'),
        Twin('mass_error', 'compare the distance between two stops with the line'),
        Twin('brake_scale', 'compare the distance between two stops with the line'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Additional resistance of bearings and flanges at low speed."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``value exp(-v / speed)`` [N/kN], ``speed`` in m/s."""
    return p['value'] * math.exp(-at.speed / p['speed'])


EFFECT: Final = EffectKind(
    name='starting_resistance',
    title='additional resistance at low speed',
    equation='w = value exp(-v / speed)',
    parameters={
        'value': Parameter('N/kN', -1000.0, 1000.0, search=(0.0, 50.0)),
        'speed': Parameter('m/s', 1e-6, 1e3, search=(0.5, 8.0), grid='log'),
    },
    amplitude='value',
    usual=2.0,
    resistance=resistance,
    needs='running at low speed, not only starts with full traction',
    twins=(
        Twin('dragging_brake', 'coasting at low speed long after the brake was released'),
        Twin('mass_error', 'running at low speed with low traction'),
        Twin('bearing_warmup', 'starts late in the day, with warm bearings'),
    ),
)

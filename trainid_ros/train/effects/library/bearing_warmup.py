# SPDX-License-Identifier: Apache-2.0
"""Cold bearings resist more until they have run warm."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``value exp(-s / distance)``: bearings run warm with the distance s [N/kN, m]."""
    return p['value'] * math.exp(-at.distance_run / p['distance'])


EFFECT: Final = EffectKind(
    name='bearing_warmup',
    title='cold bearings that run warm',
    equation='w = value exp(-s / distance), s = distance run since the start',
    parameters={
        'value': Parameter('N/kN', -1000.0, 1000.0, search=(0.0, 50.0)),
        'distance': Parameter('m', 1e-6, 1e9, search=(500.0, 50000.0), grid='log'),
    },
    amplitude='value',
    usual=1.0,
    resistance=resistance,
    needs='a record from the start of the day until the bearings are warm',
    twins=(
        Twin('resistance_step', 'a longer record: a step comes at once, warming wears off'),
        Twin('headwind', 'runs in both directions right after the start'),
    ),
)

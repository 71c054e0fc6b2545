# SPDX-License-Identifier: Apache-2.0
"""Additional resistance of cold bearings until they have warmed up."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``value exp(-s / distance)`` [N/kN]: bearings warm up over the distance run s [m]."""
    return p['value'] * math.exp(-at.distance_run / p['distance'])


EFFECT: Final = EffectKind(
    name='bearing_warmup',
    title='warm-up of cold bearings',
    equation='w = value exp(-s / distance), s = distance run since the start',
    parameters={
        'value': Parameter('N/kN', -1000.0, 1000.0, search=(0.0, 50.0)),
        'distance': Parameter('m', 1e-6, 1e9, search=(500.0, 50000.0), grid='log'),
    },
    amplitude='value',
    usual=1.0,
    resistance=resistance,
    needs='data from the start of the day until the bearings are warm',
    twins=(
        Twin('resistance_step', 'a longer record: a step is sudden, the warm-up effect decays'),
        Twin('headwind', 'runs in both directions right after the start'),
    ),
)

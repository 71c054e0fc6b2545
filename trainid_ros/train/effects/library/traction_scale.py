# SPDX-License-Identifier: Apache-2.0
"""The tractive force is larger or smaller than reported."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) T`` [N/kN]: the tractive force is ``ratio`` times the reported one."""
    return -(p['ratio'] - 1.0) * at.traction


EFFECT: Final = EffectKind(
    name='traction_scale',
    title='wrong gain of the traction force',
    equation='w = -(ratio - 1) T, ratio = true over reported traction',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.08,
    neutral=1.0,
    resistance=resistance,
    origin='sensor',
    needs='high and low traction, and coasting',
    twins=(
        Twin(
            'mass_error',
            'runs over steep gradients or braking, or weighing the train: the gain does not affect braking',
        ),
        Twin('wheel_diameter', 'comparison of the distance between two stops with the line data'),
        Twin('stamp_skew', 'long steady traction: a skew is visible only while the force changes'),
    ),
)

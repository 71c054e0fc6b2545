# SPDX-License-Identifier: Apache-2.0
"""The brake is weaker or stronger than assumed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) B`` [N/kN]: the braking force is ``ratio`` times the assumed one (B <= 0)."""
    return -(p['ratio'] - 1.0) * at.brake


EFFECT: Final = EffectKind(
    name='brake_scale',
    title='wrong braking force',
    equation='w = -(ratio - 1) B, ratio = true over assumed braking force, B <= 0',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.12,
    neutral=1.0,
    resistance=resistance,
    needs='braking with a cold brake and with a hot one',
    twins=(
        Twin('brake_fade', 'braking with a cold brake, and again soon after with a hot one'),
        Twin('brake_delay', 'long steady braking: a delay is visible only while the command changes'),
        Twin('mass_error', 'runs with high traction, or weighing the train'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""The brake is weaker or stronger than believed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) B``: the brake gives ratio times what is believed (B <= 0)."""
    return -(p['ratio'] - 1.0) * at.brake


EFFECT: Final = EffectKind(
    name='brake_scale',
    title='wrong strength of the brake',
    equation='w = -(ratio - 1) B, ratio = true over believed brake force, B <= 0',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.12,
    neutral=1.0,
    resistance=resistance,
    needs='braking, with a cold brake and with a hot one',
    twins=(
        Twin('brake_fade', 'braking with a cold brake and soon again with a hot one'),
        Twin('brake_delay', 'long steady braking: a delay shows only while the command changes'),
        Twin('mass_error', 'runs with strong traction, or weigh the train'),
    ),
)

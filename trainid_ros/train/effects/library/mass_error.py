# SPDX-License-Identifier: Apache-2.0
"""The train is heavier or lighter than weighed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``(T + B) (1 - 1 / ratio)``: forces are specific to the believed mass, the train has ratio times it."""
    return (at.traction + at.brake) * (1.0 - 1.0 / p['ratio'])


EFFECT: Final = EffectKind(
    name='mass_error',
    title='wrong mass',
    equation='w = (T + B) (1 - 1 / ratio), ratio = true over believed mass',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.08,
    neutral=1.0,
    resistance=resistance,
    needs='strong traction and steep gradients, or braking by a brake that is known',
    twins=(
        Twin('traction_scale', 'runs over steep gradients or braking, or weigh the train: mass scales the brake too'),
        Twin('wheel_diameter', 'compare the distance between two stops with the line'),
        Twin('brake_scale', 'runs with strong traction: a brake does not show there'),
    ),
)

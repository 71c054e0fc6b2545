# SPDX-License-Identifier: Apache-2.0
"""The train is heavier or lighter than assumed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``(T + B) (1 - 1 / ratio)`` [N/kN]: T, B per assumed weight, true mass ``ratio`` times assumed."""
    return (at.traction + at.brake) * (1.0 - 1.0 / p['ratio'])


EFFECT: Final = EffectKind(
    name='mass_error',
    title='wrong mass',
    equation='w = (T + B) (1 - 1 / ratio), ratio = true over assumed mass',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    usual=0.08,
    neutral=1.0,
    resistance=resistance,
    needs='high traction and steep gradients, or braking with a known brake rate',
    twins=(
        Twin(
            'traction_scale', 'runs over steep gradients or braking, or weighing the train: mass also scales the brake'
        ),
        Twin('wheel_diameter', 'comparison of the distance between two stops with the line data'),
        Twin('brake_scale', 'runs with high traction: a brake error is not visible there'),
    ),
)

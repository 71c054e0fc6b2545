# SPDX-License-Identifier: Apache-2.0
"""A hot brake loses braking force (fade)."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``loss min(1, heat / energy) B`` [N/kN], <= 0 as B is: the lost braking force; ``energy`` in J/kg."""
    return p['loss'] * min(1.0, at.heat / p['energy']) * at.brake


EFFECT: Final = EffectKind(
    name='brake_fade',
    title='fade of the hot brake',
    equation='w = loss min(1, heat / energy) B, B <= 0; heat of a brake without fade, cooling time constant 300 s',
    parameters={
        'loss': Parameter('', 0.0, 0.9),
        'energy': Parameter('J/kg', 1e-6, 1e6, search=(30.0, 3000.0), grid='log'),
    },
    amplitude='loss',
    usual=0.25,
    resistance=resistance,
    needs='braking with a cold brake, and repeated braking in quick succession',
    twins=(
        Twin('brake_scale', 'the first braking after a long pause, and repeated braking in quick succession'),
        Twin('brake_delay', 'long braking from high speed: fade grows while braking, a delay does not'),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""A hot brake is weaker."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``loss min(1, heat / energy) B``, which is <= 0 as B is: a fading brake leaves less to resist."""
    return p['loss'] * min(1.0, at.heat / p['energy']) * at.brake


EFFECT: Final = EffectKind(
    name='brake_fade',
    title='fading of the hot brake',
    equation='w = loss min(1, heat / energy) B, B <= 0; heat of a brake without fade, cooling in 300 s',
    parameters={
        'loss': Parameter('', 0.0, 0.9),
        'energy': Parameter('J/kg', 1e-6, 1e6, search=(30.0, 3000.0), grid='log'),
    },
    amplitude='loss',
    usual=0.25,
    resistance=resistance,
    needs='braking with a cold brake, and several times soon after one another',
    twins=(
        Twin('brake_scale', 'the first braking after a long rest, and several soon after one another'),
        Twin('brake_delay', 'long braking from high speed: fade grows on the way, a delay does not'),
    ),
)

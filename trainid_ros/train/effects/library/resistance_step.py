# SPDX-License-Identifier: Apache-2.0
"""Step change of the resistance at some time."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis


def resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``a`` [N/kN] from ``time`` [s since the start] on, 0 before."""
    return p['a'] if at.time_s >= p['time'] else 0.0


EFFECT: Final = EffectKind(
    name='resistance_step',
    title='step change of the resistance',
    equation='w = a from time on',
    parameters={'time': Parameter('s', 0.0, 1e9), 'a': Parameter('N/kN', -1000.0, 1000.0)},
    amplitude='a',
    usual=0.6,
    resistance=resistance,
    needs='runs over the same line before and after the step',
    twins=(
        Twin('bearing_warmup', 'data from the start of the day: the warm-up effect decays with distance'),
        Twin('headwind', 'runs in both directions before and after the step'),
    ),
)

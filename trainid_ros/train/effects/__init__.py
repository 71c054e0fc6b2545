# SPDX-License-Identifier: Apache-2.0
"""Effects beyond Davis resistance and gradient: name, equation, parameters, similar effects.

Every effect is expressed as an *equivalent extra resistance* in the specific balance with the assumed mass,
``T + B = w(v) + i + w_extra + 1000 (1 + gamma) (dv/dt) / g``, where T is the reported traction and B the braking
force of the assumed brake, both in N/kN. Simulator, live estimators and workflow evaluate the same function.

A new effect is one EffectKind, in ``physical`` or ``sensor`` here, or one file that defines ``EFFECT`` in a folder
listed in TRAINID_EFFECTS.
"""

from __future__ import annotations

from trainid_ros.train.effects.effect_catalogue import (
    EFFECTS,
    FOLDERS_VARIABLE,
    Term,
    check_effects,
    effect_value,
    parse_effects,
    resistance_terms,
)
from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Resistance, Twin
from trainid_ros.train.effects.point import BRAKE_APPLIED, COOLING_S, TrackPoint, heat_after, share_inside
from trainid_ros.train.train_file import Davis

__all__ = [
    'BRAKE_APPLIED',
    'COOLING_S',
    'EFFECTS',
    'FOLDERS_VARIABLE',
    'Davis',
    'EffectKind',
    'Parameter',
    'Parameters',
    'Resistance',
    'Term',
    'TrackPoint',
    'Twin',
    'check_effects',
    'effect_value',
    'heat_after',
    'parse_effects',
    'resistance_terms',
    'share_inside',
]

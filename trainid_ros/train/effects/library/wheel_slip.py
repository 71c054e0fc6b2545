# SPDX-License-Identifier: Apache-2.0
"""Wheel slip and slide corrupt the measured speed."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.effects.kind import EffectKind, Parameter, Twin

EFFECT: Final = EffectKind(
    name='wheel_slip',
    title='slip and slide of the speed-sensing wheel',
    equation='v measured = v + bursts of up to speed, for share of the time',
    parameters={'share': Parameter('', 0.0, 0.5), 'speed': Parameter('m/s', 0.0, 10.0, search=(0.3, 5.0))},
    amplitude='share',
    usual=0.02,
    origin='sensor',
    on_records=True,
    needs='traction and braking at the limit of adhesion',
    twins=(Twin('stamp_skew', 'long steady traction: slip occurs in bursts'),),
)

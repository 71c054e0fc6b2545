# SPDX-License-Identifier: Apache-2.0
"""Effects by which only the data of the train are wrong."""

from __future__ import annotations

from typing import Final

from trainid_ros.train.davis import davis
from trainid_ros.train.effects.kind import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.effects.point import TrackPoint, share_inside
from trainid_ros.train.train_file import Davis


def _gradient_error(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return the true gradient minus that of the map [per mille]; ``permille`` is + uphill in increasing position."""
    return at.direction * p['permille'] * share_inside(at, p['start'], p['end'])


GRADIENT_ERROR: Final = EffectKind(
    name='gradient_error',
    title='wrong gradient in the map',
    equation='w = +- permille between start and end: uphill in one direction, downhill in the other',
    parameters={'start': Parameter('m'), 'end': Parameter('m'), 'permille': Parameter('per mille')},
    amplitude='permille',
    typical_size=3.0,
    resistance=_gradient_error,
    linear=True,
    origin='sensor',
    needs='runs through the section in both directions, and beyond it; over the entire line it acts like Davis a',
    twins=(
        Twin('local_drag', 'runs through the section in both directions: a gradient error changes sign'),
        Twin('curve_resistance', 'runs through the section in both directions, and through other curves'),
        Twin('headwind', 'runs in still air, or at clearly different speeds'),
        Twin('map_shift', 'runs over other gradient changes: a shift is visible at each of them'),
    ),
)


def _map_shift(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``i(s - distance) - i(s)`` [per mille] with the reported gradient i, which is ``distance`` [m] early."""
    return at.gradient_ahead(-p['distance']) - at.gradient_ahead(0.0)


MAP_SHIFT: Final = EffectKind(
    name='map_shift',
    title='map read at a wrong position',
    equation='w = i(s - distance) - i(s): the reported gradient is early by distance',
    parameters={'distance': Parameter('m', -1000.0, 1000.0)},
    amplitude='distance',
    typical_size=60.0,
    resistance=_map_shift,
    origin='sensor',
    needs='runs over changes of gradient in both directions',
    twins=(
        Twin('gradient_error', 'runs over other changes of gradient'),
        Twin('stamp_skew', 'coasting over changes of gradient, and sharp changes of traction on level track'),
    ),
)


# Slower changes of the traction [N/kN/s] do not identify the delay: they come from the speed control, which reacts
# after the train has slowed down, so they appear late regardless of the stamps.
_MIN_SLOPE: Final = 3.0


def _stamp_skew(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``T(t) - T(t + delay)`` [N/kN] where traction T changes sharply, else 0; stamps are ``delay`` [s] late."""
    change = at.traction_before(0.0) - at.traction_before(-p['delay'])
    return change if abs(change) > _MIN_SLOPE * abs(p['delay']) else 0.0


STAMP_SKEW: Final = EffectKind(
    name='stamp_skew',
    title='late force stamps',
    equation='w = T(t) - T(t + delay): the force that acts at t is stamped t + delay',
    parameters={'delay': Parameter('s', -1.5, 1.5)},
    amplitude='delay',
    typical_size=0.15,
    resistance=_stamp_skew,
    origin='sensor',
    on_records=True,
    needs='sharp changes of traction',
    twins=(
        Twin('traction_scale', 'long steady traction, and sharp changes of traction'),
        Twin('map_shift', 'sharp changes of traction on level track'),
    ),
)


def _traction_scale(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) T`` [N/kN]: the tractive force is ``ratio`` times the reported one."""
    return -(p['ratio'] - 1.0) * at.traction


TRACTION_SCALE: Final = EffectKind(
    name='traction_scale',
    title='wrong gain of the traction force',
    equation='w = -(ratio - 1) T, ratio = true over reported traction',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    typical_size=0.08,
    neutral=1.0,
    resistance=_traction_scale,
    linear=True,
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


def _wheel_diameter(p: Parameters, resistance: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) (T + B - i - w(v) + v w'(v))`` [N/kN]: it makes the balance of the measured speed hold."""
    v = at.speed
    free = at.traction + at.brake - at.gradient_ahead(0.0) - davis(resistance, v)
    return -(p['ratio'] - 1.0) * (free + v * (resistance.b + 2.0 * resistance.c * v))


WHEEL_DIAMETER: Final = EffectKind(
    name='wheel_diameter',
    title='wrong wheel diameter of the odometer',
    equation='v measured = ratio v, s measured = ratio s between stops',
    parameters={'ratio': Parameter('', 0.2, 5.0)},
    amplitude='ratio',
    typical_size=0.02,
    resistance=_wheel_diameter,
    neutral=1.0,
    linear=True,
    origin='sensor',
    on_records=True,
    needs='positions between stops with a known distance',
    twins=(
        Twin('traction_scale', 'comparison of the distance between two stops with the line data'),
        Twin('mass_error', 'comparison of the distance between two stops with the line data'),
        Twin('brake_scale', 'comparison of the distance between two stops with the line data'),
    ),
)


WHEEL_SLIP: Final = EffectKind(
    name='wheel_slip',
    title='slip and slide of the speed-sensing wheel',
    equation='v measured = v + bursts of up to speed, for share of the time',
    parameters={'share': Parameter('', 0.0, 0.5), 'speed': Parameter('m/s', 0.0, 10.0, search=(0.3, 5.0))},
    amplitude='share',
    typical_size=0.02,
    origin='sensor',
    on_records=True,
    needs='traction and braking at the limit of adhesion',
    twins=(Twin('stamp_skew', 'long steady traction: slip occurs in bursts'),),
)

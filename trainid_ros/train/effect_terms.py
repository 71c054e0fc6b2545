# SPDX-License-Identifier: Apache-2.0
"""The effects built in: of the motion of the train, and of its data alone."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.train.effect_kinds import EffectKind, Parameter, Parameters, Twin
from trainid_ros.train.forces import TrackPoint, davis, share_inside
from trainid_ros.train.train_file import Davis


def _headwind(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    air = at.speed + at.direction * p['speed']
    return davis.c * (air * abs(air) - at.speed * at.speed)


def _stamp_skew(p: Parameters, _: Davis, at: TrackPoint) -> float:
    change = at.traction_before(0.0) - at.traction_before(-p['delay'])
    # Changes slower than 3 N/kN/s do not identify the delay: they come from the speed control, which reacts after the
    # train has slowed down, so they appear late regardless of the stamps.
    return change if abs(change) > 3.0 * abs(p['delay']) else 0.0


def _wheel_diameter(p: Parameters, resistance: Davis, at: TrackPoint) -> float:
    """Return ``-(ratio - 1) (T + B - i - w(v) + v w'(v))``: with it the balance of the measured speed holds."""
    v = at.speed
    free = at.traction + at.brake - at.gradient_ahead(0.0) - davis(resistance, v)
    return -(p['ratio'] - 1.0) * (free + v * (resistance.b + 2.0 * resistance.c * v))


KINDS: Final[tuple[EffectKind, ...]] = (
    EffectKind(
        name='bearing_warmup', title='warm-up of cold bearings',
        equation='w = value exp(-s / distance), s = distance run since the start',
        parameters={
            'value': Parameter('N/kN', -1000.0, 1000.0, search=(0.0, 50.0)),
            'distance': Parameter('m', 1e-6, 1e9, search=(500.0, 50000.0), grid='log'),
        },
        amplitude='value', typical_size=1.0, linear=True,
        resistance=lambda p, _, at: p['value'] * math.exp(-at.distance_run / p['distance']),
        needs='data from the start of the day until the bearings are warm',
        twins=(
            Twin('resistance_step', 'a longer record: a step is sudden, the warm-up effect decays'),
            Twin('headwind', 'runs in both directions right after the start'),
        ),
    ),
    EffectKind(
        name='brake_delay', title='additional dead time of the brake',
        equation='w = B(t) - B(t - extra), B <= 0',
        parameters={'extra': Parameter('s', 0.0, 10.0)},
        amplitude='extra', typical_size=0.5,
        resistance=lambda p, _, at: at.brake_before(0.0) - at.brake_before(p['extra']),
        needs='sharp brake onsets and releases at speed',
        twins=(
            Twin('brake_scale', 'long steady braking, with sharp onsets and releases'),
            Twin('dragging_brake', 'sharp brake onsets: a delay has the opposite sign there'),
            Twin('brake_fade', 'sharp onsets and releases with a cold brake'),
        ),
    ),
    EffectKind(
        name='brake_fade', title='fade of the hot brake',
        equation='w = loss min(1, heat / energy) B, B <= 0; heat of a brake without fade, cooling time constant 300 s',
        parameters={
            'loss': Parameter('', 0.0, 0.9),
            'energy': Parameter('J/kg', 1e-6, 1e6, search=(30.0, 3000.0), grid='log'),
        },
        amplitude='loss', typical_size=0.25, linear=True,
        resistance=lambda p, _, at: p['loss'] * min(1.0, at.heat / p['energy']) * at.brake,
        needs='braking with a cold brake, and repeated braking in quick succession',
        twins=(
            Twin('brake_scale', 'the first braking after a long pause, and repeated braking in quick succession'),
            Twin('brake_delay', 'long braking from high speed: fade grows while braking, a delay does not'),
        ),
    ),
    EffectKind(
        name='brake_scale', title='wrong braking force',
        equation='w = -(ratio - 1) B, ratio = true over assumed braking force, B <= 0',
        parameters={'ratio': Parameter('', 0.2, 5.0)},
        amplitude='ratio', typical_size=0.12, neutral=1.0, linear=True,
        resistance=lambda p, _, at: -(p['ratio'] - 1.0) * at.brake,
        needs='braking with a cold brake and with a hot one',
        twins=(
            Twin('brake_fade', 'braking with a cold brake, and again soon after with a hot one'),
            Twin('brake_delay', 'long steady braking: a delay is visible only while the command changes'),
            Twin('brake_slope', 'braking at high and at low speed'),
            Twin('mass_error', 'runs with high traction, or weighing the train'),
        ),
    ),
    EffectKind(
        name='brake_slope', title='braking force that changes with speed',
        equation='w = -slope v B, B <= 0: at a speed v the brake acts 1 + slope v times as strongly as assumed',
        parameters={'slope': Parameter('s/m', -0.2, 0.2)},
        amplitude='slope', typical_size=0.006, linear=True,  # blocks of cast iron lose 10 to 40 % at full speed
        resistance=lambda p, _, at: -p['slope'] * at.speed * at.brake,
        needs='braking at high and at low speed',
        twins=(
            Twin('brake_scale', 'braking at low speed: a change with speed is not visible there'),
            Twin('brake_fade', 'fast and slow braking with a cold brake'),
        ),
    ),
    EffectKind(
        name='curve_resistance', title='curve resistance',
        equation='w = coefficient / R',
        parameters={'coefficient': Parameter('N/kN m', 0.0, 20000.0)},  # 600 in the usual formula
        amplitude='coefficient', typical_size=500.0, linear=True,
        resistance=lambda p, _, at: p['coefficient'] / at.curve_radius if at.curve_radius > 0.0 else 0.0,
        needs='runs through curves of known radius and on straight track',
        twins=(
            Twin('gradient_error', 'runs through the curve in both directions: curve resistance keeps its sign'),
            Twin('local_drag', 'runs through other curves with other radii'),
        ),
    ),
    EffectKind(
        name='dragging_brake', title='dragging brake after release',
        equation='w = permille for time seconds after a release',
        parameters={
            'permille': Parameter('per mille', 0.0, 1000.0),
            'time': Parameter('s', 0.0, 1e5, search=(2.0, 120.0), grid='log'),
        },
        amplitude='permille', typical_size=2.0, linear=True,
        resistance=lambda p, _, at: p['permille'] if at.speed > 0.0 and 0.0 < at.since_release <= p['time'] else 0.0,
        needs='brake releases at speed, and motion long after them',
        twins=(
            Twin('starting_resistance', 'releases at high speed: starting resistance is not visible there'),
            Twin('brake_delay', 'releases at high speed followed by long coasting'),
        ),
    ),
    EffectKind(
        name='gradient_error', title='wrong gradient in the map',
        equation='w = +- permille between start and end: uphill in one direction, downhill in the other',
        # permille > 0: steeper uphill in increasing position than in the map
        parameters={'start': Parameter('m'), 'end': Parameter('m'), 'permille': Parameter('per mille')},
        amplitude='permille', typical_size=3.0, linear=True, origin='sensor',
        resistance=lambda p, _, at: at.direction * p['permille'] * share_inside(at, p['start'], p['end']),
        needs='runs through the section in both directions, and beyond it; over the entire line it acts like Davis a',
        twins=(
            Twin('local_drag', 'runs through the section in both directions: a gradient error changes sign'),
            Twin('curve_resistance', 'runs through the section in both directions, and through other curves'),
            Twin('headwind', 'runs in still air, or at clearly different speeds'),
            Twin('map_shift', 'runs over other gradient changes: a shift is visible at each of them'),
        ),
    ),
    EffectKind(
        name='headwind', title='wind along the line',
        equation='w = c ((v + u) |v + u| - v^2), '
        'u = headwind: speed in increasing position, -speed in decreasing position',
        parameters={'speed': Parameter('m/s', -60.0, 60.0)},
        amplitude='speed', typical_size=5.0,
        resistance=_headwind,
        needs='runs in both directions, at different speeds',
        twins=(
            Twin('tunnel_drag', 'runs in both directions'),
            Twin('gradient_error', 'runs at clearly different speeds, or on a day without wind'),
            Twin('resistance_step', 'runs in both directions before and after'),
        ),
    ),
    EffectKind(
        name='higher_order_drag', title='drag beyond the square of the speed',
        equation='w = coefficient v^3',
        parameters={'coefficient': Parameter('N/kN/(m/s)^3', -1.0, 1.0, search=(0.0, 0.01))},
        amplitude='coefficient', typical_size=0.0001, linear=True,
        resistance=lambda p, _, at: p['coefficient'] * at.speed**3,
        needs='runs over the full speed range, preferably coasting',
        twins=(
            Twin('starting_resistance', 'runs at low and at maximum speed'),
            Twin('tunnel_drag', 'equally fast runs inside and outside tunnels'),
        ),
    ),
    EffectKind(
        name='local_drag', title='additional drag in one section',
        equation='w = permille between start and end, in both directions',
        parameters={
            'start': Parameter('m'),
            'end': Parameter('m'),
            'permille': Parameter('per mille', search=(0.0, 50.0)),
        },
        amplitude='permille', typical_size=3.0, linear=True,
        resistance=lambda p, _, at: p['permille'] * share_inside(at, p['start'], p['end']),
        needs='runs through the section and beyond it',
        twins=(
            Twin('gradient_error', 'runs through the section in both directions: a drag keeps its sign'),
            Twin('curve_resistance', 'runs through other curves: a local drag is not visible there'),
            Twin('tunnel_drag', 'runs through the section at clearly different speeds, and through other tunnels'),
        ),
    ),
    EffectKind(
        name='map_shift', title='map read at a wrong position',
        equation='w = i(s - distance) - i(s): the reported gradient is early by distance',
        parameters={'distance': Parameter('m', -1000.0, 1000.0)},
        amplitude='distance', typical_size=60.0, origin='sensor',
        resistance=lambda p, _, at: at.gradient_ahead(-p['distance']) - at.gradient_ahead(0.0),
        needs='runs over changes of gradient in both directions',
        twins=(
            Twin('gradient_error', 'runs over other changes of gradient'),
            Twin('stamp_skew', 'coasting over changes of gradient, and sharp changes of traction on level track'),
        ),
    ),
    EffectKind(
        name='mass_error', title='wrong mass',
        equation='w = (T + B) (1 - 1 / ratio), ratio = true over assumed mass',
        parameters={'ratio': Parameter('', 0.2, 5.0)},
        amplitude='ratio', typical_size=0.08, neutral=1.0,
        resistance=lambda p, _, at: (at.traction + at.brake) * (1.0 - 1.0 / p['ratio']),
        needs='high traction and steep gradients, or braking with a known brake rate',
        twins=(
            Twin(
                'traction_scale',
                'braking by a brake of known rate, or weighing the train: mass also scales the brake',
            ),
            Twin('wheel_diameter', 'comparison of the distance between two stops with the line data'),
            Twin('brake_scale', 'runs with high traction: a brake error is not visible there'),
        ),
    ),
    EffectKind(
        name='resistance_step', title='step change of the resistance',
        equation='w = a from time on',
        parameters={'time': Parameter('s', 0.0, 1e9), 'a': Parameter('N/kN', -1000.0, 1000.0)},
        amplitude='a', typical_size=0.6, linear=True,
        resistance=lambda p, _, at: p['a'] if at.time_s >= p['time'] else 0.0,
        needs='runs over the same line before and after the step',
        twins=(
            Twin('bearing_warmup', 'data from the start of the day: the warm-up effect decays with distance'),
            Twin('headwind', 'runs in both directions before and after the step'),
        ),
    ),
    EffectKind(
        name='run_drag', title='additional resistance of single runs',
        equation='w = size on the runs listed; on all runs it is a of the resistance',
        parameters={'size': Parameter('N/kN', -1000.0, 1000.0)},
        amplitude='size', typical_size=0.5, linear=True,
        resistance=lambda p, *_: p['size'],
        needs='some runs with it and some without',
        twins=(
            Twin('headwind', 'these runs in both directions, fast and slow'),
            Twin('mass_error', 'coasting on level track: another mass changes nothing there'),
        ),
    ),
    EffectKind(
        name='stamp_skew', title='late force stamps',
        equation='w = T(t) - T(t + delay): the force that acts at t is stamped t + delay',
        parameters={'delay': Parameter('s', -1.5, 1.5)},
        amplitude='delay', typical_size=0.15, origin='sensor', on_records=True,
        resistance=_stamp_skew,
        needs='sharp changes of traction',
        twins=(
            Twin('traction_scale', 'long steady traction, and sharp changes of traction'),
            Twin('map_shift', 'sharp changes of traction on level track'),
        ),
    ),
    EffectKind(
        name='starting_resistance', title='additional resistance at low speed',
        equation='w = value exp(-v / speed)',
        parameters={
            'value': Parameter('N/kN', -1000.0, 1000.0, search=(0.0, 50.0)),
            'speed': Parameter('m/s', 1e-6, 1e3, search=(0.5, 8.0), grid='log'),
        },
        amplitude='value', typical_size=2.0, linear=True,
        resistance=lambda p, _, at: p['value'] * math.exp(-at.speed / p['speed']),
        needs='running at low speed, not only starts with full traction',
        twins=(
            Twin('dragging_brake', 'coasting at low speed long after the brake was released'),
            Twin('mass_error', 'running at low speed with low traction'),
            Twin('bearing_warmup', 'starts late in the day, with warm bearings'),
        ),
    ),
    EffectKind(
        name='traction_scale', title='wrong gain of the traction force',
        equation='w = -(ratio - 1) T, ratio = true over reported traction',
        parameters={'ratio': Parameter('', 0.2, 5.0)},
        amplitude='ratio', typical_size=0.08, neutral=1.0, linear=True, origin='sensor',
        resistance=lambda p, _, at: -(p['ratio'] - 1.0) * at.traction,
        needs='high and low traction, and coasting',
        twins=(
            Twin(
                'mass_error',
                'braking by a brake of known rate, or weighing the train: the gain does not affect braking',
            ),
            Twin('wheel_diameter', 'comparison of the distance between two stops with the line data'),
            Twin('stamp_skew', 'long steady traction: a skew is visible only while the force changes'),
        ),
    ),
    EffectKind(
        name='tunnel_drag', title='air drag in tunnels',
        equation='w = (factor - 1) c v^2 in tunnels',
        parameters={'factor': Parameter('', 0.0, 20.0, search=(1.0, 10.0))},
        amplitude='factor', typical_size=0.6, neutral=1.0, linear=True,
        resistance=lambda p, davis, at: (p['factor'] - 1.0) * davis.c * at.speed * at.speed if at.tunnel else 0.0,
        needs='fast runs inside and outside tunnels, with the tunnel flag set',
        twins=(
            Twin('headwind', 'runs through the tunnels in both directions'),
            Twin('local_drag', 'runs through one tunnel at clearly different speeds, and through other tunnels'),
            Twin('higher_order_drag', 'equally fast runs inside and outside tunnels'),
        ),
    ),
    EffectKind(
        name='wheel_diameter', title='wrong wheel diameter of the odometer',
        equation='v measured = ratio v, s measured = ratio s between stops',
        parameters={'ratio': Parameter('', 0.2, 5.0)},
        amplitude='ratio', typical_size=0.02, neutral=1.0, linear=True, origin='sensor', on_records=True,
        resistance=_wheel_diameter,
        needs='positions between stops with a known distance',
        twins=(
            Twin('traction_scale', 'comparison of the distance between two stops with the line data'),
            Twin('mass_error', 'comparison of the distance between two stops with the line data'),
            Twin('brake_scale', 'comparison of the distance between two stops with the line data'),
        ),
    ),
    EffectKind(
        name='wheel_slip', title='slip and slide of the speed-sensing wheel',
        equation='v measured = v + bursts of up to speed, for share of the time',
        parameters={'share': Parameter('', 0.0, 0.5), 'speed': Parameter('m/s', 0.0, 10.0, search=(0.3, 5.0))},
        amplitude='share', typical_size=0.02, origin='sensor', on_records=True,
        needs='traction and braking at the limit of adhesion',
        twins=(Twin('stamp_skew', 'long steady traction: slip occurs in bursts'),),
    ),
)  # fmt: skip
"""All of them, by name."""

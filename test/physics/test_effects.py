# SPDX-License-Identifier: Apache-2.0
"""Each effect against its equation, by hand."""

from __future__ import annotations

import math

import pytest

from trainid_ros.core.errors import InputError
from trainid_ros.physics.effect_text import parse_effects
from trainid_ros.physics.effects import EFFECTS, TrackPoint, check_effects, effect_value, extra_resistance
from trainid_ros.physics.train_file import Davis, Effect

DAVIS = Davis(1.0, 0.03, 0.003)
POINT = TrackPoint(time_s=100.0, position=500.0, direction=1, speed=20.0, length=100.0)


def at(**changes: float) -> TrackPoint:
    values = {name: getattr(POINT, name) for name in TrackPoint.__slots__}
    return TrackPoint(**(values | changes))


@pytest.mark.parametrize(
    ('text', 'point', 'expected'),
    [
        ('curve_resistance:coefficient=600', at(curve_radius=300.0), 2.0),
        ('curve_resistance:coefficient=600', at(), 0.0),
        ('tunnel_drag:factor=1.5', at(tunnel=True), 0.5 * 0.003 * 400.0),
        ('tunnel_drag:factor=1.5', at(), 0.0),
        ('headwind:speed=5', at(), 0.003 * (625.0 - 400.0)),
        ('headwind:speed=5', at(direction=-1), 0.003 * (225.0 - 400.0)),
        ('headwind:speed=-25', at(), 0.003 * (-25.0 - 400.0)),
        ('local_drag:start=450,end=900,permille=4', at(), 2.0),
        ('local_drag:start=450,end=900,permille=4', at(direction=-1), 4.0),
        ('local_drag:start=450,end=900,permille=4', at(length=0.0), 4.0),
        ('local_drag:start=600,end=900,permille=4', at(), 0.0),
        ('gradient_error:start=450,end=900,permille=4', at(), 2.0),
        ('gradient_error:start=450,end=900,permille=4', at(direction=-1), -4.0),
        ('resistance_step:time=100,a=0.5', at(), 0.5),
        ('resistance_step:time=100.2,a=0.5', at(), 0.0),
        ('starting_resistance:value=4,speed=2', at(speed=2.0), 4.0 / math.e),
        ('higher_order_drag:coefficient=1e-4', at(), 0.8),
        ('bearing_warmup:value=2,distance=5000', at(distance_run=5000.0), 2.0 / math.e),
        ('dragging_brake:permille=3,time=8', at(since_release=7.0), 3.0),
        ('dragging_brake:permille=3,time=8', at(since_release=9.0), 0.0),
        ('dragging_brake:permille=3,time=8', at(), 0.0),
        ('mass_error:ratio=1.1', at(), 0.0),
    ],
)
def test_each_effect_by_hand(text: str, point: TrackPoint, expected: float) -> None:
    assert extra_resistance(parse_effects([text]), DAVIS, point) == pytest.approx(expected, abs=1e-12)


def test_effects_add_up() -> None:
    effects = parse_effects(['headwind:speed=5', 'resistance_step:time=0,a=0.5'])
    assert extra_resistance(effects, DAVIS, POINT) == pytest.approx(0.675 + 0.5)


def test_texts_of_one_name_complete_one_effect_until_a_key_comes_again() -> None:
    texts = ['local_drag:start=1', 'local_drag:end=2', 'local_drag:permille=3']
    first, second = parse_effects([*texts, 'local_drag:start=4,end=5,permille=6'])
    assert first.parameters == (('start', 1.0), ('end', 2.0), ('permille', 3.0))
    assert second.parameters == (('start', 4.0), ('end', 5.0), ('permille', 6.0))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('headwnd:speed=3', "effect headwnd is not known; did you mean 'headwind'?"),
        ('headwind:sped=3', "effect headwind:sped is no parameter; did you mean 'speed'?"),
        ('headwind:speed=fast', "effect 'headwind:speed=fast': speed = 'fast' is not a number"),
        ('headwind:speed=nan', 'effect headwind:speed = nan m/s is outside [-inf, inf]'),
        ('headwind', "effect 'headwind' must have the form NAME:key=value"),
        ('headwind:speed', "effect 'headwind:speed' must have the form NAME:key=value"),
        ('mass_error:ratio=9', 'effect mass_error:ratio = 9 is outside [0.2, 5]'),
        ('local_drag:start=1,end=2', 'effect local_drag:permille is missing'),
        ('local_drag:start=3,end=2,permille=1', 'effect local_drag:end = 2 m must lie after start = 3 m'),
    ],
)
def test_wrong_effects_are_named(text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_effects([text])
    assert str(caught.value) == message


def test_an_effect_without_a_near_name_lists_all_that_are_known() -> None:
    with pytest.raises(InputError, match=f'known: {", ".join(sorted(EFFECTS))}'):
        check_effects([Effect('zzz')])


def test_the_last_effect_of_a_name_gives_the_value() -> None:
    effects = parse_effects(['mass_error:ratio=1.1', 'mass_error:ratio=1.2'])
    assert effect_value(effects, 'mass_error', 'ratio', 1.0) == 1.2
    assert effect_value(effects, 'brake_scale', 'ratio', 1.0) == 1.0

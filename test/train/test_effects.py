# SPDX-License-Identifier: Apache-2.0
"""Each effect against hand calculation of its equation."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.train.effects import EFFECTS, check_effects, effect_value, parse_effects, resistance_terms
from trainid_ros.train.forces import COOLING_S, TrackPoint, heat_after
from trainid_ros.train.train_file import Davis, Effect

DAVIS = Davis(1.0, 0.03, 0.003)
POINT = TrackPoint(time_s=100.0, position=500.0, direction=1, speed=20.0, length=100.0)


def at(**changes: Any) -> TrackPoint:
    return replace(POINT, **changes)


def extra_resistance(text: str, point: TrackPoint = POINT) -> float:
    return sum(term(DAVIS, point) for term in resistance_terms(parse_effects([text])))


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
        ('dragging_brake:permille=3,time=8', at(since_release=0.0), 0.0),
        ('mass_error:ratio=1.1', at(), 0.0),
        ('mass_error:ratio=1.25', at(traction=50.0), 10.0),
        ('mass_error:ratio=1.25', at(brake=-50.0), -10.0),
        ('traction_scale:ratio=0.9', at(traction=50.0), 5.0),
        ('brake_scale:ratio=0.9', at(brake=-80.0), -8.0),
        ('brake_slope:slope=-0.01', at(brake=-80.0), -16.0),
        ('brake_fade:loss=0.3,energy=200', at(brake=-80.0, heat=50.0), -6.0),
        ('brake_fade:loss=0.3,energy=200', at(brake=-80.0, heat=500.0), -24.0),
        ('brake_delay:extra=0.5', at(brake=-60.0, brake_before=lambda s: -60.0 + 80.0 * s), -40.0),
        ('map_shift:distance=30', at(gradient_ahead=lambda x: 5.0 + 0.1 * x), -3.0),
        ('wheel_diameter:ratio=1.02', at(traction=50.0), 0.0),
    ],
)
def test_each_effect_against_hand_calculation(text: str, point: TrackPoint, expected: float) -> None:
    assert extra_resistance(text, point) == pytest.approx(expected, abs=1e-12)


def test_consecutive_texts_of_one_name_form_one_effect_until_a_key_is_repeated() -> None:
    texts = ['local_drag:start=1', 'local_drag:end=2', 'local_drag:permille=3']
    first, second = parse_effects([*texts, 'local_drag:start=4,end=5,permille=6'])
    assert first.parameters == (('start', 1.0), ('end', 2.0), ('permille', 3.0))
    assert second.parameters == (('start', 4.0), ('end', 5.0), ('permille', 6.0))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('headwnd:speed=3', "effect headwnd is not known; did you mean 'headwind'?"),
        ('zzz:x=3', f'effect zzz is not known; known: {", ".join(sorted(EFFECTS))}'),
        ('headwind:sped=3', "effect headwind:sped is not a parameter; did you mean 'speed'?"),
        ('headwind:speed=fast', "effect 'headwind:speed=fast': speed = 'fast' is not a number"),
        ('headwind:speed=nan', 'effect headwind:speed = nan m/s must be finite'),
        ('headwind', "effect 'headwind' must have the form NAME:key=value"),
        ('headwind:speed', "effect 'headwind:speed' must have the form NAME:key=value"),
        ('mass_error:ratio=9', 'effect mass_error:ratio = 9 is outside [0.2, 5]'),
        ('local_drag:start=1,end=2', 'effect local_drag:permille is missing'),
        ('local_drag:start=3,end=2,permille=1', 'effect local_drag:end = 2 m must be greater than start = 3 m'),
    ],
)
def test_wrong_effects_are_named(text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_effects([text])
    assert str(caught.value) == message


def test_a_parameter_value_is_found_by_the_name_of_its_effect() -> None:
    effects = parse_effects(['mass_error:ratio=1.2'])
    assert effect_value(effects, 'mass_error', 'ratio', 1.0) == 1.2
    assert effect_value(effects, 'brake_scale', 'ratio', 1.0) == 1.0


def test_an_effect_without_its_own_position_or_time_may_occur_only_once() -> None:
    with pytest.raises(InputError, match='mass_error: given more than once'):
        check_effects(parse_effects(['mass_error:ratio=1.1', 'mass_error:ratio=1.2']))
    drags = ['local_drag:start=0,end=9,permille=1', 'local_drag:start=20,end=29,permille=2']
    check_effects(parse_effects([*drags, 'resistance_step:time=9,a=1', 'resistance_step:time=99,a=1']))


def test_an_effect_may_act_on_some_runs_only() -> None:
    (mass,) = parse_effects(['mass_error:ratio=1.25'])
    (term,) = resistance_terms([replace(mass, runs=(2, 5))])
    values = [term(DAVIS, at(traction=50.0, run=run)) for run in range(7)]
    assert values == pytest.approx([0.0, 0.0, 10.0, 0.0, 0.0, 10.0, 0.0])
    assert effect_value([replace(mass, runs=(2, 5))], 'mass_error', 'ratio', 1.0) == 1.0  # not of all runs
    check_effects([mass, replace(mass, runs=(2,)), replace(mass, runs=(3,))])
    (wheel,) = parse_effects(['wheel_diameter:ratio=1.01'])
    with pytest.raises(InputError, match='wheel_diameter: runs: it acts on all records'):
        check_effects([replace(wheel, runs=(2,))])


def test_a_force_stamped_late_already_acts_now() -> None:
    kind = EFFECTS['stamp_skew']
    assert kind.resistance is not None
    # Traction rises by 4 N/kN/s; with stamps 0.5 s late the force stamped 0.5 s from now already acts.
    rising = at(traction_before=lambda s: 30.0 - 4.0 * s)
    assert kind.resistance({'delay': 0.5}, DAVIS, rising) == pytest.approx(-2.0)
    # A speed control changes the traction slowly, after the train has slowed: it appears late but is not.
    assert kind.resistance({'delay': 0.5}, DAVIS, at(traction_before=lambda s: 30.0 - 1.0 * s)) == 0.0


def test_effects_on_records_add_no_resistance_to_the_balance() -> None:
    rising = at(traction=30.0, traction_before=lambda s: 30.0 - 4.0 * s)
    assert extra_resistance('stamp_skew:delay=0.5', rising) == 0.0
    assert {name for name, kind in EFFECTS.items() if kind.on_records} == {'stamp_skew', 'wheel_diameter', 'wheel_slip'}
    assert list(EFFECTS) == sorted(EFFECTS)


def test_heat_follows_its_equation() -> None:
    heat = 120.0
    for _ in range(10_000):
        heat += 1e-3 * (0.8 * 15.0 - heat / COOLING_S)
    assert heat_after(120.0, -0.8, 15.0, 10.0) == pytest.approx(heat, rel=1e-5)
    assert heat_after(120.0, 0.0, 15.0, COOLING_S) == pytest.approx(120.0 / math.e)


# Every input of an effect is non-zero.
FULL_POINT = at(
    curve_radius=300.0, tunnel=True, distance_run=900.0, since_release=3.0, traction=20.0, brake=-30.0, heat=80.0,
    brake_before=lambda s: -30.0 + s, traction_before=lambda s: 20.0 - 5.0 * s, gradient_ahead=lambda x: 3.0 + 0.01 * x,
)  # fmt: skip


@pytest.mark.parametrize('name', EFFECTS)
def test_each_library_effect_is_complete_and_consistent(name: str) -> None:
    kind = EFFECTS[name]
    assert kind.name == name
    assert all((kind.title, kind.equation, kind.needs, kind.twins))
    assert all(twin.name in EFFECTS and twin.name != name and twin.drive for twin in kind.twins)
    for parameter in kind.parameters.values():
        if parameter.search is not None:
            assert parameter.low <= parameter.search[0] < parameter.search[1] <= parameter.high


@pytest.mark.parametrize('name', [name for name, kind in EFFECTS.items() if kind.resistance is not None])
def test_an_effect_is_zero_at_neutral_and_grows_with_its_amplitude(name: str) -> None:
    kind = EFFECTS[name]
    assert kind.resistance is not None
    values = {'start': 100.0, 'end': 900.0, 'time': 60.0, 'speed': 3.0, 'distance': 500.0, 'energy': 200.0}
    parameters = {key: values.get(key, 1.0) for key in kind.parameters}
    none, little, more, typical, large = (
        kind.resistance(parameters | {kind.amplitude: kind.neutral + size}, DAVIS, FULL_POINT)
        for size in (0.0, 1e-3, 2e-3, kind.typical_size, 7.0 * kind.typical_size)
    )
    assert none == pytest.approx(0.0, abs=1e-12)
    assert little != 0.0
    assert more == pytest.approx(2.0 * little, rel=0.01)
    assert not kind.linear or large == pytest.approx(7.0 * typical)


# Users' effects

USERS = """
from trainid_ros.train.effects import EffectKind, Parameter

EFFECT = EffectKind(
    name='leaves',
    title='leaves on the rail',
    equation='w = value',
    parameters={'value': Parameter('N/kN', 0.0, 10.0)},
    amplitude='value',
    typical_size=1.0,
    resistance=lambda p, davis, at: p['value'] + davis.a,
)
"""


def test_a_file_in_a_user_folder_becomes_an_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'leaves.py').write_text(USERS, encoding='utf-8')
    (tmp_path / '_helper.py').write_text('', encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    assert extra_resistance('leaves:value=2') == 3.0
    assert 'headwind' in EFFECTS
    monkeypatch.delenv('TRAINID_EFFECTS')
    with pytest.raises(InputError, match='effect leaves is not known'):
        parse_effects(['leaves:value=2'])
    monkeypatch.setenv('TRAINID_EFFECTS', '/nowhere/at/all')
    with pytest.raises(InputError, match='TRAINID_EFFECTS: /nowhere/at/all is not a folder'):
        parse_effects(['headwind:speed=1'])


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('x = 1', r'bad\.py: must define EFFECT = EffectKind'),
        ('EFFECT = 3', r'bad\.py: must define EFFECT = EffectKind'),
        ('1 / 0', r'bad\.py: cannot be loaded: ZeroDivisionError: division by zero'),
        ('def', r'bad\.py: cannot be loaded: SyntaxError'),
        (USERS.replace('leaves', 'headwind'), r'bad\.py: effect headwind already exists'),
        (USERS.replace("amplitude='value'", "amplitude='size'"), r"bad\.py: .*amplitude = 'size' is not one of"),
        (
            USERS.replace('parameters={', "parameters={'depth': Parameter('mm'), "),
            r"bad\.py: .*effect leaves: parameter depth needs search=.* its unit is 'mm'",
        ),
        (
            USERS.replace('parameters={', "parameters={'depth': Parameter('mm', search=(0.0, 9.0), grid='log'), "),
            r'bad\.py: .*effect leaves: parameter depth: search of a log grid must begin above 0',
        ),
        (USERS.replace("amplitude='value'", "amplitude='value', neutral=-1.0"), r'bad\.py: .*neutral = -1 is outside'),
    ],
)
def test_an_invalid_user_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    (tmp_path / 'bad.py').write_text(text, encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    with pytest.raises(InputError, match=re.escape(str(tmp_path)) + '.*' + message):
        check_effects([Effect('headwind', (('speed', 1.0),))])


@pytest.mark.parametrize(
    ('body', 'reason'),
    [
        ('1 / 0', 'its resistance cannot be evaluated: ZeroDivisionError: division by zero'),
        ('None', 'its resistance cannot be evaluated: TypeError'),
        ('float("inf")', 'its resistance = inf N/kN at .* m/s must be finite'),
    ],
)
def test_an_effect_of_a_user_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, reason: str
) -> None:
    (tmp_path / 'leaves.py').write_text(USERS.replace("p['value'] + davis.a", body), encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    with pytest.raises(InputError, match=f'effect leaves: {reason}'):
        extra_resistance('leaves:value=2')

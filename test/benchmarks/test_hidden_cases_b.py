# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hidden_cases_b import LIBRARY, NEAR, OUTSIDE, PAIRS, SENSOR_EXTRA, make_case
from benchmarks.hidden_cases_b.case import balance_residual, draw_instruments
from benchmarks.hidden_cases_b.motion import NEUTRAL
from benchmarks.hidden_cases_b.scene import Wish, draw_scene, drive
from test.benchmarks.usable_case import aligned_share, check_usable
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import parse_train_file


def test_names_are_in_the_library_or_outside_effects() -> None:
    assert set(LIBRARY) | set(SENSOR_EXTRA) <= set(EFFECTS)
    assert not set(OUTSIDE) & set(EFFECTS)
    assert set(NEAR) <= set(OUTSIDE)
    assert {name for names in NEAR.values() for name in names} <= set(EFFECTS)


def test_equal_names_and_seeds_give_equal_cases() -> None:
    assert make_case('local_drag', 5) == make_case('local_drag', 5)
    assert make_case('local_drag', 5).bags != make_case('local_drag', 6).bags


def test_residual_is_small_without_hidden_effects() -> None:
    for seed in range(4):
        scene = draw_scene(seed, Wish())
        log = drive(scene, NEUTRAL)
        kit = draw_instruments(np.random.default_rng(seed), scene, NEUTRAL)
        residual = balance_residual(scene, NEUTRAL, kit, log)[log[:, 2] > 1.0]
        assert abs(np.mean(residual)) < 0.06
        assert np.median(np.abs(residual)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    'name',
    [
        *('none', *LIBRARY),
        *(pytest.param(name, marks=pytest.mark.long) for name in (*SENSOR_EXTRA, *OUTSIDE, *PAIRS[::5])),
    ],
)
def test_every_name_gives_usable_data(name: str) -> None:
    case = make_case(name, 77)
    check_usable(case, name)
    least = 0.45 if '10_hz' in case.answer.flags else 0.95
    assert aligned_share(case) > least


@pytest.mark.slow
def test_gradient_topic_equals_the_map_under_the_train() -> None:
    seen = 0
    for seed in range(16):
        case = make_case('none', seed)
        assumed = parse_train_file(case.train_yaml, 'assumed train file')
        if not assumed.line.gradient or 'point_gradient' in case.answer.flags or not case.answer.one_way:
            continue
        seen += 1
        profile = LineProfile(assumed.line, assumed.train.length)
        speeds = [record for record in case.bags[0] if isinstance(record, SpeedRecord)]
        slopes = [record for record in case.bags[0] if isinstance(record, GradientRecord)]
        times = [record.stamp_ns for record in slopes]
        places = np.interp(times, [record.stamp_ns for record in speeds], [record.position for record in speeds])
        apart = [profile.gradient(at, 1) - slope.gradient for at, slope in zip(places.tolist(), slopes, strict=True)]
        assert np.median(np.abs(apart)) < 0.3
        if seen == 2:
            break
    assert seen


@pytest.mark.parametrize(('effect', 'fitted'), [('tunnel_drag', 2.0), ('mass_error', 1.1), ('local_drag', 3.0)])
def test_residual_has_the_form_and_size_of_the_hidden_effect(effect: str, fitted: float) -> None:
    """The residual of the assumed balance follows the equation of the effect, with the hidden size."""
    quirk = {'tunnel_drag': 'bore_gain', 'mass_error': 'heavy', 'local_drag': 'rub'}[effect]
    wish = Wish(tunnels=True)
    scene = draw_scene(11, wish)
    low, high = scene.ground.stops[0], scene.ground.stops[-1]
    quirks = NEUTRAL._replace(**{quirk: fitted, 'rub_from': low, 'rub_to': high})
    log = drive(scene, quirks)
    kit = draw_instruments(np.random.default_rng(11), scene, quirks)
    residual, speed = balance_residual(scene, quirks, kit, log), log[:, 2]
    stock, ground = scene.stocks[0], scene.ground
    dark = ground.mean_under(ground.bore, log[:, 1], log[:, 3], stock.length)
    rise = 1000.0 / 9.81 * (1.0 + stock.gamma) * np.gradient(speed, 0.1)
    columns = {
        'tunnel_drag': stock.c * dark * speed**2,
        'mass_error': rise + stock.a + stock.b * speed + stock.c * speed**2,
        'local_drag': np.ones_like(speed),
    }
    # Far enough inside the line that the entire train is on it.
    inside = (speed > 3.0) & (np.minimum(log[:, 1] - low, high - log[:, 1]) > stock.length)
    column, neutral = columns[effect][inside], 1.0 if effect != 'local_drag' else 0.0
    size = float(column @ residual[inside] / (column @ column))
    assert size == pytest.approx(fitted - neutral, rel=0.15)


def test_force_follows_the_brake_command() -> None:
    together = []
    for seed in range(4):
        bag = make_case('none', seed).bags[0]
        forces = [record for record in bag if isinstance(record, ForceRecord)]
        brakes = [record for record in bag if isinstance(record, BrakeRecord)]
        a_second_ago = [record.stamp_ns - 10**9 for record in forces]
        commands = [record.target_acceleration for record in brakes]
        command = np.interp(a_second_ago, [record.stamp_ns for record in brakes], commands)
        pressed = command < -0.02
        together.append(np.corrcoef(command[pressed], np.array([record.force for record in forces])[pressed])[0, 1])
    assert np.median(together) > 0.8

# SPDX-License-Identifier: Apache-2.0
"""``trainid fit``: the agreed JSON, parts of a bag, exit codes; with ``--brake`` a section that a train file takes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test.cli.conftest import Change
from trainid_ros.brake_rate.brake_fit import DEAD_TIME, LAG, RESPONSE, BrakeFit, Quantity
from trainid_ros.cli.fit import describe, etcs_brake, fitted_brake, to_json
from trainid_ros.cli.main import main
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import Brake, parse_train_file

KEYS = {'a', 'b', 'c', 'std', 'iterations', 'mse', 'converged', 'speed_range'}
HEAD = 'train: {mass: 194e3}\nresistance: {a: 1.0, b: 0.0, c: 0.0}\n'
STATED = Brake(delay=0.6, time_constant=0.4)
TRAIN = replace(parse_train_file(HEAD, 'made'), brake=STATED)
FIT = BrakeFit(
    quantities=(
        Quantity(DEAD_TIME, 0.8, 0.03, 's', 0.6, 0.1),
        Quantity(LAG, 1.2, 0.05, 's', 0.4, 0.06),
        Quantity(RESPONSE, 2.0, 0.02, 's', 1.0, 0.12),
        Quantity('rate at 2.0 m/s', 0.8, 0.02, '1', 1.0, 0.2),
        Quantity('rate at 16.0 m/s', 1.08, 0.01, '1', 1.0, 0.2),
    ),
    lags=(1.0, 0.66),
    knots=(2.0, 16.0),
    rates=np.array([0.8, 1.08]),
    covariance=np.diag([0.02**2, 0.01**2]),
    scatter=0.03,
    jitter=0.04,
    speed_range=(2.0, 16.0),
    brakings=20,
    models=(('1 lag, 1 rate', -8.0), ('2 lags, 2 rates', 0.0)),
)


def call(bag: Path, *options: str, train: Path | None = None) -> int:
    return main(['fit', str(bag), '--train', str(train or bag / 'train.yaml'), *options])


def test_json_has_the_agreed_fields_and_plausible_values(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag, '--json') == 0
    out, err = capsys.readouterr()
    answer: dict[str, Any] = json.loads(out)
    assert (out.count('\n'), err) == (1, '')
    assert set(answer) == KEYS
    assert answer['converged'] is True
    assert len(answer['std']) == 3
    slow, fast = answer['speed_range']
    assert 0.0 < slow < 8.0
    assert 12.0 < fast < 25.0
    v = 0.5 * (slow + fast)
    w = answer['a'] + v * (answer['b'] + answer['c'] * v)
    assert w == pytest.approx(1.5 + 0.02 * v + 0.001 * v * v, abs=1.0)


def test_summary_shows_parameters_and_noise(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag) == 0
    out = capsys.readouterr().out
    assert all(text in out for text in ('N/kN per (m/s)^2', 'w at ', 'speed noise', 'iterations', '1 pieces'))


def test_a_part_without_motion_gives_no_answer(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag, '--duration', '0.8', '--json') == 1
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert set(answer) == KEYS
    assert (answer['a'], answer['std']) == (None, [None] * 3)
    assert ('too few to fit' in err, err.count('\n')) == (True, 1)


def test_a_part_changes_the_fit(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = []
    for options in ((), ('--start', '0', '--duration', '1e4'), ('--duration', '30'), ('--start', '25')):
        assert call(driven_bag, '--json', *options) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]
    assert answers[2]['a'] != answers[0]['a'] != answers[3]['a']


@pytest.mark.parametrize('options', [('--start', '999'), ('--duration', '0')])
def test_a_part_outside_the_bag_is_bad_input(
    driven_bag: Path, options: tuple[str, ...], one_error: Callable[[], str]
) -> None:
    assert call(driven_bag, *options) == 2
    assert options[0] in one_error()


def test_a_missing_topic_or_train_is_bad_input(driven_bag: Path, changed: Change, one_error: Callable[[], str]) -> None:
    blind = changed(lambda record: None if isinstance(record, GradientRecord) else record)
    assert call(blind, train=driven_bag / 'train.yaml') == 2
    assert 'ato/gradient' in one_error()
    assert call(driven_bag, train=driven_bag / 'none.yaml') == 2
    assert 'none.yaml' in one_error()


def test_forces_in_kn_give_no_answer(driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str]) -> None:
    path = changed(lambda item: replace(item, force=1e-3 * item.force) if isinstance(item, ForceRecord) else item)
    assert call(path, '--json', train=driven_bag / 'train.yaml') == 1
    out, err = capsys.readouterr()
    assert json.loads(out)['a'] is None
    assert ('ato/force is in kN' in err, err.count('\n')) == (True, 1)


@pytest.mark.parametrize('value', ['-1', 'x', 'nan'])
def test_times_must_be_numbers(driven_bag: Path, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        call(driven_bag, '--start', value)
    assert caught.value.code == 2
    assert 'must be a number' in capsys.readouterr().err


def test_a_bag_gives_section_and_json(driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'brake.yaml'
    assert call(driven_bag, '--brake', '--etcs', '--out', str(out), '--json') == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    brake = parse_train_file(HEAD + out.read_text('utf-8'), 'made').brake
    assert answer['brake'] == {
        'rate': brake.rate, 'delay': brake.delay, 'time_constant': brake.time_constant, 'timing_std': brake.timing_std,
    }  # fmt: skip
    assert set(answer['std']) == {'rate', 'delay', 'time_constant'}
    told = {one['name']: one for one in answer['quantities']}
    response = told['response time']
    assert abs(response['value'] - 1.0) < 4.0 * response['std']
    assert response['std'] < 0.5
    assert answer['brakings'] >= 1
    assert len(answer['etcs']['decelerations']) == 1
    # It may be written over, another file may not.
    out.write_text('mine\n', encoding='utf-8')
    assert call(driven_bag, '--brake', '--out', str(out)) == 2


def test_without_a_braking_there_is_no_answer(
    driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(lambda item: replace(item, target_acceleration=0.0) if isinstance(item, BrakeRecord) else item)
    assert call(path, '--brake', '--json', train=driven_bag / 'train.yaml') == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {'brake': None, 'std': None, 'quantities': [], 'brakings': 0}
    assert 'no braking' in err.splitlines()[-1]


def test_without_a_rate_there_are_no_brake_parameters(
    driven_bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unsure = replace(FIT, quantities=tuple(replace(one, value=one.stated, std=0.4) for one in FIT.quantities))
    monkeypatch.setattr('trainid_ros.cli.fit.fit_brake', lambda *_: unsure)
    assert call(driven_bag, '--brake', '--etcs', '--json') == 1
    out, err = capsys.readouterr()
    assert json.loads(out)['brake'] is None
    assert '--etcs: 20 brakings cannot tell the rate of the brake' in err
    assert call(driven_bag, '--brake') == 0


def test_the_reason_is_named_where_no_command_can_be_used(
    driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(lambda item: replace(item, emergency=True) if isinstance(item, BrakeRecord) else item)
    assert call(path, '--brake', train=driven_bag / 'train.yaml') == 1
    assert 'no braking from a released brake was found (most often rejected: BRAKE' in capsys.readouterr().err


@pytest.mark.parametrize('options', [('--etcs',), ('--out', 'x.yaml'), ('BAG',), ('BAG', '--brake')])
def test_options_that_do_not_go_together(
    driven_bag: Path, options: tuple[str, ...], one_error: Callable[[], str]
) -> None:
    given = [str(driven_bag) if option == 'BAG' else option for option in options]
    assert main(['fit', str(driven_bag), *given, '--train', str(driven_bag / 'train.yaml')]) == 2
    assert ('given twice' if '--brake' in options else 'only with --brake') in one_error()


def test_the_section_of_a_table_reads_back() -> None:
    text = describe(FIT, fitted_brake(FIT, TRAIN), 'a bag', etcs_brake(FIT, 1.1))
    brake = parse_train_file(HEAD + text, 'made').brake
    assert brake.rate_table == ((2.0, 0.8), (16.0, 1.08))
    assert (brake.delay, brake.time_constant) == (0.8, 1.2)
    # The scatter of the response counts for single brakings.
    assert brake.timing_std == pytest.approx(math.hypot(0.03, 0.04) / math.hypot(0.8, 0.67), rel=1e-3)
    assert 'two lags of 1 and 0.66 s' in text
    assert to_json(FIT, brake, TRAIN, None)['std'] == {'rate': [0.02, 0.01], 'delay': 0.03, 'time_constant': 0.05}


def test_stated_drops_stay() -> None:
    brake = replace(STATED, loss_per_hour=0.5, loss=0.1, loss_confidence=0.9)
    text = describe(FIT, fitted_brake(FIT, replace(TRAIN, brake=brake)), 'a bag', None)
    read = parse_train_file(HEAD + text, 'made').brake
    assert (read.loss_per_hour, read.loss, read.loss_confidence) == (0.5, 0.1, 0.9)


def test_what_is_not_told_stays_with_its_standard_deviation() -> None:
    unsure = replace(FIT, quantities=tuple(replace(one, value=one.stated, std=0.4) for one in FIT.quantities))
    brake = fitted_brake(unsure, TRAIN)
    assert brake == STATED
    delay_std, lag_std = STATED.timing_stds
    stds = {'rate': BrakeRateConfig().prior_std, 'delay': delay_std, 'time_constant': lag_std}
    assert to_json(unsure, brake, TRAIN, None)['std'] == stds


def test_times_that_agree_are_not_replaced_by_less_accurate_ones() -> None:
    surer = replace(TRAIN, brake=replace(STATED, timing_std=0.01))
    agreeing = replace(FIT, quantities=tuple(replace(one, value=one.stated) for one in FIT.quantities))
    assert fitted_brake(agreeing, surer).timing_std == 0.01


def test_effects_stay_and_so_does_the_table_beyond_the_speeds_braked_at() -> None:
    late = replace(TRAIN, effects=parse_effects(['brake_delay:extra=0.3']))
    assert fitted_brake(FIT, late).delay == pytest.approx(0.5)
    table = ((1.0, 1.0), (10.0, 1.0), (20.0, 0.5), (30.0, 0.5))
    brake = fitted_brake(FIT, replace(TRAIN, brake=replace(STATED, rate_table=table)))
    # At 16 m/s the file states .7 and the fit 1.08.
    assert brake.rate_table == ((1.0, 0.8), (2.0, 0.8), (16.0, 1.08), (20.0, 0.7714), (30.0, 0.7714))


def test_ertms_parameters_are_safe_steps() -> None:
    etcs = etcs_brake(FIT, 1.1)
    edges = [2.0, *etcs.upper_speeds, 16.0]
    assert len(etcs.decelerations) == 7
    # Each step is no stronger than the brake anywhere within it.
    for low, deceleration in zip(edges, etcs.decelerations, strict=False):
        assert deceleration == pytest.approx(1.1 * (0.8 + 0.02 * (low - 2.0)))
    # 95 % of the effort after three time constants: dead time and half of them.
    assert etcs.build_up_s == pytest.approx(0.8 + 1.5 * 1.2, abs=0.01)
    factors = [etcs.kdry_rst[key][0] for key in ('50.0%', '90.0%', '99.0%', '99.9%')]
    assert factors == sorted(factors, reverse=True)
    assert factors[0] == 1.0
    # Of one braking: t of 20 brakings times mean error and scatter.
    assert factors[2] == pytest.approx(1.0 - 2.528 * math.hypot(0.02, 0.03) / 0.8, abs=0.011)

# SPDX-License-Identifier: Apache-2.0
"""Every setting is a parameter, and every parameter reaches its configuration."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.errors import InputError, setting_info
from trainid_ros.setup.parameter_specs import (
    TAKEN,
    build_settings,
    build_train_file,
    estimator_parameters,
    validate_overrides,
)
from trainid_ros.setup.params_file import find_mismatch, parameter_file, params_files, read_overrides
from trainid_ros.setup.pipelines import RESISTANCE, EstimatorSettings
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.train_file import parse_train_file

SPECS = {spec.name: spec for spec in estimator_parameters(RESISTANCE)}
DEFAULTS = {name: spec.default for name, spec in SPECS.items()}
CONFIG = Path(__file__).parents[2] / 'config' / 'params.yaml'


def test_the_defaults_are_those_of_the_core() -> None:
    assert build_settings(DEFAULTS, RESISTANCE, 'resistance') == EstimatorSettings()


@pytest.mark.parametrize(('prefix', 'config'), [('alignment.', AlignmentConfig), ('estimator.', FilterBankConfig)])
def test_every_setting_is_a_parameter_with_unit_and_range(prefix: str, config: type) -> None:
    for item in fields(config):
        info = setting_info(item)
        assert info is not None
        spec = SPECS[prefix + item.name]
        assert (spec.low, spec.high) == (info.low, info.high)
        assert f'{info.description} [{info.unit}]' in spec.description
        assert 'next configure' in spec.description


def test_values_reach_the_settings() -> None:
    values = DEFAULTS | {
        'alignment.max_lag': 0.3,
        'estimator.hypotheses': 40,
        'stale_after': 2.0,
        'seed': 7,
        'time_jump_policy': 'refuse',
    }
    settings = build_settings(values, RESISTANCE, 'resistance')
    assert settings.resistance == RESISTANCE.choose('filter-bank', hypotheses=40)
    assert (settings.alignment.max_lag, settings.seed) == (0.3, 7)
    assert (settings.pipeline.stale_after, settings.pipeline.time_jump_policy) == (2.0, TimeJumpPolicy.REFUSE)


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('estimator.step_share_c', 'abc', "estimator.step_share_c = 'abc' must be a number"),
        ('estimator.step_share_c', True, 'estimator.step_share_c = True must be a number'),
        ('estimator.step_share_c', float('nan'), 'estimator.step_share_c = nan is outside'),
        ('estimator.step_share_c', float('inf'), 'estimator.step_share_c = inf is outside'),
        ('estimator.step_share_c', 0.0001, r'estimator.step_share_c = 0.0001 is outside \[0.001, 10\]'),
        ('estimator.hypotheses', 30.0, 'estimator.hypotheses = 30.0 must be a whole number'),
        ('train_file', 3, 'train_file = 3 must be a string'),
        ('autostart', 1, 'autostart = 1 must be true or false'),
        ('checkpoint_period', 1e-6, 'checkpoint_period = 1e-06 must be 0 or at least 0.1'),
        ('checkpoint_period', 4000.0, r'checkpoint_period = 4000 is outside \[0, 3600\]'),
        ('checkpoint_period', -1.0, r'checkpoint_period = -1 is outside'),
        ('time_jump_policy', 'panic', "time_jump_policy = 'panic' must be one of reset, ignore, refuse"),
    ],
)
def test_invalid_values_are_rejected_by_name(name: str, value: object, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        SPECS[name].coerce(value)


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        *(('checkpoint_period', value) for value in (0.0, 0.1, 3600.0)),  # off, or ten times a second at most
        ('train.mass', 194000),  # a whole number for a float
        *(('estimator.step_share_c', value) for value in (0.001, 10.0)),  # bounds are inclusive
    ],
)
def test_permitted_values_are_accepted_as_floats(name: str, value: float) -> None:
    found = SPECS[name].coerce(value)
    assert (found, type(found)) == (value, float)


def test_the_train_file_applies_where_no_parameter_is_given() -> None:
    base = parse_train_file('train: {mass: 1000.0}\nresistance: {a: 1.0, b: 0.0, c: 0.1}\n', 'x')
    values = DEFAULTS | {'train.mass': 2000.0, 'brake.delay': 1.5}
    merged = build_train_file(values, frozenset({'brake.delay'}), base)
    assert (merged.train.mass, merged.brake.delay, merged.resistance) == (1000.0, 1.5, base.resistance)


def test_without_a_train_file_the_missing_parameters_are_named() -> None:
    with pytest.raises(InputError, match=r'give the parameter train_file, or resistance\.b, resistance\.c'):
        build_train_file(DEFAULTS, frozenset({'train.mass', 'resistance.a'}), None)
    given = frozenset({'train.mass', 'resistance.a', 'resistance.b', 'resistance.c'})
    with pytest.raises(InputError, match=r'train\.mass = 0 kg must be > 0'):
        build_train_file(DEFAULTS, given, None)
    assert build_train_file(DEFAULTS | {'train.mass': 5e4}, given, None).train.mass == 5e4


def test_config_params_yaml_is_up_to_date() -> None:
    assert CONFIG.read_text(encoding='utf-8') == parameter_file(), (
        'run: python -m trainid_ros.setup.params_file > config/params.yaml'
    )


def test_the_parameter_file_is_yaml_with_every_default() -> None:
    section = yaml.safe_load(parameter_file())['/**/resistance_estimator']['ros__parameters']
    for name, spec in SPECS.items():
        node = section
        if name.split('.')[0] in ('train', 'resistance', 'brake', 'line'):
            assert name.split('.')[0] not in section  # commented out: the train file applies
            continue
        if spec is TAKEN:
            assert name not in section
            continue
        for part in name.split('.'):
            node = node[part]
        # YAML 1.1 has no 1e-05: such a number would be read as a string.
        assert spec.coerce(node) == spec.default


@pytest.mark.parametrize(
    ('section', 'node', 'usual', 'certain'),
    [
        ('resistance_estimator', '/resistance_estimator', 'resistance_estimator', None),
        ('/**', '/a/b/resistance_estimator', 'resistance_estimator', None),
        ('/**/resistance_estimator', '/resistance_estimator', 'resistance_estimator', None),
        ('/*/resistance_estimator', '/t1/resistance_estimator', 'resistance_estimator', None),
        ('/*/resistance_estimator', '/resistance_estimator', 'resistance_estimator', True),
        ('resistance_estimator', '/t1/resistance_estimator', 'resistance_estimator', True),
        ('resistence_estimator', '/resistance_estimator', 'resistance_estimator', True),
        ('resistance_estimator', '/renamed', 'resistance_estimator', True),
        ('camera', '/resistance_estimator', 'resistance_estimator', False),
    ],
)
def test_sections_that_do_not_match_the_node_are_found(
    tmp_path: Path, section: str, node: str, usual: str, certain: bool | None
) -> None:
    path = tmp_path / 'p.yaml'
    path.write_text(f'{section}:\n  ros__parameters: {{seed: 1}}\n', encoding='utf-8')
    found = find_mismatch(path, node, usual)
    assert (found if found is None else found[1]) is certain


def test_nested_sections_match_and_other_arguments_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / 'p.yaml'
    path.write_text('t1:\n  gsma:\n    ros__parameters: {seed: 1}\n', encoding='utf-8')
    assert find_mismatch(path, '/t1/gsma', 'gsma') is None
    assert params_files(['--ros-args', '--params-file', str(path), '-p', 'a:=b']) == (path,)


NUMBERS = st.one_of(st.floats(), st.integers(-(2**63), 2**63 - 1))


@settings(deadline=None, max_examples=300)
@given(st.sampled_from(sorted(SPECS)), st.one_of(NUMBERS, st.booleans(), st.text(), st.lists(st.integers())))
def test_a_value_is_accepted_or_named_with_what_is_allowed(name: str, value: object) -> None:
    spec = SPECS[name]
    given_values, problems = validate_overrides({name: value}, SPECS, ())
    assert set(given_values) | set(problems) == {name}
    if name in problems:
        assert problems[name].startswith(f'{name} = ')
        assert any(word in problems[name] for word in (' must be ', f' is outside [{spec.low:g}, {spec.high:g}]'))
    elif isinstance(spec.default, float):
        assert spec.low <= given_values[name] <= spec.high  # type: ignore[operator]
        build_settings(DEFAULTS | given_values, RESISTANCE, 'resistance')


@pytest.mark.parametrize('text', ['{a: ' * 2000 + '}' * 2000, '[' * 2000, '- ' * 2000])
def test_a_file_nested_too_deep_is_one_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(text, encoding='utf-8')
    assert find_mismatch(path, '/x', 'x') is None  # ROS reports it
    with pytest.raises(
        InputError, match=f'^{path}: line 1, column [0-9]+ is not valid YAML: nested more than 100 deep$'
    ):
        read_overrides(path, '/x')

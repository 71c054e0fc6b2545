# SPDX-License-Identifier: Apache-2.0
"""Every setting is a parameter that reaches its configuration; a file gives the same off line as in the nodes."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.errors import InputError, setting_info
from trainid_ros.setup.params_file import (
    TAKEN,
    Setup,
    build_settings,
    build_train_file,
    check_sections,
    estimator_parameters,
    mapping_in,
    node_setups,
    parameter_file,
    params_files,
    read_overrides,
    validate_overrides,
)
from trainid_ros.setup.pipelines import KINDS, RESISTANCE, EstimatorSettings
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.train_file import parse_train_file

TRAIN = parse_train_file('train: {mass: 1000.0}\nresistance: {a: 1.0, b: 0.0, c: 0.1}\n', 'x')
NODE = '/resistance_estimator'


def write(folder: Path, text: str) -> Path:
    path = folder / 'params.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def setups(folder: Path, text: str, *algorithms: str, namespace: str = '/') -> dict[str, Setup]:
    warnings: list[str] = []
    made = node_setups(TRAIN, 'x', write(folder, text), algorithms, namespace=namespace, warn=warnings.append)
    return {setup.kind.name: setup for setup in made}


def test_without_a_file_all_settings_are_defaults() -> None:
    for setup in node_setups(TRAIN, 'x'):
        assert (setup.train_file, setup.settings) == (TRAIN, EstimatorSettings())
        assert setup.algorithm == setup.kind.algorithms.default


def test_values_that_a_dump_took_from_a_train_file_give_way_to_those_of_this_one(tmp_path: Path) -> None:
    text = """
        /**: {ros__parameters: {train.mass: 2000.0, resistance.a: 7.0, brake.rate: 0.9,
                                taken_from_train_file: 'train.mass=2000.0 resistance.a=6.0'}}
    """
    # The a was changed after the dump, the brake rate was given from the start.
    for setup in setups(tmp_path, text).values():
        train_file = setup.train_file
        assert (train_file.train.mass, train_file.resistance.a, train_file.brake.rate) == (1000.0, 7.0, 0.9)


def test_each_node_gets_its_own_section_over_the_common_one(tmp_path: Path) -> None:
    text = """
        /**: {ros__parameters: {seed: 7, alignment: {max_lag: 0.5}}}
        speed_model_estimator: {ros__parameters: {train.mass: 2000, stale_after: 2}}
        /**/brake_rate_estimator: {ros__parameters: {seed: 9, estimator: {drift: 1e-03}}}
    """
    made = setups(tmp_path, text)
    assert {field: setup.settings.seed for field, setup in made.items()} == {
        'resistance': 7,
        'speed_model': 7,
        'brake_rate': 9,
    }
    assert all(setup.settings.alignment.max_lag == 0.5 for setup in made.values())
    assert [setup.train_file.train.mass for setup in made.values()] == [1000.0, 2000.0, 1000.0]
    assert made['speed_model'].settings.pipeline.stale_after == 2.0
    assert getattr(made['brake_rate'].settings.brake_rate.config, 'drift') == 0.001  # noqa: B009 - of any algorithm
    assert made['resistance'].settings.resistance == EstimatorSettings().resistance


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        (
            '/**: {ros__parameters: {alignment.perod: 0.3}}',
            'resistance_estimator: not configured: '
            "unknown parameter 'alignment.perod': did you mean 'alignment.period'?",
        ),
        ('/**: {ros__parameters: {stale_after: 1000}}', 'stale_after = 1000 is outside'),
        ('/**: {ros__parameters: {stale_after: soon}}', "stale_after = 'soon' must be a number"),
        ('/**: {ros__parameters: {seed: .nan}}', 'seed = nan must be a whole number'),
        ('brake_rate_estimator: {ros__parameters: {algorithm: V-MILS}}', "algorithm = 'V-MILS' must be one of GSMA"),
        ('resistence_estimator: {ros__parameters: {seed: 1}}', "section '/resistence_estimator' does not apply"),
        ('resistance_estimator: {seed: 1}', 'params.yaml: is not a parameter file'),
        ('a: [', 'params.yaml: line 2, column 1 is not valid YAML'),
        ('resistance_estimator: {ros__parameters: 5}', 'ros__parameters of /resistance_estimator must map names to'),
        ('? [1, 2]\n: {ros__parameters: {seed: 1}}', 'a key of it is not a name (line 1)'),
        ('/**: {ros__parameters: {? {a: 1} : 3}}', 'is not a parameter file: a key of it is not a name (line 1)'),
    ],
)
def test_errors_that_a_node_reports_are_raised(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(InputError) as caught:
        setups(tmp_path, text)
    assert reason in str(caught.value)


def test_parameters_of_ros_itself_are_accepted(tmp_path: Path) -> None:
    text = """
        /**: {ros__parameters: {use_sim_time: true, autostart: true,
                                qos_overrides: {/t1/ato/speed: {subscription: {depth: 9}}}}}
    """
    assert setups(tmp_path, text, namespace='t1')['resistance'].settings == EstimatorSettings()
    with pytest.raises(InputError, match=r'qos_overrides\./t1/ato/speed\.subscription\.depth'):
        setups(tmp_path, text)


def test_qos_of_the_outputs_of_other_nodes_is_accepted(tmp_path: Path) -> None:
    """Nodes of one process are given the parameters of all."""
    text = '/**: {ros__parameters: {qos_overrides: {/trainid/speed_model: {publisher: {deadline: 5000000000}}}}}'
    assert setups(tmp_path, text)['resistance'].settings == EstimatorSettings()


def test_qos_of_topics_of_the_mapping_may_be_in_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, '/**: {ros__parameters: {qos_overrides: {/odo: {subscription: {depth: 7}}}}}')
    assert len(node_setups(TRAIN, 'x', path, foreign=('/odo', 'force'))) == len(KINDS)
    with pytest.raises(InputError, match='unknown parameter'):
        node_setups(TRAIN, 'x', path)


def test_the_mapping_file_of_the_nodes_is_that_of_a_replay(tmp_path: Path) -> None:
    assert mapping_in(None) is None
    assert mapping_in(write(tmp_path, '/**: {ros__parameters: {}}')) is None
    assert mapping_in(write(tmp_path, '/t1/**: {ros__parameters: {mapping_file: m.yaml}}'), '/t1') == Path('m.yaml')
    with pytest.raises(InputError, match=r"nodes with different mapping_file \('', 'm.yaml'\): give --map"):
        mapping_in(write(tmp_path, '/resistance_estimator: {ros__parameters: {mapping_file: m.yaml}}'))


def test_a_file_without_a_section_for_a_node_gives_a_warning(tmp_path: Path) -> None:
    warnings: list[str] = []
    path = write(tmp_path, 'resistance_estimator: {ros__parameters: {seed: 3}}')
    made = node_setups(TRAIN, 'x', path, warn=warnings.append)
    assert [setup.settings.seed for setup in made] == [3, 1, 1]
    assert all('no section for' in line for line in warnings)
    assert len(warnings) == 2


def test_a_train_file_out_of_range_is_named_with_its_value() -> None:
    wide = replace(TRAIN, brake=replace(TRAIN.brake, time_constant=500.0))
    with pytest.raises(InputError, match=r'x\.yaml: brake\.time_constant = 500 is outside'):
        node_setups(wide, 'x.yaml')


@pytest.mark.parametrize(
    ('scalar', 'value'),
    [
        ('1e-05', 1e-5),
        ('010', 8),
        ('0x19', 25),
        ('+5', 5),
        ('1.', 1.0),
        ('-.inf', -math.inf),
        ('on', True),
        ('N', False),
        ("'3'", '3'),
        ('"on"', 'on'),
        ('1_000', '1_000'),
        ('12:30', '12:30'),
        ('~', '~'),
        ('1e400', '1e400'),
        ('[1, 2.5]', [1, 2.5]),
        ('99999999999999999999', 1e20),
    ],
)
def test_scalars_are_read_as_ros_reads_them(tmp_path: Path, scalar: str, value: object) -> None:
    found = read_overrides(write(tmp_path, f'/**: {{ros__parameters: {{x: {scalar}}}}}'), NODE)['x']
    assert (found, type(found)) == (value, type(value))


def test_the_last_of_several_matching_sections_wins(tmp_path: Path) -> None:
    text = """
        resistance_estimator: {ros__parameters: {x: 1, y: 1, a.b: 1}}
        /**/resistance_estimator: {ros__parameters: {x: 2, a: {b: 2, c: 2}}}
        /*: {ros__parameters: {x: 3}}
        /other: {ros__parameters: {x: 4}}
    """
    assert read_overrides(write(tmp_path, text), NODE) == {'x': 3, 'y': 1, 'a.b': 2, 'a.c': 2}
    assert read_overrides(write(tmp_path, text), '/t1/resistance_estimator') == {'x': 2, 'a.b': 2, 'a.c': 2}
    assert read_overrides(write(tmp_path, ''), NODE) == {}


def test_an_algorithm_of_the_command_line_overrides_that_of_the_file(tmp_path: Path) -> None:
    text = '/**/resistance_estimator: {ros__parameters: {algorithm: none}}\n/**: {ros__parameters: {seed: 2}}\n'
    made = setups(tmp_path, text, 'resistance=V-MILS')
    assert (made['resistance'].algorithm, made['resistance'].settings.seed) == ('V-MILS', 2)


@pytest.mark.parametrize(
    ('text', 'named'),
    [
        ('ros__parameters: {seed: 1}', 'the root'),
        (
            '\n'.join(f's{i}: {{ros__parameters: {{}}}}' for i in range(5000)),
            f'{", ".join(f"/s{i}" for i in range(10))} and 4990 more',
        ),
    ],
    ids=['root', 'many'],
)
def test_sections_that_do_not_match_are_named(tmp_path: Path, text: str, named: str) -> None:
    path = write(tmp_path, text)
    reason = f"{path}: no section for '/resistance_estimator'; its sections are {named}"
    warnings: list[str] = []
    check_sections(path, NODE, 'resistance_estimator', warnings.append)
    assert warnings == [reason]


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
    path, found = write(tmp_path, f'{section}:\n  ros__parameters: {{seed: 1}}\n'), []
    try:
        check_sections(path, node, usual, lambda _: found.append(False))
    except InputError:
        found.append(True)
    assert found == ([] if certain is None else [certain])


def test_nested_sections_match_and_other_arguments_are_ignored(tmp_path: Path) -> None:
    path = write(tmp_path, 't1:\n  gsma:\n    ros__parameters: {seed: 1}\n')
    check_sections(path, '/t1/gsma', 'gsma', pytest.fail)
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
    path = write(tmp_path, text)
    check_sections(path, '/x', 'x', pytest.fail)  # ROS reports it
    with pytest.raises(
        InputError, match=f'^{path}: line 1, column [0-9]+ is not valid YAML: nested more than 100 deep$'
    ):
        read_overrides(path, '/x')

# SPDX-License-Identifier: Apache-2.0
"""A parameter file gives the same settings off line as in the nodes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.setup.params_file import Setup, find_mismatch, mapping_in, node_setups, read_overrides
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
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
    assert find_mismatch(path, NODE, 'resistance_estimator') == (reason, False)

# SPDX-License-Identifier: Apache-2.0
"""The launch files, run with stand-ins for the launch packages, which are not on PyPI."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from trainid_ros.ros.playback import playback_parameters

ROOT = Path(__file__).parents[2]
PLACES = {
    'launch': ('LaunchDescription',),
    'launch.actions': ('DeclareLaunchArgument', 'IncludeLaunchDescription', 'OpaqueFunction'),
    'launch.launch_description_sources': ('PythonLaunchDescriptionSource',),
    'launch_ros': (),
    'launch_ros.actions': ('LifecycleNode',),
    'launch_ros.parameter_descriptions': ('ParameterValue',),
}


class Part:
    """Any part of a launch description: it keeps its arguments."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given = given
        self.named = named

    def __call__(self, context: dict[str, str]) -> Any:
        """Run an OpaqueFunction."""
        return self.named['function'](context)


class Configuration(Part):
    """Value of a launch argument."""

    def perform(self, context: dict[str, str]) -> str:
        return context[self.given[0]]


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that gives the parts of a launch file in their order, as (kind, part)."""
    for place, names in PLACES.items():
        module = ModuleType(place)
        for name in names:
            setattr(module, name, type(name, (Part,), {}))
        monkeypatch.setitem(sys.modules, place, module)
    substitutions = ModuleType('launch.substitutions')
    substitutions.LaunchConfiguration = Configuration  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, 'launch.substitutions', substitutions)

    def describe(name: str) -> list[tuple[str, Any]]:
        made = runpy.run_path(str(ROOT / 'launch' / f'{name}.launch.py'))['generate_launch_description']()
        return [(type(part).__name__, part) for part in made.given[0]]

    return describe


def values(parts: list[tuple[str, Any]], **given: str) -> dict[str, str]:
    """The values of all arguments, by default or given."""
    declared = [part for kind, part in parts if kind == 'DeclareLaunchArgument']
    return {part.given[0]: part.named.get('default_value') for part in declared} | given


@pytest.mark.parametrize('name', ['trainid', 'replay'])
def test_switches_are_restricted_to_what_is_understood(described: Any, name: str) -> None:
    for kind, part in described(name):
        if kind == 'DeclareLaunchArgument' and part.named.get('default_value') in {'true', 'false'}:
            assert set(part.named['choices']) == {'true', 'false', 'True', 'False', '1', '0'}


@pytest.mark.parametrize(
    ('given', 'reason'),
    [
        *(({'rate': text}, f'rate:={text} must be a number from 0.01 to 1000') for text in ('fast', 'nan', '0', '1e9')),
        ({'bag': 'none'}, 'bag:=none does not exist'),
        ({'train_file': 'none.yaml'}, 'train_file:=none.yaml does not exist'),
        ({'mapping_file': 'none.yaml'}, 'mapping_file:=none.yaml does not exist'),
    ],
    ids=str,
)
def test_a_wrong_argument_is_named_before_anything_starts(described: Any, given: dict[str, str], reason: str) -> None:
    parts = described('replay')
    kinds = [kind for kind, _ in parts]
    check = kinds.index('OpaqueFunction')
    assert not {'IncludeLaunchDescription', 'LifecycleNode'} & set(kinds[:check])
    bag = ROOT / 'bags' / 'tiny'
    right = {'bag': str(bag), 'train_file': str(bag / 'train.yaml'), 'rate': '2.5'}
    assert parts[check][1](values(parts, **right)) == []
    with pytest.raises(RuntimeError, match=re.escape(reason)):
        parts[check][1](values(parts, **(right | given)))


@pytest.mark.usefixtures('described')
def test_the_rates_are_those_of_the_player() -> None:
    (rate,) = (spec for spec in playback_parameters(live=False) if spec.name == 'rate')
    assert runpy.run_path(str(ROOT / 'launch' / 'replay.launch.py'))['RATES'] == (rate.low, rate.high)


@pytest.mark.parametrize(('text', 'expected'), [('true', True), ('True', True), ('1', True), ('0', False)])
def test_the_nodes_get_the_arguments(described: Any, text: str, expected: bool) -> None:
    parts = described('trainid')
    make = dict(parts)['OpaqueFunction']
    nodes = make(values(parts, use_sim_time=text, train_file='t.yaml', mapping_file='m.yaml'))
    assert [node.named['executable'] for node in nodes] == [
        'resistance_estimator',
        'speed_model_estimator',
        'brake_rate_estimator',
    ]
    assert nodes[0].named['parameters'] == [
        {'use_sim_time': expected, 'autostart': True},
        {'train_file': 't.yaml'},
        {'mapping_file': 'm.yaml'},
    ]

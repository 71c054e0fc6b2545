# SPDX-License-Identifier: Apache-2.0
"""Layouts of other viewers name topics and fields that exist, and show every topic."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS

ROOT = Path(__file__).parents[2]
LAYOUTS = ROOT / 'config' / 'layouts'
MESSAGES = ROOT / 'msg_defs' / 'msg'
FIELD = re.compile(r'^([\w/]+) +(\w+) *(?:#.*)?$')
NUMBERS = {'float64', 'bool', 'uint8', 'uint64'}
DIAGNOSTICS = '/diagnostics'


def types() -> dict[str, str]:
    """Return the message of each topic, the longest names first."""
    found = {f'/{topic.name}': topic.message for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)}
    found |= {f'/{topic.last_valid}': topic.message for topic in OUTPUT_TOPICS if topic.last_valid}
    return dict(sorted(found.items(), key=lambda item: -len(item[0])))


def numbers(message: str) -> set[str]:
    """Return the fields of a message that can be plotted; arrays cannot."""
    lines = (MESSAGES / f'{message}.msg').read_text(encoding='utf-8').splitlines()
    return {match[2] for line in lines if (match := FIELD.match(line)) and match[1] in NUMBERS}


def check_path(path: str, separator: str) -> str:
    """Check the path of a number and return its topic."""
    topic = next((name for name in types() if path.startswith(name + separator)), '')
    assert topic, f'{path}: no such topic'
    field = path[len(topic) + 1 :]
    assert field in numbers(types()[topic]), f'{path}: {types()[topic]} has no number {field}'
    return topic


def foxglove() -> dict[str, Any]:
    layout: dict[str, Any] = json.loads((LAYOUTS / 'foxglove.json').read_text(encoding='utf-8'))
    return layout


def paths_of(panel: dict[str, Any]) -> Iterator[str]:
    yield from (item['value'] for item in panel.get('paths', ()))
    if 'topicPath' in panel:
        yield panel['topicPath']


def leaves(tree: Any) -> Iterator[str]:
    if isinstance(tree, str):
        yield tree
    else:
        assert tree['direction'] in {'row', 'column'}
        assert 0 < tree['splitPercentage'] < 100
        yield from leaves(tree['first'])
        yield from leaves(tree['second'])


def curves() -> list[str]:
    root = ElementTree.parse(LAYOUTS / 'plotjuggler.xml').getroot()
    return [item.attrib['name'] for item in root.iter('curve')]


def test_paths_of_foxglove_exist_and_show_every_topic() -> None:
    panels = foxglove()['configById'].values()
    shown = {check_path(path, '.') for panel in panels for path in paths_of(panel)}
    assert shown == set(types())
    assert [panel['topicToRender'] for panel in panels if 'topicToRender' in panel] == [DIAGNOSTICS]


def test_panels_of_foxglove_are_those_of_its_tree() -> None:
    layout = foxglove()
    assert sorted(leaves(layout['layout'])) == sorted(layout['configById'])
    kinds = {name.partition('!')[0] for name in layout['configById']}
    assert kinds == {'Plot', 'StateTransitions', 'DiagnosticSummary', 'RawMessages'}


def test_curves_of_plotjuggler_exist_and_show_every_topic() -> None:
    assert {check_path(name, '/') for name in curves()} == set(types())


def test_splitters_of_plotjuggler_are_whole() -> None:
    root = ElementTree.parse(LAYOUTS / 'plotjuggler.xml').getroot()
    for splitter in root.iter('DockSplitter'):
        assert int(splitter.attrib['count']) == len(splitter) == splitter.attrib['sizes'].count(';') + 1
    assert all(len(plot.findall('curve')) >= 1 for plot in root.iter('plot'))


@pytest.mark.parametrize(
    'path', ['/ato/speed.sped', '/ato/velocity.speed', '/trainid/resistance.covariance', '/ato/speed.header']
)
def test_a_wrong_path_is_found(path: str) -> None:
    with pytest.raises(AssertionError):
        check_path(path, '.')

# SPDX-License-Identifier: Apache-2.0
"""Code and tables of the documents agree with the package."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import fields
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from tools.documents import ROOT, Block, blocks, documents
from trainid_ros.cli.arguments import VERBS
from trainid_ros.client import TrainModel
from trainid_ros.inputs import units as known_units
from trainid_ros.interface.errors import TrainIdError
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS, RESISTANCE_TOPIC
from trainid_ros.interface.results import ResistanceEstimate, Status
from trainid_ros.setup.pipelines import BRAKE_RATE, RESISTANCE, SPEED_MODEL
from trainid_ros.sim.worlds import UNKNOWNS, WORLDS
from trainid_ros.train.effects import EFFECTS, FOLDERS_VARIABLE, Davis, TrackPoint


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding='utf-8')


def titled(page: str, title: str) -> Block:
    (found,) = (block for block in blocks(text_of(page)) if block.title == title)
    return found


def first_cells(page: str) -> set[str]:
    """Return the names in the first cells of all tables of a page."""
    rows = re.findall(r'^\| (`[^|]*`) \|', text_of(page), re.MULTILINE)
    return {name for cell in rows for name in re.findall(r'`([^`]+)`', cell)}


def test_python_examples_compile() -> None:
    found = [(page, block) for page in documents() for block in blocks(page.read_text(encoding='utf-8'))]
    python = [(page, block) for page, block in found if block.language == 'python']
    assert len(python) >= 2
    for page, block in python:
        compile(block.text, f'{page.name}:{block.line}', 'exec')


def test_the_page_of_tables_shows_its_files() -> None:
    texts = {block.text for block in blocks(text_of('docs/tables.md'))}
    file = text_of('config/mappings/logger.yaml')
    assert file.partition('\n')[2] in texts
    head = (ROOT / 'bags' / 'logger.csv').read_text(encoding='latin-1').splitlines(keepends=True)[:4]
    assert ''.join(head) in texts


def test_the_controller_reads_fields_and_topics_that_exist() -> None:
    code = ast.parse(titled('docs/client_reference.md', 'controller.py').text)
    read = {
        node.attr
        for node in ast.walk(code)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == 'w'
    }
    assert read
    assert read <= {'status', *Status.__members__, *(item.name for item in fields(ResistanceEstimate))}
    texts = {node.value for node in ast.walk(code) if isinstance(node, ast.Constant)}
    assert RESISTANCE_TOPIC.last_valid in texts


def test_the_client_answers_after_a_bag(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    page = blocks(text_of('docs/tutorial_autopilot.md'))
    exec(compile(titled('docs/tutorial_autopilot.md', 'ask.py').text, 'ask.py', 'exec'), {})
    assert capsys.readouterr().out == next(block.text for block in page if block.language == 'output')


@pytest.mark.parametrize(
    ('speed', 'gradient', 'to_stop'),
    [
        (20.0, 0.0, 50.0),
        (1.0, 0.0, 0.0),
        (1.0, 0.0, -0.5),
        (5.0, 0.0, -300.0),
        (20.0, -90.0, 50.0),
        (5.0, math.nan, 9.0),
    ],
)
def test_the_autopilot_never_loses_its_brake_command(speed: float, gradient: float, to_stop: float) -> None:
    code = ast.parse(titled('docs/tutorial_autopilot.md', 'autopilot.py').text)
    control = next(node for node in code.body if isinstance(node, ast.FunctionDef))
    model = TrainModel(None, ROOT / 'config' / 'trains' / 'yizhuang.yaml')
    names: dict[str, Any] = {'train': model, 'node': Mock(), 'TrainIdError': TrainIdError}
    exec(compile(ast.Module([control], []), 'autopilot.py', 'exec'), names)
    force, brake = names['control'](speed, gradient, to_stop, 0.5)
    assert force == 0.0
    assert -20.0 < brake <= -0.1


def test_the_methods_of_the_client_are_described() -> None:
    public = {name for name in vars(TrainModel) if not name.startswith('_')} - {
        'from_replay',
        'mark_lost',
        'take_message',
    }
    text = text_of('docs/client_reference.md')
    assert {name for name in public if f'`{name}(' in text} == public


def test_the_new_effect_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'snow.py').write_text(titled('docs/effects.md', 'effects/snow.py').text, encoding='utf-8')
    monkeypatch.setenv(FOLDERS_VARIABLE, str(tmp_path))
    snow = EFFECTS['snow']
    assert snow.resistance is not None
    davis = Davis(1.0, 0.0, 0.001)
    outside = TrackPoint(time_s=0.0, position=0.0, direction=1, speed=10.0)
    inside = TrackPoint(time_s=0.0, position=0.0, direction=1, speed=10.0, tunnel=True)
    assert snow.resistance({'drag': 0.8}, davis, outside) == pytest.approx(1.6)
    assert snow.resistance({'drag': 0.8}, davis, inside) == 0.0
    assert {twin.name for twin in snow.twins} <= set(EFFECTS)


def test_the_table_of_effects_is_complete() -> None:
    assert first_cells('docs/effects.md') == set(EFFECTS)


def test_the_units_are_listed() -> None:
    (row,) = re.findall(r'^\| `unit` \| (.*) \|$', text_of('docs/mapping.md'), re.MULTILINE)
    listed = set(re.split(r'[,·`] *| ·', row))
    units = {unit for quantity, known in known_units._FACTORS.items() if quantity != 'time' for unit in known}
    assert units <= {unit.strip() for unit in listed}


def test_the_verbs_are_listed() -> None:
    names = {verb.name.partition(' ')[0] for verb in VERBS}
    assert {name for name in names if re.search(rf'(`|trainid ){name}\b', text_of('README.md'))} == names


def test_the_table_of_statuses_is_complete() -> None:
    assert {status.name for status in Status} <= first_cells('docs/status.md')
    assert all(f'`{status.name}`' in text_of('README.md') for status in Status)


def test_the_glossary_is_in_order_and_short() -> None:
    rows = re.findall(r'^\| ([^|]+) \| ([^|]+) \|$', text_of('docs/glossary.md'), re.MULTILINE)[1:]
    terms = [term.strip('`').lower() for term, _ in rows]
    assert terms == sorted(set(terms))
    assert [meaning for _, meaning in rows if re.search(r'[.] [A-Z]|[.]$', meaning)] == []
    assert {status.name.lower() for status in Status} <= set(terms)


@pytest.mark.parametrize('page', ['README.md', 'docs/nodes.md'])
def test_the_table_of_topics_is_complete(page: str) -> None:
    named = first_cells(page)
    assert {topic.name for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)} <= named
    assert RESISTANCE_TOPIC.last_valid in named


def test_the_tables_of_the_simulator_are_complete() -> None:
    assert set(UNKNOWNS) == first_cells('docs/simulator.md')
    text = text_of('docs/simulator.md')
    assert all(re.search(rf'`(--world )?{name}`', text) for name in WORLDS)


def test_the_algorithms_exist() -> None:
    text = text_of('docs/algorithms.md')
    table = text[text.index('## Which to choose') : text.index('```sh')]
    offered = {*RESISTANCE.names, *SPEED_MODEL.names, *BRAKE_RATE.names}
    chosen = set(re.findall(r'^\|[^|]*\| `([^`]+)` \|', table, re.MULTILINE))
    assert chosen
    assert chosen <= offered
    assert {RESISTANCE.default, SPEED_MODEL.default, BRAKE_RATE.default} <= chosen


@pytest.mark.parametrize(
    'folder', sorted(p.name for p in (ROOT / 'trainid_ros').iterdir() if (p / '__init__.py').is_file())
)
def test_every_folder_of_the_package_is_described(folder: str) -> None:
    assert f'`trainid_ros/{folder}`' in text_of('docs/architecture.md')

# SPDX-License-Identifier: Apache-2.0
"""Nodes that share their inputs record them together, with what they have learned."""

from __future__ import annotations

from itertools import chain, count
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from std_srvs.srv import Trigger

from test.ros.graph import Graph, coasting, collected, feed
from trainid_ros.bag.bag_replay import estimate_table
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli import replay
from trainid_ros.cli.main import main
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.ros.estimator_node import SPECS
from trainid_ros.setup.checkpoint import parse_checkpoint
from trainid_ros.train.train_file import load_train_file

pytestmark = pytest.mark.ros
SERVICE = '/brake_rate_estimator/save_recording'


def test_the_last_inputs_are_recorded_on_request(graph: Graph, train_file: str, tmp_path: Path) -> None:
    nodes, records = graph.all(train_file, record_folder=str(tmp_path / 'events')), coasting(40)
    feed(nodes[0], records)
    answer = graph.call(graph.plain('caller'), Trigger, SERVICE)
    assert answer.success, answer.message
    recorder = nodes[0].shared.inputs.recorder
    nodes[-1].trigger_deactivate()  # if it is not written yet
    recorder._writing.result()
    (bag,) = (tmp_path / 'events').iterdir()
    with BagReader(bag) as reader:
        assert list(reader.records()) == records
    assert load_train_file(bag / 'train.yaml').train.mass == 194e3
    make = recorder.files['train.yaml']
    assert make() is make()  # written out once, as that takes long
    for name in SPECS:
        checkpoint = parse_checkpoint((bag / f'{name}.json').read_text(encoding='utf-8'), name)
        assert checkpoint.stamp_ns == 0  # before the first message


def test_a_replay_from_the_checkpoints_equals_the_live_nodes(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ('suggested_drive', 'suggested_braking'):  # which take most of the time
        monkeypatch.setattr(replay, name, lambda *_: None)
    nodes = graph.all(
        train_file, record_folder=str(tmp_path / 'events'), record_minutes=1.0, alignment__command_hold=60.0
    )
    recorder = nodes[0].shared.inputs.recorder
    recorder._clock = count(0, NS_PER_S).__next__  # a second for each message, so that 60 to 72 are kept
    live = [collected(node) for node in nodes]
    feed(nodes[0], coasting(60))
    recorder.request('resistance_estimator')
    nodes[-1].trigger_deactivate()
    recorder._writing.result()
    (bag,) = (tmp_path / 'events').iterdir()
    with estimate_table(tmp_path / 'live.csv') as table:
        for output in sorted(chain.from_iterable(live), key=attrgetter('stamp_ns')):
            table.on_output(output, 0)
    command = ['replay', bag, '--train', bag / 'train.yaml', '--checkpoint', bag, '--out', tmp_path / 'again.csv']
    main([*map(str, command)])
    head, *again = (tmp_path / 'again.csv').read_text(encoding='utf-8').splitlines()
    known = (tmp_path / 'live.csv').read_text(encoding='utf-8').splitlines()
    assert 12 <= len(again) <= 20
    assert [head, *again] == [known[0], *known[-len(again) :]]


def test_a_fault_is_recorded(graph: Graph, train_file: str, tmp_path: Path) -> None:
    node = graph.active(train_file, record_folder=str(tmp_path / 'events'))
    feed(node, coasting(20))
    node.fail(node.pipeline, 'broken')
    recorder = node.shared.inputs.recorder
    graph.until(lambda: recorder._due)
    node.trigger_deactivate()
    recorder._writing.result()
    (bag,) = (tmp_path / 'events').iterdir()
    assert bag.name.endswith('Z_resistance_estimator_fault')


@pytest.mark.parametrize(
    ('parameters', 'text'),
    [({'record_folder': '/dev/null/x'}, "record_folder = '/dev/null/x' cannot be created"), ({}, 'record_folder')],
)
def test_without_a_folder_nothing_is_recorded(
    graph: Graph, train_file: str, parameters: dict[str, Any], text: str
) -> None:
    node = graph.make(SPECS['brake_rate_estimator'], train_file=train_file, **parameters)
    assert node.bring_up() is not bool(parameters)
    answer = graph.call(graph.plain('caller'), Trigger, SERVICE)
    assert not answer.success
    assert text in node.failure + answer.message

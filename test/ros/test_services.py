# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files and the services of a node."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from std_srvs.srv import Trigger

from trainid_ros.errors import InputError
from trainid_ros.results import Status
from trainid_ros.ros.estimator_node import EstimatorNode
from trainid_ros.ros.estimator_nodes import BRAKE_RATE, RESISTANCE
from trainid_ros.ros.services import Checkpoint, default_path, read_checkpoint, write_checkpoint

Graph: TypeAlias = Any  # the fixture of conftest.py


SAVED = Checkpoint('0.1.0', 'V-MILS', 12, 34, '{"x": 0.1}')


def test_a_checkpoint_reads_back_unchanged(tmp_path: Path) -> None:
    path = tmp_path / 'new' / 'state.json'
    write_checkpoint(path, SAVED)
    assert read_checkpoint(path, 'V-MILS') == SAVED
    assert [item.name for item in path.parent.iterdir()] == ['state.json']


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / 'state.json'
    write_checkpoint(path, SAVED)

    def full(_handle: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(InputError, match=r'state\.json: checkpoint cannot be written: No space left'):
        write_checkpoint(path, Checkpoint('9', 'V-MILS', 0, 0, ''))
    assert read_checkpoint(path, 'V-MILS') == SAVED
    assert [item.name for item in tmp_path.iterdir()] == ['state.json']


def test_a_checkpoint_of_another_estimator_is_rejected(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / 's.json', SAVED)
    with pytest.raises(InputError, match='is a checkpoint of V-MILS, not of GSMA'):
        read_checkpoint(tmp_path / 's.json', 'GSMA')


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('{', 'is not a checkpoint'),
        ('[]', 'is not a checkpoint of this package'),
        ('{"format": 1, "package": "trainid_ros"}', 'is not a checkpoint of this package'),
        pytest.param('[' * 100_000, 'is not a checkpoint', id='deep'),
        pytest.param('1' * 5000, 'is not a checkpoint', id='long'),
        (
            json.dumps({'format': 2, 'package': 'trainid_ros', 'version': '1', 'estimator': 'V-MILS', 'saved_ns': 1.5}),
            'field saved_ns = 1.5',
        ),
    ],
)
def test_files_that_are_not_checkpoints_are_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / 'x.json'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=reason):
        read_checkpoint(path, 'V-MILS')


@pytest.mark.parametrize(('old', 'new'), [('0.1}', '0.7}'), ('state_sha256', 'sha256'), ('"state_sha256": "', '"')])
def test_a_modified_state_is_rejected(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / 's.json'
    write_checkpoint(path, SAVED)
    text = path.read_text(encoding='utf-8')
    assert old in text
    path.write_text(text.replace(old, new), encoding='utf-8')
    with pytest.raises(InputError, match=r's\.json: (checkpoint is damaged|is not a checkpoint)'):
        read_checkpoint(path, 'V-MILS')


def test_a_missing_file_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'none\.json: checkpoint cannot be read: No such file'):
        read_checkpoint(tmp_path / 'none.json', 'V-MILS')


def test_the_default_path_follows_ros_home_and_the_namespace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert default_path('/train1/gsma') == tmp_path / 'trainid' / 'train1' / 'gsma.json'
    monkeypatch.delenv('ROS_HOME')
    monkeypatch.setenv('HOME', '/nowhere')
    assert default_path('/gsma') == Path('/nowhere/.ros/trainid/gsma.json')


@pytest.mark.ros
def test_services_reset_save_and_load_the_state(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'deep' / 'state.json'
    node = graph.active(train_file, checkpoint_file=str(path))
    caller = graph.plain('caller')
    prior = node.pipeline.estimator.save()
    graph.feed(node, graph.coasting(200))
    learned = node.pipeline.estimator.save()
    assert learned != prior
    saved = graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint')
    assert (saved.success, str(path) in saved.message) == (True, True)
    assert graph.call(caller, Trigger, '/resistance_estimator/reset').success
    assert (node.pipeline.estimator.save(), node.pipeline.resets) == (prior, 1)
    loaded = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert (loaded.success, node.pipeline.estimator.save()) == (True, learned)


@pytest.mark.ros
def test_services_report_why_they_fail(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = str(tmp_path / 'state.json')
    first = graph.active(train_file, partial(EstimatorNode, BRAKE_RATE), checkpoint_file=path)
    caller = graph.plain('caller')
    assert graph.call(caller, Trigger, f'/{first.get_name()}/save_checkpoint').success
    second = graph.make(partial(EstimatorNode, RESISTANCE), train_file=train_file, checkpoint_file=path)
    early = graph.call(caller, Trigger, '/resistance_estimator/reset')
    assert (early.success, early.message) == (False, 'resistance_estimator is unconfigured: configure it first')
    second.bring_up()
    before = second.pipeline.estimator.save()
    wrong = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert not wrong.success
    assert 'is a checkpoint of GSMA, not of filter-bank' in wrong.message
    assert second.pipeline.estimator.save() == before


BROKEN = (
    ZeroDivisionError('float division'),
    ValueError('math domain error'),
    np.linalg.LinAlgError('Singular matrix'),
)


class Replaced:
    """An estimator with some of its methods replaced."""

    def __init__(self, estimator: Any, **methods: Callable[..., Any]) -> None:
        self._estimator = estimator
        self.__dict__.update(methods)

    def __getattr__(self, name: str) -> Any:
        """Return what was not replaced."""
        return getattr(self._estimator, name)


@pytest.mark.ros
@pytest.mark.parametrize('error', BROKEN, ids=lambda error: type(error).__name__)
def test_a_numerical_error_in_a_step_is_a_fault_until_a_reset(
    graph: Graph, train_file: str, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    node = graph.active(train_file)
    published, records = graph.published(node), graph.coasting(80)
    graph.feed(node, records[:80])
    last = published.messages[-1].estimate

    def broken(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Replaced(node.pipeline.estimator, step=broken, estimate=broken))
        graph.feed(node, records[80:160])
        node._diagnostics.publish()
    assert (published.messages[-1].status, published.messages[-1].estimate) == (Status.FAULT, last)
    graph.feed(node, records[160:200])
    assert node.pipeline.status is Status.FAULT
    node.pipeline.reset()
    graph.feed(node, records[200:])
    assert node.pipeline.current().status is Status.CONVERGING


@pytest.mark.ros
def test_a_numerical_error_on_loading_is_reported_and_the_node_keeps_running(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.active(train_file, checkpoint_file=str(tmp_path / 'state.json'))
    caller, published, records = graph.plain('caller'), graph.published(node), graph.coasting(80)
    graph.feed(node, records[:80])
    assert graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint').success

    def broken(*_: object) -> None:
        msg = 'math domain error'
        raise ValueError(msg)

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Replaced(node.pipeline.estimator, estimate=broken))
        answer = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
        node._diagnostics.publish()
    assert (answer.success, answer.message) == (False, 'ValueError: math domain error')
    assert node.pipeline.status is Status.FAULT
    assert graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint').success
    graph.feed(node, records[80:])
    assert published.messages[-1].status is Status.CONVERGING

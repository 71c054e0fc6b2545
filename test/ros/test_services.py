# SPDX-License-Identifier: Apache-2.0
"""Services of a node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import Trigger

from test.ros.graph import Changed, Graph, coasting, collected, feed
from trainid_ros.interface.results import Status
from trainid_ros.ros.estimator_node import BRAKE_RATE
from trainid_ros.setup.checkpoint import default_path

pytestmark = pytest.mark.ros


def test_services_reset_save_and_load_the_state(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'deep' / 'state.json'
    node = graph.active(train_file, checkpoint_file=str(path))
    caller = graph.plain('caller')
    prior = node.pipeline.estimator.save()
    feed(node, coasting(200))
    learned = node.pipeline.estimator.save()
    assert learned != prior
    saved = graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint')
    assert (saved.success, str(path) in saved.message) == (True, True)
    assert graph.call(caller, Trigger, '/resistance_estimator/reset').success
    assert (node.pipeline.estimator.save(), node.pipeline.resets) == (prior, 1)
    loaded = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert (loaded.success, node.pipeline.estimator.save()) == (True, learned)


def test_services_report_why_they_fail(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = str(tmp_path / 'state.json')
    first = graph.active(train_file, BRAKE_RATE, checkpoint_file=path)
    caller = graph.plain('caller')
    assert graph.call(caller, Trigger, f'/{first.get_name()}/save_checkpoint').success
    second = graph.make(train_file=train_file)
    early = graph.call(caller, Trigger, '/resistance_estimator/reset')
    assert (early.success, early.message) == (False, 'resistance_estimator is unconfigured: configure it first')
    second.bring_up()
    before = second.pipeline.estimator.save()
    default = default_path('/resistance_estimator')
    missing = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert (missing.success, missing.message) == (False, f'{default}: there is no checkpoint')
    default.parent.mkdir(parents=True, exist_ok=True)
    Path(path).rename(default)
    wrong = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert not wrong.success
    assert 'is a checkpoint of GSMA: each node needs a checkpoint file of its own' in wrong.message
    assert second.pipeline.estimator.save() == before


BROKEN = (
    ZeroDivisionError('float division'),
    ValueError('math domain error'),
    np.linalg.LinAlgError('Singular matrix'),
)


@pytest.mark.parametrize('error', BROKEN, ids=lambda error: type(error).__name__)
def test_a_numerical_error_in_a_step_is_a_fault_until_a_reset(
    graph: Graph, train_file: str, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    node = graph.active(train_file)
    published, records = collected(node), coasting(80)
    feed(node, records[:80])
    last = published[-1].estimate

    def broken(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Changed(node.pipeline.estimator, step=broken, estimate=broken))
        feed(node, records[80:160])
        node._diagnostics.publish()
    assert (published[-1].status, published[-1].estimate) == (Status.FAULT, last)
    feed(node, records[160:200])
    assert node.pipeline.status is Status.FAULT
    node.pipeline.reset()
    feed(node, records[200:])
    assert node.pipeline.current().status is Status.CONVERGING


def test_a_numerical_error_on_loading_is_reported_and_the_node_keeps_running(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.active(train_file, checkpoint_file=str(tmp_path / 'state.json'))
    caller, published, records = graph.plain('caller'), collected(node), coasting(80)
    feed(node, records[:80])
    assert graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint').success

    def broken(*_: object) -> None:
        raise ValueError('math domain error')

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Changed(node.pipeline.estimator, estimate=broken))
        answer = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
        node._diagnostics.publish()
    assert (answer.success, answer.message) == (False, 'ValueError: math domain error')
    assert node.pipeline.status is Status.FAULT
    assert graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint').success
    feed(node, records[80:])
    assert published[-1].status is Status.CONVERGING

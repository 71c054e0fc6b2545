# SPDX-License-Identifier: Apache-2.0
"""Nodes of one process share subscriptions and streams, and publish what they publish alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import pytest

from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.ros.estimator_node import SPECS, EstimatorNode
from trainid_ros.ros.inputs import SharedInputs
from trainid_ros.setup.checkpoint import Checkpoint

pytestmark = pytest.mark.ros

Graph: TypeAlias = Any  # the fixture of conftest.py


def make(graph: Graph, train_file: str, inputs: SharedInputs | None, **parameters: Any) -> list[Any]:
    nodes = []
    for spec in SPECS.values():
        nodes.append(graph.make(partial(EstimatorNode, spec), train_file=train_file, **parameters))
        nodes[-1]._inputs = inputs or nodes[-1]._inputs
        assert nodes[-1].bring_up(), nodes[-1].failure
    return nodes


def inputs_of(node: Any) -> list[str]:
    return [item.topic_name for item in node.subscriptions if item.topic_name.startswith('/ato/')]


def pause(node: Any) -> None:
    node.trigger_deactivate()


def resume(node: Any) -> None:
    node.trigger_activate()


def reset(node: Any) -> None:
    node.reset_on_request(node.pipeline)


def save_and_load(node: Any) -> None:
    node.save_on_request(node.pipeline)
    node.load_on_request(node.pipeline)


def nothing(_node: Any) -> None:
    return


def run(graph: Graph, nodes: list[Any], change: tuple[int, Callable[[Any], None], Callable[[Any], None]]) -> list[str]:
    """Return what the nodes publish when one of them is changed in mid-drive, and again later."""
    place, first, second = change
    published = [graph.published(node) for node in nodes]
    records: list[Record] = graph.coasting(240)
    jumped = graph.coasting(40, start_ns=graph.start_ns - 100 * NS_PER_S)
    groups = list({id(node._input_group): node for node in nodes}.values())
    for part, act in ((records[:400], first), (records[403:600], second), (records[680:], nothing), (jumped, nothing)):
        for node in groups:
            graph.feed(node, part)
        act(nodes[place])
    return [repr(item.messages) for item in published]


@pytest.mark.parametrize('place', [0, 2])
@pytest.mark.parametrize(
    'actions',
    [(nothing, nothing), (reset, nothing), (pause, resume), (save_and_load, reset)],
    ids=['undisturbed', 'reset', 'paused', 'loaded'],
)
def test_nodes_that_share_inputs_publish_what_they_publish_alone(
    graph: Graph,
    train_file: str,
    place: int,
    actions: tuple[Callable[[Any], None], Callable[[Any], None]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The time between saving and loading, which differs, widens what is published before the next sample.
    monkeypatch.setattr(Checkpoint, 'age_s', lambda *_: 0.0)
    change = (place, *actions)
    together = make(graph, train_file, SharedInputs())
    found = run(graph, together, change)
    streams = {id(node.pipeline.stream) for node in together}
    assert len(streams) == (1 if actions[0] is nothing else 2)
    graph.drop()
    expected = run(graph, make(graph, train_file, None), change)
    assert min(map(len, expected)) > 10_000
    assert found == expected


def test_one_set_of_subscriptions_serves_all_until_the_last_node_leaves(graph: Graph, train_file: str) -> None:
    nodes = make(graph, train_file, SharedInputs())
    assert [len(inputs_of(node)) for node in nodes] == [5, 0, 0]
    for node in nodes[:2]:
        node.trigger_deactivate()
        node.trigger_cleanup()
    used = nodes[2].pipeline.samples
    graph.feed(nodes[2], graph.coasting(20))
    assert nodes[2].pipeline.samples > used
    assert len(inputs_of(nodes[0])) == 5
    assert nodes[1].bring_up()
    assert inputs_of(nodes[1]) == []
    for node in nodes[1:]:
        node.trigger_shutdown()
    assert inputs_of(nodes[0]) == []


def test_nodes_with_other_topics_or_quality_of_service_have_their_own_subscriptions(
    graph: Graph, train_file: str
) -> None:
    inputs = SharedInputs()
    remapped, deeper, usual = (
        graph.make(partial(EstimatorNode, spec), arguments=arguments, train_file=train_file)
        for spec, arguments in zip(
            SPECS.values(),
            (
                ('-r', 'ato/speed:=/other/speed'),
                ('-p', 'qos_overrides./ato/speed.subscription.depth:=100'),
                (),
            ),
            strict=True,
        )
    )
    for node in (remapped, deeper, usual):
        node._inputs = inputs
        assert node.bring_up(), node.failure
    assert [len(node_inputs) for node_inputs in map(inputs_of, (remapped, deeper, usual))] == [4, 5, 5]


def test_an_estimator_that_fails_leaves_the_others_alone(graph: Graph, train_file: str) -> None:
    nodes = make(graph, train_file, SharedInputs())
    estimator = nodes[0].pipeline.estimator

    class Broken:
        """An estimator that fails in its step."""

        def __getattr__(self, name: str) -> Any:
            return getattr(estimator, name)

        def step(self, _sample: object) -> None:
            raise ZeroDivisionError

    nodes[0].pipeline.estimator = Broken()
    published = [graph.published(node) for node in nodes]
    graph.feed(nodes[0], graph.coasting(20))
    assert {item.status.name for item in published[0].messages} == {'FAULT'}
    assert len(published[1].messages) == len(published[2].messages) == 20
    assert 'FAULT' not in {item.status.name for item in published[1].messages + published[2].messages}

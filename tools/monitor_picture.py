# SPDX-License-Identifier: Apache-2.0
"""Write the pictures of docs/monitor.md and docs/tutorial_integrator.md: what ``trainid monitor`` shows of a bag.

The bag is replayed, and its messages arrive at their recorded times, so the pictures are the same each time. Of two
trains, the second is at an earlier place of the bag.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final
from unittest.mock import Mock

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console

from tools.documents import DOCS, ROOT
from trainid_ros.bag.bag_replay import AnyOutput, Pipelines, replay_through
from trainid_ros.bag.reader import BagReader, LoggedRecord
from trainid_ros.interface.records import (
    FORCE_TOPIC,
    INPUT_TOPICS,
    NS_PER_S,
    OUTPUT_TOPICS,
    output_topic,
    output_values,
)
from trainid_ros.monitor.screen import Screen
from trainid_ros.monitor.trains import Level, Report, Trains, TrainView
from trainid_ros.ros.diagnostics import DiagnosticsPublisher, InputMonitors, NodeContext
from trainid_ros.ros.estimator_node import SPECS
from trainid_ros.ros.topics import Publishers
from trainid_ros.setup.params_file import node_setups
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.train.train_file import load_train_file

_BAG: Final = ROOT / 'bags' / 'tiny'
_NAMESPACE: Final = '/train_1'
_PLAYER: Final = f'{_NAMESPACE}/bag_player'
_SHOWN_S: Final = 72.0
_SECOND_S: Final = 46.0  # where in the bag the second train is [s]
_SIZE, _SIZE_OF_TWO = (100, 50), (120, 12)  # characters
_FONTS: Final = re.compile(r'@font-face \{\{.*?\}\}', re.DOTALL)


class _Feed:
    """Hands a replay to a monitor, as messages would arrive."""

    def __init__(self, trains: Trains, namespace: str = _NAMESPACE, until_s: float = math.inf) -> None:
        self.train = trains.add(namespace)
        self.inputs = InputMonitors(AlignmentConfig())
        self.now_ns, self._first_ns, self._until_s = 0, 0, until_s
        self._topics = {topic.name: topic for topic in INPUT_TOPICS}

    def on_record(self, entry: LoggedRecord) -> None:
        self._first_ns = self._first_ns or entry.log_ns
        if self._is_over(entry.log_ns):
            return
        topic, self.now_ns = self._topics[entry.topic], entry.log_ns
        self.train.on_input(topic, entry.record, self.now_ns / NS_PER_S)
        self.inputs.arrived(topic, entry.record.stamp_ns, self.now_ns, ())

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        if self._is_over(log_ns):
            return
        self.train.on_estimate(
            output_topic(output.estimate), SimpleNamespace(**output_values(output)), log_ns / NS_PER_S, log_ns
        )

    def view(self) -> TrainView:
        """Return what to show of the train at the newest record."""
        return self.train.view(self.now_ns / NS_PER_S, self.now_ns)

    def _is_over(self, log_ns: int) -> bool:
        return log_ns - self._first_ns > self._until_s * NS_PER_S


def _report(feed: _Feed, trains: Trains, pipelines: tuple[Any, ...]) -> None:
    """Let the nodes report what they would, and a second publisher of the force beside them."""
    now_s = feed.now_ns / NS_PER_S
    for spec, pipeline in zip(SPECS.values(), pipelines, strict=True):
        name = f'{_NAMESPACE}/{spec.kind.node_name}'.strip('/')
        node: Any = Mock(state='active', **{'get_fully_qualified_name.return_value': name})
        node.now_ns.return_value = feed.now_ns
        context = NodeContext(node, spec.kind, node, node, feed.inputs, pipeline=pipeline)
        brief = replace(spec, details=lambda _prior, _live: ())
        status = DiagnosticsPublisher(context, brief).estimator_status(pipeline)
        values = {item.key: item.value for item in status.values}
        level = Level(int.from_bytes(status.level, 'little'))
        trains.on_diagnostics(status.name, Report(level, status.message, values, now_s))
    force = feed.inputs.by_topic[FORCE_TOPIC]
    force.publishers = Publishers((_PLAYER, f'{_NAMESPACE}/drive_control'))
    text = force.judge(feed.now_ns, 0.8).sentence(feed.now_ns)
    trains.on_diagnostics(f'{name}: input {FORCE_TOPIC.name}', Report(Level.WARN, text, {}, now_s))


def pictures() -> dict[str, str]:
    """Return the pictures as SVG text, by their names in the folder of the documents."""
    trains = Trains()
    feed, first = _Feed(trains), _Feed(Trains(), '/train_1')
    second = _Feed(Trains(), '/train_2', _SECOND_S)
    train = _BAG / 'train.yaml'
    pipelines = Pipelines(*(setup.pipeline() for setup in node_setups(load_train_file(train), str(train))))
    with BagReader(_BAG) as reader:
        replay_through(pipelines, reader, None, (feed, first, second), duration_s=_SHOWN_S)
    _report(feed, trains, pipelines)
    nodes: dict[str, tuple[str, ...]] = {topic.name: (_PLAYER,) for topic in INPUT_TOPICS}
    nodes |= {topic.name: ('a node',) for topic in OUTPUT_TOPICS}
    first.train.on_publishers(nodes)
    second.train.on_publishers(nodes)
    feed.train.on_publishers(nodes | {FORCE_TOPIC.name: (_PLAYER, f'{_NAMESPACE}/drive_control')})
    return {
        'monitor.svg': _drawn([feed.view()], *_SIZE),
        'tutorial_integrator.svg': _drawn([first.view(), second.view()], *_SIZE_OF_TWO),
    }


def _drawn(views: Sequence[TrainView], width: int, height: int) -> str:
    console = Console(file=io.StringIO(), record=True, width=width, height=height, force_terminal=True)
    console.print(Screen(views))
    # Nothing is loaded from other servers: the fonts of the reader are used.
    return console.export_svg(title='trainid monitor', code_format=_FONTS.sub('', CONSOLE_SVG_FORMAT), unique_id='m')


if __name__ == '__main__':
    for name, picture in pictures().items():
        (ROOT / DOCS / name).write_text(picture, encoding='utf-8')

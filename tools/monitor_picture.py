# SPDX-License-Identifier: Apache-2.0
"""Print the picture of docs/monitor.md (SVG): what ``trainid monitor`` shows of a bag of this repository.

The bag is replayed, and its messages arrive at their recorded times, so the picture is the same each time.
"""

from __future__ import annotations

import io
import re
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console

from tools.documents import ROOT
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
from trainid_ros.monitor.trains import Level, Report, Trains
from trainid_ros.ros.diagnostics import InputMonitors, NodeHealth, StepTimes, estimator_status
from trainid_ros.ros.estimator_node import SPECS
from trainid_ros.ros.topics import Publishers
from trainid_ros.setup.params_file import node_setups
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.train.train_file import load_train_file

_BAG: Final = ROOT / 'bags' / 'tiny'
_NAMESPACE: Final = '/train_1'
_PLAYER: Final = f'{_NAMESPACE}/bag_player'
_SHOWN_S: Final = 72.0
_WIDTH, _HEIGHT = 100, 50
_FONTS: Final = re.compile(r'@font-face \{\{.*?\}\}', re.DOTALL)


class _Feed:
    """Hands a replay to a monitor, as messages would arrive."""

    def __init__(self, trains: Trains) -> None:
        self.train = trains.add(_NAMESPACE)
        self.inputs = InputMonitors(AlignmentConfig())
        self.now_ns = 0
        self._topics = {topic.name: topic for topic in INPUT_TOPICS}

    def on_record(self, entry: LoggedRecord) -> None:
        topic, self.now_ns = self._topics[entry.topic], entry.log_ns
        self.train.on_input(topic, entry.record, self.now_ns / NS_PER_S)
        self.inputs.arrived(topic, entry.record.stamp_ns, self.now_ns, ())

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        self.train.on_estimate(
            output_topic(output.estimate), SimpleNamespace(**output_values(output)), log_ns / NS_PER_S, log_ns
        )


def _report(feed: _Feed, trains: Trains, pipelines: tuple[Any, ...], priors: tuple[Any, ...]) -> None:
    """Let the nodes report what they would, and a second publisher of the force beside them."""
    now_s = feed.now_ns / NS_PER_S
    for spec, pipeline, prior in zip(SPECS.values(), pipelines, priors, strict=True):
        name = f'{_NAMESPACE}/{spec.kind.node_name}'.strip('/')
        health = NodeHealth(name, 'active', '', feed.now_ns, '')
        brief = replace(spec, details=lambda _prior, _live: ())
        status = estimator_status(health, brief, pipeline, prior, StepTimes())
        values = {item.key: item.value for item in status.values}
        level = Level(int.from_bytes(status.level, 'little'))
        trains.on_diagnostics(status.name, Report(level, status.message, values, now_s))
    force = feed.inputs.by_topic[FORCE_TOPIC]
    force.publishers = Publishers((_PLAYER, f'{_NAMESPACE}/drive_control'))
    text = force.judge(feed.now_ns, 0.8).sentence(feed.now_ns)
    trains.on_diagnostics(f'{name}: input {FORCE_TOPIC.name}', Report(Level.WARN, text, {}, now_s))


def picture() -> str:
    """Return the picture as SVG text."""
    trains = Trains()
    feed = _Feed(trains)
    train = _BAG / 'train.yaml'
    pipelines = Pipelines(*(setup.pipeline() for setup in node_setups(load_train_file(train), str(train))))
    priors = tuple(pipeline.current().estimate for pipeline in pipelines)
    with BagReader(_BAG) as reader:
        replay_through(pipelines, reader, None, (feed,), duration_s=_SHOWN_S)
    _report(feed, trains, pipelines, priors)
    nodes: dict[str, tuple[str, ...]] = {topic.name: (_PLAYER,) for topic in INPUT_TOPICS}
    nodes[FORCE_TOPIC.name] = (_PLAYER, f'{_NAMESPACE}/drive_control')
    feed.train.on_publishers(nodes | {topic.name: ('a node',) for topic in OUTPUT_TOPICS})
    console = Console(file=io.StringIO(), record=True, width=_WIDTH, height=_HEIGHT, force_terminal=True)
    console.print(Screen(trains.views(feed.now_ns / NS_PER_S, feed.now_ns)))
    # Nothing is loaded from other servers: the fonts of the reader are used.
    return console.export_svg(title='trainid monitor', code_format=_FONTS.sub('', CONSOLE_SVG_FORMAT), unique_id='m')


if __name__ == '__main__':
    sys.stdout.write(picture())

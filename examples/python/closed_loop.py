# SPDX-License-Identifier: Apache-2.0
"""A simulated train whose ATO stops by the estimates of running nodes.

In one shell:   .venv/bin/python examples/python/closed_loop.py --prepare day.yaml
                .venv/bin/trainid run --train day.yaml
In another:     .venv/bin/python examples/python/closed_loop.py

The sensors of the train are published on ``ato/*``, and each command is chosen with what the client knows at that time.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor

from ato.days import DayPlan, Drive, drive_day, plan_day
from ato.knowledge import TrainValues, client_values
from trainid_ros.brake_rate.motion_model import true_brake
from trainid_ros.cli.arguments import positive, whole
from trainid_ros.client import TrainModel
from trainid_ros.client.arguments import MAX_STAMP_AGE
from trainid_ros.client.live_estimate import MAX_AGE_S
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, input_topic
from trainid_ros.ros.topics import message_class, message_from_record, source_qos
from trainid_ros.sim.plant import TICK_S
from trainid_ros.sim.worlds import WORLDS
from trainid_ros.train.train_file import TrainFile, dump_train_file

if TYPE_CHECKING:
    from trainid_ros.interface.records import Record

DISCOVERY_S = 10.0
"""Longest wait for the nodes [s]."""


class NodeValues:
    """Knowledge of a controller: what running nodes estimate from the records that it publishes."""

    def __init__(self, node: Any, train_file: TrainFile, rate: float) -> None:
        """Publish on the input topics of a node's namespace, ``rate`` times as fast as real time."""
        # The time of the train: values move as fast as they would in real time.
        self._now_s = 0.0
        self.model = TrainModel(
            node, train_file, max_age=MAX_AGE_S * rate, max_stamp_age=MAX_STAMP_AGE.high, clock=lambda: self._now_s
        )
        self._publishers = {
            topic: node.create_publisher(message_class(topic), topic.name, source_qos()) for topic in INPUT_TOPICS
        }
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._brake, self._period = true_brake(train_file), TICK_S / rate
        self._due = time.monotonic()
        self._asked = self._live = 0

    def observe(self, record: Record) -> None:
        """Publish a record."""
        self._now_s = max(self._now_s, record.stamp_ns / NS_PER_S)
        self._publishers[input_topic(record)].publish(message_from_record(record))

    def values(self) -> TrainValues:
        """Wait until the next tick of the train is due, then return what the client knows."""
        self._due = max(self._due + self._period, time.monotonic() - self._period)
        while (left := self._due - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
        self._asked += 1
        self._live += self.model.brake_rate().live
        return client_values(self.model, self._brake)

    @property
    def live_share(self) -> float:
        """Share of the commands with a live estimate of the brake rate; NoAnswerError if none had one."""
        if self._live == 0:
            raise NoAnswerError(f'no live estimate of the brake rate was used: {self.model.brake_rate().reason}')
        return self._live / self._asked


def day(world: str, runs: int, seed: int) -> DayPlan:
    """Return the day of a seed."""
    return plan_day(world, runs, np.random.default_rng(seed))


def drive(plan: DayPlan, seed: int, rate: float, node: Any) -> tuple[Drive, float]:
    """Drive a day with the estimates of running nodes; return it, and for which share of the commands they were used.

    Raises:
        NoAnswerError: No node listens, or none of its estimates was used.

    """
    values = NodeValues(node, plan.case.stated, rate)
    until = time.monotonic() + DISCOVERY_S
    while node.count_subscribers('ato/speed') == 0:
        if time.monotonic() > until:
            raise NoAnswerError(
                f'no node takes in ato/speed in {node.get_namespace()}: start trainid run --train day.yaml'
            )
        time.sleep(0.1)
    return drive_day(plan, values, seed), values.live_share


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--world', default='tram', choices=sorted(WORLDS))
    parser.add_argument('--runs', type=whole, default=6, help='from stop to stop, at least 1')
    parser.add_argument('--seed', type=whole, default=4, help='of the day; on that of 4 the brake becomes weak')
    parser.add_argument('--rate', type=positive, default=10.0, help='times real time')
    parser.add_argument('--prepare', type=Path, metavar='FILE', help='write the train file of the day, and end')
    return parser


def main() -> int:
    """Drive a day and print its stops."""
    parser = arguments()
    args = parser.parse_args()
    if args.runs == 0:
        parser.error('argument --runs: must be at least 1')
    plan = day(args.world, args.runs, args.seed)
    if args.prepare:
        try:
            args.prepare.write_text(dump_train_file(plan.case.stated), encoding='utf-8')
        except OSError as error:
            parser.error(f'argument --prepare: {args.prepare}: {error.strerror}')
        return 0
    rclpy.init()
    try:
        found, share = drive(plan, args.seed, args.rate, rclpy.create_node('ato'))
    except NoAnswerError as error:
        print(f'closed_loop.py: error: {error}', file=sys.stderr)
        return 1
    nominal = drive_day(plan, 'nominal', args.seed)
    print(f'the brake rate was a live estimate for {share:.0%} of the commands')
    print('stop error with live estimates and with the train file, m')
    for live, stated in zip(found.errors, nominal.errors, strict=True):
        print(f'{live:+.2f}  {stated:+.2f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())

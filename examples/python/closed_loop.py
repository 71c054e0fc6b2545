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

from trainid_ros.ato.days import DayPlan, Drive, drive_day, plan_day
from trainid_ros.ato.knowledge import TrainValues, client_values
from trainid_ros.client import TrainModel
from trainid_ros.client.channel import MAX_AGE_S
from trainid_ros.records import INPUT_TOPICS, NS_PER_S, input_topic
from trainid_ros.ros.topics import message_class, message_from_record, source_qos
from trainid_ros.sim.driver import TICK_S
from trainid_ros.train.train_file import TrainFile, dump_train_file

if TYPE_CHECKING:
    from trainid_ros.records import Record


class NodeValues:
    """Knowledge of a controller: what running nodes estimate from the records that it publishes."""

    def __init__(self, node: Any, train_file: TrainFile, rate: float) -> None:
        """Publish on the input topics of a node's namespace, ``rate`` times as fast as real time."""
        # The time of the train: values move as fast as they would in real time.
        self._now_s = 0.0
        self.model = TrainModel(node, train_file, max_age=MAX_AGE_S * rate, clock=lambda: self._now_s)
        self._publishers = {
            topic: node.create_publisher(message_class(topic), topic.name, source_qos()) for topic in INPUT_TOPICS
        }
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._brake, self._period = train_file.brake, TICK_S / rate
        self._due = time.monotonic()

    def observe(self, record: Record) -> None:
        """Publish a record."""
        self._now_s = max(self._now_s, record.stamp_ns / NS_PER_S)
        self._publishers[input_topic(record)].publish(message_from_record(record))

    def values(self) -> TrainValues:
        """Wait until the next tick of the train is due, then return what the client knows."""
        self._due = max(self._due + self._period, time.monotonic() - self._period)
        while (left := self._due - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
        return client_values(self.model, self._brake)


def day(world: str, runs: int, seed: int) -> DayPlan:
    """Return the day of a seed."""
    return plan_day(world, runs, np.random.default_rng(seed))


def drive(plan: DayPlan, seed: int, rate: float, node: Any) -> Drive:
    """Drive a day with the estimates of running nodes."""
    return drive_day(plan, NodeValues(node, plan.case.stated, rate), seed)


def main() -> int:
    """Drive a day and print its stops."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--world', default='tram')
    parser.add_argument('--runs', type=int, default=6)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--rate', type=float, default=10.0, help='times real time')
    parser.add_argument('--prepare', type=Path, metavar='FILE', help='write the train file of the day, and end')
    args = parser.parse_args()
    plan = day(args.world, args.runs, args.seed)
    if args.prepare:
        args.prepare.write_text(dump_train_file(plan.case.stated), encoding='utf-8')
        return 0
    rclpy.init()
    found = drive(plan, args.seed, args.rate, rclpy.create_node('ato'))
    nominal = drive_day(plan, 'nominal', args.seed)
    print('stop error with live estimates and with the train file, m')
    for live, stated in zip(found.errors, nominal.errors, strict=True):
        print(f'{live:+.2f}  {stated:+.2f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())

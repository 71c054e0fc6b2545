# SPDX-License-Identifier: Apache-2.0
"""Publish rows of inputs, each at its time of day: one sensor or computer of a train, as a process of its own.

``python -m benchmarks.sender PARENT NAME FILE [--best-effort] [--wrong-type]``; the file is that of
:func:`write_rows`. Rows that are overdue at the start are left out, as by a sensor that was started again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

from trainid_ros.cli.processes import die_with
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, Row, record_of
from trainid_ros.ros.topics import message_class, message_from_record, source_qos

_OVERDUE_NS: Final = NS_PER_S // 5


class Sending(NamedTuple):
    """A row and the time of day at which it is sent [ns]."""

    send_ns: int
    row: Row


def write_rows(path: Path, sendings: Iterable[Sending]) -> None:
    path.write_text(json.dumps(list(sendings)), encoding='utf-8')


def main() -> None:
    """Publish until the end of the file, then wait for a signal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('parent', type=int)
    parser.add_argument('name')
    parser.add_argument('file')
    parser.add_argument('--best-effort', action='store_true')
    parser.add_argument('--wrong-type', action='store_true')
    args = parser.parse_args()
    die_with(args.parent)
    with open(args.file, encoding='utf-8') as file:  # noqa: PTH123
        sendings = [Sending(send_ns, tuple(row)) for send_ns, row in json.load(file)]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(args.name)
    send = _publisher(node, sendings, best_effort=args.best_effort, wrong_type=args.wrong_type)
    begin_ns = time.time_ns() - _OVERDUE_NS
    for send_ns, row in sendings:
        if send_ns >= begin_ns:
            time.sleep(max((send_ns - time.time_ns()) / NS_PER_S, 0.0))
            send(row)
    time.sleep(3600.0)


def _publisher(node: Any, sendings: Iterable[Sending], *, best_effort: bool, wrong_type: bool) -> Any:
    profile = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT) if best_effort else source_qos()
    places = {row[0] for _, row in sendings}
    publishers = {
        place: node.create_publisher(
            Float64 if wrong_type else message_class(INPUT_TOPICS[place]), INPUT_TOPICS[place].name, profile
        )
        for place in places
    }

    def send(row: Row) -> None:
        message = Float64(data=row[2]) if wrong_type else message_from_record(record_of(*row))
        publishers[row[0]].publish(message)

    return send


if __name__ == '__main__':
    main()

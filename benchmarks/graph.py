# SPDX-License-Identifier: Apache-2.0
"""ROS nodes of the benchmark's own process: a private domain, publishers of inputs and subscribers to estimates."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from benchmarks.days import REPOSITORY
from trainid_ros.cli.processes import free_domain, local_environment
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS, OutputTopic, Record
from trainid_ros.ros.topics import estimate_qos, message_class, source_qos

_PROFILE: Final = REPOSITORY / 'config' / 'fastdds_localhost.xml'
_DISCOVERY_S: Final = 60.0


@contextmanager
def private_domain(logs: Path) -> Iterator[None]:
    """Put this process and its children into a ROS domain of their own, on this machine only."""
    before = dict(os.environ)
    domain = {'ROS_DOMAIN_ID': str(free_domain(os.getpid())), 'ROS_LOG_DIR': str(logs)}
    os.environ |= {**local_environment(_PROFILE), **domain}
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class Peer:
    """A node of this process beside those that are measured, in a thread from ``with`` on; ``node`` is that node."""

    def __init__(self, name: str, domain: int | None = None) -> None:
        """Join the domain of the environment if none is given."""
        self._context = Context()
        no_handler = SignalHandlerOptions.NO
        rclpy.init(context=self._context, args=[], domain_id=domain, signal_handler_options=no_handler)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def publishers(self, profile: QoSProfile | None = None) -> dict[type[Record], Any]:
        """Return publishers of the inputs by the class of their records."""
        return {
            topic.record: self.node.create_publisher(message_class(topic), topic.name, profile or source_qos())
            for topic in INPUT_TOPICS
        }

    def hear(self, note: Callable[[OutputTopic, Any], object], profile: QoSProfile | None = None) -> None:
        for topic in OUTPUT_TOPICS:
            take, kind = partial(note, topic), message_class(topic)
            self.node.create_subscription(kind, topic.name, take, profile or estimate_qos())

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        self._context.destroy()

    def wait_for_nodes(self, processes: int = 1) -> None:
        """Wait until all processes subscribe to the inputs, once each, and publish the estimates.

        Raises:
            TimeoutError: The nodes did not start.

        """
        end = time.monotonic() + _DISCOVERY_S
        while not self._sees_all(processes):
            if time.monotonic() > end:
                raise TimeoutError(f'the nodes did not start within {_DISCOVERY_S:g} s')
            time.sleep(0.1)
        time.sleep(1.0)

    def _sees_all(self, processes: int) -> bool:
        subscribed = all(self.node.count_subscribers(topic.name) == processes for topic in INPUT_TOPICS)
        return subscribed and all(self.node.count_publishers(topic.name) for topic in OUTPUT_TOPICS)

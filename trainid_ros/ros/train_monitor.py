# SPDX-License-Identifier: Apache-2.0
"""The node of ``trainid monitor``: finds trains in the ROS graph and hands their messages to :class:`Trains`."""

from __future__ import annotations

import os
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_namespace import validate_namespace

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, record_from_message
from trainid_ros.monitor.trains import SHOWN, Level, Report, Trains
from trainid_ros.ros.node import creation_of
from trainid_ros.ros.topics import NO_SUBSCRIPTION_EVENTS, estimate_qos, input_qos, message_class, type_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.qos import QoSProfile

    from trainid_ros.interface.records import InputTopic, OutputTopic
    from trainid_ros.monitor.trains import Train, TrainView

_ESTIMATES: Final = tuple(item.topic for item in SHOWN)
_TOPICS: Final[tuple[InputTopic | OutputTopic, ...]] = (*INPUT_TOPICS, *_ESTIMATES)
_TYPES: Final = {topic.name: type_name(message_class(topic)) for topic in _TOPICS}


def _checked(namespace: str) -> str:
    name = f'/{namespace.removeprefix("/").removesuffix("/")}'
    try:
        validate_namespace(name)
    except InvalidNamespaceException as error:
        reason = str(error).splitlines()[0].partition(': ')[2].rstrip(':')
        raise InputError(f'--namespace {namespace}: {reason}') from None
    return name


class TrainMonitor(Node):
    """Subscribes to the topics of one namespace, or of all in which a topic of ours is published."""

    def __init__(self, arguments: Sequence[str], namespace: str | None, **options: Any) -> None:
        """Subscribe in a namespace, in all that are found for None; InputError if no namespace can have this name."""
        self._wanted = None if namespace is None else _checked(namespace)
        name = f'trainid_monitor_{os.getpid()}'
        silent = Parameter('start_type_description_service', value=False)  # a service with a number in its name
        with creation_of(name):
            super().__init__(
                name,
                cli_args=list(arguments),
                enable_rosout=False,
                start_parameter_services=False,
                parameter_overrides=[silent],
                **options,
            )
        self.trains = Trains()
        self._looked_s = 0.0
        self._listening: dict[str, list[Any]] = {}
        self.create_subscription(
            DiagnosticArray,
            '/diagnostics',
            self._on_diagnostics,
            estimate_qos(),
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
        )

    def views(self) -> tuple[TrainView, ...]:
        """Return what to show now, after a look at the graph if the last one is old."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= 0.5:  # [s]
            self._looked_s = now_s
            self._look()
        return self.trains.views(now_s, self.get_clock().now().nanoseconds)

    @property
    def notice(self) -> str:
        """What to say while nothing is published, '' once something is."""
        if self.trains.by_namespace:
            return ''
        place = 'in any namespace' if self._wanted is None else f'in the namespace {self._wanted}'
        others = sorted(self._found() - {self._wanted})
        elsewhere = f' There are trains in {", ".join(others)}.' if others else ''
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        return (
            f'Nothing is published yet {place}, in ROS domain {domain}.{elsewhere} Start the nodes with '
            'trainid run --train T.yaml, or check ROS_DOMAIN_ID and the namespace. Waiting; Ctrl-C ends.'
        )

    def _found(self) -> set[str]:
        """Return the namespaces in which one of our topics has a publisher."""
        found = set()
        for name, types in self.get_topic_names_and_types():
            for topic, kind in _TYPES.items():
                if name.endswith(f'/{topic}') and kind in types and self.count_publishers(name):
                    found.add(name.removesuffix(f'/{topic}') or '/')
        return found

    def _look(self) -> None:
        found = self._found()
        for namespace in self.trains.drop_ended(found, time.monotonic()):
            for subscription in self._listening.pop(namespace):
                self.destroy_subscription(subscription)
        for namespace in sorted(found if self._wanted is None else found & {self._wanted}):
            if namespace not in self.trains.by_namespace:
                self._subscribe(namespace)
        for namespace, train in self.trains.by_namespace.items():
            train.on_publishers({name: self._publishing(_full(namespace, name), kind) for name, kind in _TYPES.items()})

    def _publishing(self, topic: str, kind: str) -> tuple[str, ...]:
        """Return the nodes that publish a topic, with their type if it is not the one whose messages arrive."""
        infos = self.get_publishers_info_by_topic(topic)
        nodes = {(_full(info.node_namespace, info.node_name), info.topic_type) for info in infos}
        return tuple(name if found == kind else f'{name} (of type {found})' for name, found in sorted(nodes))

    def _subscribe(self, namespace: str) -> None:
        train = self.trains.add(namespace)
        wanted: list[tuple[InputTopic | OutputTopic, QoSProfile, Callable[[Any], None]]] = [
            *((topic, input_qos(), partial(_on_input, train, topic)) for topic in INPUT_TOPICS),
            *((topic, estimate_qos(), partial(self._on_estimate, train, topic)) for topic in _ESTIMATES),
        ]
        self._listening[namespace] = [
            self.create_subscription(
                message_class(topic),
                _full(namespace, topic.name),
                receive,
                profile,
                event_callbacks=NO_SUBSCRIPTION_EVENTS,
            )
            for topic, profile, receive in wanted
        ]

    def _on_estimate(self, train: Train, topic: OutputTopic, message: Any) -> None:
        train.on_estimate(topic, message, time.monotonic(), self.get_clock().now().nanoseconds)

    def _on_diagnostics(self, array: Any) -> None:
        now_s = time.monotonic()
        for status in array.status:
            values = {item.key: item.value for item in status.values}
            level = Level(int.from_bytes(status.level, 'little'))
            self.trains.on_diagnostics(status.name, Report(level, status.message, values, now_s))


def _on_input(train: Train, topic: InputTopic, message: Any) -> None:
    train.on_input(topic, record_from_message(topic, message), time.monotonic())


def _full(namespace: str, topic: str) -> str:
    return f'{namespace.rstrip("/")}/{topic}'

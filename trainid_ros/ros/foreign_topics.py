# SPDX-License-Identifier: Apache-2.0
"""The mapping of an estimator node, and the topics that it names.

Those are subscribed with the type that their publishers have, whenever these come.
"""

from __future__ import annotations

import re
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import OWN, Signal
from trainid_ros.inputs.mapping_file import load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    MASS_TOPIC,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
    InputTopic,
)
from trainid_ros.ros.topics import Publishers, input_qos
from trainid_ros.setup.parameter_specs import MAPPING_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.node import Node

    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.setup.pipelines import EstimatorSettings
    from trainid_ros.train.train_file import TrainFile

# What is read, and the input that does not come without it; positions may come now and then.
_INPUTS: Final[dict[str, InputTopic | None]] = {
    'speed': SPEED_TOPIC,
    'position': None,
    'force': FORCE_TOPIC,
    'gradient': GRADIENT_TOPIC,
    'brake_command': BRAKE_TOPIC,
    'mass': MASS_TOPIC,
}
# Quantities that may be published once and then hold.
_HELD: Final = frozenset({'gradient', 'brake_command', 'mass'})
_TYPE: Final = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)')
# While no message comes on a topic, each of its types is tried for so long [ns].
_PATIENCE_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ForeignTopic:
    """A topic that a mapping names."""

    name: str  # Its name, as in the mapping
    quantities: tuple[str, ...]  # What is read from it

    @property
    def label(self) -> str:
        """Its name with what is read from it, for people."""
        return f'{self.name} ({", ".join(self.quantities)})'

    @property
    def may_be_held(self) -> bool:
        """True if its messages may be rare, so that none must be lost and a late subscriber wants the last one."""
        return _HELD.issuperset(self.quantities)


AnyTopic: TypeAlias = InputTopic | ForeignTopic


def label_of(topic: AnyTopic) -> str:
    """Return the name of a topic for people."""
    return topic.label if isinstance(topic, ForeignTopic) else topic.name


def required_inputs(topic: AnyTopic) -> tuple[InputTopic, ...]:
    """Return the inputs that are required and do not come without a topic."""
    inputs = [_INPUTS[name] for name in topic.quantities] if isinstance(topic, ForeignTopic) else [topic]
    return tuple(item for item in REQUIRED_TOPICS if item in inputs)


def subscribed_topics(mapping: Mapping = OWN) -> tuple[AnyTopic, ...]:
    """Return the topics that the nodes subscribe to: our own that the mapping does not replace, and its own."""
    found: dict[str, dict[str, None]] = {}
    for quantity in _INPUTS:
        signal = getattr(mapping, quantity)
        for source in signal.sources if isinstance(signal, Signal) else ():
            found.setdefault(source.topic, {})[quantity] = None
    own = (topic for topic in INPUT_TOPICS if topic.name not in mapping.replaced)
    return (*own, *(ForeignTopic(name, tuple(quantities)) for name, quantities in found.items()))


def foreign_class(name: str) -> Any:
    """Return the class of a message type by its name in the graph, such as ``std_msgs/msg/Float64``.

    Raises:
        InputError: Its package is not installed, or has no such type.
    """
    if (match := _TYPE.fullmatch(name)) is None:
        raise InputError(f'{name!r} is not a type of messages')
    package, kind = match.groups()
    try:
        return getattr(import_module(f'{package}.msg'), kind)
    except ModuleNotFoundError:
        msg = f'{name}: the package {package} is not installed here'
    except (ImportError, AttributeError):
        msg = f'{name}: the package {package} that is installed here has no such type'
    raise InputError(msg)


def foreign_qos(topic: ForeignTopic, offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return a profile with which all publishers are heard, which promises as much as they do where that matters.

    Args:
        topic: The topic.
        offered: Profiles of its publishers.
    """
    profile = input_qos()
    if topic.may_be_held and all(item.reliability == ReliabilityPolicy.RELIABLE for item in offered):
        profile.reliability = ReliabilityPolicy.RELIABLE
        if all(item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in offered):
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


class ForeignSubscription:
    """The subscription to one foreign topic, made again when its publishers have another type.

    Attributes:
        topic: The topic.
        current: The subscription, None before there is a publisher whose messages can be read.
        type: Name of the type subscribed to, '' without one.
        problem: Why messages cannot be read, '' if they can.
    """

    def __init__(self, topic: ForeignTopic, open_: Callable[[Any, QoSProfile], Any], close: Callable[[Any], Any]):
        """Prepare.

        Args:
            topic: The topic.
            open_: Subscribes with a message class and a profile.
            close: Ends a subscription.
        """
        self.topic = topic
        self.current: Any = None
        self.type = ''
        self.problem = ''
        self._open, self._close = open_, close
        self._profile = input_qos()
        self._alive_ns = 0

    @property
    def profile(self) -> QoSProfile:
        """Its quality of service, overrides of the user included."""
        profile: QoSProfile = self._profile if self.current is None else self.current.qos_profile
        return profile

    def unreadable(self) -> Publishers | None:
        """Return why messages cannot be read and what to do, None if they can."""
        if not self.problem:
            return None
        remedy = 'install it' if self.current is None else 'correct the mapping file or this publisher'
        return Publishers((), (self.problem,), remedy)

    def arrived(self, problem: str, steady_ns: int) -> None:
        """Note that a message came, and why it cannot be read, by a steady clock [ns]."""
        self.problem, self._alive_ns = problem, steady_ns

    def follow(self, publishers: Sequence[Any], steady_ns: int) -> bool:
        """Subscribe as the publishers in the graph want it; return True if that is new.

        A publisher that was killed is in the graph for a while, so a type with which no messages come is left.

        Args:
            publishers: What ``get_publishers_info_by_topic`` returns.
            steady_ns: Time of a steady clock [ns].
        """
        types = list(dict.fromkeys(info.topic_type for info in publishers))
        if not types:
            return False
        kind = self.type if self.type in types else types[0]
        if len(types) > 1 and kind == self.type and steady_ns - self._alive_ns > _PATIENCE_NS:
            kind = types[(types.index(kind) + 1) % len(types)]
        profile = foreign_qos(self.topic, [info.qos_profile for info in publishers if info.topic_type == kind])
        if kind == self.type and profile == self._profile:
            return False
        return self._subscribe(kind, profile, steady_ns)

    def _subscribe(self, kind: str, profile: QoSProfile, steady_ns: int) -> bool:
        self.close()
        self.type, self._profile, self._alive_ns, self.problem = kind, profile, steady_ns, ''
        try:
            self.current = self._open(foreign_class(kind), copy(profile))  # which rclpy changes
        except InputError as error:
            self.problem = str(error)
        except Exception as error:  # whatever a package of others raises must not end the node; it is tried again
            self.type, self.problem = '', f'{kind}: cannot be subscribed ({error})'
        return True

    def close(self) -> None:
        """End the subscription."""
        if self.current is not None:
            self._close(self.current)
        self.current, self.type = None, ''


class NodeMapping:
    """Where the inputs of a node come from, if not from our own topics.

    Attributes:
        topics: Topics that the file names, known from the start as they have parameters; none if it cannot be used,
            which is said on configure.
    """

    def __init__(self, node: Node) -> None:
        """Read the file, if the node is given one."""
        self._node = node
        self._make: Callable[[], MappedInputs] | None = None
        self._mapping = OWN
        self.topics: tuple[str, ...] = ()
        given = node._parameter_overrides.get(MAPPING_FILE.name)  # rclpy gives no public access to them
        if given is not None and isinstance(given.value, str) and given.value:
            with suppress(InputError):
                self.topics = load_mapping(Path(given.value).expanduser()).topics

    def configure(self, train_file: TrainFile, settings: EstimatorSettings) -> EstimatorSettings:
        """Read the file again; return settings that fit it.

        Raises:
            InputError: The file cannot be used.
        """
        path = str(self._node.get_parameter(MAPPING_FILE.name).value)
        self._make = mapped_inputs(Path(path).expanduser() if path else None, train_file)
        self._mapping = OWN if (inputs := self.inputs()) is None else inputs.mapping
        if inputs is None:
            return settings
        return replace(settings, alignment=inputs.mapping.alignment(settings.alignment))

    def named(self, text: str) -> str:
        """Return a text for people with the topics that are read in place of our own ones."""
        return self._mapping.named(text)

    def inputs(self) -> MappedInputs | None:
        """Return what makes records of the messages of foreign topics, None without a mapping."""
        return None if self._make is None else self._make()

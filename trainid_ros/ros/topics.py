# SPDX-License-Identifier: Apache-2.0
"""Topics of the nodes: message classes, quality of service, publishers not heard, subscriptions of a client."""

from __future__ import annotations

import math
import re
import time
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from trainid_msgs import msg as trainid_msgs

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    NS_PER_S,
    InputTopic,
    Record,
    input_topic,
    output_topic,
    output_values,
    record_values,
    stamp_of,
    status_of,
)
from trainid_ros.interface.results import Output, Status
from trainid_ros.setup.params_file import QOS_POLICIES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rclpy.impl.rcutils_logger import RcutilsLogger

    from trainid_ros.interface.records import OutputTopic


def message_class(topic: InputTopic | OutputTopic) -> Any:
    """Return the message class of a topic."""
    return getattr(trainid_msgs, topic.message)


def time_message(time_ns: int) -> Time:
    """Return a time [ns] as a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(time_ns, NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def message_from_record(record: Record) -> Any:
    """Return the input message of a record."""
    return _message(input_topic(record), record.stamp_ns, record_values(record))


def estimate_message(output: Output[Any]) -> Any:
    """Return the message of an output; a non-finite estimate gets status FAULT."""
    return _message(output_topic(output.estimate), output.stamp_ns, output_values(output))


def _message(topic: InputTopic | OutputTopic, stamp_ns: int, values: Mapping[str, Any]) -> Any:
    message = message_class(topic)()
    message.header.stamp = time_message(stamp_ns)
    for name, value in values.items():
        setattr(message, name, value)
    return message


class SerializedEstimate(NamedTuple):
    """A message of an estimate, ready to be sent, its status and its topic."""

    status: Status
    data: bytes
    topic: OutputTopic


DEADLINE_S: Final = 1.0  # an active node publishes at least this often [s], where speeds come at 2 Hz or more
LEASE_S: Final = 2.0  # without a sign of life for this time, a node counts as gone [s]
LIFESPAN_S: Final = 2.0  # age at which an estimate that could not be delivered is dropped [s]
_LEASE: Final = {'liveliness': LivelinessPolicy.AUTOMATIC, 'liveliness_lease_duration': Duration(seconds=LEASE_S)}


# Each function returns a new profile: rclpy writes the overrides of a user into the profile that it is given. By
# default a profile keeps the last messages, and is reliable and volatile.
def input_qos() -> QoSProfile:
    """Return the profile of estimator inputs: best effort, compatible with every sensor; deep enough to lose none."""
    return QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


def source_qos() -> QoSProfile:
    """Return the profile of player and simulator on the input topics and on ``/clock``.

    Reliable subscribers that are slow lose nothing: what they have acknowledged is not kept.
    """
    return QoSProfile(depth=10_000)


def estimate_qos() -> QoSProfile:
    """Return the profile of ``/diagnostics``, and of subscribers of estimates: they also hear who promises less."""
    return QoSProfile(depth=10)


def offered_estimate_qos() -> QoSProfile:
    """Return the profile of the estimates with what their publisher promises: deadline, liveliness and lifespan."""
    deadline, lifespan = Duration(seconds=DEADLINE_S), Duration(seconds=LIFESPAN_S)
    return QoSProfile(depth=10, deadline=deadline, lifespan=lifespan, **_LEASE)


def latched_qos() -> QoSProfile:
    """Return the profile of the last valid estimates: a late joiner gets the newest one, however old it is."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, **_LEASE)


def overridable(entity: str) -> QoSOverridingOptions:
    """Let the user override the quality of service of a 'publisher' or 'subscription'."""
    return QoSOverridingOptions([QoSPolicyKind[name.upper()] for name in QOS_POLICIES[entity]])


# Event callbacks cost time whenever the executor waits, so the default ones are left out. Publishers of inputs with a
# wrong type or quality of service are seen in the graph, see diagnostics.
NO_SUBSCRIPTION_EVENTS: Final = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_PUBLISHER_EVENTS: Final = PublisherEventCallbacks(use_default_callbacks=False)


def publisher_events(logger: RcutilsLogger, topic: str) -> PublisherEventCallbacks:
    """Return event callbacks that log subscribers with incompatible QoS."""

    def log(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        logger.error(f'{topic}: a subscriber has an incompatible QoS ({policy}); no messages are exchanged with it')

    return PublisherEventCallbacks(incompatible_qos=log, use_default_callbacks=False)


NAMELESS: Final = 'a node without a name'  # it is not of ROS, or not known yet


@dataclass(frozen=True, slots=True)
class Publishers:
    """Publishers of a topic."""

    heard: tuple[str, ...] = ()  # Nodes whose messages arrive, one name for each publisher
    unheard: tuple[str, ...] = ()  # One sentence for each publisher whose messages cannot arrive or be read
    remedy: str = 'correct this publisher'  # What to do about those

    def at_a_time(self) -> Publishers:
        """Return the same where messages come from one publisher at a time.

        One that was killed stays in the graph for its lease, up to 20 s: each name counts once. Its successor has no
        name at first.
        """
        names = dict.fromkeys(self.heard)
        return Publishers(tuple(name for name in names if name != NAMELESS) or tuple(names), self.unheard, self.remedy)


def type_name(message: Any) -> str:
    """Return the name of a message class in the graph."""
    package, _, _ = message.__module__.partition('.')
    return f'{package}/msg/{message.__name__}'


def is_hash(text: str) -> bool:
    """Return whether a text is the hash of a definition; not every middleware states it."""
    return text.startswith('RIHS')


def sort_publishers(infos: Iterable[Any], wanted: str, definition: str, profile: QoSProfile) -> Publishers:
    """Sort publishers in the graph by whether a subscription hears them, with its message type and profile.

    Args:
        infos: What ``get_publishers_info_by_topic`` returns.
        wanted: Message type of the subscription.
        definition: Hash of its definition, '' if it is not known. The middleware does not compare it, and misreads
            messages of another one.
        profile: Its quality of service.
    """
    heard, unheard = [], []
    for info in infos:
        is_known = not info.node_name.startswith('_NODE_NAME_UNKNOWN')
        name = f'{info.node_namespace.rstrip("/")}/{info.node_name}' if is_known else NAMELESS
        if info.topic_type != wanted:
            unheard.append(f'{name} publishes {info.topic_type} instead of {wanted}')
            continue
        if definition and is_hash(other := str(info.topic_type_hash)) and other != definition:
            unheard.append(f'{name} publishes another version of {wanted}, whose messages are misread')
            continue
        compatibility, reason = qos_check_compatible(info.qos_profile, profile)
        if compatibility == QoSCompatibility.ERROR:
            text = reason.strip().removeprefix('ERROR: ').rstrip(';').replace(';ERROR:', ',')
            unheard.append(f'{name} has an incompatible quality of service ({text})')
        else:
            heard.append(name)
    return Publishers(tuple(sorted(heard)), tuple(sorted(unheard)))


def foreign_class(name: str) -> Any:
    """Return the class of a message type by its name in the graph, such as ``std_msgs/msg/Float64``.

    InputError if its package is not installed, or has no such type.
    """
    if (match := re.fullmatch(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)', name)) is None:
        raise InputError(f'{name!r} is not a type of messages')
    package, kind = match.groups()
    try:
        return getattr(import_module(f'{package}.msg'), kind)
    except ModuleNotFoundError:
        problem = f'the package {package} is not installed here'
    except (ImportError, AttributeError):
        problem = f'the package {package} that is installed here has no such type'
    raise InputError(f'{name}: {problem}')


class _Rivals:
    """Whether messages of a topic come from two publishers at a time.

    Each publisher numbers its messages. So the number falls where another one takes over: once after a restart, again
    and again where two publish. The graph does not tell: it keeps a killed publisher for its lease, up to 20 s. A
    middleware that gives no numbers shows nothing.
    """

    def __init__(self, topic: str) -> None:
        self._doubt = f'{topic} has two publishers, see ros2 topic info --verbose'
        self._last, self._falls_s = -1, (-math.inf, -math.inf)

    def doubt(self, info: Mapping[str, int | None]) -> str:
        """Return why messages are not to be believed after one more with this information; empty if they are."""
        now_s, number = time.monotonic(), info.get('publication_sequence_number')
        if number is not None:
            if 0 < number <= self._last:  # some number none
                self._falls_s = self._falls_s[1], now_s
            self._last = number
        return self._doubt if now_s - self._falls_s[0] < _RIVALS_S else ''


_RIVALS_S: Final = 5.0  # time in which two falls show two publishers; nobody restarts a node twice within it [s]


def subscribe_estimates(
    node: Any, topic: OutputTopic, receive: Callable[..., object], lose: Callable[[OutputTopic, str], object]
) -> tuple[Any, ...]:
    """Subscribe to an estimate and its latched copy, if any, in the namespace of a node; return the subscriptions.

    The first asks for no deadline and no lease: a subscriber that asks for more than a publisher offers gets nothing
    from it, and publishers of slow inputs offer less. The receiver measures silence, in less time than the deadline of
    the nodes. The latched one asks for the lease of the nodes and tells when a node is gone; without it, silence does.
    """
    rivals = _Rivals(topic.name)

    def take(message: Any, info: Mapping[str, int | None]) -> None:
        receive(topic, status_of(message), message, stamp_of(message), doubt=rivals.doubt(info))

    def keep(message: Any) -> None:
        receive(topic, status_of(message), message, stamp_of(message), latched=True)

    def refuse(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        lose(topic, f'its publisher has an incompatible quality of service ({policy})')

    def follow(event: Any) -> None:
        if event.alive_count == 0:
            lose(topic, 'its node is gone')

    kind = message_class(topic)
    events = SubscriptionEventCallbacks(incompatible_qos=refuse, use_default_callbacks=False)
    live = node.create_subscription(kind, topic.name, take, estimate_qos(), event_callbacks=events)
    if not topic.last_valid:
        return (live,)
    events = SubscriptionEventCallbacks(liveliness=follow, use_default_callbacks=False)
    return live, node.create_subscription(kind, topic.last_valid, keep, latched_qos(), event_callbacks=events)

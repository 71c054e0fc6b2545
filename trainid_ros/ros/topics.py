# SPDX-License-Identifier: Apache-2.0
"""Topics of the nodes: message classes and quality of service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from builtin_interfaces.msg import Time
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from trainid_msgs import msg as trainid_msgs

from trainid_ros.messages import OutputLike, output_values, record_values
from trainid_ros.records import INPUT_TOPICS, NS_PER_S, InputTopic, Record

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rclpy.impl.rcutils_logger import RcutilsLogger

    from trainid_ros.messages import OutputTopic


def message_class(topic: InputTopic | OutputTopic) -> Any:
    """Return the message class of a topic."""
    return getattr(trainid_msgs, topic.message)


_MESSAGES: Final = {topic.record: message_class(topic) for topic in INPUT_TOPICS}


def time_message(time_ns: int) -> Time:
    """Return a time [ns] as a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(time_ns, NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def message_from_record(record: Record) -> Any:
    """Return the input message of a record."""
    return _fill(_MESSAGES[type(record)](), record.stamp_ns, record_values(record))


def fill_estimate(message: Any, output: OutputLike) -> Any:
    """Copy an output into its message and return it; a non-finite estimate gets status FAULT."""
    return _fill(message, output.stamp_ns, output_values(output))


def _fill(message: Any, stamp_ns: int, values: Mapping[str, Any]) -> Any:
    message.header.stamp = time_message(stamp_ns)
    for name, value in values.items():
        setattr(message, name, value)
    return message


# Each function returns a new profile: rclpy writes the overrides of a user into the profile that it is given.
def _keep_last(depth: int, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)


def input_qos() -> QoSProfile:
    """Return the profile of estimator inputs: best effort, compatible with every sensor; deep enough to lose none."""
    return _keep_last(50, ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)


def source_qos() -> QoSProfile:
    """Return the profile of player and simulator on the input topics and on ``/clock``."""
    return _keep_last(100, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def estimate_qos() -> QoSProfile:
    """Return the profile of the estimates."""
    return _keep_last(10, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def latched_qos() -> QoSProfile:
    """Return the profile of the last valid estimates: a late joiner gets the newest one."""
    return _keep_last(1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


def diagnostics_qos() -> QoSProfile:
    """Return the profile of ``/diagnostics``."""
    return _keep_last(10, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def overridable() -> QoSOverridingOptions:
    """Let the user override history, depth and reliability with parameters ``qos_overrides.*``."""
    return QoSOverridingOptions.with_default_policies()


def _log_incompatible(logger: RcutilsLogger, topic: str, other: str) -> Callable[[Any], None]:
    def log(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        logger.error(f'{topic}: a {other} has an incompatible QoS ({policy}); no messages are exchanged with it')

    return log


def subscription_events(logger: RcutilsLogger, topic: str) -> SubscriptionEventCallbacks:
    """Return event callbacks that log publishers with incompatible QoS."""
    return SubscriptionEventCallbacks(incompatible_qos=_log_incompatible(logger, topic, 'publisher'))


def publisher_events(logger: RcutilsLogger, topic: str) -> PublisherEventCallbacks:
    """Return event callbacks that log subscribers with incompatible QoS."""
    return PublisherEventCallbacks(incompatible_qos=_log_incompatible(logger, topic, 'subscriber'))

# SPDX-License-Identifier: Apache-2.0
"""Quality of service of all topics.

Each function returns a new profile: rclpy writes a user's overrides into the profile it is given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.impl.rcutils_logger import RcutilsLogger


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

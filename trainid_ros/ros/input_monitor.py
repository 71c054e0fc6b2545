# SPDX-License-Identifier: Apache-2.0
"""What arrives on one input topic, and what is wrong with it, since when, and what to do."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticStatus

from trainid_ros.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    NS_PER_S,
    SPEED_TOPIC,
    InputTopic,
)
from trainid_ros.ros.publishers import Publishers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.stream.alignment import AlignmentConfig

_WINDOW_NS: Final = 5 * NS_PER_S
# A larger difference means that stamps come from another clock or that messages are buffered.
_WORST_AGE_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong, in words.

    Attributes:
        level: Level of the diagnostics.
        text: What is the case.
        action: What to do, '' if nothing.
        since_ns: Since when, by the node's clock [ns]; 0 if not known.

    """

    level: Any
    text: str
    action: str = ''
    since_ns: int = 0

    def sentence(self, now_ns: int) -> str:
        """Return everything in one line, at a time of the node's clock [ns]."""
        since = f', since {clock_time(self.since_ns)}' if 0 < self.since_ns <= now_ns else ''
        return f'{self.text}{since}' + (f': {self.action}' if self.action else '')


def clock_time(time_ns: int) -> str:
    """Return a time [ns] as date and time of day."""
    return f'{datetime.fromtimestamp(time_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC'


class InputMonitor:
    """Arrivals on one input topic, timed with the node's clock.

    Attributes:
        topic: The topic.
        longest_s: Longest time between messages that the estimators can bridge at any rate [s].
        slowest_s: Longest acceptable interval between messages [s].
        optional: True if the estimators can run without it.
        count: Messages received.
        newest_ns: Stamp of the last message [ns], 0 before the first.
        publishers: Who publishes on it.

    """

    def __init__(self, topic: InputTopic, longest_s: float, slowest_s: float, *, optional: bool) -> None:
        self.topic = topic
        self.longest_s = longest_s
        self.slowest_s = max(longest_s, slowest_s)
        self.optional = optional
        self.count = 0
        self.newest_ns = 0
        self.publishers = Publishers()
        self._last_ns = 0
        self._delay_s = math.nan
        self._arrivals: deque[int] = deque(maxlen=4096)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """Record a message with this stamp [ns] that arrived now [ns]."""
        self.count += 1
        self.newest_ns = stamp_ns
        if self._arrivals and now_ns < self._arrivals[-1]:
            self._arrivals.clear()
        self._arrivals.append(now_ns)
        self._last_ns = now_ns
        self._delay_s = (now_ns - stamp_ns) / NS_PER_S

    def rate(self, now_ns: int) -> float:
        """Return the message rate over the last seconds [Hz]; NaN while unknown, as with a clock that stands still."""
        while self._arrivals and self._arrivals[0] < now_ns - _WINDOW_NS:
            self._arrivals.popleft()
        if not self._arrivals or self._arrivals[-1] == self._arrivals[0]:
            return math.nan
        return (len(self._arrivals) - 1) * NS_PER_S / (self._arrivals[-1] - self._arrivals[0])

    def missing_for_s(self, now_ns: int) -> float:
        """Return the time since the last message [s], infinite before the first."""
        if not self.count:
            return math.inf
        return max(now_ns - self._last_ns, 0) / NS_PER_S

    def age_s(self, now_ns: int) -> float:
        """Return the age of the newest stamp [s], NaN before the first message."""
        return (now_ns - self.newest_ns) / NS_PER_S if self.count else math.nan

    def is_missing(self, now_ns: int, stale_s: float) -> bool:
        """Return whether a required input is missing; ``stale_s`` is its timeout [s]."""
        return not self.optional and self.missing_for_s(now_ns) > stale_s

    def judge(self, now_ns: int, stale_s: float) -> Finding:
        """Return the most important thing to know about the input; ``stale_s`` is its timeout [s]."""
        publishers = self.publishers
        if publishers.unheard and not (publishers.heard and self.count):
            return Finding(DiagnosticStatus.ERROR, '; '.join(publishers.unheard), 'correct this publisher')
        if self.optional and not self.count:
            return Finding(DiagnosticStatus.OK, 'optional, not received; the parameter is used')
        if self.is_missing(now_ns, max(stale_s, self.longest_s)):
            return self._missing(now_ns)
        if len(publishers.heard) > 1:
            text = f'{len(publishers.heard)} publishers, whose messages mix: {_names(publishers.heard)}'
            return Finding(DiagnosticStatus.WARN, text, 'stop all but one')
        if publishers.unheard:
            return Finding(DiagnosticStatus.WARN, '; '.join(publishers.unheard), 'correct or stop this publisher')
        return self._judge_messages(now_ns)

    def _judge_messages(self, now_ns: int) -> Finding:
        delay, rate = self._delay_s, self.rate(now_ns)
        if abs(delay) > _WORST_AGE_S and not self.optional:
            where = f'{delay:.1f} s behind' if delay > 0.0 else f'{-delay:.1f} s ahead of'
            text = f"stamps are {where} this node's clock"
            action = 'for a bag set use_sim_time and play it with /clock; on a train synchronise the clocks'
            return Finding(DiagnosticStatus.WARN, text, action)
        if rate * self.slowest_s < 1.0 and not self.optional:
            text = f'too slow: {rate:.2f} Hz, at least {1.0 / self.slowest_s:.2f} Hz needed'
            return Finding(DiagnosticStatus.WARN, text, 'let its publisher send more often')
        return Finding(DiagnosticStatus.OK, 'received' if math.isnan(rate) else f'{rate:.1f} Hz')

    def _missing(self, now_ns: int) -> Finding:
        heard = self.publishers.heard
        since = f'no message for {self.missing_for_s(now_ns):.1f} s' if self.count else 'never received'
        if not heard:
            action = 'start the node that publishes it' + ('' if self.count else ', or remap the topic to its name')
            return Finding(DiagnosticStatus.STALE, f'{since}, no publisher', action, self._last_ns)
        action = f'check sensor and network of {_names(heard)}, or whether it is active'
        text = f'{since}, {len(heard)} publisher(s), but no messages arrive'
        return Finding(DiagnosticStatus.STALE, text, action, self._last_ns)


class InputMonitors:
    """The monitors of all inputs of a node, by topic.

    Args:
        alignment: Settings that say how long each input may be missing.

    """

    def __init__(self, alignment: AlignmentConfig) -> None:
        longest = {
            SPEED_TOPIC: alignment.max_dt,
            FORCE_TOPIC: alignment.max_gap,
            GRADIENT_TOPIC: alignment.max_gap,
            BRAKE_TOPIC: alignment.command_hold or alignment.command_timeout,
        }
        slowest_s = alignment.max_interval
        self.by_topic = {
            topic: InputMonitor(topic, longest.get(topic, 0.0), slowest_s, optional=topic not in longest)
            for topic in INPUT_TOPICS
        }

    def describe_missing(self, now_ns: int, timeout_s: Callable[[InputTopic], float]) -> str:
        """Return which required inputs do not arrive and for how long, '' if all do; timeouts in [s]."""
        late = (item for item in self.by_topic.values() if item.is_missing(now_ns, timeout_s(item.topic)))
        return ', '.join(
            f'no {item.topic.name} {f"for {item.missing_for_s(now_ns):.1f} s" if item.count else "yet"}'
            for item in late
        )


def _names(names: Sequence[str]) -> str:
    return ', '.join(dict.fromkeys(names))

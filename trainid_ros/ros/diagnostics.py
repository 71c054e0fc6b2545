# SPDX-License-Identifier: Apache-2.0
"""Contents of ``/diagnostics``: one status for the estimator and one for each input, and what they are made from.

Ages are measured with the node's clock, so they are correct under simulated time too.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from trainid_ros.records import NS_PER_S, InputTopic
from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.estimators.pipeline import EstimatorPipeline

_LEVELS: Final = {
    Status.UNINITIALIZED: DiagnosticStatus.WARN,
    Status.CONVERGING: DiagnosticStatus.WARN,
    Status.VALID: DiagnosticStatus.OK,
    Status.HOLDING: DiagnosticStatus.OK,
    Status.STALE: DiagnosticStatus.STALE,
    Status.FAULT: DiagnosticStatus.ERROR,
}
_MEANINGS: Final = {
    Status.UNINITIALIZED: 'no sample yet',
    Status.CONVERGING: 'converging, not yet fit to use',
    Status.VALID: 'fit to use, updating',
    Status.HOLDING: 'fit to use, not updating now',
    Status.STALE: 'inputs missing, last estimate kept',
    Status.FAULT: 'the estimator cannot continue: reset it',
}
# A larger difference means that stamps come from another clock or that messages are buffered.
_WORST_AGE_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class ShownValue:
    """A value of an estimate to show in the diagnostics, with its unit.

    ``std`` names the field of its standard deviation; ``variance`` is its index on the diagonal of ``covariance``
    (-1: none).
    """

    name: str
    unit: str
    std: str = ''
    variance: int = -1

    def deviation(self, estimate: Any) -> float:
        """Return the standard deviation in the unit of the value, NaN if there is none."""
        if self.std:
            return float(getattr(estimate, self.std))
        if self.variance < 0:
            return math.nan
        covariance = estimate.covariance
        size = math.isqrt(len(covariance))
        return math.sqrt(max(covariance[self.variance * (size + 1)], 0.0))


@dataclass(frozen=True, slots=True)
class NodeHealth:
    """State of the node apart from its estimator.

    ``failure`` is the reason of the last failed transition; ``now_ns`` is the node's time [ns]; ``clock_problem``
    describes what is wrong with the clock, empty if nothing is.
    """

    name: str
    state: str
    failure: str
    now_ns: int
    clock_problem: str


def idle_status(health: NodeHealth) -> Any:
    """Return the estimator's status while the node is not configured."""
    reason = f': {health.failure}' if health.failure else ''
    level = DiagnosticStatus.ERROR if health.failure else DiagnosticStatus.WARN
    return _status(f'{health.name}: estimator', level, f'{health.state}{reason}', (('state', health.state),))


def estimator_status(
    health: NodeHealth,
    pipeline: EstimatorPipeline[Any],
    shown: tuple[ShownValue, ...],
    prior: Any,
    steps: StepTimeSummary,
    details: Iterable[tuple[str, str]],
) -> Any:
    """Return the status of a configured estimator."""
    output = pipeline.current()
    level, meaning = _LEVELS[output.status], _MEANINGS[output.status]
    first = shown[0]
    live = getattr(output.estimate, first.name)
    message = f'{output.status.name}: {meaning}; {first.name} {live:.4g} {first.unit}'.rstrip()
    if health.state != 'active':
        level, message = DiagnosticStatus.WARN, f'{health.state}, inputs are ignored; last {message}'
    if health.clock_problem:
        level, message = max(level, DiagnosticStatus.WARN), f'{health.clock_problem}; {message}'
    consistency = pipeline.consistency
    if consistency.is_alarm:
        level, message = (
            max(level, DiagnosticStatus.WARN),
            f'errors exceed the stated uncertainty: {consistency}; {message}',
        )
    rejection = output.last_rejection
    values: list[tuple[str, object]] = [
        ('state', health.state),
        ('status', output.status.name),
        ('used', output.used),
        ('rejected', output.rejected),
        *((f'rejected.{reason.name}', count) for reason, count in sorted(pipeline.rejections.items())),
        ('last rejection', 'none' if rejection is None else str(rejection)),
        *_compared(shown, prior, output.estimate),
        ('consistency', consistency),
        ('consistency ratio', f'{consistency.ratio:.3f}'),
        *details,
        ('step time p50 [ms]', f'{steps.p50 * 1e3:.3f}'),
        ('step time p99 [ms]', f'{steps.p99 * 1e3:.3f}'),
        ('step time max [ms]', f'{steps.longest * 1e3:.3f}'),
        ('overruns', steps.overruns),
        ('resets', pipeline.resets),
    ]
    return _status(f'{health.name}: estimator', level, message, values)


def _compared(shown: tuple[ShownValue, ...], prior: Any, live: Any) -> Iterable[tuple[str, object]]:
    for item in shown:
        unit = f' [{item.unit}]' if item.unit else ''
        yield f'{item.name}{unit}', f'{getattr(live, item.name):.6g}'
        if not math.isnan(deviation := item.deviation(live)):
            yield f'{item.name} std{unit}', f'{deviation:.3g}'
        yield f'{item.name} prior{unit}', f'{getattr(prior, item.name):.6g}'


def input_status(health: NodeHealth, monitor: InputMonitor, topic: str, publishers: int, stale_s: float) -> Any:
    """Return the status of one input; ``topic`` is its remapped name, ``stale_s`` its timeout [s]."""
    rate, missing_for = monitor.rate(health.now_ns), monitor.missing_for_s(health.now_ns)
    age = (health.now_ns - monitor.newest_ns) / NS_PER_S if monitor.count else math.nan
    level, message = _judge_input(monitor, publishers, rate=rate, missing_for=missing_for, age=age, stale_s=stale_s)
    if health.clock_problem:
        level, message = max(level, DiagnosticStatus.WARN), f'{health.clock_problem}; {message}'
    values = (
        ('topic', topic),
        ('rate [Hz]', f'{rate:.2f}'),
        ('age [s]', f'{age:.3f}'),
        ('time since last message [s]', f'{missing_for:.3f}'),
        ('count', monitor.count),
        ('publishers', publishers),
    )
    return _status(f'{health.name}: input {monitor.topic.name}', level, message, values)


def _judge_input(
    monitor: InputMonitor, publishers: int, *, rate: float, missing_for: float, age: float, stale_s: float
) -> tuple[bytes, str]:
    """Return diagnostic level and message of an input."""
    if monitor.optional and not monitor.count:
        return DiagnosticStatus.OK, 'optional, not received; the parameter is used'
    if missing_for > max(stale_s, monitor.longest_s) and not monitor.optional:
        who = 'no publisher' if not publishers else f'{publishers} publisher(s), but no messages arrive'
        since = 'never received' if math.isinf(missing_for) else f'no message for {missing_for:.1f} s'
        return DiagnosticStatus.STALE, f'{since}, {who}'
    if abs(age) > _WORST_AGE_S and not monitor.optional:
        return DiagnosticStatus.WARN, f"stamps are {age:.1f} s old by this node's clock (use_sim_time?)"
    if rate * monitor.slowest_s < 1.0 and not monitor.optional:
        return DiagnosticStatus.WARN, f'too slow: {rate:.2f} Hz, at least {1.0 / monitor.slowest_s:.2f} Hz needed'
    return DiagnosticStatus.OK, 'received' if math.isnan(rate) else f'{rate:.1f} Hz'


def _status(name: str, level: bytes, message: str, values: Iterable[tuple[str, object]]) -> Any:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id='', values=pairs)


_WINDOW_NS: Final = 5 * NS_PER_S
_STEPS_KEPT: Final = 3000
OVERRUN_S: Final = 0.2


class InputMonitor:
    """Arrivals on one input topic, timed with the node's clock.

    Attributes:
        topic: The topic.
        longest_s: Longest time between messages that the estimators can bridge at any rate [s].
        slowest_s: Longest acceptable interval between messages [s].
        optional: True if the estimators can run without it.
        count: Messages received.
        newest_ns: Stamp of the last message [ns], 0 before the first.

    """

    def __init__(self, topic: InputTopic, longest_s: float, slowest_s: float, *, optional: bool) -> None:
        self.topic = topic
        self.longest_s = longest_s
        self.slowest_s = max(longest_s, slowest_s)
        self.optional = optional
        self.count = 0
        self.newest_ns = 0
        self._last_ns = 0
        self._arrivals: deque[int] = deque(maxlen=4096)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """Record a message with this stamp [ns] that arrived now [ns]."""
        self.count += 1
        self.newest_ns = stamp_ns
        if self._arrivals and now_ns < self._arrivals[-1]:
            self._arrivals.clear()
        self._arrivals.append(now_ns)
        self._last_ns = now_ns

    def rate(self, now_ns: int) -> float:
        """Return the message rate over the last seconds [Hz]; NaN while unknown."""
        while self._arrivals and self._arrivals[0] < now_ns - _WINDOW_NS:
            self._arrivals.popleft()
        if len(self._arrivals) < 2:
            return float('nan')
        span = max(self._arrivals[-1] - self._arrivals[0], 1)
        return (len(self._arrivals) - 1) * NS_PER_S / span

    def missing_for_s(self, now_ns: int) -> float:
        """Return the time since the last message [s], infinite before the first."""
        if not self.count:
            return float('inf')
        return max(now_ns - self._last_ns, 0) / NS_PER_S


@dataclass(frozen=True, slots=True)
class StepTimeSummary:
    """Quantiles of the recent step times, the longest since the start [s], and the number of overruns since then."""

    p50: float
    p99: float
    longest: float
    overruns: int


class StepTimes:
    """Computing time of the estimator per sample."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_STEPS_KEPT)
        self._longest = 0.0
        self._overruns = 0

    def add(self, seconds: float) -> None:
        """Record the time of one step [s]."""
        self._recent.append(seconds)
        self._longest = max(self._longest, seconds)
        self._overruns += seconds > OVERRUN_S

    def summary(self) -> StepTimeSummary:
        """Return the summary; zeros before the first step."""
        if not self._recent:
            return StepTimeSummary(0.0, 0.0, 0.0, 0)
        p50, p99 = np.percentile(self._recent, (50.0, 99.0))
        return StepTimeSummary(float(p50), float(p99), self._longest, self._overruns)


# At high replay rates a short stall of the machine is long in simulated time, but is not a dropout.
_SHORTEST_NS: Final = NS_PER_S // 4
# Simulated time may run at any rate, so it has to be polled often.
_POLL_NS: Final = NS_PER_S // 10
_MARGIN_NS: Final = NS_PER_S // 100


class Watchdog:
    """Reports once that no new input has arrived for too long, by the node's clock or a steady one.

    Attributes:
        limit_ns: How long inputs may be missing [ns].

    """

    def __init__(self, limit_ns: int) -> None:
        self.limit_ns = limit_ns
        self._newest_ns = 0
        self._seen = (0, 0)
        self._clock = (0, 0)
        self._published = True

    def restart(self) -> None:
        """Wait for the next record before reporting again."""
        self._published = True
        self._newest_ns = 0

    def saw(self, newest_ns: int, now_ns: int, steady_ns: int) -> None:
        """Record the newest stamp so far [ns]; only a changed stamp counts as new input."""
        if newest_ns not in (0, self._newest_ns):
            self._published = False
            self._seen = (now_ns, steady_ns)
            self._newest_ns = newest_ns

    def is_missing(self, now_ns: int, steady_ns: int) -> bool:
        """Return True once when inputs have been missing for too long.

        Args:
            now_ns: Time of the node's clock [ns], which may be simulated, stop or jump.
            steady_ns: Time of a clock that does none of this [ns].

        """
        if now_ns != self._clock[0]:
            self._clock = (now_ns, steady_ns)
        if self._published:
            return False
        missing_for, missing_for_steady = now_ns - self._seen[0], steady_ns - self._seen[1]
        stopped = steady_ns - self._clock[1] > self.limit_ns
        if (missing_for > self.limit_ns and missing_for_steady > min(self.limit_ns, _SHORTEST_NS)) or (
            stopped and missing_for_steady > self.limit_ns
        ):
            self._published = True
        return self._published

    def pause_ns(self, steady_ns: int, *, simulated: bool) -> int:
        """Return how long the limit cannot be exceeded, by the steady clock [ns]."""
        if simulated:
            return _POLL_NS
        waited = 0 if self._published else steady_ns - self._seen[1]
        return max(self.limit_ns - waited, 0) + _MARGIN_NS

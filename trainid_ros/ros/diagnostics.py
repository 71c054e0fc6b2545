# SPDX-License-Identifier: Apache-2.0
"""Contents of ``/diagnostics``: one status for the estimator and one for each input.

Ages are measured with the node's clock, so they are correct under simulated time too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from trainid_ros.records import NS_PER_S
from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.monitors import InputMonitor, StepTimeSummary

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

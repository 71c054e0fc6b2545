# SPDX-License-Identifier: Apache-2.0
"""Contents of ``/diagnostics``: one status for the estimator and one for each input, and what they are made from.

Ages are measured with the node's clock, so they are correct under simulated time too.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from trainid_ros.brake_rate.brake_findings import brake_findings
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Status
from trainid_ros.ros.input_monitor import Finding

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Output
    from trainid_ros.ros.input_monitor import InputMonitor
    from trainid_ros.setup.jobs import Job

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
    Status.FAULT: 'the estimator cannot continue',
}
_ACTIONS: Final = {
    Status.UNINITIALIZED: 'wait for the inputs',
    Status.CONVERGING: 'drive on, it learns at changing speeds',
    Status.STALE: 'restore the inputs that are named',
    Status.FAULT: 'call the service reset of the node; if it fails again, report the log',
}
# Why samples are rejected although all inputs arrive, and what to do.
_REJECTED: Final = {
    Reason.SPEED_STUCK: ('ato/speed is stuck', 'check the speed sensor'),
    Reason.CONTRADICTION: ('speed and forces contradict each other', 'check the inputs if this lasts'),
    Reason.FORCE_MISSING: ('no ato/force at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.GRADIENT_MISSING: ('no ato/gradient at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.BRAKE_COMMAND_MISSING: ('no ato/brake_command at the stamps of ato/speed', 'synchronise their clocks'),
}
_STEPS_KEPT: Final = 3000
OVERRUN_S: Final = 0.2


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


def _no_details(_prior: Any, _live: Any) -> Iterable[tuple[str, str]]:
    return ()


@dataclass(frozen=True, slots=True)
class EstimatorSpec:
    """What distinguishes one estimator node from the others."""

    job: Job  # What it estimates
    shown: tuple[ShownValue, ...]  # Values to show in the diagnostics, the most important first
    # Returns further diagnostics, as names and values, for the prior and the current estimate
    details: Callable[[Any, Any], Iterable[tuple[str, str]]] = _no_details


class Problem(Enum):
    """What may be wrong with a configured estimator beside its status."""

    CONTRADICTION = 'contradiction'
    BRAKE = 'brake'
    CLOCK = 'clock'
    REJECTED = 'rejected'
    ERRORS = 'errors'
    UNSAVED = 'unsaved'
    BUSY = 'busy'


# Nothing is valid while one of these lasts, whatever is driven.
_BLOCKING: Final = frozenset({Problem.CONTRADICTION, Problem.BRAKE})


@dataclass(frozen=True, slots=True)
class NodeHealth:
    """State of the node apart from its estimator."""

    name: str  # Name of the node
    state: str  # Its lifecycle state
    failure: str  # Reason of the last failed transition, '' if it succeeded
    now_ns: int  # The node's time [ns]
    clock_problem: str  # What is wrong with the clock, '' if nothing is
    since_ns: int = 0  # Since when the estimate has its status [ns]
    missing: str = ''  # Which inputs are missing, '' if none is
    fault: str = ''  # Why the estimator cannot continue, '' if it can
    unsaved: str = ''  # Why its state cannot be saved, '' if it can
    busy_s: float = 0.0  # How long the node could not do anything else just now, 0 if not for long [s]
    began: Mapping[Problem, int] = field(default_factory=dict)  # When each present problem began [ns]


def idle_status(health: NodeHealth) -> Any:
    """Return the estimator's status while the node is not configured."""
    level = DiagnosticStatus.ERROR if health.failure else DiagnosticStatus.WARN
    action = f'{health.failure}; correct this, then configure again' if health.failure else 'configure and activate it'
    message = Finding(level, health.state, action).sentence(health.now_ns)
    return _status(f'{health.name}: estimator', level, message, (('state', health.state),))


def unusable(output: Output[Any]) -> tuple[str, str] | None:
    """Return why the newest sample was rejected and what to do, None if it was not, or if that is in order."""
    rejection = output.last_rejection
    if output.status in {Status.STALE, Status.FAULT} or rejection is None or rejection.stamp_ns != output.stamp_ns:
        return None
    return _REJECTED.get(rejection.reason)


def _problems(health: NodeHealth, pipeline: EstimatorPipeline[Any], output: Output[Any]) -> Iterable[Finding]:
    """Yield what is wrong beside the status of the estimate, the worst first."""
    warn = DiagnosticStatus.WARN
    rejected, to_do = unusable(output) or ('', '')
    problems = {
        Problem.CONTRADICTION: Finding(
            DiagnosticStatus.ERROR,
            f'inputs contradict each other: {pipeline.stream.finding}',
            'check units, signs, stamps and publishers of the inputs, and the train file; nothing is learned meanwhile',
        ),
        Problem.BRAKE: Finding(
            warn, '; '.join(brake_findings(pipeline)), 'correct it; no brake rate is valid meanwhile'
        ),
        Problem.CLOCK: Finding(warn, health.clock_problem),
        Problem.REJECTED: Finding(warn, f'samples are rejected: {rejected}', to_do),
        Problem.ERRORS: Finding(
            warn,
            f'errors exceed the stated uncertainty: {pipeline.consistency}',
            'compare train file and inputs with the train',
        ),
        Problem.UNSAVED: Finding(
            warn, f'not saved: {health.unsaved}', 'make room on the disk, or correct checkpoint_file'
        ),
        Problem.BUSY: Finding(
            warn, f'this node was busy or stopped for {health.busy_s:.1f} s', 'give it more computing time'
        ),
    }
    for problem, finding in problems.items():
        if problem in health.began:
            yield replace(finding, since_ns=health.began[problem])


def _judge(health: NodeHealth, output: Output[Any], value: str, why_converging: str) -> Finding:
    """Return what is the case with the estimate; ``value`` is the most important one of it."""
    status = output.status
    reasons = {Status.STALE: health.missing, Status.FAULT: health.fault, Status.CONVERGING: why_converging}
    reason = reasons.get(status, '')
    text = f'{status.name}: {_MEANINGS[status]}{f" ({reason})" if reason else ""}; {value}'
    if health.state != 'active':
        return Finding(DiagnosticStatus.WARN, f'{health.state}, inputs are ignored; last {text}', 'activate it')
    # What to do about a problem comes before driving on.
    action = '' if status is Status.CONVERGING and _BLOCKING & health.began.keys() else _ACTIONS.get(status, '')
    return Finding(_LEVELS[status], text, action, health.since_ns)


def estimator_status(
    health: NodeHealth,
    pipeline: EstimatorPipeline[Any],
    shown: tuple[ShownValue, ...],
    prior: Any,
    steps: StepTimeSummary,
    details: Iterable[tuple[str, str]],
) -> Any:
    """Return the status of a configured estimator."""
    output, first = pipeline.current(), shown[0]
    value = f'{first.name} {getattr(output.estimate, first.name):.4g} {first.unit}'.rstrip()
    findings = [*_problems(health, pipeline, output), _judge(health, output, value, pipeline.why_converging)]
    message = '; '.join(finding.sentence(health.now_ns) for finding in findings)
    levels = [finding.level for finding in findings]
    # An error comes before STALE, whose number is higher.
    level = DiagnosticStatus.ERROR if DiagnosticStatus.ERROR in levels else max(levels)
    values = (
        ('state', health.state),
        *_timed_status(health),
        *_counted(pipeline, output),
        *_compared(shown, prior, output.estimate),
        ('consistency', pipeline.consistency),
        ('consistency ratio', f'{pipeline.consistency.ratio:.3f}'),
        *details,
        *_timed(steps),
        ('resets', pipeline.resets),
    )
    return _status(f'{health.name}: estimator', level, message, values)


def _timed_status(health: NodeHealth) -> Iterable[tuple[str, object]]:
    if 0 < health.since_ns <= health.now_ns:
        yield 'time in status [s]', f'{(health.now_ns - health.since_ns) / NS_PER_S:.1f}'


def _counted(pipeline: EstimatorPipeline[Any], output: Output[Any]) -> Iterable[tuple[str, object]]:
    yield 'status', output.status.name
    yield 'used', output.used
    yield 'rejected', output.rejected
    for reason, count in sorted(pipeline.rejections.items()):
        yield f'rejected.{reason.name}', count
    yield 'last rejection', 'none' if output.last_rejection is None else str(output.last_rejection)


def _timed(steps: StepTimeSummary) -> Iterable[tuple[str, object]]:
    for name, seconds in (('p50', steps.p50), ('p99', steps.p99), ('max', steps.longest)):
        yield f'step time {name} [ms]', f'{seconds * 1e3:.3f}'
    yield 'overruns', steps.overruns


def _compared(shown: tuple[ShownValue, ...], prior: Any, live: Any) -> Iterable[tuple[str, object]]:
    for item in shown:
        unit = f' [{item.unit}]' if item.unit else ''
        yield f'{item.name}{unit}', f'{getattr(live, item.name):.6g}'
        if not math.isnan(deviation := item.deviation(live)):
            yield f'{item.name} std{unit}', f'{deviation:.3g}'
        yield f'{item.name} prior{unit}', f'{getattr(prior, item.name):.6g}'


def input_status(health: NodeHealth, monitor: InputMonitor, topic: str, finding: Finding) -> Any:
    """Return the status of one input; ``topic`` is its remapped name, ``finding`` what is the case."""
    now_ns, level, message = health.now_ns, finding.level, finding.sentence(health.now_ns)
    if health.clock_problem:
        level, message = max(level, DiagnosticStatus.WARN), f'{health.clock_problem}; {message}'
    values = (
        ('topic', topic),
        ('rate [Hz]', f'{monitor.rate(now_ns):.2f}'),
        ('age [s]', f'{monitor.age_s(now_ns):.3f}'),
        ('time since last message [s]', f'{monitor.missing_for_s(now_ns):.3f}'),
        ('count', monitor.count),
        ('publishers', monitor.publishers.count),
        ('heard', ', '.join(monitor.publishers.heard) or 'none'),
        ('not heard', '; '.join(monitor.publishers.unheard) or 'none'),
    )
    return _status(f'{health.name}: input {monitor.label}', level, message, values)


def _status(name: str, level: bytes, message: str, values: Iterable[tuple[str, object]]) -> Any:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id='', values=pairs)


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

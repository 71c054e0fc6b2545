# SPDX-License-Identifier: Apache-2.0
"""What the parts of an estimator node share, so that none of them needs the node itself."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.linalg import LinAlgError

from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S
from trainid_ros.ros.inputs import required_inputs

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.input_monitor import InputMonitors
    from trainid_ros.ros.inputs import AnyTopic, NodeMapping
    from trainid_ros.ros.node import ManagedNode, NodeParameters
    from trainid_ros.setup.pipelines import EstimatorKind

NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, LinAlgError)
"""What arithmetic on an invalid state raises; in old versions of numpy LinAlgError is not a ValueError."""
# Steps that quantiles are formed of: ten minutes at 5 Hz.
_MAX_STEPS: Final = 3000
OVERRUN_S: Final = 0.2
"""A step that takes longer delays the next sample, at 5 Hz [s]."""


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
        self._recent: deque[float] = deque(maxlen=_MAX_STEPS)
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


@dataclass(slots=True)
class NodeContext:
    """The node, as far as ROS goes, and the state of its work."""

    node: ManagedNode  # Clocks, timers, logger, graph and lifecycle state
    kind: EstimatorKind[Any]  # What it estimates
    parameters: NodeParameters
    mapping: NodeMapping
    monitors: InputMonitors
    pipeline: EstimatorPipeline[Any] | None = None  # None while the node is not configured
    prior: Any = None  # Estimate before the first record
    fault: str = ''  # Why the estimator cannot continue, '' if it can
    step_times: StepTimes = field(default_factory=StepTimes)
    # Returns why an input that no topic carries is not there, '' if all are
    lacking: Callable[[], str] = str

    def forget(self) -> None:
        """Forget what configuring the node has made."""
        self.pipeline = self.prior = None
        self.fault, self.step_times, self.lacking = '', StepTimes(), str

    def timeout_s(self, topic: AnyTopic) -> float:
        """Return how long a topic may be missing [s]; 0 for one that need not come."""
        required = required_inputs(topic)
        if self.pipeline is None or not required:
            return 0.0
        return min(self.pipeline.timeout_ns(INPUT_TOPICS.index(item)) for item in required) / NS_PER_S

    def missing_inputs(self) -> str:
        """Return which inputs do not arrive and for how long, '' if all do."""
        found = (self.monitors.describe_missing(self.node.now_ns(), self.timeout_s), self.lacking())
        return ', '.join(text for text in found if text)

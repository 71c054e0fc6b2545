# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``resistance_estimator``: estimates the running resistance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from trainid_msgs.msg import ResistanceEstimate

from trainid_ros.estimators.force_findings import force_findings
from trainid_ros.estimators.observability import observe
from trainid_ros.ros.diagnostics import ShownValue
from trainid_ros.ros.estimator_node import EstimatorNode, EstimatorSpec
from trainid_ros.ros.jobs import RESISTANCE_JOB
from trainid_ros.ros.runner import run_node

if TYPE_CHECKING:
    from collections.abc import Iterator


def _details(prior: Any, live: Any) -> Iterator[tuple[str, str]]:
    yield 'findings', '; '.join(force_findings(live)) or 'none'
    yield 'force scale', f'{live.force_scale:.4f}'
    yield 'force scale std', f'{live.force_scale_std:.2g}'
    yield 'force delay [s]', f'{live.force_delay:.3f}'
    yield 'force delay std [s]', f'{live.force_delay_std:.2g}'
    seen = observe(live.covariance, prior.covariance, live.speed_min, live.speed_max)
    yield 'observability', seen.text
    for name, share in zip('abc', seen.shares, strict=True):
        yield f'{name} prior variance removed', f'{share:.3f}'
    yield 'resistance std at speeds seen, at most [N/kN]', f'{seen.std_observed:.3g}'
    yield 'resistance std at other speeds, at most [N/kN]', f'{seen.std_outside:.3g}'
    yield 'resistance known from [m/s]', f'{seen.known[0]:.1f}'
    yield 'resistance known to [m/s]', f'{seen.known[1]:.1f}'


RESISTANCE: Final = EstimatorSpec(
    job=RESISTANCE_JOB,
    message=ResistanceEstimate,
    shown=(
        ShownValue('resistance', 'N/kN', std='resistance_std'),
        ShownValue('a', 'N/kN', variance=0),
        ShownValue('b', 'N/kN per m/s', variance=1),
        ShownValue('c', 'N/kN per (m/s)^2', variance=2),
    ),
    details=_details,
)


def make_node(arguments: Any = (), **options: Any) -> EstimatorNode:
    """Return the node, unconfigured."""
    return EstimatorNode(RESISTANCE, arguments=arguments, **options)


def main() -> int:
    """Run the node as a program."""
    return run_node(make_node)

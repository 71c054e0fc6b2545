# SPDX-License-Identifier: Apache-2.0
"""The three estimator nodes: what each of them shows in its diagnostics, and their programs."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.estimators.observability import observe
from trainid_ros.resistance.force_findings import force_findings
from trainid_ros.ros.diagnostics import EstimatorSpec, ShownValue
from trainid_ros.ros.estimator_node import EstimatorNode
from trainid_ros.ros.runner import run_node
from trainid_ros.setup.jobs import BRAKE_RATE_JOB, RESISTANCE_JOB, SPEED_MODEL_JOB

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
    shown=(
        ShownValue('resistance', 'N/kN', std='resistance_std'),
        ShownValue('a', 'N/kN', variance=0),
        ShownValue('b', 'N/kN per m/s', variance=1),
        ShownValue('c', 'N/kN per (m/s)^2', variance=2),
    ),
    details=_details,
)
SPEED_MODEL: Final = EstimatorSpec(
    job=SPEED_MODEL_JOB,
    shown=(
        ShownValue('prediction_error', 'm/s'),
        ShownValue('a1', '1/(m/s)', variance=0),
        ShownValue('a2', '', variance=1),
        ShownValue('b1', 'm/s per N/kN', variance=2),
        ShownValue('d0', 'm/s', variance=3),
        ShownValue('a', 'N/kN'),
        ShownValue('b', 'N/kN per m/s'),
        ShownValue('c', 'N/kN per (m/s)^2'),
        ShownValue('mass_factor', ''),
    ),
)
BRAKE_RATE: Final = EstimatorSpec(
    job=BRAKE_RATE_JOB,
    shown=(
        ShownValue('brake_rate', '', std='brake_rate_std'),
        ShownValue('effective_particles', ''),
    ),
)
SPECS: Final = {spec.job.node_name: spec for spec in (RESISTANCE, SPEED_MODEL, BRAKE_RATE)}
"""The nodes by name, in starting order."""


def resistance_main() -> int:
    """Run the resistance estimator as a program."""
    return run_node(partial(EstimatorNode, RESISTANCE))


def speed_model_main() -> int:
    """Run the speed model estimator as a program."""
    return run_node(partial(EstimatorNode, SPEED_MODEL))


def brake_rate_main() -> int:
    """Run the brake rate estimator as a program."""
    return run_node(partial(EstimatorNode, BRAKE_RATE))

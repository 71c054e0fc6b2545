# SPDX-License-Identifier: Apache-2.0
"""Step an estimator and look at its estimate at once, as experiments and tests do."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from trainid_ros.estimators.algorithm_registry import Estimator
    from trainid_ros.interface.results import Rejection
    from trainid_ros.stream.samples import Sample

EstimateT = TypeVar('EstimateT')


def step_and_estimate(estimator: Estimator[EstimateT], sample: Sample) -> EstimateT | Rejection:
    """Step an estimator; return its estimate at the speed of the sample, or why the sample was not used."""
    return estimator.step(sample) or estimator.estimate(sample.speed)

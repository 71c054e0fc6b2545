# SPDX-License-Identifier: Apache-2.0
"""Score resistance estimates over a drive against the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.real_train_informed import InformedFilter
    from benchmarks.worlds import Truth
    from trainid_ros.estimators.algorithm_registry import Estimator
    from trainid_ros.interface.results import ResistanceEstimate
    from trainid_ros.stream.samples import Sample

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Below this true speed no algorithm updates [m/s].
MOVING: Final = 1.0
# Time in motion after the start and after each change by which an estimate should have settled [s].
SETTLED_S: Final = 300.0
# Two-sided normal quantile of 95 %.
_SIGMA_95: Final = 1.96
_FAR: Final = 3.0
_S_PER_MIN: Final = 60.0


@dataclass(frozen=True, slots=True)
class Course:
    """Truth at each sample.

    Attributes:
        speed: Speed [m/s].
        davis: a, b, c, shape (n, 3).
        moving: The train moves.
        motion_s: Time in motion so far [s].
        settled: The train moves, and has moved for ``SETTLED_S`` since the start and since the last change.

    """

    speed: Array
    davis: Array
    moving: Mask
    motion_s: Array
    settled: Mask


@dataclass(frozen=True, slots=True)
class Answers:
    """Output of an algorithm at each sample.

    Attributes:
        davis: a, b, c, shape (n, 3).
        std: Standard deviation of w at the measured speed [N/kN].
        used: The sample was used.
        valid: The sample was used and the estimate is fit to use.

    """

    davis: Array
    std: Array
    used: Mask
    valid: Mask


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one algorithm on one drive; NaN where there was nothing to score.

    Attributes:
        error: Mean absolute error of w over settled samples [N/kN].
        cover: Share of settled samples with an error within 1.96 standard deviations.
        valid: Share of the time in motion with status VALID.
        first_valid_min: Time in motion to the first VALID [min], infinite if there is none.
        wrong: Share of the samples used in motion that are VALID with an error above 3 standard deviations.

    """

    error: float
    cover: float
    valid: float
    first_valid_min: float
    wrong: float


def course_of(truth: Truth, stamps_ns: NDArray[np.int64]) -> Course:
    """Return the truth at the stamps of samples."""
    at = np.maximum(np.searchsorted(truth.time_ns, stamps_ns, side='right') - 1, 0)
    start_ns = truth.time_ns[0]
    time_s = (stamps_ns - start_ns) / NS_PER_S
    speed = np.interp(time_s, (truth.time_ns - start_ns) / NS_PER_S, truth.speed)
    moving = speed >= MOVING
    motion_s = motion_time(time_s, moving)
    return Course(
        speed=speed,
        davis=np.stack((truth.a[at], truth.b[at], truth.c[at]), axis=1),
        moving=moving,
        motion_s=motion_s,
        settled=moving & (motion_since_change(time_s, motion_s, truth.changes) >= SETTLED_S),
    )


def motion_time(time_s: Array, moving: Mask) -> Array:
    """Return the time in motion so far [s]."""
    return np.cumsum(np.diff(time_s, prepend=0.0) * moving)


def motion_since_change(time_s: Array, motion_s: Array, changes: Sequence[float]) -> Array:
    """Return the time in motion since the start or the last change before each sample [s]."""
    begins = np.array([0.0, *changes])
    motion_then = np.array([0.0, *np.interp(begins[1:], time_s, motion_s)])
    since: Array = motion_s - motion_then[np.searchsorted(begins, time_s, side='right') - 1]
    return since


def answers_of(estimator: Estimator[ResistanceEstimate] | InformedFilter, samples: Sequence[Sample]) -> Answers:
    """Return the outputs of an estimator over samples; after a rejected sample the status is HOLDING."""
    rows = np.array([_row(estimator, sample) for sample in samples])
    used = rows[:, 4] > 0.5
    return Answers(rows[:, :3], rows[:, 3], used, used & (rows[:, 5] > 0.5))


def _row(estimator: Estimator[ResistanceEstimate] | InformedFilter, sample: Sample) -> tuple[float, ...]:
    rejected = estimator.step(sample) is not None
    now = estimator.estimate(sample.speed)
    return now.a, now.b, now.c, now.resistance_std, float(not rejected), float(estimator.converged)


def score(answers: Answers, course: Course) -> Score:
    """Score the outputs of one algorithm."""
    v = course.speed
    wrong = answers.davis - course.davis
    error = np.abs(wrong[:, 0] + v * (wrong[:, 1] + v * wrong[:, 2]))
    settled, used, valid = course.settled, course.moving & answers.used, course.moving & answers.valid
    far = valid & (error > _FAR * answers.std)
    return Score(
        error=_mean(error[settled]),
        cover=_mean((error <= _SIGMA_95 * answers.std)[settled]),
        valid=_mean(valid[course.moving]),
        first_valid_min=first_valid(course.motion_s, valid),
        wrong=_mean(far[used]),
    )


def first_valid(motion_s: Array, valid: Mask) -> float:
    """Return the time in motion to the first VALID [min]."""
    return float(motion_s[np.argmax(valid)]) / _S_PER_MIN if valid.any() else math.inf


def _mean(values: Array | Mask) -> float:
    return float(np.mean(values)) if values.size else math.nan

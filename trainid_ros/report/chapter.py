# SPDX-License-Identifier: Apache-2.0
"""A drive as a chapter of a report: its recording with the last estimates, and their accuracy if the truth is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.interface.records import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.interface.results import BrakeRateEstimate, Output, Reason, ResistanceEstimate, SpeedModelEstimate
    from trainid_ros.report.recording import Array, Recording, Track
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import Davis, TrainFile

# Two-sided normal quantile of 95 %.
SIGMA_95: Final = 1.959964


class RejectionCounts(NamedTuple):
    """Records and samples that one estimator did not use: its name, and their number by reason."""

    estimator: str
    counts: tuple[tuple[Reason, int], ...]


@dataclass(frozen=True, slots=True)
class Chapter:
    """One drive in a report."""

    title: str  # Heading
    bag: str  # Name of the bag
    train_file_name: str  # Name of the train file
    train_file: TrainFile  # The train file, whose values are the priors
    how: str  # How the estimators were run, as text
    recording: Recording  # Columns to plot
    resistance: Output[ResistanceEstimate]  # Last output of the resistance estimator
    speed_model: Output[SpeedModelEstimate]  # Last output of AM-VFF-RLS
    brake_rate: Output[BrakeRateEstimate]  # Last output of GSMA
    rejections: tuple[RejectionCounts, ...]  # Rejected samples by estimator
    truth: Truth | None = None  # True parameters, None if unknown
    notes: tuple[str, ...] = ()  # Further sentences, such as the outcome of a comparison
    others: tuple[tuple[str, Track], ...] = ()  # Resistance by other algorithms, by name


@dataclass(frozen=True, slots=True)
class AccuracyScore:
    """Errors over all usable outputs (VALID or HOLDING), in the unit of the quantity."""

    outputs: int  # Number of outputs compared
    bias: float  # Mean error, estimate less truth
    rms: float  # Root mean square error
    last: float  # Error of the last output
    inside_68: float  # Share of errors within one published standard deviation [1]
    inside_95: float  # Share of errors within 1.96 standard deviations [1]


def resistance_std(covariance: Array, speed: float | Array) -> Array:
    """Return the standard deviation of w [N/kN] at a speed [m/s] for covariances of a, b, c, shape (..., 3, 3)."""
    v = np.asarray(speed, dtype=np.float64)
    phi = np.stack([np.ones_like(v), v, v * v], axis=-1)
    variance: Array = np.einsum('...i,...ij,...j->...', phi, covariance, phi)
    std: Array = np.sqrt(np.maximum(0.0, variance))
    return std


def resistance_at(theta: Array, speed: float | Array) -> Array:
    """Return w = a + b v + c v^2 [N/kN] at a speed [m/s] for parameters of shape (..., 3)."""
    w: Array = theta[..., 0] + speed * (theta[..., 1] + speed * theta[..., 2])
    return w


def true_theta(truth: Truth, start_ns: int, time_s: Array) -> Array:
    """Return the true a, b, c [N/kN, v in m/s] at times since ``start_ns`` [s], shape (n, 3)."""
    points = (truth.truth_at_ns(start_ns + round(t * NS_PER_S)).resistance for t in time_s)
    return np.array([(point.a, point.b, point.c) for point in points]).reshape(-1, 3)


def true_rate(truth: Truth, start_ns: int, time_s: Array) -> Array | None:
    """Return the true brake rate [1] at times since ``start_ns`` [s], None if it is unknown."""
    if not truth.brake_rate:
        return None
    rates = [truth.truth_at_ns(start_ns + round(t * NS_PER_S)).brake_rate for t in time_s]
    return np.array([math.nan if rate is None else rate for rate in rates])


def score_resistance(recording: Recording, truth: Truth) -> AccuracyScore | None:
    """Score w [N/kN] at the current speed, None if no output was usable."""
    track = recording.resistance
    speed = track.column('speed')
    w = resistance_at(track.theta, speed)
    true = resistance_at(true_theta(truth, recording.start_ns, track.time_s), speed)
    return _score(w - true, resistance_std(track.covariance, speed), track.usable)


def score_brake_rate(recording: Recording, truth: Truth) -> AccuracyScore | None:
    """Score the brake rate [1], None if the truth is unknown or no output was usable."""
    track = recording.brake_rate
    if (true := true_rate(truth, recording.start_ns, track.time_s)) is None:
        return None
    return _score(track.column('brake_rate') - true, track.column('brake_rate_std'), track.usable)


def final_truth(recording: Recording, truth: Truth) -> tuple[Davis, float | None]:
    """Return the true resistance and brake rate [1] at the end of the recording."""
    point = truth.truth_at_ns(recording.start_ns + round(recording.duration_s * NS_PER_S))
    return point.resistance, point.brake_rate


def _score(error: Array, std: Array, usable: NDArray[np.bool_]) -> AccuracyScore | None:
    kept = usable & np.isfinite(error) & np.isfinite(std)
    if not kept.any():
        return None
    error, std = error[kept], std[kept]
    return AccuracyScore(
        outputs=len(error),
        bias=float(error.mean()),
        rms=float(np.sqrt(np.mean(np.square(error)))),
        last=float(error[-1]),
        inside_68=float(np.mean(np.abs(error) <= std)),
        inside_95=float(np.mean(np.abs(error) <= SIGMA_95 * std)),
    )

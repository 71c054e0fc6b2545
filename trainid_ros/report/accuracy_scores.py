# SPDX-License-Identifier: Apache-2.0
"""Accuracy of estimates against a known truth, and coverage of their standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.train_file import Davis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.report.traces import Array, Traces
    from trainid_ros.sim.truth import Truth

# Two-sided normal quantile of 95 %.
SIGMA_95: Final = 1.959964


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


def score_resistance(traces: Traces, truth: Truth) -> AccuracyScore | None:
    """Score w [N/kN] at the current speed, None if no output was usable."""
    trace = traces.resistance
    w = resistance_at(trace.theta, trace.speed)
    true = resistance_at(true_theta(truth, traces.start_ns, trace.time_s), trace.speed)
    return _score(w - true, resistance_std(trace.covariance, trace.speed), trace.usable)


def score_brake_rate(traces: Traces, truth: Truth) -> AccuracyScore | None:
    """Score the brake rate [1], None if the truth is unknown or no output was usable."""
    trace = traces.brake_rate
    if (true := true_rate(truth, traces.start_ns, trace.time_s)) is None:
        return None
    return _score(trace.rate - true, trace.std, trace.usable)


def final_truth(traces: Traces, truth: Truth) -> tuple[Davis, float | None]:
    """Return the true resistance and brake rate [1] at the end of the traces."""
    point = truth.truth_at_ns(traces.start_ns + round(traces.duration_s * NS_PER_S))
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

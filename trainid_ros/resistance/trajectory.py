# SPDX-License-Identifier: Apache-2.0
"""Motion without braking as arrays: pieces of a drive, each with its own initial speed, and the noise of its speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg.lapack import dtbtrs

from trainid_ros.estimators.admission import Admission
from trainid_ros.stream.known_force import KnownForce

if TYPE_CHECKING:
    from collections import Counter

    from numpy.typing import NDArray

    from trainid_ros.results import Reason, Rejection
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Ratio of the standard deviation to the median absolute deviation of a Gaussian.
_MAD: Final = 1.4826
# Median absolute difference of two rounding errors, in quanta.
_ROUNDED: Final = 1.0 - math.sqrt(0.5)
# Share of steps of a rounded speed that are not whole multiples of its quantum, due to errors of single messages.
_STRAY_STEPS: Final = 0.05


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Concatenated pieces; a stage leads from each node to the next one of its piece.

    Attributes:
        speed: Measured speed at the nodes [m/s], shape (n,).
        dt: Time since the previous node [s], 0 at the start of a piece, shape (n,).
        known: Mean known specific force since the previous node [N/kN], shape (n,).
        traction: Traction part of it [N/kN], shape (n,).
        inertia: Specific force per acceleration, 1000 (1 + gamma) / g [N/kN per m/s^2].

    """

    speed: NDArray[np.float64]
    dt: NDArray[np.float64]
    known: NDArray[np.float64]
    traction: NDArray[np.float64]
    inertia: float

    @property
    def starts(self) -> NDArray[np.intp]:
        """Start indices of the pieces, shape (m,)."""
        return np.flatnonzero(self.dt == 0.0)

    def traction_rate(self) -> NDArray[np.float64]:
        """Return the rate of traction over each stage [N/kN per s], 0 at the ends of pieces, shape (n,)."""
        stage, t = self.dt > 0.0, self.traction
        change = np.zeros_like(t)
        before = np.where(stage[:-2], t[:-2], t[1:-1])
        change[1:-1] = np.where(stage[1:-1] & stage[2:], 0.5 * (t[2:] - before), 0.0)
        return np.asarray(change / np.where(stage, self.dt, 1.0))


@dataclass(slots=True)
class PieceCollector:
    """Collector of the samples without braking for a trajectory.

    Attributes:
        train_file: Train file with train and effects.
        min_speed: Slowest speed to learn from [m/s].
        shortest: Shortest piece to use, given that each needs its own initial speed [s].

    """

    train_file: TrainFile
    min_speed: float
    shortest: float
    known: KnownForce = field(init=False)
    _nodes: list[tuple[float, float, float, float]] = field(init=False, default_factory=list)
    _begun: int = field(init=False, default=0)
    _admission: Admission = field(init=False)

    def __post_init__(self) -> None:
        self.known = KnownForce(self.train_file)
        self._admission = Admission(self.known, self.min_speed)

    def monitor(self, sample: Sample) -> None:
        """Update the drive history without adding the sample."""
        self._reject(sample)

    def _reject(self, sample: Sample) -> Rejection | None:
        rejection = self._admission.reject(sample)
        return sample.rejection or rejection

    def add(self, sample: Sample, rejected: Counter[Reason]) -> None:
        """Add one sample, or count the reason for its rejection."""
        rejection = self._reject(sample)
        if rejection is not None:
            rejected[rejection.reason] += 1
            self.end_piece()
            return
        traction = self.known.traction(sample.force_mean, sample)
        dt = sample.dt if len(self._nodes) > self._begun else 0.0
        self._nodes.append((sample.speed, dt, traction - self.known.track(sample), traction))

    def end_piece(self) -> None:
        """End the current piece, and remove it if it is too short."""
        if sum(node[1] for node in self._nodes[self._begun :]) < self.shortest:
            del self._nodes[self._begun :]
        self._begun = len(self._nodes)

    def trajectory(self) -> Trajectory:
        """Return all pieces collected so far."""
        self.end_piece()
        speed, dt, known, traction = np.array(self._nodes, dtype=float).reshape(-1, 4).T.copy()
        return Trajectory(speed, dt, known, traction, self.known.inertia)


def half_variance(y: NDArray[np.float64], piece: NDArray[np.intp], lag: int) -> float:
    """Return half the variance of increments over a lag within pieces; for white noise this is its variance.

    Args:
        y: A signal, shape (n,).
        piece: Index of the piece of each value, shape (n,).
        lag: Lag in values; at least one piece must be longer.

    """
    change = np.abs(y[lag:] - y[:-lag])[piece[lag:] == piece[:-lag]]
    middle = change.size // 2
    return 0.5 * (_MAD * float(np.partition(change, middle)[middle])) ** 2


def rounding_variance(given: Trajectory) -> float:
    """Return the :func:`half_variance` of rounding alone, for lags over which speed changes many quanta [(m/s)^2].

    The quantum is the smallest step of the measured speed, except for a few percent of the steps. With fine rounding
    the result is less than the noise.
    """
    steps = np.abs(np.diff(given.speed))[given.dt[1:] > 0.0]
    steps = steps[steps > 0.0]
    quantum = float(np.quantile(steps, _STRAY_STEPS)) if steps.size else 0.0
    return 0.5 * (_MAD * _ROUNDED * quantum) ** 2


def recur(k: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve ``x_i = k_i x_{i-1} + r_i``, x_0 = 0, for several right-hand sides: one LAPACK call, no loop over stages.

    Args:
        k: Coefficients of stages 1 to I, shape (I,); the first is not used.
        rows: Right-hand sides, shape (m, I).

    Returns:
        x_1 to x_I for each right-hand side, shape (m, I).

    """
    band = np.ones((2, k.size))
    band[1, :-1] = -k[1:]
    # Rows in C order are columns in Fortran order, so only the result is copied.
    x, _ = dtbtrs(band, rows.T, uplo='L', diag='U')
    result: NDArray[np.float64] = x.T
    return result

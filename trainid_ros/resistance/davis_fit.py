# SPDX-License-Identifier: Apache-2.0
"""Batch fit of a, b, c to speed trajectories in time, robust to gusts and slip.

The model is that of Xia et al. 2023 (TBRPI-SF), (3), over stages in *time*,
``v_i - v_{i-1} = mu_i (u_i - a - b m1_i - c m2_i)``, with mu = dt/inertia, the exact means m1, m2 of v and v^2 over a
stage of constant acceleration, and the mean known force u. The fit minimises, over a, b, c *and all speeds*,

``sum rho((v~_i - v_i)/sigma) + sum (defect_i)^2 / (D dt_i / inertia^2)``.

The first sum is objective (8), made robust by Huber's rho; the second one lets the trajectory deviate due to gusts and
map errors, as a random walk of density D. D -> 0 gives (8) itself. Without it all errors are modelled as white noise,
and the standard deviations of a long drive are ten times too small.

Reported forces have a delay and a gain error, which under traction bias the resistance. Both are parameters in
addition to a, b and c, with zero-mean priors, so that their remaining uncertainty is included in the covariance.

Each Gauss-Newton step linearises all stages at the current speeds and solves one tridiagonal system; the first one,
from the measured speeds and theta = 0, is integrated linear least squares. No speed is integrated from an uncertain
initial value, so the model can neither stall nor diverge. The initial speeds are free like all others.

The paper steps in distance; its formulation, for comparison, is in ``research/``. Steps in time need no position and
have no 1/v at a stop, and the exact balance over an interval holds for the time-mean force, which the aligned samples
contain. Distance steps would bring the noise of speeds into the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg.lapack import dptsv, dtbtrs

from trainid_ros.interface.errors import NoAnswerError, check_settings, setting
from trainid_ros.stream.known_force import Admission, KnownForce

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from trainid_ros.interface.results import Reason
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

# Ratio of the standard deviation to the median absolute deviation of a Gaussian.
_MAD: Final = 1.4826


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Pieces of a drive without braking, one after another; a stage leads from each node to the next of its piece."""

    speed: Array  # Measured speed at the nodes [m/s], shape (n,)
    dt: Array  # Time since the previous node [s], 0 at the start of a piece, shape (n,)
    known: Array  # Mean known specific force since the previous node [N/kN], shape (n,)
    traction: Array  # Traction part of it [N/kN], shape (n,)
    inertia: float  # Specific force per acceleration, 1000 (1 + gamma) / g0 [N/kN per m/s^2]

    @property
    def starts(self) -> NDArray[np.intp]:
        """Start indices of the pieces, shape (m,)."""
        return np.flatnonzero(self.dt == 0.0)

    def traction_rate(self) -> Array:
        """Return the rate of traction over each stage [N/kN per s], 0 at the ends of pieces, shape (n,)."""
        stage, t = self.dt > 0.0, self.traction
        change = np.zeros_like(t)
        before = np.where(stage[:-2], t[:-2], t[1:-1])
        change[1:-1] = np.where(stage[1:-1] & stage[2:], 0.5 * (t[2:] - before), 0.0)
        return np.asarray(change / np.where(stage, self.dt, 1.0))


class PieceCollector:
    """Collector of the samples without braking, from a slowest speed [m/s] and in pieces of a shortest duration [s]."""

    def __init__(self, train_file: TrainFile, min_speed: float, shortest: float) -> None:
        self.train_file, self._shortest = train_file, shortest
        self.known = KnownForce(train_file)
        self._nodes: list[tuple[float, float, float, float]] = []
        self._begun = 0
        self._admission = Admission(self.known, min_speed)

    def monitor(self, sample: Sample) -> None:
        """Update the drive history without adding the sample."""
        self._admission.reject(sample)

    def add(self, sample: Sample, rejected: Counter[Reason]) -> None:
        """Add one sample, or count the reason for its rejection."""
        unused = self._admission.reject(sample)
        if (rejection := sample.rejection or unused) is not None:
            rejected[rejection.reason] += 1
            self.end_piece()
            return
        traction = self.known.traction(sample.force_mean, sample)
        dt = sample.dt if len(self._nodes) > self._begun else 0.0
        self._nodes.append((sample.speed, dt, traction - self.known.track(sample), traction))

    def end_piece(self) -> None:
        """End the current piece, and remove it if it is too short."""
        if sum(node[1] for node in self._nodes[self._begun :]) < self._shortest:
            del self._nodes[self._begun :]
        self._begun = len(self._nodes)

    def trajectory(self) -> Trajectory:
        """Return all pieces collected so far."""
        self.end_piece()
        speed, dt, known, traction = np.array(self._nodes, dtype=float).reshape(-1, 4).T.copy()
        return Trajectory(speed, dt, known, traction, self.known.inertia)


def half_variance(y: Array, piece: NDArray[np.intp], lag: int) -> float:
    """Return half the variance of increments of y over a lag; for white noise this is its variance.

    Only increments within a piece count. ``piece`` is the index of the piece of each value, shape (n,) like y.
    """
    change = np.abs(y[lag:] - y[:-lag])[piece[lag:] == piece[:-lag]]
    middle = change.size // 2
    return 0.5 * (_MAD * float(np.partition(change, middle)[middle])) ** 2


def rounding_variance(given: Trajectory) -> float:
    """Return the :func:`half_variance` of rounding alone, for lags over which speed changes many quanta [(m/s)^2].

    The quantum is the smallest step of the measured speed, except for 5 % of the steps: errors of single messages.
    """
    steps = np.abs(np.diff(given.speed))[given.dt[1:] > 0.0]
    steps = steps[steps > 0.0]
    quantum = float(np.quantile(steps, 0.05)) if steps.size else 0.0
    median = 1.0 - math.sqrt(0.5)  # of the absolute difference of two rounding errors, in quanta
    return 0.5 * (_MAD * median * quantum) ** 2


def recur(k: Array, rows: Array) -> Array:
    """Solve ``x_i = k_i x_{i-1} + r_i``, x_0 = 0, for several right-hand sides.

    k has the shape (I,), its first entry is not used; rows r and the result x_1 to x_I have the shape (m, I).
    """
    band = np.ones((2, k.size))
    band[1, :-1] = -k[1:]
    # Rows in C order are columns in Fortran order, so only the result is copied.
    x, _ = dtbtrs(band, rows.T, uplo='L', diag='U')
    result: Array = x.T
    return result


# Typical sizes of a, b, c, force delay and force gain, used to scale the steps.
_SCALE: Final = np.array([1.0, 0.02, 0.001, 0.05, 0.005])
# Largest scaled step that is negligible, and maximum number of steps.
_STEP_TOLERANCE, _MAX_ITERATIONS = 1e-9, 30
# Weights and noise are updated from the residuals until they change by less than this, or for this many steps; then
# they are fixed, and the iteration continues until the step is negligible.
_SETTLED, _LEARNING_STEPS = 0.1, 8
# Number of stages of one change of traction, which share a timing error.
_CHANGE_STAGES: Final = 5.0
# Smallest standard deviation of the speed noise [m/s].
_MIN_STD: Final = 1e-4
# Weights of the declared values, since a short bag contains almost no information on either: that of the declared
# disturbance in observed lags, and that of the expected spread of the scores in clusters.
_DECLARED_LAGS, _DECLARED_CLUSTERS = 1.0, 6.0


@dataclass(frozen=True, slots=True)
class DavisFitConfig:
    """Settings of the batch fit."""

    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    shortest: float = setting(5.0, 'shortest piece between brakings to learn from', 's', 1.0, 600.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.1, 'unmodelled resistance at the start (then learned)', 'N/kN', 1e-6, 10.0)
    disturbance_time: float = setting(10.0, 'its correlation time', 's', 0.01, 600.0)
    force_skew: float = setting(0.06, 'unknown delay of the reported force, std', 's', 1e-9, 5.0)
    force_error: float = setting(0.005, 'unknown relative error of the traction force, std', '1', 1e-9, 0.5)
    force_jitter: float = setting(0.06, 'unknown delay of each change of the force, std', 's', 0.0, 5.0)
    learn_noise: bool = True  # whether the noise is learned from the data
    huber: float = setting(2.0, "residuals beyond this count linearly (Huber's rho)", 'standard deviations', 1.0, 1e9)
    cut: float = setting(6.0, 'residuals beyond this are excluded', 'standard deviations', 2.0, 1e9)
    noise_lag: float = setting(20.0, 'time lag over which the disturbance is measured', 's', 1.0, 600.0)
    cluster: float = setting(30.0, 'time after which errors count as independent', 's', 1.0, 3600.0)


@dataclass(frozen=True, slots=True)
class DavisFit:
    """Result of a batch fit."""

    theta: Array  # a, b, c [N/kN, v in m/s], shape (3,)
    covariance: Array  # Covariance of theta, shape (3, 3)
    force_delay: float  # Estimated delay of the reported force [s]
    force_gain: float  # Estimated relative error of the traction force [1]
    iterations: int  # Number of Gauss-Newton steps
    converged: bool  # True if the last step was negligible
    mse: float  # Objective (8): mean square of measured minus calculated speed, without the disturbance [(m/s)^2]
    speed_std: float  # Estimated noise of measured speed [m/s]
    disturbance: float  # Estimated density D of unmodelled resistance [(N/kN)^2 s]
    inflation: float  # Factor on the covariance, the spread of the cluster scores relative to the noise model, >= 1 [1]
    outliers: float  # Share of excluded speeds [1]
    speed_range: tuple[float, float]  # Slowest and fastest speed [m/s]
    pieces: int  # Number of pieces
    nodes: int  # Number of speeds

    def resistance(self, speed: float) -> tuple[float, float]:
        """Return w(v) and its standard deviation [N/kN] at a speed [m/s]."""
        phi = np.array([1.0, speed, speed * speed])
        return float(phi @ self.theta), math.sqrt(max(0.0, float(phi @ self.covariance @ phi)))


def fit_davis(trajectory: Trajectory, config: DavisFitConfig) -> DavisFit:
    """Fit a, b, c to all pieces at once.

    Raises:
        InputError: A setting is out of range.
        NoAnswerError: There are too few speeds, or they do not determine a, b and c separately.
    """
    check_settings(config)
    if trajectory.speed.size < 4 + trajectory.starts.size:
        raise NoAnswerError(
            f'{trajectory.speed.size} speeds without braking in {trajectory.starts.size} pieces are too few to fit'
        )
    work = _Iteration(trajectory, config)
    step, iterations, learning = math.inf, 0, True
    while (learning or step > _STEP_TOLERANCE) and iterations < _MAX_ITERATIONS:
        step = work.advance()
        iterations += 1
        if learning:
            learning = iterations <= _LEARNING_STEPS and work.update_noise() > _SETTLED
            if not learning:
                work.allow_for_parameters()
                step = math.inf
    return work.finish(iterations, step <= _STEP_TOLERANCE)


def check_plausible(fit: DavisFit, config: DavisFitConfig) -> None:
    """Raise NoAnswerError, naming the cause, if a fit is implausible for a train measured in the specified units.

    In other units the model cannot follow the motion: the fit classifies speeds as outliers, attributes the motion to
    gusts, or gives a negative resistance.
    """
    if odd := next(_oddities(fit, config), ''):
        raise NoAnswerError(
            f'{odd}: check the units and signs of speed, force, mass and gradient, and the speed sensor'
        )


def _oddities(fit: DavisFit, config: DavisFitConfig) -> Iterator[str]:
    slow, fast = fit.speed_range
    for v in (slow, 0.5 * (slow + fast), fast):
        w, std = fit.resistance(v)
        if w < -3.0 * std:
            yield f'a negative resistance of {w:.3g} N/kN (std {std:.2g}) at {v:.1f} m/s would drive the train'
    if abs(fit.force_gain) > 0.1:
        yield f'the fit requires a force error of {fit.force_gain:+.0%}'
    if fit.speed_std > 1.0:  # a quantum of 1 mph gives an eighth of it
        yield f'the speed noise is {fit.speed_std:.2g} m/s'
    gust = math.sqrt(fit.disturbance / (2.0 * config.disturbance_time))
    if gust > 4.0:  # as the resistance of a train; map errors of two per mille give half of it
        yield f'forces and resistance leave {gust:.2g} N/kN of the motion unexplained'
    if fit.outliers > 0.3:
        yield f'{fit.outliers:.0%} of the speeds are outliers'


@dataclass(frozen=True, slots=True)
class _Linear:
    """All stages linearised about v and theta: defect_i + D_i dv_i - N_i dv_{i-1} + F_i dtheta = 0."""

    defect: Array
    D: Array
    N: Array
    F: Array


class _Iteration:
    """Speeds, parameters, weights and noise in an iteration."""

    def __init__(self, trajectory: Trajectory, config: DavisFitConfig) -> None:
        self._given, self._config = trajectory, config
        self._starts = trajectory.starts
        self._mu = trajectory.dt / trajectory.inertia
        self._stage = trajectory.dt > 0.0
        self._piece = np.cumsum(~self._stage, dtype=np.intp)
        self._lengths = np.diff(np.append(self._starts, trajectory.dt.size))
        self._dt = float(np.median(trajectory.dt[self._stage]))
        self._lag = max(2, min(round(config.noise_lag / self._dt), int(self._lengths.max()) // 2))
        self._rounding = rounding_variance(trajectory)
        self._lags = float(np.maximum(self._lengths - self._lag, 0).sum()) / self._lag
        self._v = trajectory.speed.copy()
        self._theta = np.zeros(5)
        self._rate = trajectory.traction_rate()
        self._change = self._rate * trajectory.dt
        prior = np.array([math.inf, math.inf, math.inf, config.force_skew, config.force_error])
        self._prior = np.square(_SCALE / prior)
        self._weights = np.ones(self._v.size)
        self._variance = config.speed_std**2
        self._declared = 2.0 * config.disturbance_time * config.disturbance_std**2
        self._density = self._declared
        self._schur = np.eye(5)

    def _linear(self) -> _Linear:
        v1, mu = self._v, self._mu
        v0 = np.concatenate((v1[:1], v1[:-1]))
        m1 = 0.5 * (v0 + v1)
        m2 = (v0 * v0 + v0 * v1 + v1 * v1) / 3.0
        a, b, c, delay, gain = self._theta
        force = self._given.known + delay * self._rate + gain * self._given.traction
        defect = np.where(self._stage, v1 - v0 - mu * (force - a - b * m1 - c * m2), 0.0)
        third = c / 3.0
        half = 0.5 * b
        D = np.where(self._stage, 1.0 + mu * (half + third * (v0 + 2.0 * v1)), 0.0)
        N = np.where(self._stage, 1.0 - mu * (half + third * (2.0 * v0 + v1)), 0.0)
        F = np.array((mu, mu * m1, mu * m2, -mu * self._rate, -mu * self._given.traction))
        return _Linear(defect, D, N, F * _SCALE[:, None])

    def advance(self) -> float:
        """Make one Gauss-Newton step; return its largest scaled component."""
        lin, W = self._linear(), self._weights / self._variance
        L = self._precision()
        # Tridiagonal normal equations of dv, with dtheta and the right-hand side as additional columns.
        LD, LN = L * lin.D, L * lin.N
        diagonal = W + LD * lin.D + _ahead(LN * lin.N)
        beside = np.empty((6, W.size))
        FL = lin.F * L
        beside[:5] = FL * lin.D - _ahead(FL * lin.N)
        beside[5] = W * (self._given.speed - self._v) - LD * lin.defect + _ahead(LN * lin.defect)
        solved = _solve_tridiagonal(diagonal, -(LD * lin.N)[1:], beside)
        S = np.diag(self._prior) + FL @ lin.F.T - beside[:5] @ solved[:5].T
        h = -self._prior * self._theta / _SCALE - FL @ lin.defect - beside[:5] @ solved[5]
        self._schur = 0.5 * (S + S.T)
        delta = _solve(self._schur, h)
        self._v = self._v + solved[5] - delta @ solved[:5]
        self._theta = self._theta + _SCALE * delta
        return float(np.max(np.abs(delta)))

    def _precision(self) -> Array:
        """Return the inverse variances of the defects [(m/s)^-2], 0 where a piece begins."""
        force = self._density * self._given.dt + _CHANGE_STAGES * np.square(self._config.force_jitter * self._change)
        return np.where(self._stage, self._given.inertia**2 / np.where(self._stage, force, 1.0), 0.0)

    def update_noise(self) -> float:
        """Update noise and weights from the residuals; return their largest change."""
        config, before = self._config, (self._density, self._weights)
        if config.learn_noise:
            self._learn_noise()
        z = np.abs(self._given.speed - self._v) / math.sqrt(self._variance)
        weights = np.minimum(1.0, config.huber / np.maximum(z, config.huber))
        self._weights = np.where(z > config.cut, 1e-9, weights)
        moved = float(np.max(np.abs(self._weights - before[1])))
        return max(moved, abs(math.log(self._density / before[0])))

    def _learn_noise(self) -> None:
        """Estimate noise and density from medians of increments of the speed error.

        Increments over one step show the noise, those over a long lag noise plus drift. A few lags contain little
        information on the density, so it is the mean of n lags and of the declared density with the weight n0.
        """
        y, lag, dt = self._errors(self._linear()), self._lag, self._dt
        # Rounding hides the noise of one step, but is visible after many.
        short, long = max(half_variance(y, self._piece, 1), self._rounding), half_variance(y, self._piece, lag)
        drift = max(long - short, 0.0) / (lag - 1)  # D dt / (2 inertia^2)
        self._variance = max(short - drift, 0.25 * short, _MIN_STD**2)
        found = 2.0 * drift / dt * self._given.inertia**2
        n0, n = _DECLARED_LAGS, self._lags
        self._density = (n0 * self._declared + n * found) / (n0 + n)

    def allow_for_parameters(self) -> None:
        """Correct the density for the p fitted parameters, which use up p of n lags: divide by n0 + n - p.

        After the weights are fixed: with the larger density, slip in a short piece would count as gusts.
        """
        if self._config.learn_noise:
            n0, n = _DECLARED_LAGS, self._lags
            self._density *= (n0 + n) / (n0 + max(0.0, n - self._parameters()))

    def _parameters(self) -> float:
        """Return the effective number of parameters: 3 to 5, as the prior partly determines delay and gain."""
        return 5.0 - float(np.trace(_solve(self._schur, np.diag(self._prior))))

    def _errors(self, lin: _Linear) -> Array:
        """Return measured speeds minus those of the model without disturbance, up to an initial speed, shape (n,)."""
        inverse = np.where(self._stage, 1.0 / np.where(self._stage, lin.D, 1.0), 0.0)
        deviation = recur(lin.N * inverse, (lin.defect * inverse)[None, :])[0]
        return np.asarray(self._given.speed - self._v + deviation)

    def finish(self, iterations: int, converged: bool) -> DavisFit:
        """Return the result."""
        lin = self._linear()
        inflation = self._inflation(lin)
        factor = _SCALE[:, None] * np.linalg.inv(np.linalg.cholesky(self._schur)).T
        kept = self._weights > 1e-3
        speed = self._v[kept]
        return DavisFit(
            theta=self._theta[:3],
            covariance=inflation * (factor @ factor.T)[:3, :3],
            force_delay=float(self._theta[3]),
            force_gain=float(self._theta[4]),
            iterations=iterations,
            converged=converged,
            mse=self._mse(lin),
            speed_std=math.sqrt(self._variance),
            disturbance=self._density,
            inflation=inflation,
            outliers=float(1.0 - np.mean(kept)),
            speed_range=(float(speed.min()), float(speed.max())),
            pieces=self._starts.size,
            nodes=self._given.speed.size,
        )

    def _mse(self, lin: _Linear) -> float:
        """Return objective (8) with the best initial speed of each piece, over the speeds not excluded."""
        y, w = self._errors(lin), np.where(self._weights > 1e-3, 1.0, 0.0)
        k = np.where(self._stage, lin.N / np.where(self._stage, lin.D, 1.0), 0.0)
        grown = recur(k, np.where(self._stage, 0.0, 1.0)[None, :])[0]
        best = np.add.reduceat(w * grown * y, self._starts) / np.maximum(
            np.add.reduceat(w * grown * grown, self._starts), 1e-12
        )
        left = y - grown * np.repeat(best, self._lengths)
        return float((w * left) @ left / max(1.0, w.sum()))

    def _inflation(self, lin: _Linear) -> float:
        """Return the spread of the cluster scores relative to the noise model, averaged with the expected one; >= 1."""
        clusters = np.add.reduceat(lin.F * (self._precision() * lin.defect), self._cluster_starts(), axis=1)
        count = clusters.shape[1]
        spread = float(np.trace(_solve(self._schur, clusters @ clusters.T))) / self._parameters()
        free = max(0.0, count - 3.0)
        mean = (_DECLARED_CLUSTERS + count * spread) / (_DECLARED_CLUSTERS + free)
        return max(1.0, float(mean))

    def _cluster_starts(self) -> NDArray[np.intp]:
        """Return the start indices of the pieces, split where they last longer than a cluster."""
        time = np.cumsum(self._given.dt)
        since = time - np.repeat(time[self._starts], self._lengths)
        number = np.floor(since / self._config.cluster)
        fresh = ~self._stage
        fresh[1:] |= number[1:] != number[:-1]
        return np.flatnonzero(fresh)


def _ahead(x: Array) -> Array:
    """Return the contribution of the stage after each node."""
    return np.concatenate((x[..., 1:], np.zeros_like(x[..., :1])), axis=-1)


def _solve(S: Array, h: Array) -> Array:
    """Solve with the information matrix of theta; raise NoAnswerError if it is rank deficient."""
    size = np.sqrt(np.maximum(np.diag(S), 1e-300))
    unit = S / np.outer(size, size)
    if not np.all(np.isfinite(unit)) or np.linalg.eigvalsh(unit)[0] < 1e-11:
        raise NoAnswerError('the driven speeds do not determine a, b and c separately')
    return np.asarray(np.linalg.solve(S, h))


def _solve_tridiagonal(diagonal: Array, below: Array, rows: Array) -> Array:
    """Solve a symmetric tridiagonal system for rows of shape (m, n); raise NoAnswerError if it is not definite."""
    _, _, x, info = dptsv(diagonal, below, rows.T)
    if info != 0:
        raise NoAnswerError('speeds and forces do not determine a trajectory')
    result: Array = x.T
    return result

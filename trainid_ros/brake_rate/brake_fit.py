# SPDX-License-Identifier: Apache-2.0
"""Fit of dead time, lag and rate of a brake to brakings.

In each braking, with the command u after dead time and lags as z, the speed is

    v(t) = v0 + int r(v) z dt - int (track + w(v) - traction) dt,

with the measured speed in r and w. It is linear in v0, in the values of r at knots over speed, and in errors of the
resistance, the traction and the map, which have the priors of the train file. Dead time and lags are not linear. The
response of a piecewise constant command is exact, as that of :func:`~trainid_ros.train.forces.actuator_response`.

Errors of a braking are Gaussian: white noise of the speed, the integral of an acceleration that decorrelates with
distance (map and gusts), and, differing from braking to braking, a factor of the rate and a shift in time. The four
standard deviations have wide priors. All linear quantities are integrated out, so what is maximised over dead time,
lags and deviations is the evidence: variable projection, with weights from the data.

Models differ in their number of lags, in the knots of r, and in whether r steps at a changeover between brakes. Each
value of a knot pays by its prior; each of the other parameters pays ln(n) / 2 as in the Bayesian information criterion.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.stats import t as student

from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.stream.known_force import KnownForce

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.brake_rate.braking import Braking
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

# Number of points to which a braking is averaged, at most.
_POINTS: Final = 64
# Prior standard deviations of an initial speed [m/s], which may be anything, and of the mean rate [1].
_SPEED_STD: Final = 10.0
_RATE_STD: Final = 0.5
# Delay of the reported traction, std [s]: half a sample at 5 Hz.
_TRACTION_DELAY: Final = 0.1
# Usual scatter of the rate from braking to braking [1], and the spread of its prior, and of that of the other standard
# deviations [nepers]: within a factor of three, and of two. Assumed, without a source.
_SCATTER: Final = 0.03
_SCATTER_SPREAD: Final = 1.1
_SPREAD: Final = 0.7
# Time shift from braking to braking as a share of the timing error of the train file [s].
_JITTER_S: Final = 0.4
# Numbers of knots that are compared, between the speeds that 2 % of the braking is below, and above.
_KNOTS: Final = (1, 2, 3, 5)
_TAIL: Final = 0.02
# Speeds at which a changeover is looked for, and half the width of the step, as shares of the range of speeds [1].
_PLACES: Final = 19
_HALF: Final = 0.05
# Distance over which brakings at the same place share an error of the map [m].
_PLACE_M: Final = 200.0
# Step of differences of times [s], and shortest lag at which that of the lag is taken.
_STEP_S: Final = 0.05
_LEAST_LAG: Final = 0.25
# Means of dead time and lag from which the search starts, and shares of the lag in them [s, 1].
_STARTS: Final = (0.4, 0.8, 1.5, 3.0, 6.0, 12.0)
_SHARES: Final = (0.25, 0.75)
# Difference from the train file that is worth a word [standard deviations].
_DIFFERS: Final = 2.0
DEAD_TIME: Final = 'dead time'
LAG: Final = 'time constant'
RESPONSE: Final = 'response time'
RELEASE: Final = 'release later than application'
CHANGEOVER: Final = 'changeover speed'
STEP: Final = 'rate above less below it'
HOLD: Final = 'rate held less rate changing'
"""Names of quantities; those of rates end with the speed."""
# Gain of evidence below which a search ends [nats], and most steps.
_SETTLED: Final = 0.01
_MOST_STEPS: Final = 6
# A lag below this is none [s].
_NO_LAG: Final = 1e-3


def step_response(elapsed: Array, lags: Sequence[float]) -> Array:
    """Return the integral of the response to a unit step [s], up to times after it [s], of none, one or two lags."""
    s = np.maximum(elapsed, 0.0)
    some = [tau for tau in lags if tau > _NO_LAG]
    if not some:
        return s
    first, last = some[0], some[-1]
    if len(some) == 1:
        return s + first * np.expm1(-s / first)
    if abs(first - last) < 1e-3 * first:
        last = first * (1.0 - 1e-3)
    slow, fast = first * first * np.expm1(-s / first), last * last * np.expm1(-s / last)
    return np.asarray(s + (slow - fast) / (first - last))


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of a brake [s]."""

    delay: float  # Dead time of applications
    lags: tuple[float, ...]  # Time constants, one or two
    release: float = 0.0  # By how much later releases act

    @property
    def response(self) -> float:
        """Mean time by which the brake follows its command."""
        return self.delay + sum(self.lags)

    @property
    def first_order(self) -> tuple[float, float]:
        """Dead time and time constant of the first-order brake whose step response has the same area and spread."""
        lag = min(math.hypot(*self.lags), self.response)
        return self.response - lag, lag


@dataclass(frozen=True, slots=True)
class Quantity:
    """An estimated quantity, and whether the data can tell it."""

    name: str
    value: float
    std: float
    unit: str
    stated: float  # What the train file states
    wanted: float  # Standard deviation below which the data tell it: that of the train file, or what is required

    @property
    def is_told(self) -> bool:
        """True if the data tell the value."""
        return self.std < self.wanted

    @property
    def verdict(self) -> str:
        """Whether the data can tell the value, in words."""
        unit = '' if self.unit == '1' else f' {self.unit}'
        if not self.is_told:
            return f'the data cannot tell: wanted is a std of {self.wanted:.2g}{unit}'
        off = abs(self.value - self.stated) / self.std
        agrees = 'as' if off < _DIFFERS else f'{off:.1f} std from what'
        return f'the data tell: {agrees} the train file says, {self.stated:.3g}{unit}'


@dataclass(frozen=True, slots=True)
class BrakeFit:
    """Result of a fit."""

    timing: Timing  # Times as fitted
    quantities: tuple[Quantity, ...]  # What was estimated; dead time and time constant are first-order equivalents
    knots: tuple[float, ...]  # Speeds of the rates [m/s]; one if the rate does not depend on speed
    rates: Array  # Rates there [1], shape (n,)
    covariance: Array  # Covariance of the rates, shape (n, n)
    scatter: float  # Standard deviation of the rate from braking to braking [1]
    jitter: float  # Standard deviation of the response time from braking to braking [s]
    disturbance: float  # Standard deviation of the unmodelled acceleration [m/s^2]
    speed_noise: float  # That of a measured speed [m/s]
    speed_range: tuple[float, float]  # Speeds braked at [m/s]
    brakings: int  # Number of brakings
    models: tuple[tuple[str, float], ...]  # Models compared, with their evidence against the chosen one [nats]

    def find(self, name: str) -> Quantity | None:
        """Return the quantity of a name, None if it was not estimated."""
        return next((one for one in self.quantities if one.name == name), None)


@dataclass(frozen=True, slots=True)
class _Model:
    """Structure of a model."""

    lags: int
    knots: tuple[float, ...]
    half: float  # Half the width of the changeover [m/s]
    changeover: float = math.nan  # Speed [m/s]
    releases: bool = False
    hold: bool = False

    @property
    def name(self) -> str:
        """What tells it from other models."""
        rate = f'{len(self.knots)} knots' if len(self.knots) > 1 else 'one rate'
        step = f', changeover at {self.changeover:.1f} m/s' if math.isfinite(self.changeover) else ''
        return f'{"one lag" if self.lags == 1 else "two lags"}, {rate}{step}'

    @property
    def penalised(self) -> int:
        """Number of parameters that pay by the criterion."""
        return self.lags + math.isfinite(self.changeover)

    @property
    def rates(self) -> int:
        """Number of columns of the rate: knots, and the step of the changeover."""
        return len(self.knots) + math.isfinite(self.changeover)

    def shapes(self, v: Array) -> Array:
        """Return the columns of the rate over speeds, shape (n,) to (n, rates)."""
        knots = np.array(self.knots)
        columns = [np.interp(v, knots, row) for row in np.eye(knots.size)] if knots.size > 1 else [np.ones_like(v)]
        if math.isfinite(self.changeover):
            columns.append(0.5 * np.clip((v - self.changeover) / self.half, -1.0, 1.0))
        return np.stack(columns, axis=1)


class _Course:
    """A braking with what of its equations does not change: averages over groups of samples, shape (p,)."""

    def __init__(self, braking: Braking, length: float) -> None:
        t, v = braking.time, braking.speed
        self.braking, self.t = braking, t
        dt = np.diff(t, prepend=t[0])
        size = -(-t.size // _POINTS)
        self._starts = np.arange(0, t.size, size)
        self._counts = np.diff(np.append(self._starts, t.size))
        self.middle = np.maximum(0.5 * (v + np.concatenate((v[:1], v[:-1]))), 0.0)
        total = {name: np.cumsum(dt * getattr(braking, name)) for name in ('track', 'rolling', 'air', 'traction')}
        self.y = self.mean(v + total['track'] + total['rolling'] + total['air'] - total['traction'])
        traction = braking.traction - braking.traction[0]
        nuisances = (-total['rolling'], -total['air'], total['traction'], -traction, -(t - t[0]))
        self.nuisances = self.mean(np.stack(nuisances, axis=1))
        way = np.cumsum(dt * self.middle)
        kernel = np.exp(-np.abs(way[:, None] - way[None, :]) / length) * np.outer(dt, dt)
        drift = self.mean(self.mean(np.cumsum(np.cumsum(kernel, axis=0), axis=1)).T)
        # In these axes noise of the speed has the variance 1, and the drift the eigenvalues.
        root = np.sqrt(self._counts)
        self.drift, axes = np.linalg.eigh(drift * np.outer(root, root))
        self.axes = axes.T * root
        times, values = np.array(braking.changes).T
        self._times, self._steps = times, np.diff(values, prepend=0.0)
        self.is_release = self._steps > 0.0
        self.braked = np.interp(t, times, values, left=0.0) < 0.0

    def mean(self, values: Array) -> Array:
        """Return the means of groups of samples, shapes (n,) to (p,) or (n, k) to (p, k)."""
        counts = self._counts if values.ndim == 1 else self._counts[:, None]
        return np.asarray(np.add.reduceat(values, self._starts, axis=0) / counts)

    def columns(self, timing: Timing, model: _Model) -> Array:
        """Return the change of speed by the brake for each column of the rate [m/s], shape (p, rates)."""
        at = self._times + timing.delay + np.where(self.is_release, timing.release, 0.0)
        at = np.minimum.accumulate(at[::-1])[::-1]  # a later change overtakes one that has not acted yet
        z = step_response(self.t[:, None] - at, timing.lags) @ self._steps
        braked = np.diff(z, prepend=z[0]) * self.braking.share
        parts = braked[:, None] * model.shapes(self.middle)
        if model.hold:
            target = np.where(self.t[:, None] >= at, self._steps, 0.0).sum(axis=1)
            rate = braked / np.maximum(np.diff(self.t, prepend=self.t[0] - 1.0), 1e-6)
            held = np.abs(rate - target) < 0.1 * np.abs(target)
            parts = np.column_stack((parts, braked * (held - float(held[braked < 0.0].mean() if braked.any() else 0))))
        return self.mean(np.cumsum(parts, axis=0))


class _Problem:
    """The brakings, with the priors of the train file."""

    def __init__(self, brakings: Sequence[Braking], train_file: TrainFile) -> None:
        config, train = BrakeRateConfig(), train_file.train
        inertia = KnownForce(train_file).inertia
        self.courses = [_Course(braking, config.disturbance_length) for braking in brakings]
        self.drift = np.concatenate([course.drift for course in self.courses])
        sizes = [course.y.size for course in self.courses]
        self.points, self.starts = sum(sizes), np.cumsum([0, *sizes[:-1]])
        self.brake, self.rate_std = train_file.brake, config.prior_std
        force, gradient = math.hypot(train.mass_std, train.force_std), train_file.line.gradient_std / inertia
        self._common = np.array([config.resistance_std, config.resistance_std, force, _TRACTION_DELAY])
        # Brakings at the same place have the same error of the map.
        places = [self._place(course.braking) for course in self.courses]
        shared = [place for place, count in Counter(places).items() if count > 1 and place is not None]
        self._places = [shared.index(place) if place in shared else -1 for place in places]
        self._nuisance_std = np.concatenate((self._common, np.full(len(shared), gradient)))
        noise = float(np.median([course.braking.noise_std for course in self.courses]))
        self.usual = np.log([noise, math.hypot(config.disturbance_std, gradient), _SCATTER, _JITTER_S * self.brake.timing_std])
        self.spread = np.array([_SPREAD, _SPREAD, _SCATTER_SPREAD, _SPREAD])

        speeds = np.concatenate([course.braking.speed[course.braked] for course in self.courses])
        low, high = np.quantile(speeds, (_TAIL, 1.0 - _TAIL)).tolist()
        self.speeds = (low, max(high, low + 1.0))
        self.releases = any(course.is_release.any() for course in self.courses)

    @staticmethod
    def _place(braking: Braking) -> tuple[int, int] | None:
        known = braking.position[np.isfinite(braking.position)]
        return (round(float(known[-1]) / _PLACE_M), braking.direction) if known.size else None

    def prior(self, model: _Model) -> tuple[Array, Array]:
        """Return mean and precision of the linear quantities: rates and step, hold, nuisances."""
        rates, extra = len(model.knots), model.rates - len(model.knots) + model.hold
        # The mean rate may be anything; its change over speed is of the size that is usual.
        change = self.rate_std**2 * np.eye(rates) if rates > 1 else np.zeros((1, 1))
        stds = np.concatenate((np.full(extra, self.rate_std), self._nuisance_std))
        precision = np.zeros((rates + stds.size, rates + stds.size))
        precision[:rates, :rates] = np.linalg.inv(_RATE_STD**2 + change)
        precision[range(rates, rates + stds.size), range(rates, rates + stds.size)] = 1.0 / np.square(stds)
        mean = np.zeros(rates + stds.size)
        mean[:rates] = [self.brake.rate_at(v) for v in model.knots]
        return mean, precision

    def nuisances(self, k: int) -> Array:
        """Return the nuisance columns of a braking, shape (p, m)."""
        all_of = self.courses[k].nuisances
        columns = np.zeros((all_of.shape[0], self._nuisance_std.size))
        columns[:, :4] = all_of[:, :4]
        if self._places[k] >= 0:
            columns[:, 4 + self._places[k]] = all_of[:, 4]
        return columns


@dataclass(frozen=True, slots=True)
class _State:
    """A fitted model."""

    model: _Model
    timing: Timing
    sizes: Array  # Logarithms of noise, disturbance, scatter and jitter
    rates: Array  # Values of the columns of the rate
    evidence: float  # Logarithm of the evidence, less what the parameters pay [nats]


@dataclass(frozen=True, slots=True)
class _Design:
    """Equations of all brakings, one after another, in axes in which their errors are independent, shape (P, ...).

    ``y`` is the measured less the expected speed [m/s]; the columns F are those of the linear quantities and of the
    times, the columns U those that each braking has by itself: its initial speed, its factor, and its shift.
    """

    y_F: Array  # y and F, shape (P, 1 + m)
    U: Array  # Shape (P, 3)


@dataclass(frozen=True, slots=True)
class _Solution:
    """Linear quantities and times at given standard deviations."""

    evidence: float  # Logarithm of the evidence [nats]
    estimate: Array  # Rates, step, hold, nuisances, and steps of the times, shape (m,)
    information: Array  # Inverse of their covariance, shape (m, m)


class _Fit:
    """Search for the best model."""

    def __init__(self, problem: _Problem) -> None:
        self._problem = problem

    def design(self, model: _Model, timing: Timing, rates: Array, floor: float = math.nan) -> _Design:
        """Return the equations at some times and rates, with the columns of the times if a shortest lag is given."""
        problem, (mean, _) = self._problem, self._problem.prior(model)
        moved = [] if math.isnan(floor) else _moved(timing, model, floor)
        rows = []
        for k, course in enumerate(problem.courses):
            X = course.columns(timing, model)
            factor = X[:, : model.rates] @ rates
            late = course.columns(replace(timing, delay=timing.delay + _STEP_S), model)[:, : model.rates]
            linear = np.column_stack((X, problem.nuisances(k)))
            changes = [course.columns(after, model) - course.columns(before, model) for after, before in moved]
            steps = [change[:, : model.rates] @ rates / _STEP_S for change in changes]
            y = course.y - course.braking.speed[0] - linear @ mean
            own = (np.ones_like(y), factor, (late @ rates - factor) / _STEP_S)
            rows.append(course.axes @ np.column_stack((y, linear, *steps, *own)))
        joined = np.concatenate(rows)
        return _Design(joined[:, :-3], joined[:, -3:])

    def solve(self, model: _Model, design: _Design, sizes: Array) -> _Solution:
        """Solve the equations at logarithms of the standard deviations."""
        problem, (mean, precision) = self._problem, self._problem.prior(model)
        noise, drift, scatter, jitter = np.exp(2.0 * sizes)
        w = 1.0 / (noise + drift * problem.drift)
        own = 1.0 / np.array([_SPEED_STD**2, scatter, jitter])
        wU = design.U * w[:, None]
        M = np.add.reduceat(wU[:, :, None] * design.U[:, None, :], problem.starts) + np.diag(own)
        B = np.add.reduceat(wU[:, :, None] * design.y_F[:, None, :], problem.starts)
        S = design.y_F.T @ (w[:, None] * design.y_F) - np.einsum('kij,kil->jl', B, np.linalg.solve(M, B))
        A, b, m = S[1:, 1:], S[1:, 0], mean.size
        A[:m, :m] += precision
        # Times have no prior, so they are not integrated out.
        root = np.linalg.cholesky(A[:m, :m])
        z = solve_triangular(root, b[:m], lower=True)
        total = float(z @ z) - float(S[0, 0]) - 2.0 * float(np.log(np.diag(root)).sum())
        total += float(np.linalg.slogdet(precision)[1]) + float(np.log(w).sum())
        total -= float(np.linalg.slogdet(M)[1].sum()) - len(M) * float(np.log(own).sum())
        total -= float(np.square((sizes - problem.usual) / problem.spread).sum())
        estimate = np.linalg.lstsq(A, b, rcond=1e-12)[0]
        estimate[:m] += mean
        return _Solution(0.5 * total, estimate, A)

    def first(self) -> _State:
        """Return the state to start from: the best of some times, with one rate and usual standard deviations."""
        problem = self._problem
        model = _Model(1, (sum(problem.speeds) / 2,), _HALF * (problem.speeds[1] - problem.speeds[0]), releases=problem.releases)
        rates = np.array([problem.brake.rate_at(model.knots[0])])
        times = [Timing((1.0 - share) * mean, (share * mean,)) for mean in _STARTS for share in _SHARES]
        states = [_State(model, at, problem.usual, rates, self._at(model, at, problem.usual, rates)) for at in times]
        return max(states, key=_evidence)

    def _at(self, model: _Model, timing: Timing, sizes: Array, rates: Array) -> float:
        return self.solve(model, self.design(model, timing, rates), sizes).evidence

    def places(self, state: _State) -> list[tuple[float, float]]:
        """Return speeds of a changeover and the evidence of each."""
        low, high = self._problem.speeds
        half, count = state.model.half, state.model.rates - math.isfinite(state.model.changeover)
        rates = np.append(state.rates[:count], 0.0)
        speeds = np.linspace(low + 2.0 * half, high - 2.0 * half, _PLACES).tolist()
        models = (replace(state.model, changeover=speed) for speed in speeds)
        return [(one.changeover, self._at(one, state.timing, state.sizes, rates)) for one in models]

    def settle(self, state: _State, rounds: int = 3) -> _State:
        """Return a model with its times, standard deviations and rates at the maximum of the evidence."""
        model, problem = state.model, self._problem
        paid = 0.5 * model.penalised * math.log(problem.points)
        timing, sizes, rates = state.timing, state.sizes, state.rates
        evidence = -math.inf
        for _ in range(rounds):
            design = self.design(model, timing, rates)
            cost = lambda x, at=design: -self.solve(model, at, x).evidence  # noqa: E731
            limits = [(u - 6.0 * s, u + 6.0 * s) for u, s in zip(problem.usual, problem.spread, strict=True)]
            sizes = minimize(cost, sizes, method='L-BFGS-B', bounds=limits, options={'ftol': 1e-6}).x
            before = evidence
            timing, rates, evidence = self._move(model, timing, rates, sizes)
            if evidence - before < _SETTLED:
                break
        return _State(model, timing, sizes, rates, evidence - paid)

    def _move(self, model: _Model, timing: Timing, rates: Array, sizes: Array) -> tuple[Timing, Array, float]:
        """Return times and rates after Gauss-Newton steps, and the evidence there."""
        best = self.solve(model, self.design(model, timing, rates), sizes)
        for _ in range(_MOST_STEPS):
            rates = best.estimate[: model.rates]
            count = 1 + model.lags + model.releases
            step = self.solve(model, self.design(model, timing, rates, _NO_LAG), sizes).estimate[-count:]
            before = best.evidence
            for share in (1.0, 0.5, 0.2, 0.05):
                trial = _shifted(timing, share * step)
                found = self.solve(model, self.design(model, trial, rates), sizes)
                if found.evidence > best.evidence:
                    timing, best = trial, found
                    break
            if best.evidence - before < _SETTLED:
                break
        return timing, best.estimate[: model.rates], best.evidence


    def result(self, state: _State, train_file: TrainFile, models: tuple[tuple[str, float], ...]) -> BrakeFit:
        """Return a fitted model with its standard deviations."""
        model, timing, problem = state.model, state.timing, self._problem
        config, brake, count = BrakeRateConfig(), train_file.brake, len(problem.courses)
        # As few brakings show little of their scatter, a t distribution has its place.
        widen = float(student.ppf(0.975, count) / student.ppf(0.975, math.inf)) ** 2
        solution = self.solve(model, self.design(model, timing, state.rates, _LEAST_LAG), state.sizes)
        P = widen * np.linalg.inv(solution.information)
        n, times = model.rates, slice(-(1 + model.lags + model.releases), None)
        T = P[times, times]
        grown = [_shifted(timing, _STEP_S * row) for row in np.eye(1 + model.lags)]
        base = np.array(timing.first_order)
        J = np.array([(np.array(one.first_order) - base) / _STEP_S for one in grown]).T
        first_order, k = J @ T[: 1 + model.lags, : 1 + model.lags] @ J.T, 1 + model.lags
        stds = np.sqrt(np.diag(first_order))
        delay_std, lag_std = brake.timing_stds
        wanted = math.hypot(delay_std, lag_std)
        found = [
            Quantity(DEAD_TIME, float(base[0]), float(stds[0]), 's', brake.delay, delay_std),
            Quantity(LAG, float(base[1]), float(stds[1]), 's', brake.time_constant, lag_std),
            Quantity(RESPONSE, timing.response, math.sqrt(T[:k, :k].sum()), 's', brake.delay + brake.time_constant, wanted),
        ]
        knots = np.array(model.knots)
        if math.isfinite(model.changeover):
            knots = np.unique(np.append(knots[knots.size == 1 :], model.changeover + model.half * np.array([-1.0, 1.0])))
        shapes = model.shapes(knots)
        rates, covariance = shapes @ solution.estimate[:n], shapes @ P[:n, :n] @ shapes.T
        for speed, rate, std in zip(knots, rates, np.sqrt(np.diag(covariance)), strict=True):
            at = float(speed)
            found.append(Quantity(f'rate at {at:.1f} m/s', float(rate), float(std), '1', brake.rate_at(at), config.valid_std))
        if model.releases:
            found.append(Quantity(RELEASE, timing.release, math.sqrt(T[-1, -1]), 's', 0.0, wanted))
        if math.isfinite(model.changeover):
            speeds, evidence = np.array(self.places(state)).T
            weights = np.exp(evidence - evidence.max()) / np.exp(evidence - evidence.max()).sum()
            at, spacing = float(weights @ speeds), (speeds[1] - speeds[0]) / math.sqrt(12.0)
            std = math.hypot(math.sqrt(weights @ np.square(speeds - at)), spacing)
            found.append(Quantity(CHANGEOVER, at, std, 'm/s', config.blend_speed, config.blend_speed))
            step = float(solution.estimate[n - 1]), math.sqrt(P[n - 1, n - 1])
            found.append(Quantity(STEP, *step, '1', 0.0, config.valid_std))
        held = replace(model, hold=True)
        more = self.solve(held, self.design(held, timing, state.rates, _LEAST_LAG), state.sizes)
        std = math.sqrt(widen * np.linalg.inv(more.information)[n, n])
        found.append(Quantity(HOLD, float(more.estimate[n]), std, '1', 0.0, config.valid_std))
        noise, drift, scatter, jitter = np.exp(state.sizes).tolist()
        return BrakeFit(
            timing, tuple(found), tuple(knots.tolist()), rates, covariance, scatter, jitter, drift, noise,
            problem.speeds, count, models,
        )  # fmt: skip


def _moved(timing: Timing, model: _Model, floor: float) -> list[tuple[Timing, Timing]]:
    """Return the pairs of times whose differences show dead time, lags and release."""
    base = replace(timing, lags=tuple(max(lag, floor) for lag in timing.lags))
    pairs = [(replace(timing, delay=timing.delay + _STEP_S), timing)]
    for j, lag in enumerate(base.lags):
        longer = tuple(lag + _STEP_S if i == j else other for i, other in enumerate(base.lags))
        pairs.append((replace(base, lags=longer), base))
    if model.releases:
        pairs.append((replace(timing, release=timing.release + _STEP_S), timing))
    return pairs


def _shifted(timing: Timing, step: Array) -> Timing:
    """Return times after a step of dead time, lags and release [s]."""
    lags = tuple(max(0.0, lag + by) for lag, by in zip(timing.lags, step[1:].tolist(), strict=False))
    release = timing.release + float(step[len(lags) + 1]) if step.size > len(lags) + 1 else 0.0
    return Timing(max(0.0, timing.delay + float(step[0])), lags, release)


def fit_brake(brakings: Sequence[Braking], train_file: TrainFile) -> BrakeFit:
    """Fit the brake to brakings; NoAnswerError if there is none."""
    if not brakings:
        raise NoAnswerError('no braking from a released brake was found')
    problem = _Problem(brakings, train_file)
    fit, tried = _Fit(problem), dict[str, _State]()

    def settle(model: _Model, start: _State) -> _State:
        rates = np.array([train_file.brake.rate] * model.rates)
        rates[: len(model.knots)] = np.interp(model.knots, start.model.knots, start.rates[: len(start.model.knots)])
        rates[len(model.knots) :] = 0.0
        lags = start.timing.lags
        if len(lags) != model.lags:
            lags = (0.7 * lags[0], 0.4 * lags[0]) if model.lags == 2 else (start.timing.first_order[1],)
        found = fit.settle(_State(model, replace(start.timing, lags=lags), start.sizes, rates, 0.0))
        tried[model.name] = found
        return found

    first = fit.first()
    best = settle(first.model, first)
    best = max(best, settle(replace(best.model, lags=2), best), key=_evidence)
    number = best
    for count in _KNOTS[1:]:
        knots = tuple(np.linspace(*problem.speeds, count).tolist())
        best = max(best, settle(replace(number.model, knots=knots), number), key=_evidence)
    for start in dict.fromkeys((number.model, best.model)):
        at = tried[start.name]
        place = max(fit.places(at), key=lambda one: one[1])[0]
        best = max(best, settle(replace(start, changeover=place), at), key=_evidence)
    best = max(best, settle(replace(best.model, lags=3 - best.model.lags), best), key=_evidence)
    models = tuple((name, state.evidence - best.evidence) for name, state in tried.items())
    return fit.result(best, train_file, models)


def _evidence(state: _State) -> float:
    return state.evidence

# SPDX-License-Identifier: Apache-2.0
"""Fit of dead time, lags and rate of a brake to brakings.

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
value of a knot pays by its prior; a lag and a changeover pay ln(n) / 2 as in the Bayesian information criterion.
Standard deviations also cover the models that are worse, by their evidence.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import stdtrit

from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.stream.known_force import KnownForce

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.brake_rate.braking import Braking
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_POINTS: Final = 64  # Points to which a braking is averaged, at most
_SPEED_STD: Final = 10.0  # Prior std of an initial speed, which may be anything [m/s]
_RATE_STD: Final = 0.5  # Prior std of the mean rate [1]
_TIME_STD: Final = 100.0  # Prior std of dead time, lags and a later release, which may be anything [s]
_TRACTION_DELAY: Final = 0.1  # Delay of the reported traction, std [s]: half a sample at 5 Hz
# Usual scatter of the rate from braking to braking [1], shift of the response as a share of the timing error of the
# train file [s], and how wide their priors are [nepers]: within a factor of two or three. Assumed, without a source.
_SCATTER: Final = 0.03
_JITTER_S: Final = 0.4
_SPREAD: Final = np.array([0.7, 0.7, 1.1, 0.7])
_KNOTS: Final = (5, 3, 2, 1)  # Numbers of knots compared, over the speeds braked at but for this share at each end
_TAIL: Final = 0.02
# Places at which a changeover is looked for, and half the width of the step, as a share of the range of speeds [1].
_PLACES: Final = 19
_HALF: Final = 0.05
_PLACE_M: Final = 200.0  # Distance within which brakings share an error of the map [m]
_STEP_S: Final = 0.05  # Step of difference quotients of times [s]
_LEAST_LAG: Final = 0.25  # Lag from which they are taken for standard deviations, as in ``Brake.timing_stds`` [s]
_NO_LAG: Final = 1e-3  # A lag below this is none [s]
# Response times from which the search starts [s], shares of the lag in them, and more drift than usual [nepers].
_STARTS: Final = (0.4, 0.8, 1.5, 3.0, 6.0, 12.0)
_SHARES: Final = (0.25, 0.75)
_FAR: Final = 2.0
_SETTLED: Final = 0.01  # Gain of evidence that ends a search [nats]
_ROUNDS, _MOST_STEPS = 3, 6
_DIFFERS: Final = 2.0  # Difference from the train file that is worth a word [std]
_STEADY: Final = 0.1  # A brake is held while it is within this share of its command [1]

DEAD_TIME: Final = 'dead time'
LAG: Final = 'time constant'
RESPONSE: Final = 'response time'
_RATE: Final = 'rate at'
RELEASE: Final = 'release later than application'
CHANGEOVER: Final = 'changeover speed'
STEP: Final = 'rate above less rate below it'
HOLD: Final = 'rate while held less rate while changing'
"""Names of quantities; those of rates end with the speed."""


def step_response(elapsed: Array, lags: Sequence[float]) -> Array:
    """Return the integral of the response to a unit step [s], up to times after it [s], of none, one or two lags."""
    s, some = np.maximum(elapsed, 0.0), [tau for tau in lags if tau > _NO_LAG]
    if not some:
        return s
    first, last = some[0], some[-1]
    if len(some) == 1:
        return np.asarray(s + first * np.expm1(-s / first))
    last = last if abs(first - last) > _NO_LAG * first else first * (1.0 - _NO_LAG)
    slow, fast = first * first * np.expm1(-s / first), last * last * np.expm1(-s / last)
    return np.asarray(s + (slow - fast) / (first - last))


def first_order(times: Array) -> tuple[float, float, float]:
    """Return dead time and lag of the first-order brake with the same area and spread of its step response, and area.

    ``times`` are dead time, how much later releases act, and the lags [s]. The area is the mean response time [s].
    """
    response = float(times[0] + times[2:].sum())
    lag = min(float(np.linalg.norm(times[2:])), response)
    return response - lag, lag, response


@dataclass(frozen=True, slots=True)
class Quantity:
    """An estimated quantity, and whether the data can tell it."""

    name: str
    value: float
    std: float
    unit: str
    stated: float  # What the train file says, NaN if nothing
    wanted: float  # Std below which the data tell the value: that of the train file, or of the estimator's prior

    @property
    def is_told(self) -> bool:
        """True if the data tell the value, or contradict the one stated."""
        return self.std < self.wanted or abs(self.value - self.stated) > _DIFFERS * math.hypot(self.std, self.wanted)

    @property
    def agrees(self) -> bool:
        """True if the train file states about the same."""
        return abs(self.value - self.stated) < _DIFFERS * self.std

    @property
    def verdict(self) -> str:
        """Whether the data can tell the value, in words."""
        unit = '' if self.unit == '1' else f' {self.unit}'
        if not self.is_told:
            return f'the data cannot tell: its std would have to be below {self.wanted:.2g}{unit}'
        if math.isnan(self.stated):
            return 'the data tell'
        if self.agrees:
            return f'the data tell: as in the train file, {self.stated:.3g}{unit}'
        off = abs(self.value - self.stated) / self.std
        return f'the data contradict the train file, {self.stated:.3g}{unit}, by {off:.1f} std'


@dataclass(frozen=True, slots=True)
class BrakeFit:
    """Result of a fit."""

    quantities: tuple[Quantity, ...]  # What was estimated; dead time and lag are those of the first-order equivalent
    lags: tuple[float, ...]  # Time constants as fitted, one or two [s]
    knots: tuple[float, ...]  # Speeds of the rates [m/s]; one if the rate does not depend on speed
    rates: Array  # Rates there [1], shape (n,)
    covariance: Array  # Their covariance, shape (n, n)
    scatter: float  # Standard deviation of the rate from braking to braking [1]
    jitter: float  # That of the response time [s]
    speed_range: tuple[float, float]  # Speeds braked at [m/s]
    brakings: int  # Number of brakings
    models: tuple[tuple[str, float], ...]  # Models compared, with their evidence less that of the chosen one [nats]

    def find(self, name: str) -> Quantity:
        """Return the quantity of a name."""
        return next(one for one in self.quantities if one.name == name)

    @property
    def tells_rate(self) -> bool:
        """True if the data tell the rate at some speed."""
        return any(one.is_told for one in self.quantities if one.name.startswith(_RATE))


@dataclass(frozen=True, slots=True)
class _Model:
    lags: int
    knots: tuple[float, ...]
    half: float  # Half the width of the changeover [m/s]
    changeover: float = math.nan  # Its speed [m/s], NaN without one
    hold: bool = False

    @property
    def steps(self) -> int:
        return int(math.isfinite(self.changeover))

    @property
    def rates(self) -> int:
        """Number of columns of the rate."""
        return len(self.knots) + self.steps

    @property
    def name(self) -> str:
        step = f' and a changeover at {self.changeover:.1f} m/s' if self.steps else ''
        return f'{self.lags} lag{"s" * (self.lags > 1)}, {len(self.knots)} rate{"s" * (len(self.knots) > 1)}{step}'

    def shapes(self, v: Array) -> Array:
        """Return the columns of the rate over speeds, shape (n,) to (n, rates)."""
        columns = [np.interp(v, self.knots, row) for row in np.eye(len(self.knots))]
        if self.steps:
            columns.append(0.5 * np.clip((v - self.changeover) / self.half, -1.0, 1.0))
        return np.stack(columns, axis=-1)


class _Course:
    """A braking with what of its equations does not change: averages over groups of samples, shape (p, ...)."""

    def __init__(self, braking: Braking, length: float) -> None:
        t, v = braking.time, braking.speed
        self.braking, self._t = braking, t
        self._dt = np.diff(t, prepend=t[0])
        self._starts = np.arange(0, t.size, -(-t.size // _POINTS))
        self._counts = np.diff(np.append(self._starts, t.size))
        self._middle = 0.5 * (v + np.concatenate((v[:1], v[:-1])))
        track, rolling, air, traction = (
            np.cumsum(self._dt * one) for one in (braking.track, braking.rolling, braking.air, braking.traction)
        )
        self.y = self.mean(v - v[0] + track + rolling + air - traction)
        pulled = braking.traction - braking.traction[0]
        self.nuisances = self.mean(np.stack((-rolling, -air, traction, -pulled, t[0] - t), axis=1))
        way = np.cumsum(self._dt * self._middle)
        kernel = np.exp(-np.abs(way[:, None] - way) / length) * np.outer(self._dt, self._dt)
        drift = self.mean(self.mean(np.cumsum(np.cumsum(kernel, axis=0), axis=1)).T)
        # In these axes noise of the speed has the variance 1, and the drift the eigenvalues.
        root = np.sqrt(self._counts)
        self.drift, axes = np.linalg.eigh(drift * np.outer(root, root))
        self.axes = axes.T * root
        self._at, values = np.array(braking.changes).T
        self._steps = np.diff(values, prepend=0.0)
        braked = v[np.interp(t, self._at, values, left=0.0) < 0.0]
        self.braked = braked if braked.size else v
        self.is_released = bool((self._steps > 0.0).any())

    def mean(self, values: Array) -> Array:
        """Return the means of groups of samples, shapes (n, ...) to (p, ...)."""
        sums = np.add.reduceat(values, self._starts, axis=0)
        return np.asarray(sums / (self._counts if values.ndim == 1 else self._counts[:, None]))

    def columns(self, times: Array, model: _Model) -> Array:
        """Return the change of speed by the brake for each column of the rate [m/s], shape (p, rates)."""
        at = self._at + times[0] + times[1] * (self._steps > 0.0)
        at = np.minimum.accumulate(at[::-1])[::-1]  # a later change overtakes one that has not acted yet
        z = step_response(self._t[:, None] - at, times[2:].tolist()) @ self._steps
        nominal = np.diff(z, prepend=z[0])
        change = nominal * self.braking.share
        parts = change[:, None] * model.shapes(self._middle)
        if model.hold:
            target, acts = ((self._t[:, None] >= at) @ self._steps) * self._dt, change < 0.0
            held = np.abs(nominal - target) < -_STEADY * target
            parts = np.column_stack((parts, change * (held - held.sum(where=acts) / max(acts.sum(), 1))))
        return self.mean(np.cumsum(parts, axis=0))


class _State(NamedTuple):
    """A model with its times [s], logarithms of its standard deviations, values of its rates, and evidence [nats]."""

    model: _Model
    times: Array  # Dead time, how much later releases act, lags
    sizes: Array  # Of noise, drift, scatter, jitter
    rates: Array
    evidence: float = -math.inf


_evidence: Final = attrgetter('evidence')


class _Solution(NamedTuple):
    evidence: float
    estimate: Array  # Rates, hold, nuisances, steps of the times
    information: Array  # Inverse of their covariance


class _Fit:
    """The brakings, with the priors of the train file."""

    def __init__(self, brakings: Sequence[Braking], train_file: TrainFile) -> None:
        config, train = BrakeRateConfig(), train_file.train
        self.courses = [_Course(braking, config.disturbance_length) for braking in brakings]
        self.drift = np.concatenate([course.drift for course in self.courses])
        self.starts = np.cumsum([0, *(course.drift.size for course in self.courses[:-1])])
        known = KnownForce(train_file)
        self.brake, self.rate_std = known.brake, config.prior_std  # with the dead time that effects add
        gradient = train_file.line.gradient_std / known.inertia
        # Brakings at the same place have the same error of the map.
        places = [_place(braking) for braking in brakings]
        shared = [place for place, count in Counter(places).items() if count > 1 and place is not None]
        self.places = [shared.index(place) if place in shared else -1 for place in places]
        common = (config.resistance_std, config.resistance_std, math.hypot(train.mass_std, train.force_std))
        self.nuisance_std = np.array([*common, _TRACTION_DELAY, *([gradient] * len(shared))])
        noise, jitter = np.median([braking.noise_std for braking in brakings]), _JITTER_S * self.brake.timing_std
        self.usual = np.log([noise, math.hypot(config.disturbance_std, gradient), _SCATTER, jitter])
        slow, fast = np.quantile(np.concatenate([course.braked for course in self.courses]), (_TAIL, 1.0 - _TAIL))
        self.speeds = float(slow), max(float(fast), float(slow) + 1.0)
        self.is_released = any(course.is_released for course in self.courses)

    def knots(self, count: int) -> tuple[float, ...]:
        """Return knots over the speeds braked at [m/s]."""
        return tuple(np.linspace(*self.speeds, count).tolist()) if count > 1 else (0.5 * sum(self.speeds),)

    def prior(self, model: _Model) -> tuple[Array, Array]:
        """Return mean and precision of the linear quantities: rates and step, hold, nuisances."""
        n, extra = len(model.knots), model.steps + model.hold
        stds = np.concatenate((np.full(n + extra, self.rate_std), self.nuisance_std))
        precision = np.diag(1.0 / np.square(stds))
        # The mean rate may be anything; its change over speed is of the size that is usual.
        precision[:n, :n] = np.linalg.inv(_RATE_STD**2 + self.rate_std**2 * np.eye(n) * (n > 1))
        mean = np.zeros(stds.size)
        mean[:n] = [self.brake.rate_at(v) for v in model.knots]
        return mean, precision

    def design(self, state: _State, floor: float = math.nan) -> tuple[Array, Array]:
        """Return the equations of all brakings, in axes in which their errors are independent.

        Shapes (P, 1 + m), measured less expected speed and the columns of the linear quantities, with those of the
        times if their shortest lag is given; and (P, 3), the columns that each braking has by itself: its initial
        speed, its factor, and its shift.
        """
        model, times = state.model, state.times
        mean, rows = self.prior(model)[0], []
        base = np.append(times[:2], np.maximum(times[2:], floor))
        moved = [] if math.isnan(floor) else [base + step for step in _STEP_S * np.eye(times.size)]
        for course, place in zip(self.courses, self.places, strict=True):

            def braked(at: Array, course: _Course = course) -> Array:
                return np.asarray(course.columns(at, model)[:, : model.rates] @ state.rates)

            nuisances = np.zeros((course.y.size, self.nuisance_std.size))
            nuisances[:, :4] = course.nuisances[:, :4]
            if place >= 0:
                nuisances[:, 4 + place] = course.nuisances[:, 4]
            linear = np.column_stack((course.columns(times, model), nuisances))
            factor, start = braked(times), braked(base) if moved else 0.0
            shift = (braked(times + _STEP_S * np.eye(times.size)[0]) - factor) / _STEP_S
            steps = [(braked(at) - start) / _STEP_S for at in moved]
            y = course.y - linear @ mean
            rows.append(course.axes @ np.column_stack((y, linear, *steps, np.ones_like(y), factor, shift)))
        joined = np.concatenate(rows)
        return joined[:, :-3], joined[:, -3:]

    def solve(self, model: _Model, design: tuple[Array, Array], sizes: Array) -> _Solution:
        """Solve the equations at logarithms of the standard deviations."""
        (both, U), (mean, precision) = design, self.prior(model)
        m = mean.size
        noise, drift, scatter, jitter = np.exp(2.0 * sizes)
        w = 1.0 / (noise + drift * self.drift)
        own = 1.0 / np.array([_SPEED_STD**2, scatter, jitter])
        # What each braking has by itself is integrated out first.
        wU = (w[:, None] * U)[:, :, None]
        M = np.add.reduceat(wU * U[:, None, :], self.starts) + np.diag(own)
        B = np.add.reduceat(wU * both[:, None, :], self.starts)
        S = both.T @ (w[:, None] * both) - np.einsum('kij,kil->jl', B, np.linalg.solve(M, B))
        A, b = S[1:, 1:] + np.eye(len(S) - 1) / _TIME_STD**2, S[1:, 0]
        A[:m, :m] = S[1 : m + 1, 1 : m + 1] + precision
        # Times are not integrated out.
        root = np.linalg.cholesky(A[:m, :m])
        z = solve_triangular(root, b[:m], lower=True)
        log_determinants = 2.0 * np.log(np.diag(root)).sum() + np.linalg.slogdet(M)[1].sum() - np.log(w).sum()
        log_priors = np.linalg.slogdet(precision)[1] + len(M) * np.log(own).sum()
        fit = z @ z - S[0, 0] - np.square((sizes - self.usual) / _SPREAD).sum()
        estimate = np.linalg.solve(A, b)
        estimate[:m] += mean
        return _Solution(0.5 * float(fit + log_priors - log_determinants), estimate, A)

    def at(self, state: _State) -> _Solution:
        """Return the solution of a state; its evidence pays for lags and changeover."""
        found = self.solve(state.model, self.design(state), state.sizes)
        paid = 0.5 * (state.model.lags + state.model.steps) * math.log(self.drift.size)
        return found._replace(evidence=found.evidence - paid)

    def first(self) -> _State:
        """Return the state from which to start: with the most flexible rate, the best of some times."""
        model = _Model(1, self.knots(_KNOTS[0]), _HALF * (self.speeds[1] - self.speeds[0]))
        rates = np.array([self.brake.rate_at(v) for v in model.knots])
        sizes = self.usual + np.array([0.0, _FAR, 0.0, 0.0])
        times = [np.array([(1.0 - share) * mean, 0.0, share * mean]) for mean in _STARTS for share in _SHARES]
        states = [_State(model, one, sizes, rates) for one in times]
        return max(states, key=lambda state: self.at(state).evidence)._replace(sizes=self.usual)

    def settle(self, model: _Model, start: _State) -> _State:
        """Return a model with times, standard deviations and rates at the maximum of the evidence."""
        lags, n = start.times[2:], len(start.model.knots)
        if lags.size != model.lags:
            lags = lags[0] * np.array([0.7, 0.4]) if model.lags == 2 else np.array([np.linalg.norm(lags)])
        rates = np.append(np.interp(model.knots, start.model.knots, start.rates[:n]), np.zeros(model.steps))
        state = _State(model, np.append(start.times[:2], lags), start.sizes, rates)
        limits = list(zip(self.usual - 6.0 * _SPREAD, self.usual + 6.0 * _SPREAD, strict=True))
        for _ in range(_ROUNDS):
            before, design = state.evidence, self.design(state)

            def cost(sizes: Array, design: tuple[Array, Array] = design) -> float:
                return -self.solve(model, design, sizes).evidence

            sizes = minimize(cost, state.sizes, method='L-BFGS-B', bounds=limits, options={'ftol': 1e-6}).x
            state = self._step(state._replace(sizes=sizes))
            if state.evidence - before < _SETTLED:
                break
        return state

    def _step(self, state: _State) -> _State:
        """Return a state after Gauss-Newton steps of its times."""
        best = self.at(state)
        for _ in range(_MOST_STEPS):
            before, state = best.evidence, state._replace(rates=best.estimate[: state.model.rates])
            step = self.solve(state.model, self.design(state, _NO_LAG), state.sizes).estimate[-state.times.size :]
            for share in (1.0, 0.5, 0.2, 0.05):
                times = state.times + share * step
                times[[0, *range(2, times.size)]] = np.maximum(times[[0, *range(2, times.size)]], 0.0)
                found = self.at(trial := state._replace(times=times))
                if found.evidence > best.evidence:
                    state, best = trial, found
                    break
            if best.evidence - before < _SETTLED:
                break
        return state._replace(rates=best.estimate[: state.model.rates], evidence=best.evidence)

    def changeovers(self, state: _State) -> list[_State]:
        """Return a state with a changeover at each of some speeds."""
        (low, high), half, n = self.speeds, state.model.half, len(state.model.knots)
        start, found = state._replace(rates=np.append(state.rates[:n], 0.0)), list[_State]()
        for v in np.linspace(low + 2.0 * half, high - 2.0 * half, _PLACES).tolist():
            one = start._replace(model=replace(state.model, changeover=v))
            solution = self.at(one)
            found.append(one._replace(rates=solution.estimate[: n + 1], evidence=solution.evidence))
        return found


def _place(braking: Braking) -> tuple[int, int] | None:
    """Return the place of a braking's end and its direction, None if it is unknown."""
    known = braking.position[np.isfinite(braking.position)]
    return (round(float(known[-1]) / _PLACE_M), braking.direction) if known.size else None


def fit_brake(brakings: Sequence[Braking], train_file: TrainFile) -> BrakeFit:
    """Fit the brake to brakings; NoAnswerError if there is none."""
    if not brakings:
        raise NoAnswerError('no braking from a released brake was found')
    fit = _Fit(brakings, train_file)
    # From the most flexible rate to the simplest: times must not make up for a rate that is too simple.
    start = fit.first()
    tried = [start := fit.settle(start.model, start)]
    tried += [fit.settle(replace(start.model, knots=fit.knots(count)), start) for count in _KNOTS[1:]]
    best = max(tried, key=_evidence)
    tried.append(fit.settle(replace(best.model, lags=2), best))
    best = max(tried, key=_evidence)
    # A table may stand for a changeover, so that is also looked for on top of one rate.
    bases = [best]
    if len(best.model.knots) > 1:
        bases.append(fit.settle(replace(best.model, knots=fit.knots(1)), best))
    tried += [fit.settle(max(fit.changeovers(one), key=_evidence).model, one) for one in bases]
    best = max(tried, key=_evidence)
    if best.model.steps:
        tried.append(fit.settle(replace(best.model, lags=3 - best.model.lags), best))
    return _result(fit, max(tried, key=_evidence), tried)


def _weights(states: list[_State]) -> Array:
    """Return the probabilities of models by their evidence."""
    evidence = np.array([state.evidence for state in states])
    weights = np.exp(evidence - evidence.max(initial=-math.inf))
    return np.asarray(weights / weights.sum())


def _result(fit: _Fit, best: _State, tried: list[_State]) -> BrakeFit:
    """Return the best of the models tried with standard deviations, which cover the others by their evidence."""
    model, times, config, brake = best.model, best.times, BrakeRateConfig(), fit.brake
    # As few brakings show little of their scatter, a t distribution has its place.
    widen = float(stdtrit(len(fit.courses), 0.975) / stdtrit(math.inf, 0.975)) ** 2
    solution = fit.solve(model, fit.design(best, _LEAST_LAG), best.sizes)
    P, n, k = widen * np.linalg.inv(solution.information), model.rates, times.size
    T, weights = P[-k:, -k:], _weights(tried)
    base = np.array(first_order(times))
    J = np.array([np.array(first_order(times + step)) - base for step in _STEP_S * np.eye(k)]).T / _STEP_S
    others = np.array([first_order(one.times) for one in tried])
    stds = np.sqrt(np.diag(J @ T @ J.T) + weights @ np.square(others - base))
    stated = np.array([*brake.timing_stds, math.hypot(*brake.timing_stds)])
    file_times = brake.delay, brake.time_constant, brake.delay + brake.time_constant
    found = [
        Quantity(name, float(base[j]), float(stds[j]), 's', file_times[j], float(stated[j]))
        for j, name in enumerate((DEAD_TIME, LAG, RESPONSE))
    ]
    knots = np.array(model.knots)
    if model.steps:
        edges = model.changeover + model.half * np.array([-1.0, 1.0])
        knots = np.unique(np.append(knots[knots.size == 1 :], edges))
    shapes = model.shapes(knots)
    rates, covariance = shapes @ solution.estimate[:n], shapes @ P[:n, :n] @ shapes.T
    # One number holds at all speeds, so its error is the mean over them.
    speeds = knots if knots.size > 1 else np.linspace(*fit.speeds, _PLACES)
    places = fit.changeovers(best) if model.steps else []
    shares = _weights(places)
    for weight, one in zip((*weights, *shares), (*tried, *places), strict=True):
        off = one.model.shapes(speeds) @ one.rates - np.interp(speeds, knots, rates)
        covariance += weight * (np.outer(off, off) if knots.size > 1 else np.mean(off * off))
    for v, rate, std in zip(knots.tolist(), rates.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True):
        found.append(Quantity(f'{_RATE} {v:.1f} m/s', rate, std, '1', brake.rate_at(v), config.prior_std))
    if fit.is_released:
        found.append(Quantity(RELEASE, float(times[1]), math.sqrt(T[1, 1]), 's', 0.0, float(stated[2])))
    if model.steps:
        v = np.array([one.model.changeover for one in places])
        std = math.sqrt(shares @ np.square(v - shares @ v) + (v[1] - v[0]) ** 2 / 12.0)
        found.append(Quantity(CHANGEOVER, float(shares @ v), std, 'm/s', math.nan, config.blend_speed))
        step = float(solution.estimate[n - 1]), math.sqrt(P[n - 1, n - 1])
        found.append(Quantity(STEP, *step, '1', 0.0, config.blend_std))
    held = best._replace(model=replace(model, hold=True))
    more = fit.solve(held.model, fit.design(held, _LEAST_LAG), best.sizes)
    std = math.sqrt(widen * np.linalg.inv(more.information)[n, n])
    found.append(Quantity(HOLD, float(more.estimate[n]), std, '1', 0.0, config.slope_std))
    scatter, jitter = np.exp(best.sizes[2:]).tolist()
    models = tuple((one.model.name, one.evidence - best.evidence) for one in tried)
    return BrakeFit(
        tuple(found), tuple(times[2:].tolist()), tuple(knots.tolist()), rates, covariance, scatter, jitter,
        fit.speeds, len(fit.courses), models,
    )  # fmt: skip

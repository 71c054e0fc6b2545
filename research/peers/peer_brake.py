# SPDX-License-Identifier: Apache-2.0
"""Particle filters of the brake rate: filterpy and particles compared with ours, on the metro drives of `brake_runs`.

All run in the same estimator, which models the brake and its dead time and selects the informative samples; they
differ in the representation of the posterior of [v, a, b] and the rate f. With filterpy each particle has its own
Kalman filter, copied at resampling; the library particles provides weights and resampling, with all four states
sampled.
"""

from __future__ import annotations

import math
import sys
import time
from copy import deepcopy
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.seeds import over_seeds
from benchmarks.stepping import step_and_estimate
from benchmarks.tables import Table
from research.papers.brake_runs import BrakeRun, metro_run, metro_train
from research.peers.contest import FIRST_SEED, installed
from trainid_lab.brake_rate.particles import (
    SPEED,
    LinearStep,
    effective_number,
    error_covariance,
    errors_of,
    normal_weights,
    speed_step,
    started,
    systematic,
)
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.motion_model import STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.results import Rejection
from trainid_ros.setup.pipelines import BRAKE_RATE

Array = NDArray[np.float64]
# Few stops per drive allow many seeds; the variation between drives exceeds that between stops.
_STOPS: Final = 2
_SHORT_STOPS: Final = 1
_FEW: Final = 2
_SETTLED_S: Final = 3.0
_SLOWEST: Final = 1.0
RATIO: Final = 'trainid GSMA, 500 particles'


class PeerPosterior:
    """Common part of the posteriors of other libraries: weights, f, and mean and variance of f [1]."""

    def __init__(self, particles: int, drift: float, seed: int) -> None:
        self.N, self._q = particles, drift * drift
        self._rng = np.random.default_rng(seed)
        self.weights = np.full(particles, 1.0 / particles)
        self.f = np.ones(particles)
        self.step = LinearStep(np.eye(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)))

    def means(self) -> Array:
        """Return the states of all particles, v, a, b first, shape (STATES, N)."""
        raise NotImplementedError

    def spread(self) -> float:
        """Return the variance of v within a particle [(m/s)^2]."""
        return 0.0

    @property
    def rate(self) -> float:
        return float(self.weights @ self.f)

    @property
    def variance(self) -> float:
        return float(self.weights @ np.square(self.f - self.rate))

    @property
    def speed(self) -> float:
        return float(self.means()[0] @ self.weights)

    @property
    def acceleration(self) -> float:
        return float(self.means()[1] @ self.weights)

    @property
    def effective(self) -> float:
        return effective_number(self.weights)

    @property
    def errors(self) -> Errors:
        return errors_of(self.means()[3:] @ self.weights)

    @property
    def error_variances(self) -> Errors:
        e = self.means()[3:]
        return errors_of(np.diag(self.inner())[3:] + np.square(e - (e @ self.weights)[:, None]) @ self.weights)

    def total_rate(self, share: Array) -> tuple[float, float]:
        total = self.f + share @ self.means()[3:]
        mean = float(total @ self.weights)
        return mean, float(np.square(total - mean) @ self.weights + share @ self.inner()[3:, 3:] @ share)

    def inner(self) -> Array:
        return np.zeros((STATES, STATES))

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        self.f = np.maximum(rate + std * self._rng.standard_normal(self.N), 0.0)
        self.begin(error_stds)

    def begin(self, error_stds: Errors) -> None:
        raise NotImplementedError

    def predicted(self) -> tuple[float, float]:
        v, mean = self.means()[0], self.speed
        return mean, self.spread() + float(np.square(v - mean) @ self.weights)

    def save(self) -> str:
        raise NotImplementedError

    def restore(self, text: str) -> None:
        raise NotImplementedError


class FilterpyPosterior(PeerPosterior):
    """A filterpy KalmanFilter for each particle."""

    def __init__(self, particles: int, drift: float, seed: int) -> None:
        super().__init__(particles, drift, seed)
        kalman = import_module('filterpy.kalman').KalmanFilter
        self._filters = [kalman(dim_x=STATES, dim_z=1, dim_u=1) for _ in range(particles)]

    def means(self) -> Array:
        return np.array([kf.x[:, 0] for kf in self._filters]).T

    def spread(self) -> float:
        return float(self._filters[0].P[0, 0])

    def inner(self) -> Array:
        P: Array = self._filters[0].P
        return P

    def begin(self, error_stds: Errors) -> None:
        for kf in self._filters:
            kf.x, kf.P, kf.H = np.zeros((STATES, 1)), error_covariance(error_stds), SPEED

    def reinit_motion(self, start: Start) -> None:
        for kf, f in zip(self._filters, self.f, strict=True):
            kf.x = np.array([start.speed, f * start.target, 0.0, *(np.array(start.decay_e) * kf.x[3:, 0])])[:, None]
            kf.P = started(kf.P, start)

    def recentre(self, shift: Errors) -> None:
        for kf in self._filters:
            kf.x = kf.x - np.array([0.0, 0.0, 0.0, *shift])[:, None]

    def predict(self, interval: Transition) -> None:
        self.step = step = speed_step(interval)
        for kf, f in zip(self._filters, self.f, strict=True):
            kf.predict(u=1.0, B=(step.gamma * f + step.known)[:, None], F=step.Phi, Q=step.Q)

    def follow(self, speed: float, r: float) -> None:
        for kf in self._filters:
            kf.update(speed, R=r)

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        del interval
        moved = math.sqrt(self._q * elapsed) * self._rng.standard_normal(self.N)
        self.f = self.f + moved
        log_weights = np.log(np.maximum(self.weights, 1e-300))
        for k, kf in enumerate(self._filters):
            kf.x = kf.x + self.step.gamma[:, None] * moved[k]
            kf.update(speed, R=r)
            y, S = float(kf.y[0, 0]), float(kf.S[0, 0])
            log_weights[k] -= 0.5 * (y * y / S + math.log(S))
        self.weights = normal_weights(log_weights)
        if effective_number(self.weights) < 0.5 * self.N:
            kept = systematic(self.weights, self.N, float(self._rng.random()))
            self._filters = [deepcopy(self._filters[k]) for k in kept]
            self.f, self.weights = self.f[kept], np.full(self.N, 1.0 / self.N)
        return True


class ParticlesPosterior(PeerPosterior):
    """Bootstrap filter on [v, a, b, f] with the weights and the resampling of the library particles."""

    def __init__(self, particles: int, drift: float, seed: int) -> None:
        super().__init__(particles, drift, seed)
        self._resampling = import_module('particles.resampling')
        self._x = np.zeros((STATES, particles))
        self._held = self._resampling.Weights(lw=np.zeros(particles))

    def means(self) -> Array:
        return self._x

    def begin(self, error_stds: Errors) -> None:
        stds = np.array([0.0, 0.0, 0.0, *error_stds])
        self._x = stds[:, None] * self._rng.standard_normal((STATES, self.N))

    def reinit_motion(self, start: Start) -> None:
        e = np.array(start.decay_e)[:, None] * self._x[3:]
        x = np.vstack([np.full(self.N, start.speed), start.target * self.f, np.zeros(self.N), e])
        stds = np.sqrt(np.array([*start.variances, *start.q_e]))
        self._x = x + stds[:, None] * self._rng.standard_normal((STATES, self.N))

    def recentre(self, shift: Errors) -> None:
        self._x = self._x - np.array([0.0, 0.0, 0.0, *shift])[:, None]

    def predict(self, interval: Transition) -> None:
        self.step = step = speed_step(interval)
        noise = np.sqrt(np.diag(step.Q))[:, None] * self._rng.standard_normal((STATES, self.N))
        self._x = step.predict(self._x, self.f) + noise

    def follow(self, speed: float, r: float) -> None:
        self._weigh(speed, r)

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        del interval
        moved = math.sqrt(self._q * elapsed) * self._rng.standard_normal(self.N)
        self.f = self.f + moved
        self._x = self._x + self.step.gamma[:, None] * moved
        self._weigh(speed, r)
        return True

    def _weigh(self, speed: float, r: float) -> None:
        self._held = self._held.add(-0.5 * np.square(speed - self._x[0]) / r)
        if self._held.ESS < 0.5 * self.N:
            kept = self._resampling.systematic(self._held.W)
            self._x, self.f = self._x[:, kept], self.f[kept]
            self._held = self._resampling.Weights(lw=np.zeros(self.N))
        self.weights = self._held.W


@dataclass(frozen=True, slots=True)
class Contestant:
    """A filter: its name, required package, posterior or our algorithm, and number of particles.

    ``stops`` is the number of stops per drive; ``drives`` limits the number of drives of slow filters.
    """

    name: str
    package: str
    kind: str
    particles: int
    stops: int = _STOPS
    drives: int = sys.maxsize


CONTESTANTS: Final = (
    Contestant('filterpy KalmanFilter per particle, 50', 'filterpy', 'filterpy', 50, _SHORT_STOPS),
    Contestant('filterpy KalmanFilter per particle, 500', 'filterpy', 'filterpy', 500, _SHORT_STOPS, _FEW),
    Contestant('particles, [v, a, b, f] sampled, 500', 'particles', 'particles', 500),
    Contestant('particles, [v, a, b, f] sampled, 5000', 'particles', 'particles', 5000),
    Contestant('trainid RBPF, 500', 'numpy', 'RBPF', 500),
    Contestant('trainid GSMA, 50 particles', 'numpy', 'GSMA', 50),
    Contestant(RATIO, 'numpy', 'GSMA', 500),
    Contestant('trainid KF, no particles', 'numpy', 'KF', 0),
)


@dataclass(frozen=True, slots=True)
class Result:
    """One drive: mean error of f [1], and CPU time of each step with an update [us]."""

    name: str
    error: float
    times: tuple[float, ...]


def measure(seeds: int) -> list[Table]:
    """Return the table of the particle filters."""
    results = [item for ride in over_seeds(drives, range(seeds)) for item in ride]
    times = {item.name: np.concatenate([one.times for one in results if one.name == item.name]) for item in results}
    rows = []
    for item in CONTESTANTS:
        errors = [one.error for one in results if one.name == item.name]
        if not errors:
            rows.append((item.name, 'not installed', '-', '-', '-', '0'))
            continue
        p50, p99 = np.percentile(times[item.name], (50.0, 99.0))
        ratio = p50 / np.median(times[RATIO])
        error = f'{np.mean(errors):.4f} ± {np.std(errors) / math.sqrt(len(errors)):.4f}'
        error += '' if item.stops == _STOPS else f' ({item.stops} stop)'
        rows.append((item.name, f'{p50 / 1e3:.4f}', f'{p99 / 1e3:.4f}', f'{ratio:.2f}', error, str(len(errors))))
    note = (
        f'CPU time of prediction and update for one sample. Error: mean |f - truth| from {_SETTLED_S:.0f} s after '
        f'the command and above {_SLOWEST:.0f} m/s, with its standard error over drives of {_STOPS} stops. All run in '
        f'the same estimator of trainid. {_limited(seeds)}'
    )
    header = ('filter', 'ms p50', 'ms p99', 'p50 / GSMA 500', 'mean error', 'drives')
    return [Table('Particle filters of the brake rate compared with other libraries', header, tuple(rows), note)]


def _limited(seeds: int) -> str:
    limited = [f'{item.name}, over {item.drives} drives of {seeds}' for item in CONTESTANTS if item.drives < seeds]
    return f'Slow filters run over fewer drives: {"; ".join(limited)}.' if limited else ''


def drives(number: int) -> list[Result]:
    """Run all filters that take part in this seed."""
    runs = {stops: metro_run(FIRST_SEED + number, stops) for stops in (_SHORT_STOPS, _STOPS)}
    return [
        _drive(item, runs[item.stops], number)
        for item in CONTESTANTS
        if installed(item.package) and number < item.drives
    ]


def _drive(item: Contestant, run: BrakeRun, number: int) -> Result:
    estimator = _estimator(item, number)
    timed = TimedPosterior(estimator.posterior)
    estimator.posterior = timed
    errors, times = [], []
    for k, sample in enumerate(run.samples):
        timed.spent_ns, timed.learned = 0, False
        estimate = step_and_estimate(estimator, sample)
        if timed.learned:
            times.append(timed.spent_ns / 1e3)
        if not isinstance(estimate, Rejection) and run.braked_s[k] > _SETTLED_S and run.speed[k] > _SLOWEST:
            errors.append(abs(estimate.brake_rate - float(run.rate[k])))
    return Result(item.name, float(np.mean(errors)), tuple(times[len(times) // 10 :]))


class TimedPosterior:
    """A posterior that sums up the CPU time of prediction and update [ns]."""

    def __init__(self, posterior: Any) -> None:
        self._posterior = posterior
        self.spent_ns = 0
        self.learned = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._posterior, name)

    def predict(self, interval: Transition) -> None:
        begun = time.thread_time_ns()
        self._posterior.predict(interval)
        self.spent_ns += time.thread_time_ns() - begun

    def update(self, *arguments: Any) -> bool:
        begun = time.thread_time_ns()
        fine: bool = self._posterior.update(*arguments)
        self.spent_ns += time.thread_time_ns() - begun
        self.learned = True
        return fine


def _estimator(item: Contestant, seed: int) -> Any:
    if item.kind in _PEERS:
        config = BrakeRateConfig()
        return BrakeRateEstimator(metro_train(), config, _PEERS[item.kind](item.particles, config.drift, seed))
    changes: dict[str, float] = {'particles': item.particles} if item.particles else {}
    return BRAKE_RATE.make(BRAKE_RATE.choose(item.kind, **changes), metro_train(), np.random.default_rng(seed))


_PEERS: Final[dict[str, Any]] = {'filterpy': FilterpyPosterior, 'particles': ParticlesPosterior}

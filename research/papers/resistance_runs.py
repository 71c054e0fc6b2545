# SPDX-License-Identifier: Apache-2.0
"""Run the main resistance estimators on one seed of each experiment; all errors are curve errors [N/kN]."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from research.papers import coasts as coast_data
from research.papers.coasts import GRID, KMH, LARGE_A, PAPER, CoastPlan, in_kmh, in_si
from research.papers.spoiled import NOISE_STD, OBSERVED, SPEEDS, spoiled_observations, spoiled_speeds
from research.peers import metro_stream as metro
from research.peers.hand_filters import HandRls
from research.peers.our_filters import VMilsRaw
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step
from trainid_lab.resistance.speed_ekf import SpeedEkf, SpeedEkfConfig
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.change_points import ChangePointConfig, Normal, Tracker, independent, robust_fit
from trainid_ros.resistance.vmils import VMils
from trainid_ros.train.train_file import Davis

Array = NDArray[np.float64]
# Prior standard deviation of the term of each parameter in w at 22 m/s [N/kN].
PRIOR_STD: Final = (2.0, 4.0, 4.0)
_FAST: Final = 22.0
PLAN: Final = ChangePointConfig(
    p=4,
    outliers=0.2,
    step_variances=(1.0, (0.2 / _FAST) ** 2, (0.5 / _FAST**2) ** 2),
    hazard=1.0 / 2000.0,
    spacing=10,
    hypotheses=5,
    min_age=60,
    lockout=120,
)
# Observations before the initial fit, and before a refit: in bursts most data of a short period may be bad.
_WARM_UP: Final = 100
_SECOND_LOOK: Final = 500
_MEMORY: Final = 0.01
_UNCERTAIN: Final = 0.1
_MAX_SCALED_SQUARE: Final = 9.0
_TINY: Final = 1e-8


class RobustStream:
    """Robust multi-innovation least squares with warm-up and estimated noise.

    Attributes:
        estimate: Mean and covariance of a, b, c [N/kN, v in m/s].

    """

    def __init__(self, prior_mean: tuple[float, float, float], plan: ChangePointConfig = PLAN) -> None:
        self._prior = independent(prior_mean, [(std / _FAST**i) ** 2 for i, std in enumerate(PRIOR_STD)])
        self._tracker = Tracker(self._prior, plan)
        self._rows: list[tuple[float, ...]] = []
        self._seen = 0
        self._variance = 0.0

    @property
    def estimate(self) -> Normal:
        """The estimate; the prior while warming up."""
        return self._tracker.estimate

    @property
    def steps_found(self) -> int:
        """Number of parameter steps detected."""
        return self._tracker.steps_found

    def update(self, v: float, y: float) -> None:
        """Process one observation, speed v [m/s] and resistance y [N/kN]."""
        self._seen += 1
        if self._seen <= _SECOND_LOOK:
            self._rows.append((1.0, v, v * v, y, _TINY, 1.0))
        if self._seen in (_WARM_UP, _SECOND_LOOK):
            self._refit()
        elif self._seen > _WARM_UP:
            self._learn(v, y)

    def _refit(self) -> None:
        """Start from a robust fit of all observations so far."""
        # The row variances are tiny, so the fit takes the scale from the residuals.
        fit = robust_fit(tuple(self._rows), self._prior)
        start = self._prior if fit is None else fit
        rows = np.array(self._rows)
        residuals = np.abs(rows[:, 3] - rows[:, :3] @ start.theta)
        # One-sided errors raise the median; the variance is rather set too small, since it is updated later.
        self._variance = max((1.2 * float(np.median(residuals))) ** 2, _TINY)
        if fit is not None:
            self._tracker.begin(fit)
        if self._seen == _SECOND_LOOK:
            self._rows.clear()

    def _learn(self, v: float, y: float) -> None:
        phi = vec[float]([1.0, v, v * v])
        expected, variance = self._tracker.estimate.predict(phi)
        nu = y - expected
        weight = self._tracker.update(phi, y, self._variance)
        if self._tracker.change_probability < _UNCERTAIN:
            S = variance + self._variance
            known = self._variance / S
            self._variance += _MEMORY * weight * known * (min(nu * nu / S, _MAX_SCALED_SQUARE) - 1.0) * self._variance


FIRST_SEED: Final = 5000
JUMP_STD: Final = 0.57
JUMPS: Final = (0.31, 1.22)
"""60 % of the paper's a, and of that of the second truth [N/kN]."""
FORGETTING: Final = (0.995, 0.99, 0.95)
GUST: Final = 0.3
_SI: Final = GRID * KMH
_PHI: Final = np.stack([np.ones_like(_SI), _SI, _SI**2], axis=1)
# Prior over true parameters: 20 % too high.
_WRONG: Final = 1.2
_METRO_PRIOR: Final = (1.5, 0.03, 0.003)
_METRO_GRID: Final = np.linspace(5.0, 22.0, 69)
_METRO_PHI: Final = np.stack([np.ones_like(_METRO_GRID), _METRO_GRID, _METRO_GRID**2], axis=1)


@dataclass(frozen=True, slots=True)
class CoastErrors:
    """Errors on coasts with gusts, one per kind of bad speeds in the order of SPEEDS, and the bound [N/kN]."""

    ekf: tuple[float, ...]
    vmils: tuple[float, ...]
    bound: float
    ekf_calm: float
    bound_calm: float


@dataclass(frozen=True, slots=True)
class ObservedErrors:
    """Errors for each kind of bad observations, in the order of OBSERVED [N/kN]."""

    least_squares: tuple[float, ...]
    robust: tuple[float, ...]
    bound: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class JumpResult:
    """Observations until 90 % of a jump is followed, error just before it, mean change of w over time [N/kN].

    ``forgetting`` holds delay and error of recursive least squares for each forgetting factor of FORGETTING.
    """

    delay: int
    before: float
    track: tuple[float, ...]
    forgetting: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class MetroResult:
    """Error of w over 5-22 m/s at the end, rms of that error in its own standard deviations, steps detected.

    ``least_squares`` is the error of least squares over all rows of the same ride, without tracking of changes.
    """

    error: float
    normalised: float
    steps: int
    least_squares: float


def coast_errors(seed: int) -> CoastErrors:
    """Run both estimators on the coasts of one seed, clean and contaminated."""
    truth = PAPER if seed % 2 else LARGE_A
    coasts = coast_data.drive(CoastPlan(truth, gust_std=GUST), np.random.default_rng(seed))
    calm = coast_data.drive(CoastPlan(truth), np.random.default_rng(seed))
    ekf, vmils = [], []
    for i, spoil in enumerate(SPEEDS):
        speed = spoiled_speeds(spoil, coasts, np.random.default_rng([seed, i]))
        ekf.append(on_coasts(ekf_of(coasts.plan), coasts, speed))
        vmils.append(on_coasts(vmils_of(truth), coasts, speed))
    return CoastErrors(
        ekf=tuple(ekf),
        vmils=tuple(vmils),
        bound=coast_data.curve_std(coast_data.cramer_rao(coasts)),
        ekf_calm=on_coasts(ekf_of(calm.plan), calm, calm.speed),
        bound_calm=coast_data.curve_std(coast_data.cramer_rao(calm)),
    )


def _wrong_prior(truth: tuple[float, ...]) -> tuple[float, float, float]:
    a, b, c = (_WRONG * x for x in truth)
    return a, b, c


def ekf_of(plan: CoastPlan) -> SpeedEkf:
    """Return the EKF with the true statistics of gusts and noise, a wide prior and constant parameters."""
    config = SpeedEkfConfig(
        prior_share=0.0,
        prior_std_a=2.0,
        prior_std_b=0.2,
        prior_std_c=0.01,
        drift_share=0.0,
        disturbance_std=plan.gust_std,
        disturbance_time=plan.gust_time,
        speed_std=plan.speed_std * KMH,
    )
    return SpeedEkf(coast_data.train_file(_wrong_prior(plan.truth)), config)


def vmils_of(truth: tuple[float, float, float]) -> VMils:
    """Return V-MILS as shipped, except for the same prior and constant parameters."""
    config = VMilsConfig(prior_share=0.0, prior_std_a=2.0, prior_std_b=0.2, prior_std_c=0.01, drift_share=0.0)
    return VMils(coast_data.train_file(_wrong_prior(truth)), replace(config, step_share=0.25))


def on_coasts(estimator: SpeedEkf | VMils, coasts: coast_data.Coasts, speed: Array) -> float:
    """Return the error of an estimator after all coasts with the given measured speeds [km/h]."""
    for sample in coast_data.samples(coasts, speed):
        estimator.step(sample)
    found = estimator.estimate(15.0)
    return coast_data.curve_error(in_kmh(Davis(found.a, found.b, found.c)), coasts.plan.truth)


def observed_errors(seed: int) -> ObservedErrors:
    """Run least squares and the robust kernel on the observations of one seed, clean and contaminated."""
    truth = PAPER if seed % 2 else LARGE_A
    rows = [observed_error(truth, seed, i) for i in range(len(OBSERVED))]
    least_squares, robust, bound = zip(*rows, strict=True)
    return ObservedErrors(least_squares, robust, bound)


def observed_error(truth: tuple[float, float, float], seed: int, kind: int) -> tuple[float, float, float]:
    """Return the errors of least squares and of the robust kernel, and the bound."""
    data = spoiled_observations(OBSERVED[kind], truth, np.random.default_rng([seed, kind]))
    Phi = np.stack([np.ones_like(data.v), data.v, data.v**2], axis=1)
    true = np.array(_si(truth))
    good = Phi[data.good]
    P = NOISE_STD**2 * np.linalg.inv(good.T @ good)
    stream = RobustStream(_si(_wrong_prior(truth)))
    for v, y in zip(data.v.tolist(), data.y.tolist(), strict=True):
        stream.update(v, y)
    batch = np.linalg.lstsq(Phi, data.y, rcond=None)[0]
    bound = float(np.sqrt(np.mean(np.sum((_PHI @ P) * _PHI, axis=1))))
    return _rms(_PHI @ (batch - true)), _rms(_PHI @ (stream.estimate.theta - true)), bound


def _si(truth: tuple[float, ...]) -> tuple[float, float, float]:
    davis = in_si(truth)
    return davis.a, davis.b, davis.c


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def jump_results(seed: int) -> tuple[JumpResult, ...]:
    """Run a jump of a in the middle of 2064 observations, for each size."""
    return tuple(_jump(seed, size) for size in JUMPS)


def _jump(seed: int, size: float) -> JumpResult:
    rng = np.random.default_rng(seed)
    truth = PAPER if size < 1.0 else LARGE_A
    halves = [coast_data.white_observations(CoastPlan(truth), rng, JUMP_STD) for _ in range(2)]
    v = np.concatenate([half[0] for half in halves])
    y = np.concatenate([halves[0][1], halves[1][1] + size])
    at, rows = len(halves[0][0]), list(zip((v * KMH).tolist(), y.tolist(), strict=True))
    stream, thetas = RobustStream(_si(_wrong_prior(truth))), []
    for speed, value in rows:
        stream.update(speed, value)
        thetas.append(stream.estimate.theta)
    error_w = (np.array(thetas) - np.array(_si(truth))) @ _PHI.T
    followed = tuple(_followed(_forgetful(factor, rows, truth), at, size) for factor in FORGETTING)
    track = error_w.mean(axis=1)[at - 100 : at + 300]
    return JumpResult(*_followed(error_w, at, size), tuple(track.tolist()), followed)


def _forgetful(factor: float, rows: list[tuple[float, float]], truth: tuple[float, float, float]) -> Array:
    """Return the errors of w of recursive least squares after each observation, shape (n, speeds)."""
    peer, thetas = HandRls(forgetting=factor), []
    for speed, value in rows:
        peer.step(value, speed)
        thetas.append(peer.theta)
    return np.asarray((np.array(thetas) - np.array(_si(truth))) @ _PHI.T)


def _followed(error_w: Array, at: int, size: float) -> tuple[int, float]:
    """Return the delay until 90 % of a jump is followed and the error just before it."""
    followed = error_w[at:].mean(axis=1) >= 0.9 * size
    return int(np.argmax(followed)) if followed.any() else len(followed), _rms(error_w[at - 1])


def metro_results(seed: int) -> tuple[MetroResult, ...]:
    """Run V-MILS, settings as shipped, over the four scenarios of the metro ride."""
    return tuple(metro_result(seed, scenario) for scenario in metro.SCENARIOS)


def metro_result(seed: int, scenario: metro.Scenario) -> MetroResult:
    """Return the result of one scenario, including ticks under braking, since here the brake force is known."""
    data, peer = metro.metro_stream(seed, scenario), VMilsRaw(_METRO_PRIOR)
    for item in peer.items(data):
        peer.step(*item)
    true, (theta, P) = data.after, peer.moments
    error_w = _METRO_PHI @ (theta - np.array([true.a, true.b, true.c]))
    variance = np.sum((_METRO_PHI @ P) * _METRO_PHI, axis=1)
    batch = np.asarray(np.linalg.lstsq(data.rows.phi, data.rows.y, rcond=None)[0], dtype=np.float64)
    plain = metro.curve_error(batch, true)
    return MetroResult(_rms(error_w), _rms(error_w / np.sqrt(variance)), peer.steps_found, plain)


def kernel_cost(p: int, updates: int = 20_000, repeats: int = 9) -> float:
    """Return the least CPU time of one kernel update over some repeats [us]."""
    rng = np.random.default_rng(1)
    v = rng.uniform(2.0, 22.0, updates)
    rows = list(zip(v.tolist(), (1.5 + 0.02 * v + 0.5 * rng.standard_normal(updates)).tolist(), strict=True))
    best = np.inf
    for _ in range(repeats):
        state = (*information_of((1.4, 0.0, 0.01, 0.8, 0.0, 0.0, 4e-4, 0.0, 2.5e-5)), *NOTHING)
        parts = deque([NOTHING] * p)
        start = time.thread_time_ns()
        for speed, y in rows:
            state, newest, _, _ = mils_step(state, parts.popleft(), speed, speed * speed, y, 0.25, 1.0, 0.05, p)
            parts.append(newest)
        best = min(best, (time.thread_time_ns() - start) / updates / 1e3)
    return float(best)

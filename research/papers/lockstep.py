# SPDX-License-Identifier: Apache-2.0
"""The speed-model algorithms on raw (y, u): on one line with the product's kernels, on many lines in lockstep.

Lines of the experiments have no samples and no admission checks: ``drive`` calls a ``Method`` of the product as its
estimator would. ``drive_many`` does the same for all lines at once with the algorithms for comparison, whose kernels
also take arrays; only decisions are implemented twice, and a test checks that both give the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from trainid_lab.speed_model import integral_rls, rls
from trainid_ros.interface.state import encode, restore
from trainid_ros.speed_model.am_vff_rls import Method, Symmetric, Theta

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_SPEED: Final = 0.5
STANDING: Final = 3
READMIT: Final = 5


@dataclass(frozen=True, slots=True)
class Track:
    """Results of an algorithm on some lines."""

    state: Array  # x [m/s], a1, a2, b1, d0 after every sample, shape (samples, 5, lines)
    S: Array  # Covariance of theta, upper triangle, after every tenth sample, shape (samples / 10, 10, lines)
    predicted: Array  # Speed predicted for every sample [m/s], shape (samples, lines)
    error: Array  # Measured minus predicted speed [m/s], NaN without measurement
    nis: Array  # Squared error over its variance at updates, else NaN
    factor: Array  # Forgetting factor


@dataclass(frozen=True, slots=True)
class ManyLearned:
    """``Learned`` for many lines; ``variance`` is that of the error."""

    numbers: Array
    predicted: Array
    error: Array
    rejected: Mask
    variance: Array
    factor: Array


class ManyMethod(Protocol):
    """``Method`` for arrays: ``numbers`` has the shape (numbers, lines)."""

    def start(self, lines: int) -> Array: ...
    def update(self, numbers: Array, y: Array, u: Array) -> ManyLearned: ...
    def coast(self, numbers: Array, u: Array) -> Array: ...
    def reinit_speed(self, numbers: Array, y: Array) -> Array: ...
    def inflate_load_variance(self, numbers: Array) -> Array: ...
    def covariance(self, numbers: Array) -> Array: ...


def drive(method: Method, y: Array, u: Array, variance: float, *, freeze: bool = True) -> Track:
    """Run one line with a kernel of the product, from its start; shapes as in :class:`Track` without the lines."""
    method.start(variance)
    method.reinit_speed(float(y[0]), variance)
    rows: list[tuple[float, ...]] = [(method.speed(), *method.theta(), float(y[0]), math.nan, math.nan, 1.0)]
    S = [method.covariance(variance)]
    slow = rejected = 0
    for now, force in zip(y[1:].tolist(), u[:-1].tolist(), strict=True):
        nis, factor = math.nan, 1.0
        if math.isnan(now) or (freeze and now < MIN_SPEED):
            before = encode(method)
            method.coast(force, 1.0)
            predicted = method.speed()
            if not math.isnan(now):
                slow, rejected = slow + 1, 0
                if slow >= STANDING:  # theta and its covariance stay constant
                    restore(method, before)
                    method.reinit_speed(now, variance)
                if slow == STANDING:
                    method.inflate_load_variance(1.0)
        else:
            learned, slow = method.update(now, force, 1.0, variance), 0
            predicted = learned.predicted
            rejected = rejected + 1 if learned.rejected else 0
            if not learned.rejected and learned.variance > 0.0:
                nis, factor = learned.error**2 / learned.variance, learned.forgetting
            if rejected >= READMIT:
                method.reinit_speed(now, variance)
                rejected = 0
        rows.append((method.speed(), *method.theta(), predicted, now - predicted, nis, factor))
        if len(rows) % 10 == 1:
            S.append(method.covariance(variance))
    table = np.array(rows)
    return Track(table[:, :5], np.array(S), table[:, 5], table[:, 6], table[:, 7], table[:, 8])


def drive_each(make: Callable[[], Method], y: Array, u: Array, variance: float, *, freeze: bool = True) -> Track:
    """Run all lines one by one, each with a kernel of its own."""
    tracks = [drive(make(), y[:, k], u[:, k], variance, freeze=freeze) for k in range(y.shape[1])]
    return Track(*(np.stack([getattr(track, item.name) for track in tracks], axis=-1) for item in fields(Track)))


def drive_many(method: ManyMethod, y: Array, u: Array, *, freeze: bool = True) -> Track:
    """Run all lines, shapes (samples, lines), sample by sample."""
    samples, lines = y.shape
    numbers = method.reinit_speed(method.start(lines), y[0])
    slow, rejected = np.zeros(lines, dtype=np.int64), np.zeros(lines, dtype=np.int64)
    rows: list[tuple[Array, ...]] = [(numbers[:5], y[0], y[0] * np.nan, y[0] * np.nan, np.ones(lines))]
    S = [method.covariance(numbers)]
    with np.errstate(all='ignore'):
        for n in range(1, samples):
            have = ~np.isnan(y[n])
            now = np.where(have, y[n], 0.0)
            still = have & (now < MIN_SPEED) if freeze else np.zeros(lines, dtype=np.bool_)
            learning = have & ~still
            coasted, learned = method.coast(numbers, u[n - 1]), method.update(numbers, now, u[n - 1])
            slow = np.where(learning, 0, slow + still)
            outliers = learning & learned.rejected
            rejected = np.where(outliers, rejected + 1, np.where(have, 0, rejected))
            new = np.where(learning, learned.numbers, coasted)
            standing = still & (slow >= STANDING)
            # At standstill theta and its covariance stay constant, without the drift of coasting.
            new = np.where(standing, numbers, new)
            new = np.where(standing | (rejected >= READMIT), method.reinit_speed(new, now), new)
            numbers = np.where(still & (slow == STANDING), method.inflate_load_variance(new), new)
            rejected = np.where(rejected >= READMIT, 0, rejected)
            nis = np.where(learning & ~outliers, learned.error**2 / learned.variance, np.nan)
            factor = np.where(learning & ~outliers, learned.factor, 1.0)
            rows.append((numbers[:5], learned.predicted, np.where(have, learned.error, np.nan), nis, factor))
            if n % 10 == 0:
                S.append(method.covariance(numbers))
    state, predicted, error, nis_all, factors = (np.array(column) for column in zip(*rows, strict=True))
    return Track(state, np.array(S), predicted, error, nis_all, factors)


class ManyRls:
    """The algorithms of the paper (RLS, VFF-RLS, AM-RLS, AM-VFF-RLS as printed)."""

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: rls.Tuning, variance: float) -> None:
        self._start = (0.0, *theta0, *P0)
        self._tuning, self._variance = tuning, variance

    def start(self, lines: int) -> Array:
        return np.tile(np.array(self._start)[:, None], lines)

    def update(self, numbers: Array, y: Array, u: Array) -> ManyLearned:
        tuning = self._tuning
        theta, P = tuple(numbers[1:5]), tuple(numbers[5:])
        phi: Any = rls.regressor(numbers[0], u, 1.0)  # type: ignore[arg-type]
        phi = (phi[0], phi[1], phi[2], np.ones_like(u))
        predicted: Any = rls.output(theta, phi)
        w: Any = rls.times(P, phi)
        error, g = y - predicted, w[4]
        s = self._variance * (1.0 + np.maximum(g, 0.0))
        rejected = ~(np.abs(error) <= tuning.gate * np.sqrt(s))
        factor = np.ones_like(error)
        if tuning.sigma > 0.0:
            factor = np.maximum(tuning.low, 1.0 - error * error / (tuning.sigma * (1.0 + g)))
        after: Any = rls.updated(theta, P, w, error, factor, factor)
        x_a = rls.output(after[0], phi)
        learned = np.stack([x_a + tuning.kappa * (y - x_a), *after[0], *after[1]])
        coasted = np.concatenate([predicted[None], numbers[1:]])
        return ManyLearned(np.where(rejected, coasted, learned), predicted, error, rejected, s, factor)

    def coast(self, numbers: Array, u: Array) -> Array:
        phi: Any = rls.regressor(numbers[0], u, 1.0)  # type: ignore[arg-type]
        x: Any = rls.output(tuple(numbers[1:5]), phi)
        return np.concatenate([x[None], numbers[1:]])

    def reinit_speed(self, numbers: Array, y: Array) -> Array:
        return np.concatenate([y[None], numbers[1:]])

    def inflate_load_variance(self, numbers: Array) -> Array:
        return numbers

    def covariance(self, numbers: Array) -> Array:
        return self._variance * numbers[5:]


class ManyIntegral:
    """The integral RLS.

    Numbers: x, theta, P, waited, seen, variance of x by noise, std of x by theta, steps, windows (oldest first).
    """

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: integral_rls.Tuning, variance: float) -> None:
        self._tuning = tuning
        self._variance = variance
        self._start = (0.0, *theta0, *P0, *(0.0,) * 5, *(0.0,) * (5 * tuning.window))
        self._noise = integral_rls.regression_variance(variance, tuning.noise, tuning.window, tuning.hop)

    def start(self, lines: int) -> Array:
        return np.tile(np.array(self._start)[:, None], lines)

    def _moved(self, numbers: Array, u: Array) -> tuple[Array, tuple[Array, Array], Array, Array]:
        """Return predicted speed [m/s], its variance by noise and std by theta, number of steps and the new window."""
        x = numbers[0]
        phi = np.stack([x * x, x, u, np.ones_like(u)])
        predicted: Any = rls.output(tuple(numbers[1:5]), tuple(phi))
        g: Any = rls.times(tuple(numbers[5:15]), tuple(phi))[4]
        spreads = numbers[17] + self._tuning.noise, numbers[18] + np.sqrt(np.maximum(g, 0.0))
        window = np.concatenate([numbers[25:], phi, numbers[16:17]])
        return predicted, spreads, np.minimum(numbers[19] + 1.0, self._tuning.window), window

    def update(self, numbers: Array, y: Array, u: Array) -> ManyLearned:
        tuning, K = self._tuning, self._tuning.window
        predicted, (by_noise, by_theta), count, window = self._moved(numbers, u)
        error = y - predicted
        error_variance = by_noise + by_theta * by_theta + self._variance
        limit = tuning.clip * np.sqrt(error_variance)
        seen = np.minimum(np.maximum(y, predicted - limit), predicted + limit)
        waited = numbers[15] + 1.0
        due = (count == K) & (waited >= tuning.hop)
        blocks = window.reshape(K, 5, -1)
        summed: Any = tuple(blocks[:, :4].sum(axis=0))
        theta, P = tuple(numbers[1:5]), (*numbers[5:14], numbers[14] + tuning.drift * tuning.hop)
        change: Any = seen - window[4] - (rls.output(theta, summed) - summed[1])
        w: Any = rls.times(P, summed)
        after: Any = rls.updated(theta, P, w, change, self._noise)
        kept = np.where(due, np.stack([*after[0], *after[1]]), numbers[1:15])
        kappa, left = tuning.kappa, 1.0 - tuning.kappa
        now = predicted + kappa * (seen - predicted)
        corrected, unclipped = (left * left * by_noise + kappa * kappa * self._variance, left * by_theta), seen == y
        after = np.where(unclipped, corrected[0], by_noise), np.where(unclipped, corrected[1], by_theta)
        head = np.stack([now, *kept, np.where(due, 0.0, waited), seen, *after, count])
        none = np.zeros_like(error, dtype=np.bool_)
        return ManyLearned(np.concatenate([head, window]), predicted, error, none, error_variance, np.ones_like(error))

    def coast(self, numbers: Array, u: Array) -> Array:
        predicted, spreads, count, window = self._moved(numbers, u)
        head = np.stack([predicted, *numbers[1:15], numbers[15] + 1.0, predicted, *spreads, count])
        return np.concatenate([head, window])

    def reinit_speed(self, numbers: Array, y: Array) -> Array:
        zero = np.zeros_like(y)
        spreads = np.full_like(y, self._variance), zero
        return np.concatenate([y[None], numbers[1:15], np.stack([zero, y, *spreads, zero]), 0.0 * numbers[20:]])

    def inflate_load_variance(self, numbers: Array) -> Array:
        wider = numbers.copy()
        wider[12] += self._tuning.load
        return wider

    def covariance(self, numbers: Array) -> Array:
        return numbers[5:15]

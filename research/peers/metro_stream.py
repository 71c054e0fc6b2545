# SPDX-License-Identifier: Apache-2.0
"""A metro on its line as a stream of numbers, to compare recursive estimators of w(v) = a + b v + c v².

Station to station at 5 Hz between 0 and 21.6 m/s, on known gradients, with gusts unknown to the estimators,
and four scenarios: ``clean``; ``out5``, 5 % gross errors; ``slip``, bursts of wheel slip; ``step``, the resistance
changes half an hour before the end. It has two forms: ``raw`` ticks (speed, force, gradient), and ``rows`` for
estimators of y = w + noise with phi = [1, v, v²], computed from windows of 2 s. Rows overlap, so their noise is
correlated: sd 1.13 N/kN, autocorrelation .73, .47, .22, -.17, -.39 at lags 1, 2, 3, 5, 7.

All operations are vectorised; one seed takes about 20 ms. The scenarios of one seed share ride and noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Davis

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Scenario = Literal['clean', 'out5', 'slip', 'step']
SCENARIOS: Final[tuple[Scenario, ...]] = get_args(Scenario)

PERIOD: Final = 0.2
"""Time between two ticks [s]."""
INERTIA: Final = 1000.0 * 1.08 / G
"""Specific force [N/kN] per acceleration [m/s²], with 8 % rotating masses."""
BEFORE: Final = Davis(0.8, 0.02, 0.0012)
AFTER: Final = Davis(1.2, 0.02, 0.00144)
"""The resistance [N/kN, m/s] in the scenario ``step`` after a has grown by 0.4 and c by 20 %."""
NOISE_SD: Final = 1.13
"""Standard deviation of the noise of a clean row [N/kN]; the limit of a gate is a multiple of it."""
SPEED_SD: Final = float(np.hypot(0.02, 0.1 / 3.6 / np.sqrt(12.0)))
"""Standard deviation of a raw speed [m/s]: sensor noise of 0.02 m/s and a resolution of 0.1 km/h."""

_TOP_SPEED: Final = 21.6
_QUANTUM: Final = 0.1 / 3.6
_SPEED_NOISE: Final = 0.02
_FORCE_NOISE: Final = 0.3
_FORCE_SHARE: Final = 0.003
_GUST_SD: Final = 0.1
_GUST_TIME: Final = 10.0
_WINDOW: Final = 11
_SLOWEST: Final = 0.5
_STEP_ROWS: Final = 9000
_OUTLIERS: Final = 0.05
_SLIPPING: Final = 0.05


@dataclass(frozen=True, slots=True)
class Raw:
    """Ticks of 0.2 s, shapes (ticks,), including the stops, where ``moving`` is false.

    The force and the gradient of a tick are the means over the 0.2 s that end with it, the speed is that of its end.
    """

    speed: Floats
    force: Floats
    gradient: Floats
    moving: Flags
    spoiled: Flags


@dataclass(frozen=True, slots=True)
class Rows:
    """Regression form: y (n,) [N/kN], phi (n, 3) = [1, v, v²], the tick that ends each window, outlier flags."""

    y: Floats
    phi: Floats
    tick: NDArray[np.int64]
    spoiled: Flags


@dataclass(frozen=True, slots=True)
class MetroStream:
    """One ride of one scenario: ticks, rows, and the resistance before and after the row ``change`` (n if none)."""

    scenario: Scenario
    raw: Raw
    rows: Rows
    before: Davis
    after: Davis
    change: int


def metro_stream(seed: int, scenario: Scenario = 'clean', rows: int = 20_000) -> MetroStream:
    """Return the ride of a seed; ticks end with the last row.

    Args:
        seed: Seed of the random numbers, independent of the scenario.
        scenario: One of ``SCENARIOS``.
        rows: Number of windows of 2 s in motion.
    """
    ride, line, noise, trouble = (np.random.default_rng([seed, part]) for part in range(4))
    speed = _speeds(ride, rows)
    moving = speed > _SLOWEST
    ends = np.flatnonzero(np.convolve(moving, np.ones(_WINDOW), 'full')[: speed.size] > _WINDOW - 0.5)[:rows]
    speed, moving = speed[: ends[-1] + 1], moving[: ends[-1] + 1]
    change = max(rows - _STEP_ROWS, rows // 2) if scenario == 'step' else rows
    gradient = _gradients(line, speed)
    resistance = _resistances(speed, int(ends[change]) if change < rows else speed.size)
    force = INERTIA * np.diff(speed, prepend=speed[0]) / PERIOD + resistance + gradient + _gusts(noise, speed.size)
    measured = force + noise.standard_normal(speed.size) * (_FORCE_NOISE + _FORCE_SHARE * np.abs(force))
    seen = speed + noise.normal(0.0, _SPEED_NOISE, speed.size)
    spoiled = np.zeros(speed.size, dtype=np.bool_)
    if scenario == 'slip':
        excess = _slips(trouble, force, moving)
        seen, spoiled = seen + excess, excess != 0.0
    seen = np.maximum(np.round(seen / _QUANTUM) * _QUANTUM, 0.0)
    table = _rows(seen, measured - gradient, ends, spoiled)
    if scenario == 'out5':
        table = _with_gross_errors(trouble, table)
        spoiled = (trouble.random(speed.size) < _OUTLIERS) & moving
        error = trouble.uniform(0.5, 3.0, speed.size) * trouble.choice((-1.0, 1.0), speed.size)
        seen = np.where(spoiled, np.maximum(seen + error, 0.0), seen)
    raw = Raw(seen, measured, gradient, moving, spoiled)
    return MetroStream(scenario, raw, table, BEFORE, AFTER if scenario == 'step' else BEFORE, change)


def curve_error(theta: tuple[float, float, float] | Floats, truth: Davis) -> float:
    """Return the root mean square of the error of w(v) over 5 to 22 m/s [N/kN]; theta is (a, b, c)."""
    v = np.linspace(5.0, 22.0, 69)
    a, b, c = theta[0] - truth.a, theta[1] - truth.b, theta[2] - truth.c
    return float(np.sqrt(np.mean((a + v * (b + c * v)) ** 2)))


def _speeds(rng: np.random.Generator, rows: int) -> Floats:
    """Return true speeds [m/s] at the ticks: leg after leg with a stop between, enough for the rows."""
    legs: list[Floats] = []
    moving = 0
    while moving < rows + 200:
        leg = _leg(rng)
        moving += int(np.count_nonzero(leg > _SLOWEST)) - _WINDOW
        legs += [leg, np.zeros(int(rng.integers(100, 200)))]
    return np.concatenate(legs)


def _leg(rng: np.random.Generator) -> Floats:
    """Return one ride between stations: traction (power-limited), holding, coasting, braking; speeds [m/s]."""
    top = rng.uniform(0.72, 1.0) * (_TOP_SPEED - 0.2)
    rate, brake = rng.uniform(0.8, 1.05), rng.uniform(0.7, 1.0)
    # dv/dt = rate up to 9 m/s, then at constant power.
    knee = min(9.0, top)
    t = np.arange(0.0, 200.0, PERIOD)
    rising = np.minimum(rate * t, np.sqrt(knee * knee + 2.0 * knee * np.maximum(rate * t - knee, 0.0)))
    rising = rising[rising < top]
    holding = np.full(int(rng.integers(25, 200)), top)
    coasting = top - rng.uniform(0.02, 0.06) * PERIOD * np.arange(int(rng.integers(0, 250)))
    final = float(coasting[-1]) if coasting.size else top
    falling = np.arange(final, 0.0, -brake * PERIOD)
    leg = np.concatenate([rising, holding, coasting, falling, np.zeros(5)])
    # Smoothed over seven samples (1.2 s) to limit the jerk.
    return np.convolve(np.pad(leg, 3, mode='edge'), np.full(7, 1.0 / 7.0), 'valid')


def _gradients(rng: np.random.Generator, speed: Floats) -> Floats:
    """Return gradients under the train [per mille, at most 25], new every 250 m, smoothed over the train length."""
    place = np.cumsum(speed) * PERIOD
    values = np.clip(rng.normal(0.0, 9.0, int(place[-1] / 250.0) + 3), -25.0, 25.0)
    knots = np.arange(values.size) * 250.0
    corners = np.sort(np.concatenate([knots - 60.0, knots + 60.0]))[1:-1]
    smooth: Floats = np.interp(place, corners, np.repeat(values, 2)[: corners.size])
    return smooth


def _resistances(speed: Floats, change: int) -> Floats:
    """Return the mean w [N/kN] over the 0.2 s that end with each tick."""
    before = np.concatenate([speed[:1], speed[:-1]])
    middle = 0.5 * (speed + before)
    square = middle * middle + (speed - before) ** 2 / 12.0
    old = BEFORE.a + BEFORE.b * middle + BEFORE.c * square
    new = AFTER.a + AFTER.b * middle + AFTER.c * square
    resistances: Floats = np.where(np.arange(speed.size) < change, old, new)
    return resistances


def _gusts(rng: np.random.Generator, size: int) -> Floats:
    """Return gusts [N/kN], a first-order autoregressive process."""
    from scipy.signal import lfilter  # noqa: PLC0415 (slow to load)

    pole = float(np.exp(-PERIOD / _GUST_TIME))
    kicks = rng.normal(0.0, _GUST_SD * np.sqrt(1.0 - pole * pole), size)
    kicks[0] = rng.normal(0.0, _GUST_SD)
    return np.asarray(lfilter([1.0], [1.0, -pole], kicks), dtype=np.float64)


def _slips(rng: np.random.Generator, force: Floats, moving: Flags) -> Floats:
    """Return the slip speed [m/s], negative in braking: bursts of 0.6-2 s, 5 % of the time in motion."""
    excess = np.zeros(force.size)
    ticks = np.flatnonzero(moving)
    missing = int(_SLIPPING * ticks.size)
    while missing > 0:
        length = int(rng.integers(3, 11))
        start = int(rng.choice(ticks))
        if start + length >= force.size or excess[start : start + length].any():
            continue
        peak = rng.uniform(0.5, 3.0) * (1.0 if force[start] > 0.0 else -1.0)
        # Slow rise, fast fall.
        shape = np.interp(np.arange(1, length + 1) / (length + 1.0), (0.0, 0.7, 1.0), (0.0, 1.0, 0.0))
        excess[start : start + length] = peak * shape
        missing -= length
    return excess


def _rows(speed: Floats, balance: Floats, ends: NDArray[np.int64], spoiled: Flags) -> Rows:
    """Return y = f - i - (1 + gamma) slope and phi at the ends of windows of 11 ticks.

    The forces between the ticks are weighted as in the slope of the speeds.
    """
    place = np.arange(_WINDOW) - (_WINDOW - 1) / 2
    slope = place / (place @ place)
    # d(slope)/d(acceleration of the interval before each tick): sum of the weights from that tick on.
    share = np.cumsum(slope[::-1])[::-1][1:]
    windows = np.lib.stride_tricks.sliding_window_view(speed, _WINDOW)[ends - (_WINDOW - 1)]
    forces = np.lib.stride_tricks.sliding_window_view(balance, _WINDOW)[ends - (_WINDOW - 1)]
    y = forces[:, 1:] @ share - windows @ slope * (INERTIA / PERIOD)
    v = windows.mean(axis=1)
    phi = np.column_stack([np.ones(v.size), v, v * v])
    seen = np.lib.stride_tricks.sliding_window_view(spoiled, _WINDOW)[ends - (_WINDOW - 1)]
    return Rows(y, phi, ends, np.asarray(seen.any(axis=1)))


def _with_gross_errors(rng: np.random.Generator, rows: Rows) -> Rows:
    """Add errors of 10 to 60 N/kN to 5 % of the y, 70 % of them positive."""
    spoiled = rng.random(rows.y.size) < _OUTLIERS
    sign = np.where(rng.random(rows.y.size) < 0.7, 1.0, -1.0)
    error = rng.uniform(10.0, 60.0, rows.y.size) * sign
    return Rows(rows.y + np.where(spoiled, error, 0.0), rows.phi, rows.tick, spoiled)

# SPDX-License-Identifier: Apache-2.0
"""Synthetic station lines for the experiments on Yuan et al. 2017, many lines at once.

The data of the paper (Hangzhou Line 4) are not public. These lines follow its description: a train under closed-loop
ATO from stop to stop at 5 Hz, a new load after every stop, gradients unknown to the estimators, and a fast change of
d0 around sample 1100. The force is exact; speed is measured with one of several kinds of noise.

The truth is a differential equation, not the model (2): ``dv/dt = c (u - w(v)) - k i`` with the Davis resistance
w [N/kN of the nominal weight], ``c = k m_nominal / m``, the gradient i [per mille] and ``k = g / (1000 (1 + gamma))``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.stream.samples import SAMPLE_PERIOD
from trainid_ros.train.forces import G

Array = NDArray[np.float64]

NOMINAL_MASS_T: Final = 250.0
RAMP: Final = (1100, 1130)
"""Samples during which the base gradient falls by ``RAMP_DROP``."""
RAMP_DROP: Final = 6.5
SAMPLES: Final = 2200
_ROTARY: Final = 0.08
_K: Final = G / (1000.0 * (1.0 + _ROTARY))
_BASE: Final = 1.5
_WAVE: Final = 1.2
_MAP_STEP_M: Final = 10.0
_TRAIN_M: Final = 120.0
_SUBSTEPS: Final = 2
# Greatest force of motors and brakes [N/kN].
_MAX_FORCE: Final = 120.0


@dataclass(frozen=True, slots=True)
class LineShape:
    """Shape of a line and its runs."""

    samples: int = SAMPLES  # Number of samples
    distance: tuple[float, float] = (1100.0, 1700.0)  # Shortest and longest run from stop to stop [m]
    first: float = 800.0  # Added to the first run, so that most trains are in motion while the gradient falls [m]
    constant: bool = False  # Constant load and no gradient


ONE_RUN: Final = LineShape(samples=550, distance=(1550.0, 1750.0), first=0.0, constant=True)
LONG_CRUISE: Final = LineShape(samples=6700, distance=(18_500.0, 19_500.0), first=0.0)


@dataclass(frozen=True, slots=True)
class Lines:
    """Truth, one column per line."""

    x: Array  # Speed [m/s], shape (samples, lines)
    u: Array  # Specific force [N/kN] from this sample to the next, shape (samples, lines)
    theta: Array  # Parameters (a1, a2, b1, d0) of model (2) from this sample to the next, shape (samples, 4, lines)
    run: NDArray[np.int64]  # Number of the run from stop to stop, shape (samples, lines)


@dataclass(frozen=True, slots=True)
class _Draws:
    """Random parameters of lines; columns are lines, rows are stops or places."""

    davis: Array
    mass: Array
    distance: Array
    cruise: Array
    acceleration: Array
    braking: Array
    dwell: Array
    gradient: Array


def station_lines(seeds: Sequence[int], shape: LineShape = LineShape()) -> Lines:
    """Simulate one line per seed; a line depends on its own seed only."""
    draws = _draw(seeds, shape)
    drive = _Drive(draws, shape)
    rows = [drive.sample(n) for n in range(shape.samples)]
    x, u, theta, run = (np.array(column) for column in zip(*rows, strict=True))
    return Lines(x, u, theta, run)


def _draw(seeds: Sequence[int], shape: LineShape) -> _Draws:
    lines = [_draw_line(np.random.default_rng([seed, 2017]), shape) for seed in seeds]
    return _Draws(*(np.stack(column, axis=-1) for column in zip(*lines, strict=True)))


def _draw_line(rng: np.random.Generator, shape: LineShape) -> tuple[Array, ...]:
    stops = 2 + math.ceil(shape.samples * SAMPLE_PERIOD / 80.0)
    davis = rng.uniform((1.0, 0.02, 0.007), (3.0, 0.08, 0.014))
    mass = rng.uniform(205.0, 295.0, stops)
    if shape.constant:
        mass[:] = mass[0]
    distance = rng.uniform(*shape.distance, stops)
    distance[0] += shape.first
    cruise = rng.uniform(15.0, 20.0, stops)
    acceleration, braking = rng.uniform(0.7, 0.95, stops), rng.uniform(0.65, 0.9, stops)
    dwell = rng.uniform(22.0, 32.0, stops)
    gradient = _gradient(rng, shape.samples * SAMPLE_PERIOD * 21.0)
    return davis, mass, distance, cruise, acceleration, braking, dwell, 0.0 * gradient if shape.constant else gradient


def _gradient(rng: np.random.Generator, length: float) -> Array:
    """Return gradients every 10 m in pieces of some hundred metres, averaged over the train length [per mille]."""
    places = math.ceil(length / _MAP_STEP_M)
    steps = rng.integers(20, 60, places // 20 + 1)
    values = np.repeat(rng.uniform(-_WAVE, _WAVE, len(steps)), steps)[:places]
    window = round(_TRAIN_M / _MAP_STEP_M)
    smoothed: Array = np.convolve(values, np.full(window, 1.0 / window))[:places]
    return smoothed


class _Drive:
    """Train and automatic driver, vectorised over the lines."""

    def __init__(self, draws: _Draws, shape: LineShape) -> None:
        self._draws, self._shape = draws, shape
        self._lines = np.arange(draws.davis.shape[1])
        zero = np.zeros(len(self._lines))
        self._v, self._wanted, self._gone, self._place = zero, zero, zero, zero
        self._wait = self._lines % 7 * 1.0
        self._run = np.zeros(len(self._lines), dtype=np.int64)

    def sample(self, n: int) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """Return the present (x, u, theta, run) and advance to the next sample."""
        v, run = self._v, self._run
        mass = self._at_stop(self._draws.mass)
        c, i = _K * NOMINAL_MASS_T / mass, self._gradient(n)
        u = np.where(self._wait > 0.0, 0.0, self._force(c))
        a, b, c2 = self._draws.davis
        T = SAMPLE_PERIOD
        theta = np.stack([-T * c * c2, 1.0 - T * c * b, T * c, -T * (c * a + _K * i)])
        self._move(u, c, i)
        return v, u, theta, run

    def _at_stop(self, values: Array) -> Array:
        chosen: Array = values[np.minimum(self._run, len(values) - 1), self._lines]
        return chosen

    def _gradient(self, n: int) -> Array:
        places = np.minimum((self._place / _MAP_STEP_M).astype(np.int64), len(self._draws.gradient) - 1)
        wave: Array = self._draws.gradient[places, self._lines]
        if self._shape.constant:
            return wave
        start, end = RAMP
        fallen = min(max((n - start) / (end - start), 0.0), 1.0)
        return wave + _BASE - RAMP_DROP * fallen

    def _force(self, c: Array) -> Array:
        """Return the force [N/kN] to track a speed profile of acceleration, cruise and braking to the stop."""
        T, b = SAMPLE_PERIOD, self._at_stop(self._draws.braking)
        left = np.maximum(self._at_stop(self._draws.distance) - self._gone - self._v * T, 0.0)
        rise = self._wanted + T * self._at_stop(self._draws.acceleration)
        wanted = np.minimum(np.minimum(rise, self._at_stop(self._draws.cruise)), np.sqrt(2.0 * b * left))
        change, self._wanted = (wanted - self._wanted) / T, wanted
        force: Array = (change + 0.4 * (wanted - self._v)) / c + 3.0 + 0.01 * self._v**2
        return np.clip(force, -_MAX_FORCE, _MAX_FORCE)

    def _move(self, u: Array, c: Array, i: Array) -> None:
        """Integrate over one period (Runge-Kutta); stop at the platform, dwell, change the load."""
        a, b, c2 = self._draws.davis
        h, v = SAMPLE_PERIOD / _SUBSTEPS, self._v

        def slope(v: Array) -> Array:
            rate: Array = c * (u - a - b * v - c2 * v * v) - _K * i
            return rate

        for _ in range(_SUBSTEPS):
            k1 = slope(v)
            k2 = slope(v + 0.5 * h * k1)
            k3 = slope(v + 0.5 * h * k2)
            v = v + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(v + h * k3))
        waiting = self._wait > 0.0
        arrived = ~waiting & (v < 0.15) & (self._gone > 100.0)
        moving = ~waiting & ~arrived
        moved = np.where(moving, 0.5 * (self._v + v) * SAMPLE_PERIOD, 0.0)
        self._gone, self._place = self._gone + moved, self._place + moved
        self._v = np.where(moving, np.maximum(v, 0.0), 0.0)
        dwell = self._at_stop(self._draws.dwell)
        self._run = self._run + arrived
        self._wait = np.where(arrived, dwell, self._wait - SAMPLE_PERIOD * waiting)
        self._gone, self._wanted = np.where(arrived, 0.0, self._gone), np.where(arrived, 0.0, self._wanted)


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise model of the measured speed."""

    name: str  # Name in the tables
    std: float = 0.02  # White noise [m/s]
    rho: float = 0.0  # Correlation of adjacent samples, of AR(1) noise with the same standard deviation
    quantum: float = 0.0  # Resolution [m/s]
    missing: float = 0.0  # Share of samples that are lost
    outliers: float = 0.0  # Share of samples with an error of 0.3 to 2 m/s

    @property
    def declared(self) -> float:
        """Standard deviation of the noise without outliers, as given to the estimators [m/s]."""
        return math.hypot(self.std, self.quantum / math.sqrt(12.0))


NOISES: Final = (
    Noise('white .02'),
    Noise('AR(1) .9, .02', rho=0.9),
    Noise('0.1 km/h', std=0.0, quantum=0.1 / 3.6),
    Noise('10 % missing', missing=0.1),
    Noise('5 % outliers', outliers=0.05),
)


def measured(lines: Lines, noise: Noise, seeds: Sequence[int]) -> Array:
    """Return measured speeds [m/s], shape (samples, lines); NaN if lost, exactly zero at standstill."""
    columns = [_measured(x, noise, np.random.default_rng([seed, 7])) for x, seed in zip(lines.x.T, seeds, strict=True)]
    return np.stack(columns, axis=1)


def _measured(x: Array, noise: Noise, rng: np.random.Generator) -> Array:
    n = len(x)
    white, chance, size = rng.standard_normal(n), rng.random((2, n)), rng.uniform(-1.0, 1.0, n)
    r = _ar1(white, noise.rho) * noise.std
    y = x + r
    if noise.quantum > 0.0:
        y = np.round(y / noise.quantum) * noise.quantum
    y = np.where(x == 0.0, 0.0, y)
    wrong = np.copysign(0.3 + 1.7 * np.abs(size), size)
    y = np.where((chance[0] < noise.outliers) & (x > 0.0), y + wrong, y)
    lost = chance[1] < noise.missing
    lost[0] = False
    measured: Array = np.where(lost, np.nan, np.maximum(y, 0.0))
    return measured


def _ar1(white: Array, rho: float) -> Array:
    if rho == 0.0:
        return white
    scaled = math.sqrt(1.0 - rho * rho) * white
    scaled[0] = white[0]
    coloured = [0.0]
    for value in scaled.tolist():
        coloured.append(rho * coloured[-1] + value)
    return np.array(coloured[1:])

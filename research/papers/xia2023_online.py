# SPDX-License-Identifier: Apache-2.0
"""Online identification (Table 4 of Xia et al. 2023): a, b, c change with the position, one record every 100 m."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from research.papers import highspeed_line as data
from research.papers.xia2023_fits import DISTANCE, NOISE, at_measured
from trainid_lab.resistance.trajectory.newton import NewtonConfig, newton
from trainid_lab.resistance.trajectory.stages import Stages, objective
from trainid_lab.resistance.trajectory.two_window import TwoWindow, TwoWindowConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

ENDS: Final = (22e3, 52e3, 64e3, 82e3, 120e3)
# b as printed, a tenth of that in Table 3.
LAWS: Final = (
    (0.79, 0.002288, 0.001368),
    (0.49, 0.001208, 0.001368),
    (0.79, 0.002288, 0.001368),
    (0.79, 0.002288, 0.001368),
    (0.79, 0.002288, 0.002557),
)
NOISY_FROM: Final = 64e3
SWITCHES: Final = (22e3, 52e3, 82e3)
CAPACITY: Final = 20
CONFIG: Final = TwoWindowConfig(
    stride=1, short=20, long=60, switch=4.0, speed_std=NOISE, disturbance_std=0.005, force_error=1e-9, force_skew=1e-9,
    prior_share=0.0, prior_std_a=0.4, prior_std_b=0.004, prior_std_c=0.0008,
)  # fmt: skip
# Prior, 9 % off on purpose.
PRIOR: Final = Davis(*(1.09 * x for x in LAWS[0]))
_SETTLING: Final = 6e3
_BEFORE_SWITCH: Final = 500.0
_HEAVY_EVERY: Final = 5
_START_NS: Final = 1_700_000_000 * NS_PER_S


def law_at(position: float) -> data.Law:
    """Return a, b, c [N/kN, v in m/s] at a position from the start [m]."""
    return LAWS[min(len(LAWS) - 1, sum(position >= end for end in ENDS))]


@dataclass(frozen=True, slots=True)
class Drive:
    """A record of the drive with its measured speeds."""

    record: data.Record
    seen: NDArray[np.float64]

    @property
    def position(self) -> NDArray[np.float64]:
        """Positions from the start [m]."""
        return np.asarray(self.record.position - self.record.position[0])


def drive(seed: int, source: str) -> Drive:
    """Return a drive on a random line; noise acts in the last two sections."""
    rng = np.random.default_rng(seed)
    line, plan = data.make_line(rng), data.cruise_plan(rng)
    record = (data.drive_scheme if source == 'scheme' else data.drive_ode)(line, plan, law_at, DISTANCE)
    noise = NOISE * rng.standard_normal(record.speed.size)
    noisy = record.position - record.position[0] >= NOISY_FROM
    return Drive(record, np.asarray(record.speed + np.where(noisy, noise, 0.0)))


def samples(given: Drive) -> list[Sample]:
    """Return the drive as samples of the product, with means in time."""
    record, dt = given.record, np.diff(given.record.time)
    newton_per_unit = data.MASS_T * 9.80665
    out = []
    for i, seen in enumerate(given.seen.tolist()):
        force = float(record.time_mean[max(i - 1, 0)]) * newton_per_unit
        load = float(record.load_time_mean[max(i - 1, 0)])
        stamp_ns = _START_NS + round(float(record.time[i]) * NS_PER_S)
        sample = coasting_sample(stamp_ns, float(dt[i - 1]) if i else math.nan, seen)
        sample.position = float(record.position[i])
        sample.force = sample.force_mean = force
        sample.gradient = sample.gradient_mean = load
        out.append(sample)
    return out


def train_file() -> TrainFile:
    """Return the train file for the two windows, with the prior resistance."""
    return TrainFile(Train(1000.0 * data.MASS_T, data.GAMMA, data.LENGTH), PRIOR, Brake(1.0, 0.0, 0.0))


def two_window(given: Drive) -> NDArray[np.float64]:
    """Return w(v_now) [N/kN] after each sample, shape (I + 1,)."""
    estimator = TwoWindow(train_file(), CONFIG)
    out = []
    for sample, true in zip(samples(given), given.record.speed.tolist(), strict=True):
        estimator.step(sample)
        out.append(estimator.estimate(true).resistance)
    return np.array(out)


def refitted(given: Drive, method: str, every: int = 1) -> NDArray[np.float64]:
    """Refit the last 20 samples at each sample, v_0 as measured, as the paper does; NaN between.

    Args:
        given: The drive.
        method: 'left' samples force and load at the start of a stage, 'mean' uses means, 'printed' is Algorithm 1.
        every: Samples between two fits.

    """
    mean = method != 'left'
    stages = given.record.stages(mean_force=mean, mean_load=mean)
    theta = np.array((PRIOR.a, PRIOR.b, PRIOR.c))
    rng, config = np.random.default_rng(0), NewtonConfig()
    theta = np.clip(theta, config.low, config.high)
    out = np.full(given.seen.size, np.nan)
    for i in range(CAPACITY, given.seen.size, every):
        part = Stages(stages.lam[i - CAPACITY : i], stages.drive[i - CAPACITY : i])
        seen = given.seen[i - CAPACITY : i + 1]
        if method == 'printed':
            theta = newton(partial(at_measured, objective, part, seen), theta, replace(config, most=30), rng).theta
        else:
            theta = _boxed(part, seen, config)
        out[i] = theta @ given.record.speed[i] ** np.arange(3)
    return out


def _boxed(stages: Stages, seen: NDArray[np.float64], config: NewtonConfig) -> NDArray[np.float64]:
    """Return the least-squares solution of the paper in its box, v_0 as measured: the limit of Algorithm 1."""
    scale = np.array([1.0, 0.02, 0.001])
    lam_v = stages.lam * seen[:-1] ** np.arange(3)[:, None]
    A = -np.cumsum(lam_v, axis=1).T * scale / seen[1:, None]
    y = (0.5 * (seen[1:] ** 2 - seen[0] ** 2) - np.cumsum(stages.lam * stages.drive)) / seen[1:]
    low, high = np.array(config.low) / scale, np.array(config.high) / scale
    return scale * np.asarray(lsq_linear(A, y, (low, high), method='bvls').x)


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one method on one drive."""

    method: str  # Name of the method
    clean: NDArray[np.float64]  # Settled errors of w(v_now) in sections 1 to 3 [N/kN]
    fourth: NDArray[np.float64]  # The same in section 4
    fifth: NDArray[np.float64]  # The same in section 5
    delays: tuple[float, ...]  # Distance to half of each change [m]


def score(given: Drive, method: str, w: NDArray[np.float64]) -> Score:
    """Score estimates of w(v_now) [N/kN]."""
    s, v = given.position, given.record.speed
    truth = np.array([law_at(x) for x in s.tolist()])
    error = w - np.sum(truth * v[:, None] ** np.arange(3), axis=1)
    edges = (0.0, *SWITCHES, DISTANCE)
    settled = np.zeros(s.size, dtype=bool)
    for begin, end in pairwise(edges):
        settled |= (s >= begin + _SETTLING) & (s <= end - _BEFORE_SWITCH)
    settled &= np.isfinite(error) & ((s < NOISY_FROM) | (s >= NOISY_FROM + _SETTLING))
    parts = [
        error[settled & (s < NOISY_FROM)],
        error[settled & (s >= NOISY_FROM) & (s < 82e3)],
        error[settled & (s >= 82e3)],
    ]
    return Score(method, parts[0], parts[1], parts[2], tuple(_half_delay(s, v, error, at) for at in SWITCHES))


def _half_delay(s: NDArray[np.float64], v: NDArray[np.float64], error: NDArray[np.float64], at: float) -> float:
    change = np.array(law_at(at)) - np.array(law_at(at - 1.0))
    jump = np.abs(v[:, None] ** np.arange(3) @ change)
    there = (s >= at) & np.isfinite(error) & (np.abs(error) < 0.5 * jump)
    return float(s[np.argmax(there)] - at) if there.any() else math.inf


def online(seed: int) -> list[Score]:
    """Run the two windows on one drive by (3)."""
    given = drive(seed, 'ode')
    return [score(given, 'two windows 20/60 (ours)', two_window(given))]


def online_of_the_paper(seed: int) -> list[Score]:
    """Run the refits of 20 samples on one drive."""
    real, scheme = drive(seed, 'ode'), drive(seed, 'scheme')
    return [
        score(scheme, 'I = 20, v0 as measured, data of (7)', refitted(scheme, 'mean', 2)),
        score(scheme, 'I = 20, Algorithm 1, data of (7)', refitted(scheme, 'printed', _HEAVY_EVERY)),
        score(real, 'I = 20, v0 as measured, data of (3), left ends', refitted(real, 'left', 2)),
        score(real, 'I = 20, v0 as measured, data of (3), means', refitted(real, 'mean', 2)),
    ]

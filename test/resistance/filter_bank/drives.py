# SPDX-License-Identifier: Apache-2.0
"""Drives of a simulated train with known errors, and filter banks that followed them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from test.estimators.makers import stepped
from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import ResistanceEstimate
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan
from trainid_ros.resistance.hypotheses import A, B, C
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

Array = NDArray[np.float64]
# Fewer hypotheses: the same filters, but faster.
SMALL = FilterBankConfig(hypotheses=8, valid_std=0.25)
START = 1_700_000_000 * NS_PER_S
G, GAMMA, MASS = 9.80665, 0.08, 200e3
INERTIA = 1000.0 * (1.0 + GAMMA) / G
FILE = TrainFile(Train(MASS, GAMMA, 100.0), Davis(1.5, 0.03, 0.004), Brake(1.0, 0.4, 0.6), Line(gradient_std=0.1))
TRUTH = Davis(1.8, 0.02, 0.005)
GRADIENT = 6.0
FINE = 0.025


def w(davis: Davis, v: float) -> float:
    return davis.a + davis.b * v + davis.c * v * v


@dataclass(frozen=True)
class World:
    """True train and line.

    Attributes:
        davis: Resistance as a function of time [s].
        mass: Ratio of the true mass to that of the train file [1].
        gain: Ratio of the true force to the reported one [1].
        delay: Delay of the force stamps relative to the force [s].
        curve: Coefficient of the curve resistance [N/kN m]; every third 150 m are a curve of 300 m.
        gust_std: Standard deviation of gusts [N/kN].
        map_std: Standard deviation of map errors [N/kN].
        force_noise: White noise of the mean force of a sample [N/kN].
        speed_noise: Noise of the measured speed [m/s].

    """

    davis: Callable[[float], Davis] = lambda _: TRUTH
    mass: float = 1.0
    gain: float = 1.0
    delay: float = 0.0
    curve: float = 0.0
    gust_std: float = 0.1
    map_std: float = 0.05
    force_noise: float = 0.2
    speed_noise: float = 0.02


def markov(rng: np.random.Generator, std: float, rho: float, n: int) -> list[float]:
    """Return a Gauss-Markov sequence of n numbers, correlated by rho from one to the next."""
    out = [std * float(rng.standard_normal())]
    for noise in (std * math.sqrt(1.0 - rho * rho) * rng.standard_normal(n - 1)).tolist():
        out.append(rho * out[-1] + noise)
    return out


def drive(seconds: float, world: World | None = None, *, seed: int = 0, period: float = 0.2) -> list[Sample]:
    """Drive uphill with changing power levels, ramped within a second, and coasting; Euler steps of 25 ms."""
    world = world or World()
    rng = np.random.default_rng(seed)
    n, lag = round(seconds / FINE), round(world.delay / FINE)
    gust = markov(rng, world.gust_std, math.exp(-FINE / 6.0), n)
    # One value per metre of the line; the train stays below 40 m/s.
    error = markov(rng, world.map_std, math.exp(-1.0 / 250.0), round(40.0 * seconds))
    v, position, pulls, level, force = 11.0, 0.0, True, 30.0, 0.0
    forces, speeds, positions, bends = [], [], [], []
    for k in range(n):
        speeds.append(v)
        positions.append(position)
        pulls = v < 16.0 if pulls else v < 9.0
        level = rng.uniform(15.0, 50.0) if not pulls else level
        target = level if pulls else 0.0
        force += min(max(target - force, -40.0 * FINE), 40.0 * FINE)
        forces.append(force)
        davis = world.davis(k * FINE)
        bends.append(position % 450.0 < 150.0)
        bend = world.curve / 300.0 if bends[-1] else 0.0
        pull = force / world.mass - GRADIENT - bend - gust[k] - error[int(position)]
        v += FINE / INERTIA * (pull - w(davis, v))
        position += FINE * v
    # The report at t is the force at t - delay, divided by the gain.
    padded = [0.0] * max(0, lag) + forces + [force] * max(0, -lag)
    reported = np.array(padded[max(0, -lag) :][:n]) / world.gain
    many = round(period / FINE)
    samples = []
    for i in range(n // many):
        k = i * many
        mean = float(reported[max(0, k - many) : max(1, k)].mean()) + world.force_noise * rng.standard_normal()
        share = sum(bends[max(0, k - many) : max(1, k)]) / many
        samples.append(
            Sample(
                stamp_ns=START + round(k * FINE * NS_PER_S),
                dt=math.nan if i == 0 else period,
                speed=max(0.0, speeds[k] + world.speed_noise * float(rng.standard_normal())),
                position=positions[k],
                direction=1,
                force=float(reported[k]) * MASS * G / 1000.0,
                force_mean=mean * MASS * G / 1000.0,
                gradient=GRADIENT,
                gradient_mean=GRADIENT,
                curve_radius=300.0 if bends[k] else 0.0,
                tunnel=False,
                mass=math.nan,
                brake_command=0.0,
                brake_changes=(),
                brake_gap=False,
                emergency=False,
                curvature_mean=share / 300.0,
            )
        )
    return samples


def run(samples: list[Sample], file: TrainFile = FILE, config: FilterBankConfig = SMALL) -> FilterBank:
    return stepped(FilterBank(file, config), samples)


def check_finite(estimate: ResistanceEstimate) -> None:
    """Check that all numbers are finite and the covariance is valid."""
    values = [getattr(estimate, name) for name in ResistanceEstimate.__dataclass_fields__ if name != 'covariance']
    assert all(map(math.isfinite, [*values, *estimate.covariance]))
    P = np.array(estimate.covariance).reshape(3, 3)
    std = np.sqrt(np.diag(P))
    R = P / np.outer(std, std)
    assert np.max(np.abs(R - R.T)) < 1e-9
    assert np.linalg.eigvalsh(R)[0] > -1e-9


def fields_except_speed(estimate: ResistanceEstimate) -> tuple[Any, ...]:
    names = ('a', 'b', 'c', 'covariance', 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std')
    return tuple(getattr(estimate, name) for name in names)


def restored(text: str, config: FilterBankConfig = SMALL) -> FilterBank:
    bank = FilterBank(FILE, config)
    bank.restore(text)
    return bank


def after(samples: list[Sample], **fields: Any) -> Sample:
    """Return a good sample one period after the last one, with some fields replaced."""
    last = samples[-1]
    return replace(last, stamp_ns=last.stamp_ns + NS_PER_S // 5, **fields)


def shifted(samples: list[Sample], seconds: float) -> list[Sample]:
    """Return the same drive at a later time."""
    return [replace(item, stamp_ns=item.stamp_ns + round(seconds * NS_PER_S)) for item in samples]


def coverage(seeds: range, seconds: float, config: FilterBankConfig) -> tuple[Array, Array]:
    """Return normalised errors of w at four speeds, shape (n, 4), and of force scale and delay, (n, 2)."""
    in_w, in_force = [], []
    prior = bank_plan(FILE, config, INERTIA)
    for seed in seeds:
        rng = np.random.default_rng((seed, 77))
        a, b, c = (prior.mean + np.sqrt(prior.variance) * rng.standard_normal(9))[[A, B, C]].tolist()
        davis = Davis(max(a, 0.2), b, max(c, 0.0))
        mass, gain = 1.0 + 0.03 * rng.standard_normal(), 1.0 + 0.02 * rng.standard_normal()
        delay = FINE * round(float(np.clip(0.15 * rng.standard_normal(), -0.2, 0.3)) / FINE)
        world = World(
            lambda _, davis=davis: davis,  # type: ignore[misc]
            mass,
            gain,
            delay,
            gust_std=float(rng.choice([0.1, 0.2, 0.4])),
            map_std=float(rng.choice([0.025, 0.125])),
        )
        bank = run(drive(seconds, world, seed=seed), config=config)
        here = [bank.estimate(v) for v in (9.0, 11.0, 13.0, 15.0)]
        in_w.append([(e.resistance - w(davis, e.speed)) / e.resistance_std for e in here])
        e = here[0]
        in_force.append(
            [(e.force_scale - gain / mass) / e.force_scale_std, (e.force_delay - delay) / e.force_delay_std]
        )
    return np.array(in_w), np.array(in_force)


def check_recovers(bank: FilterBank, seed: int = 12, sigmas: float = 3.0) -> None:
    """Check that after good driving w is within, or near, its stated band again."""
    stepped(bank, shifted(drive(100.0, seed=seed), 10_000.0))
    found = bank.estimate(12.0)
    check_finite(found)
    assert found.resistance == pytest.approx(w(TRUTH, 12.0), abs=max(0.5, sigmas * found.resistance_std))

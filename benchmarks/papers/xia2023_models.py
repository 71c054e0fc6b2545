# SPDX-License-Identifier: Apache-2.0
"""Errors of the model in the fit of Xia et al. 2023: what wrong beliefs cost, and what the scheme (7) costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.papers import highspeed_line as data
from benchmarks.papers.xia2023_fits import CASES, KINDS, in_time, record
from trainid_ros.resistance.trajectory.davis_fit import DavisFitConfig, fit_davis
from trainid_ros.resistance.trajectory.levenberg import levenberg
from trainid_ros.resistance.trajectory.multi_mass import Cars, MultiMassLine
from trainid_ros.resistance.trajectory.stages import Stages, reach
from trainid_ros.train.train_file import Line

if TYPE_CHECKING:
    from numpy.typing import NDArray

SPEEDS: Final = (270.0, 290.0, 305.0)
_QUIET: Final = DavisFitConfig(
    speed_std=0.01, disturbance_std=1e-3, learn_noise=False, force_skew=1e-9, force_error=1e-9, force_jitter=0.0
)


@dataclass(frozen=True, slots=True)
class Belief:
    """Errors of what is believed: factors and shifts, 1 and 0 where it is right."""

    name: str
    mass: float = 1.0
    force: float = 1.0
    gradient: float = 0.0
    shift: float = 0.0
    odometer: float = 1.0
    wheel: float = 1.0
    gamma: float = data.GAMMA
    one_mass: bool = False


BELIEFS: Final = (
    Belief('mass +5 %', mass=1.05),
    Belief('gradient +1 per mille', gradient=1.0),
    Belief('force +3 %', force=1.03),
    Belief('map shifted by 100 m', shift=100.0),
    Belief('odometer 0.1 %', odometer=1.001),
    Belief('wheel diameter +0.5 %', wheel=1.005),
    Belief('gamma 0.10 for 0.06', gamma=0.10),
    Belief('one mass at the head', one_mass=True),
)


@dataclass(frozen=True, slots=True)
class Cost:
    """What an error of belief does: to w at three speeds [N/kN], to a, b, c, and what the fit leaves [m/s]."""

    name: str
    kind: str
    w: tuple[float, ...]
    theta: tuple[float, ...]
    residual: float


def costs() -> list[Cost]:
    """Return the cost of each error on both records, made by (7), without noise."""
    return [_cost(belief, kind) for belief in BELIEFS for kind in KINDS]


def _cost(belief: Belief, kind: str) -> Cost:
    given = record(kind, 0, 'scheme')
    position = given.position[0] + belief.odometer * (given.position - given.position[0])
    cars = Cars(np.ones(1), np.zeros(1)) if belief.one_mass else data.make_cars()
    load = MultiMassLine(_line(), cars).means(position + belief.shift) + belief.gradient
    if belief.wheel != 1.0:
        position = given.position[0] + belief.wheel * (given.position - given.position[0])
    stages = Stages(reach(np.diff(position), belief.gamma), given.mean * belief.force / belief.mass - load)
    fit = levenberg(stages, belief.wheel * given.speed)
    e = fit.theta - np.array(CASES[0])
    w = [float(e @ (v / 3.6) ** np.arange(3)) for v in SPEEDS]
    return Cost(belief.name, kind, tuple(w), tuple(e.tolist()), float(np.sqrt(fit.mse)))


def _line() -> Line:
    return data.make_line(np.random.default_rng(5000))


@dataclass(frozen=True, slots=True)
class SchemeError:
    """Error of a scheme on the differential equation: speeds run open loop [m/s], worst w of a fit without noise."""

    name: str
    kind: str
    open_loop: float
    w: float


def scheme_errors() -> list[SchemeError]:
    """Return the errors of (7) by what it is given, and of the stages in time."""
    out = []
    for kind in KINDS:
        given = record(kind, 0, 'ode')
        for name, force, load in (
            ('(7), F and G where stages begin (printed)', False, False),
            ('(7), mean F, G where stages begin', True, False),
            ('(7), mean F and G', True, True),
        ):
            stages = given.stages(mean_force=force, mean_load=load)
            run = stages.speeds(np.array(CASES[0]), float(given.speed[0]))
            theta = levenberg(stages, given.speed).theta
            out.append(SchemeError(name, kind, float(np.sqrt(np.mean((run - given.speed) ** 2))), _worst(given, theta)))
        fit = fit_davis(in_time(given, given.speed), _QUIET)
        out.append(SchemeError('stages in time, mean F and G (ours)', kind, np.nan, _worst(given, fit.theta)))
    return out


def _worst(given: data.Record, theta: NDArray[np.float64]) -> float:
    v = np.linspace(given.speed.min(), given.speed.max(), 100)
    return float(np.max(np.abs(v[:, None] ** np.arange(3) @ (theta - np.array(CASES[0])))))

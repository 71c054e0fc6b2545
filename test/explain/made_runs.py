# SPDX-License-Identifier: Apache-2.0
"""Runs of a train with known motion, made stage by stage without aligner or simulator."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trainid_ros.explain.dataset import Run
from trainid_ros.explain.effects import EffectTerm, track_points
from trainid_ros.explain.model import Model
from trainid_ros.train.effects import TrackPoint
from trainid_ros.train.forces import specific_inertia
from trainid_ros.train.train_file import Davis, Train, TrainFile

DAVIS = Davis(1.5, 0.02, 0.003)
TRAIN = TrainFile(Train(200e3, length=100.0), DAVIS)
DT = 0.2
PULL, PUSH = 90.0, -80.0  # N/kN

Extra = Callable[[float, float, int], float]
"""Resistance missing in the train file [N/kN], by position [m], speed [m/s] and direction."""


def drag(permille: float) -> Extra:
    """Return a drag [per mille] on the part of the train between 100 and 350 m."""

    def extra(position: float, _: float, direction: int) -> float:
        rear = position - direction * TRAIN.train.length
        inside = min(max(position, rear), 350.0) - max(min(position, rear), 100.0)
        return permille * max(inside, 0.0) / TRAIN.train.length

    return extra


@dataclass(frozen=True)
class Maker:
    """Makes runs in both directions of a line with a hill.

    Attributes:
        noise: Noise of measured speeds [m/s].
        coast_s: Time of coasting before the train brakes [s].
        pull: Traction [N/kN].
        push: Brake [N/kN]; 0 ends the run after coasting.
        weighed: True if the mass is measured.

    """

    noise: float = 0.02
    coast_s: float = 30.0
    pull: float = PULL
    push: float = PUSH
    weighed: bool = True

    def runs(self, count: int, seed: int, extra: Extra = lambda *_: 0.0) -> list[Run]:
        rng = np.random.default_rng(seed)
        made: list[Run] = []
        start, time, run_m = 0.0, 0.0, 0.0
        for k in range(count):
            run = self.run(start, (1, -1)[k % 2], time, run_m, rng, extra)
            made.append(run)
            start, time, run_m = run.stops[1], float(run.time[-1]) + 30.0, float(run.distance_run[-1])
        return made

    def run(
        self, start: float, direction: int, time: float, run_m: float, rng: np.random.Generator, extra: Extra
    ) -> Run:
        inertia = specific_inertia(1.0, TRAIN.train.rotary_mass)
        top, released = 14.0 + 4.0 * rng.random(), math.inf
        v, s, coasted = 0.4, start, 0.0
        rows = [(time, 0.0, v, s, 0.0, 0.0, 0.0, math.inf, run_m)]
        while v >= 0.3 and (self.push or coasted < self.coast_s):
            pulling = coasted == 0.0 and v < top
            coasted += 0.0 if pulling else DT
            traction = min(self.pull, 900.0 / v) if pulling else 0.0
            brake = self.push if coasted > self.coast_s else 0.0
            gradient = direction * (5.0 if 300.0 < s < 600.0 else 0.0)
            w = DAVIS.a + DAVIS.b * v + DAVIS.c * v * v
            v += DT * (traction + brake - gradient - w - extra(s, v, direction)) / inertia
            time, s, run_m = time + DT, s + direction * DT * v, run_m + DT * v
            released = 0.0 if brake else released + DT
            rows.append((time, DT, max(v, 0.0), s, gradient, traction, brake, released, run_m))
        t, dt, speed, position, gradients, pulls, pushes, since, distance = np.array(rows).T
        speed = np.maximum(speed + self.noise * rng.standard_normal(speed.size), 0.0)
        nothing = np.zeros(t.size)
        return Run(
            0, direction, t, dt, speed, position, gradients, nothing, nothing, pulls, pushes, nothing, since, distance,
            positioned=True, weighed=self.weighed, stops=(start, s), travelled=float(distance[-1] - distance[0]),
        )  # fmt: skip


def disturbed(run: Run, *changes: tuple[Any, Any]) -> Run:
    """Return a run whose measured speed is changed by some amounts [m/s] at some samples."""
    speed = run.speed.copy()
    for at, by in changes:
        speed[at] += by
    return replace(run, speed=np.maximum(speed, 0.0))


def local_drag(start: float, end: float, permille: float) -> EffectTerm:
    """Return a drag of this size between two positions [m]."""
    return EffectTerm('local_drag', {'start': start, 'end': end, 'permille': permille})


def points(model: Model) -> list[TrackPoint]:
    """Return what effects see at all stages of a model."""
    d, length = model.dataset, TRAIN.train.length
    parts = zip(d.runs, np.split(d.speed, d.starts[1:]), strict=True)
    return [point for run, speed in parts for point in track_points(run, speed, length, d.inertia, TRAIN.resistance)]


def evaluated(text: str, **names: object) -> float:
    """Return the value of an expression that a file of an effect contains."""
    return float(eval(text, {'exp': math.exp, 'sin': math.sin, 'cos': math.cos, **names}))

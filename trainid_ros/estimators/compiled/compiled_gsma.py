# SPDX-License-Identifier: Apache-2.0
"""GSMA with its step over all particles in one compiled loop, for hundreds of particles or fast replays."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.brake_rate import group_cloud
from trainid_ros.brake_rate.group_cloud import GroupCloud
from trainid_ros.brake_rate.gsma import LEAST_PAUSE, GsmaPosterior
from trainid_ros.brake_rate.particles import speed_step
from trainid_ros.brake_rate.posterior import Transition
from trainid_ros.estimators.compiled import group_loops
from trainid_ros.estimators.compiled.jit import compiled

if TYPE_CHECKING:
    from trainid_ros.brake_rate.gsma import GsmaConfig
    from trainid_ros.brake_rate.particles import Array
    from trainid_ros.estimators.compiled.group_loops import Learned


class CompiledGsmaPosterior(GsmaPosterior):
    """The particles of GSMA; the same states, saved and restored alike."""

    def __init__(self, config: GsmaConfig, expected: float, rng: np.random.Generator) -> None:
        self._predict, self._learn = compiled(group_loops.predict), compiled(group_loops.learn)
        super().__init__(config, expected, rng)
        self._edges = np.concatenate([[0], np.cumsum(self.strata.sizes)]).astype(np.intp)
        # Now, not when the brake first acts: compiling takes seconds.
        interval = Transition(0.2, 0.1, 0.6, 0.01, 0.4, 1.0, 0.0, 1e-6, 0.0)
        c, (z, line, P) = self.cloud, self._predicted(interval)
        moved = GroupCloud(z, c.weight, c.mean, c.variance, line)
        self._learned(moved, P, interval, 0.0, 0.0, 1.0, np.zeros(len(self._q)))

    def predict(self, interval: Transition) -> None:
        """Follow the motion over an interval."""
        c = self.cloud
        z, line, self.P = self._predicted(interval)
        self.cloud = GroupCloud(z, c.weight, c.mean, c.variance, line)

    def learn(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """One step of GSMA, eqs. (14)-(22)."""
        dt, c = interval.dt, self.cloud
        if (pause := elapsed - dt) > LEAST_PAUSE:
            c = group_cloud.widened(c, speed_step(interval), self._config.drift**2 * pause)
        draws = self._rng.random(len(self._q))
        z, weight, mean, variance, line, P, each, numbers = self._learned(c, self.P, interval, pause, speed, r, draws)
        rate, spread, effective = numbers
        if not math.isfinite(spread):
            return False
        self.cloud, self._weights = GroupCloud(z, weight, mean, variance, line), each
        self._rate, self._variance, self._effective, self.P = rate, spread, effective, P
        return True

    def _predicted(self, interval: Transition) -> tuple[Array, Array, Array]:
        c = self.cloud
        return self._predict(c.z, c.line, self.P, interval)

    def _learned(
        self, c: GroupCloud, P: Array, interval: Transition, pause: float, speed: float, r: float, draws: Array
    ) -> Learned:
        walk, chain = self._walk(interval.calm), self._chain(interval.calm * interval.dt, pause)
        return self._learn(
            c.z, c.weight, c.mean, c.variance, c.line, self._edges,
            interval, walk, P, speed, r, self._largest, chain, draws,
        )  # fmt: skip

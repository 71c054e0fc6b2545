# SPDX-License-Identifier: Apache-2.0
"""The estimators of trainid on the metro ride, with the interface of the comparison."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

from research.peers.hand_filters import START, START_SD, VARIANCE, RowPeer, speeds_of, square
from research.peers.metro_stream import INERTIA, PERIOD, MetroStream
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.change_points import ChangePointConfig, Tracker, independent
from trainid_ros.resistance.davis_posterior import MIN_FORCE_STD
from trainid_ros.resistance.vmils import tracker_of
from trainid_ros.resistance.window_learner import WindowLearner, WindowSample

Item = tuple[Any, ...]
P: Final = 10
OUTLIERS: Final = 0.05
PRIOR: Final = (*START, START_SD[0] ** 2, 0.0, 0.0, START_SD[1] ** 2, 0.0, START_SD[2] ** 2)
PLAN: Final = ChangePointConfig(
    p=P,
    outliers=OUTLIERS,
    step_variances=(0.16, 1e-6, 6e-8),
    hazard=1e-5,
    spacing=300,
    hypotheses=4,
    min_age=300,
    lockout=100,
)
# Standard deviation of the gradient of a surveyed line [per mille].
GRADIENT_STD: Final = 0.05
_TICK_NS: Final = round(PERIOD * NS_PER_S)


class MilsPlain(RowPeer):
    """The recursion of V-MILS alone: multi-innovation least squares with a soft gate."""

    def __init__(self) -> None:
        self._state = (*information_of(PRIOR), *NOTHING)
        self._parts = deque([NOTHING] * P)

    def items(self, stream: MetroStream) -> list[Item]:
        return speeds_of(stream)

    def step(self, y: float, v: float) -> None:
        oldest = self._parts.popleft()
        self._state, newest, _, _ = mils_step(self._state, oldest, v, v * v, y, VARIANCE, 1.0, OUTLIERS, P)
        self._parts.append(newest)

    @property
    def moments(self) -> tuple[Any, Any]:
        posterior = posterior_of(self._state[:9])
        return posterior[:3], square(posterior[3:])


class MilsTracker(RowPeer):
    """V-MILS on rows: the recursion and step hypotheses, created every minute and evaluated after another minute."""

    def __init__(self) -> None:
        self._tracker = Tracker(independent(START, np.square(START_SD).tolist()), PLAN)

    def items(self, stream: MetroStream) -> list[Item]:
        return [(vec[float]([1.0, v, v * v]), y, VARIANCE) for y, v in speeds_of(stream)]

    @property
    def step(self) -> Any:
        return self._tracker.update

    @property
    def moments(self) -> tuple[Any, Any]:
        estimate = self._tracker.estimate
        return estimate.theta[:3], estimate.P[:3, :3]


class VMilsRaw(RowPeer):
    """V-MILS as shipped, from raw ticks with exact force: windows, soft gate, step hypotheses, estimated noise."""

    def __init__(self, prior: tuple[float, float, float] = START) -> None:
        config = VMilsConfig()
        self._tracker = tracker_of(prior, (MIN_FORCE_STD**2,) * 3, config)
        self._learner = WindowLearner(self._tracker, config, INERTIA, GRADIENT_STD)

    def items(self, stream: MetroStream) -> list[Item]:
        raw = stream.raw
        known, force = (raw.force - raw.gradient).tolist(), raw.force.tolist()
        parts = zip(raw.speed.tolist(), known, force, raw.moving.tolist(), strict=True)
        return [
            (WindowSample(_TICK_NS * k + 1, PERIOD, v, u, f) if moving else None, v)
            for k, (v, u, f, moving) in enumerate(parts)
        ]

    @property
    def steps_found(self) -> int:
        """Number of steps detected."""
        return self._tracker.steps_found

    def step(self, tick: WindowSample | None, speed: float) -> None:
        if tick is None:
            self._learner.interrupt(speed)
        else:
            self._learner.push(tick)

    @property
    def moments(self) -> tuple[Any, Any]:
        estimate = self._tracker.estimate
        return estimate.theta[:3], estimate.P[:3, :3]

# SPDX-License-Identifier: Apache-2.0
"""Undisturbed motion as arrays: pieces of a drive between braking, each with an initial speed of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce

if TYPE_CHECKING:
    from collections import Counter

    from numpy.typing import NDArray

    from trainid_ros.core.results import Reason, Rejection
    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Pieces one after another; a stage leads from each node to the next one of its piece.

    Attributes:
        speed: Measured speed at the nodes [m/s], shape (n,).
        dt: Time since the node before [s], 0 where a piece begins, shape (n,).
        known: Mean known specific force since the node before [N/kN], shape (n,).
        traction: The part of it that is traction [N/kN], shape (n,).
        inertia: Specific force per acceleration, 1000 (1 + gamma) / g [N/kN per m/s^2].

    """

    speed: NDArray[np.float64]
    dt: NDArray[np.float64]
    known: NDArray[np.float64]
    traction: NDArray[np.float64]
    inertia: float

    @property
    def starts(self) -> NDArray[np.intp]:
        """Indices at which pieces begin, shape (m,)."""
        return np.flatnonzero(self.dt == 0.0)

    def traction_rate(self) -> NDArray[np.float64]:
        """Return the rate of traction over each stage [N/kN per s], 0 at the ends of pieces, shape (n,)."""
        stage, t = self.dt > 0.0, self.traction
        change = np.zeros_like(t)
        before = np.where(stage[:-2], t[:-2], t[1:-1])
        change[1:-1] = np.where(stage[1:-1] & stage[2:], 0.5 * (t[2:] - before), 0.0)
        return np.asarray(change / np.where(stage, self.dt, 1.0))


@dataclass(slots=True)
class PieceCollector:
    """Takes samples, keeps those without braking, and makes a trajectory of them.

    Attributes:
        train_file: What is believed of train and effects.
        min_speed: Slowest speed to learn from [m/s].
        shortest: Shortest piece worth an initial speed of its own [s].

    """

    train_file: TrainFile
    min_speed: float
    shortest: float
    known: KnownForce = field(init=False)
    _nodes: list[tuple[float, float, float, float]] = field(init=False, default_factory=list)
    _begun: int = field(init=False, default=0)
    _admission: Admission = field(init=False)

    def __post_init__(self) -> None:
        self.known = KnownForce(self.train_file)
        self._admission = Admission(self.known, self.min_speed)

    def monitor(self, sample: Sample) -> None:
        """Follow the drive without taking the sample in."""
        self._reject(sample)

    def _reject(self, sample: Sample) -> Rejection | None:
        rejection = self._admission.reject(sample)
        return sample.rejection or rejection

    def add(self, sample: Sample, rejected: Counter[Reason]) -> None:
        """Take one sample in; count why it cannot be used."""
        rejection = self._reject(sample)
        if rejection is not None:
            rejected[rejection.reason] += 1
            self.end_piece()
            return
        traction = self.known.traction(sample.force_mean, sample)
        dt = sample.dt if len(self._nodes) > self._begun else 0.0
        self._nodes.append((sample.speed, dt, traction - self.known.track(sample), traction))

    def end_piece(self) -> None:
        """What comes next begins another piece; forget the last one if it was too short."""
        if sum(node[1] for node in self._nodes[self._begun :]) < self.shortest:
            del self._nodes[self._begun :]
        self._begun = len(self._nodes)

    def trajectory(self) -> Trajectory:
        """Return all pieces so far."""
        self.end_piece()
        speed, dt, known, traction = np.array(self._nodes, dtype=float).reshape(-1, 4).T.copy()
        return Trajectory(speed, dt, known, traction, self.known.inertia)

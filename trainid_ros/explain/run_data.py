# SPDX-License-Identifier: Apache-2.0
"""Runs: what a bag tells of the drive from one standstill to the next, as arrays.

A run begins when the train moves and ends when it stands. A gap in the data, an emergency brake or too long a drive
ends it too; every run has an initial speed of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.records import NS_PER_S
from trainid_ros.train.brake import CommandHistory, lag_integral, lag_response
from trainid_ros.train.davis import specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, heat_after

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

SLOWEST: Final = 0.3
"""Below this speed [m/s] a train may be held, so the balance tells nothing."""
LONGEST_S: Final = 240.0
"""A drive without a stop is cut into runs of this length, so that gusts do not carry errors through all of it."""
SHORTEST_S: Final = 15.0
_PARTING: Final = 1e-3
# Share of the positions of a run that must be measured to know where it is.
_MEASURED: Final = 0.5
PULLING: Final = 1.0
"""A traction above this counts as one [N/kN]; less is noise."""
BRAKING: Final = -1.0
"""The same of a brake [N/kN]."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run; row j tells of the stage from the sample before to sample j, row 0 of an instant.

    Attributes:
        bag: Number of the bag.
        direction: +1 while positions rise, -1 while they fall.
        time: Time since the first sample of all [s], shape (n,).
        dt: Length of the stage [s], 0 in row 0.
        speed: Measured speed at the end of the stage [m/s].
        position: Position of the front at the end of the stage [m]; the distance run if not measured.
        gradient: Mean over the stage [per mille, + uphill in the direction of travel].
        radius: Curve radius [m], 0 = straight.
        tunnel: 1 in a tunnel.
        traction: Mean reported force beside the brake, per weight [N/kN].
        brake: Mean force of the believed brake, per weight [N/kN, <= 0].
        heat: Energy in the brake [J/kg].
        since_release: Time since the brake was released [s], infinite before its first use.
        distance_run: Distance since the first sample of the bag [m].
        positioned: True if position was measured, all but holes that are bridged.
        weighed: True if the mass was.
        stops: Measured positions at the standstills before and after [m], NaN where there is none.
        travelled: Integral of measured speed between those standstills [m].

    """

    bag: int
    direction: int
    time: Array
    dt: Array
    speed: Array
    position: Array
    gradient: Array
    radius: Array
    tunnel: Array
    traction: Array
    brake: Array
    heat: Array
    since_release: Array
    distance_run: Array
    positioned: bool
    weighed: bool
    stops: tuple[float, float]
    travelled: float


_Row = tuple[float, float, float, float, float, float, float, float, float, float, float, float]


@dataclass(slots=True)
class RunCollector:
    """Takes the samples of one bag in; gives its runs.

    Attributes:
        train_file: What is believed.
        bag: Number of the bag.
        origin_ns: Stamp from which times count; 0 = that of the first sample.

    """

    train_file: TrainFile
    bag: int = 0
    origin_ns: int = 0
    runs: list[Run] = field(init=False, default_factory=list)
    _rows: list[_Row] = field(init=False, default_factory=list)
    _commands: CommandHistory = field(init=False, default_factory=CommandHistory)
    _stamp_ns: int = field(init=False, default=0)
    _brake: float = field(init=False, default=0.0)
    _heat: float = field(init=False, default=0.0)
    _since_release: float = field(init=False, default=math.inf)
    _distance: float = field(init=False, default=0.0)
    _start_position: float = field(init=False, default=math.nan)
    _travelled: float = field(init=False, default=0.0)
    _speed: float = field(init=False, default=math.nan)
    _weighed: bool = field(init=False, default=False)

    def add(self, sample: Sample) -> None:
        """Take one sample in."""
        self.origin_ns = self.origin_ns or sample.stamp_ns
        for change in sample.brake_changes:
            self._commands = self._commands.push(change)
        gap = math.isnan(sample.dt)
        brake = self._follow_brake(sample, gap=gap)
        if gap:
            self.end_run()
        elif math.isfinite(self._speed):
            moved = 0.5 * (self._speed + sample.speed) * sample.dt
            self._distance += moved
            self._travelled += moved
        self._speed = sample.speed
        if sample.speed <= _PARTING:
            self._stand(sample)
            return
        known = (sample.force_mean, sample.gradient_mean, sample.brake_command)
        if sample.emergency or not all(map(math.isfinite, known)):
            self.end_run()
            return
        self._add_row(sample, brake)

    def _add_row(self, sample: Sample, brake: float) -> None:
        # A brake that still releases at departure holds the train or drags it; who knows which.
        if not self._rows and (sample.speed < SLOWEST or brake < BRAKE_APPLIED):
            return
        mass = sample.mass if math.isfinite(sample.mass) else self.train_file.train.mass
        self._weighed = sample.weighed
        inertia = specific_inertia(1.0, self.train_file.train.rotary_mass)
        braking = inertia * brake if brake < BRAKE_APPLIED else 0.0
        traction = _traction(specific_force(sample.force_mean, mass), braking)
        row = (
            (sample.stamp_ns - self.origin_ns) / NS_PER_S, sample.dt, sample.speed, sample.position,
            sample.gradient_mean, sample.curve_radius, float(sample.tunnel), traction,
            braking, self._heat, self._since_release, self._distance,
        )  # fmt: skip
        self._rows.append(row)
        if row[0] - self._rows[0][0] > LONGEST_S:
            self.end_run()

    def _stand(self, sample: Sample) -> None:
        if self._rows:
            self.end_run(sample.position)
        self._start_position = sample.position
        self._travelled = 0.0

    def end_run(self, stop_position: float = math.nan) -> None:
        """What comes next is another run; forget this one if it is too short."""
        rows, self._rows = self._rows, []
        while rows and rows[-1][2] < SLOWEST:
            rows.pop()
        start, self._start_position = self._start_position, math.nan
        if not rows or rows[-1][0] - rows[0][0] < SHORTEST_S:
            return
        columns = np.array(rows).T.copy()
        time, dt, speed, position, gradient, radius, tunnel, traction, brake, heat, release, distance = columns
        dt[0] = 0.0
        position, positioned = _bridged(position, distance)
        run = Run(
            self.bag, 1 if position[-1] >= position[0] else -1, time, dt, speed, position, gradient, radius, tunnel,
            traction, brake, heat, release, distance, positioned, self._weighed,
            (start, stop_position), self._travelled,
        )  # fmt: skip
        self.runs.append(run)

    def _follow_brake(self, sample: Sample, *, gap: bool) -> float:
        """Return the mean acceleration of the believed brake since the sample before [m/s^2, <= 0]."""
        brake, now = self.train_file.brake, sample.stamp_ns
        delay_ns = round(brake.delay * NS_PER_S)
        before, self._stamp_ns = self._stamp_ns, now
        if gap or before == 0:
            self._brake = min(0.0, self._commands.value(now - delay_ns))
            self._commands = self._commands.prune(now - delay_ns)
            return brake.rate_at(sample.speed) * self._brake
        change = 0.0
        for duration, target in self._commands.segments(before - delay_ns, now - delay_ns):
            change += lag_integral(self._brake, target, brake.time_constant, duration)
            self._brake = lag_response(self._brake, target, brake.time_constant, duration)
        # A delay found longer than believed looks back further than the believed one.
        self._commands = self._commands.prune(now - delay_ns)
        mean = brake.rate_at(sample.speed) * change / sample.dt
        self._since_release = 0.0 if self._brake < BRAKE_APPLIED else self._since_release + sample.dt
        self._heat = heat_after(self._heat, mean, sample.speed, sample.dt)
        return mean


def _bridged(position: Array, distance: Array) -> tuple[Array, bool]:
    """Return positions with holes bridged by the distance run [m], shape (n,), and True if most were measured.

    Otherwise they are the distance run: no place on the line, but a way.
    """
    known = np.isfinite(position)
    if np.mean(known) < _MEASURED:
        return distance.copy(), False
    way = 1.0 if position[known][-1] >= position[known][0] else -1.0
    offset = position[known] - way * distance[known]
    return np.where(known, position, way * distance + np.interp(distance, distance[known], offset)), True


def _traction(reported: float, brake: float) -> float:
    """Return the force beside the brake [N/kN].

    While the brake acts, it is known by its command. What is reported is the sum of both: above zero there is traction
    still, below there is none.
    """
    if not brake:
        return reported
    return reported - brake if reported > PULLING else 0.0

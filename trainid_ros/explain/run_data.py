# SPDX-License-Identifier: Apache-2.0
"""Runs: the samples of a bag from one standstill to the next, as arrays.

A run begins when the train moves and ends when it stands. A gap in the data, an emergency brake application or the
maximum length ends it too; every run has its own initial speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.records import NS_PER_S
from trainid_ros.train.brake import CommandHistory, actuator_response
from trainid_ros.train.davis import specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, heat_after

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

SLOWEST: Final = 0.3
"""Speed [m/s] below which the brake may hold the train, so the force balance is not valid."""
LONGEST_S: Final = 240.0
"""Maximum length of a run [s]: a longer drive is split, so that errors by gusts do not accumulate over all of it."""
SHORTEST_S: Final = 15.0
"""Minimum length of a run [s]."""
_STANDSTILL: Final = 1e-3
"""Speed up to which the train stands [m/s]."""
# Share of measured positions that a run needs to be located on the line.
_MEASURED: Final = 0.5
PULLING: Final = 1.0
"""Traction above this is taken as traction [N/kN]; less is noise."""
BRAKING: Final = -1.0
"""Brake force below this is taken as braking [N/kN]."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run; row j describes the stage from sample j - 1 to sample j, row 0 a single instant.

    Attributes:
        bag: Number of the bag.
        direction: +1 for rising positions, -1 for falling ones.
        time: Time since the first sample of all bags [s], shape (n,).
        dt: Length of the stage [s], 0 in row 0.
        speed: Measured speed at the end of the stage [m/s].
        position: Position of the front at the end of the stage [m]; the distance travelled if not measured.
        gradient: Mean over the stage [per mille, + uphill in the direction of travel].
        radius: Curve radius [m], 0 = straight.
        tunnel: 1 in a tunnel.
        traction: Mean reported force without that of the brake, per weight [N/kN].
        brake: Mean brake force by the brake model of the train file, per weight [N/kN, <= 0].
        heat: Energy stored in the brake per mass of the train [J/kg].
        since_release: Time since the brake was released [s], infinite before its first use.
        distance_run: Distance since the first sample of the bag [m].
        positioned: True if the position was measured, except for interpolated gaps.
        weighed: True if the mass was measured.
        stops: Measured positions at the standstills before and after [m], NaN if there is none.
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
    """Collects the samples of one bag into runs.

    Attributes:
        train_file: Train file with the mass and the brake model.
        bag: Number of the bag.
        origin_ns: Time stamp at which times are zero; 0 = that of the first sample.
        runs: Completed runs.

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
        """Add one sample."""
        self.origin_ns = self.origin_ns or sample.stamp_ns
        self._commands.follow(sample.brake_changes)
        gap = math.isnan(sample.dt)
        brake = self._follow_brake(sample, gap=gap)
        if gap:
            self.end_run()
        elif math.isfinite(self._speed):
            moved = 0.5 * (self._speed + sample.speed) * sample.dt
            self._distance += moved
            self._travelled += moved
        self._speed = sample.speed
        if sample.speed <= _STANDSTILL:
            self._on_standstill(sample)
            return
        known = (sample.force_mean, sample.gradient_mean, sample.brake_command)
        if sample.emergency or not all(map(math.isfinite, known)):
            self.end_run()
            return
        self._add_row(sample, brake)

    def start_over(self) -> None:
        """End the current run and forget the history of the drive, as after a jump of the stamps."""
        self.end_run()
        self._commands, self._stamp_ns, self._brake = CommandHistory(), 0, 0.0
        self._heat, self._since_release, self._speed = 0.0, math.inf, math.nan

    def _add_row(self, sample: Sample, brake: float) -> None:
        # A brake that is still releasing at departure may hold the train or drag; which of them is unknown.
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

    def _on_standstill(self, sample: Sample) -> None:
        if self._rows:
            self.end_run(sample.position)
        self._start_position = sample.position
        self._travelled = 0.0

    def end_run(self, stop_position: float = math.nan) -> None:
        """End the current run; discard it if it is too short.

        Args:
            stop_position: Measured position of the standstill that ends it [m], NaN if there is none.

        """
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
        """Return the mean acceleration by the train file's brake model since the previous sample [m/s^2, <= 0]."""
        brake, now = self.train_file.brake, sample.stamp_ns
        delay_ns = round(brake.delay * NS_PER_S)
        before, self._stamp_ns = self._stamp_ns, now
        if gap or before == 0:
            self._brake = min(0.0, self._commands.value(now - delay_ns))
            self._commands.prune(now - delay_ns)
            return brake.rate_at(sample.speed) * self._brake
        tau = brake.time_constant
        self._brake, change = actuator_response(
            self._commands, before, now, self._brake, delay_ns=delay_ns, time_constant=tau
        )
        self._commands.prune(now - delay_ns)
        mean = brake.rate_at(sample.speed) * change / sample.dt
        self._since_release = 0.0 if self._brake < BRAKE_APPLIED else self._since_release + sample.dt
        self._heat = heat_after(self._heat, mean, sample.speed, sample.dt)
        return mean


def _bridged(position: Array, distance: Array) -> tuple[Array, bool]:
    """Return positions with gaps bridged by the distance travelled [m], shape (n,), and True if most were measured.

    Otherwise return the distance travelled, which gives no location on the line.
    """
    known = np.isfinite(position)
    if np.mean(known) < _MEASURED:
        return distance.copy(), False
    way = 1.0 if position[known][-1] >= position[known][0] else -1.0
    offset = position[known] - way * distance[known]
    return np.where(known, position, way * distance + np.interp(distance, distance[known], offset)), True


def _traction(reported: float, brake: float) -> float:
    """Return the traction without the force of the brake [N/kN].

    While the brake acts, its force follows from its command. The reported force is the sum of both: if it is positive
    there is still traction, otherwise there is none.
    """
    if not brake:
        return reported
    return reported - brake if reported > PULLING else 0.0

# SPDX-License-Identifier: Apache-2.0
"""Make the bag ``bags/ride`` from a measured bicycle ride.

Usage: python tools/convert_ride.py ride_cycleRtools_1.npz bags/ride

The ride (package cycleRtools, MIT) holds speed, power, altitude and distance once a second. Nothing is simulated and
no noise is added, but three assumptions are made. Power is the mean over the second that ends at its stamp, and
acts at the wheel without loss. Gradient is the slope of a local line through altitude over distance. The rider's
brakes were not measured: the brake command is zero throughout, which here means unknown.

The windows of the estimators are designed for five samples a second, so speed is interpolated to 5 Hz, force and
gradient to 2 Hz. That adds no information; nothing is interpolated over pauses.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile, dump_train_file

Array = NDArray[np.float64]
START_NS: Final = 1_720_000_000 * NS_PER_S
PAUSE_S: Final = 1.5
SPEED_STEP_S: Final = 0.2
FORCE_STEP_S: Final = 0.5
BRAKE_STEP_S: Final = 1.0
# Below this speed [m/s], power over speed is not a usable force.
SLOWEST: Final = 1.0
# The altitude has steps of 0.2 m; over this distance they correspond to 2 per mille.
SMOOTHING_M: Final = 30.0
# Assumed values of rider and bicycle; none was measured.
MASS: Final = 85.0  # kg, rider and bicycle
ROLLING: Final = 5.0  # N/kN
DRAG_AREA: Final = 0.35  # m^2
AIR: Final = 1.2  # kg/m^3

TRAIN_HEADER: Final = """\
# Rider and bicycle of bags/ride as one would guess them: 85 kg, rolling resistance 0.005, drag area 0.35 m^2 in
# still air of 1.2 kg/m^3. None of it was measured, and there is no truth to compare with. See bags/README.md.
"""


@dataclass(frozen=True, slots=True)
class Ride:
    """The ride, sampled once a second except in pauses, shapes (n,)."""

    time: Array  # Time since the start [s]
    speed: Array  # Speed [m/s]
    distance: Array  # Distance ridden [m]
    power: Array  # Mean power over the second before [W], NaN where it is missing
    gradient: Array  # Slope [per mille]

    def pieces(self) -> list[slice]:
        """Return the parts without a pause, at least two rows each."""
        edges = [0, *(np.flatnonzero(np.diff(self.time) > PAUSE_S) + 1).tolist(), self.time.size]
        return [slice(a, b) for a, b in pairwise(edges) if b - a > 1]


def load(path: Path) -> Ride:
    """Read the ride."""
    with np.load(path) as data:
        time, speed, distance, power, altitude = (data[name].astype(np.float64) for name in ('t', 'v', 's', 'P', 'alt'))
    return Ride(time, speed, distance, power, slope(distance, altitude))


def slope(distance: Array, altitude: Array) -> Array:
    """Return the slope of a line through the altitudes nearby, with Gaussian weights over distance [per mille]."""
    slopes = np.zeros(distance.size)
    reach = 3.0 * SMOOTHING_M
    first, last = np.searchsorted(distance, (distance - reach, distance + reach))
    for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        x, y = distance[a:b] - distance[i], altitude[a:b]
        weight = np.exp(-0.5 * np.square(x / SMOOTHING_M))
        x = x - weight @ x / weight.sum()
        spread = weight @ np.square(x)
        slopes[i] = 1000.0 * (weight @ (x * y)) / spread if spread > 1.0 else 0.0
    return slopes


def records(ride: Ride) -> list[Record]:
    """Return all records by stamp."""
    out: list[Record] = []
    for piece in ride.pieces():
        out += _records_of(ride, piece)
    return sorted(out, key=attrgetter('stamp_ns'))


def _records_of(ride: Ride, piece: slice) -> list[Record]:
    time, speed, power = ride.time[piece], ride.speed[piece], ride.power[piece]
    out: list[Record] = []
    for t in _grid(time, SPEED_STEP_S):
        v, s = np.interp(t, time, speed), np.interp(t, time, ride.distance[piece])
        out.append(SpeedRecord(_stamp(t), round(float(v), 4), round(float(s), 2)))
    for t in _grid(time, FORCE_STEP_S):
        gradient = round(float(np.interp(t, time, ride.gradient[piece])), 2)
        out.append(GradientRecord(_stamp(t), gradient, 0.0, tunnel=False))
    middle, mean = 0.5 * (time[1:] + time[:-1]), 0.5 * (speed[1:] + speed[:-1])
    force = np.where(mean >= SLOWEST, power[1:] / np.maximum(mean, SLOWEST), np.nan)
    pulls = ((t, float(np.interp(t, middle, force))) for t in _grid(middle, FORCE_STEP_S))
    out += [ForceRecord(_stamp(t), round(pull, 2)) for t, pull in pulls if math.isfinite(pull)]
    out += [BrakeRecord(_stamp(t), 0.0, emergency=False) for t in _grid(time, BRAKE_STEP_S)]
    return out


def _grid(time: Array, step: float) -> list[float]:
    """Return times from the first to the last of an array."""
    times: list[float] = (time[0] + step * np.arange(round((time[-1] - time[0]) / step) + 1)).tolist()
    return times


def _stamp(time: float) -> int:
    return START_NS + round(time * 1000.0) * (NS_PER_S // 1000)


def assumed_train() -> TrainFile:
    """Return the assumed values of rider and bicycle as a train file."""
    c = 0.5 * AIR * DRAG_AREA / (MASS * G) * 1000.0
    train = Train(
        mass=MASS, rotary_mass=0.01, length=1.8, cars=1, max_traction_force=400.0, max_traction_power=1000.0,
        max_speed=17.0,
    )  # fmt: skip
    return TrainFile(train, Davis(ROLLING, 0.0, round(c, 4)), Brake(rate=1.0, time_constant=0.0, delay=0.0))


def main() -> int:
    """Convert the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('npz', type=Path, help='ride_cycleRtools_1.npz')
    parser.add_argument('out', type=Path, help='bag to create')
    args = parser.parse_args()
    ride = load(args.npz)
    with BagWriter(args.out) as writer:
        for record in records(ride):
            writer.write_record(record)
    (args.out / 'train.yaml').write_text(TRAIN_HEADER + dump_train_file(assumed_train()), encoding='utf-8')
    idle = float(np.mean(ride.power == 0.0))
    print(f'{ride.time.size} seconds in {len(ride.pieces())} pieces, {idle:.1%} of them without power')
    return 0


if __name__ == '__main__':
    sys.exit(main())

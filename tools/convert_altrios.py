# SPDX-License-Identifier: Apache-2.0
"""Make the bag ``bags/altrios_manifest`` from a freight run simulated by ALTRIOS.

Usage: python tools/convert_altrios.py manifest_5hz.npz bags/altrios_manifest

ALTRIOS (NREL, BSD-3-Clause) is a train simulator independent of this project. Row i of its result
holds the forces that act between t[i-1] and t[i], and the resistances in row i, gradient included,
are those at t[i-1]; so

    (m_static + m_rot) (v[i] - v[i-1]) / dt = f_net[i] - sum(res[i]).

Force and gradient are therefore stamped in the middle of that interval and the brake command at its
start. The simulation has no noise; sensor noise is added here from one seeded generator.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.sim.truth import Truth, save_truth
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Brake, Davis, Effect, Train, TrainFile, dump_train_file

FIRST_ROW: Final = 31_500
START_NS: Final = 1_710_000_000 * NS_PER_S
SEED: Final = 20240
SPEED_NOISE: Final = 0.05  # m/s
SPEED_QUANTUM: Final = 0.1 / 3.6  # m/s
FORCE_NOISE_SHARE: Final = 0.005  # of the force
FORCE_NOISE_WEIGHT: Final = 0.0002  # of the weight
POSITION_QUANTUM: Final = 1.0  # m
GREATEST_CURVATURE: Final = 0.01  # 1/m; the map has some impossible ones
STRAIGHT: Final = 1e-6  # 1/m
# Factors on the true Davis parameters in the train file: each 20 % too high or too low.
STATED_FACTORS: Final = (1.2, 0.8, 1.2)
CARS: Final = 110  # not given by the source, estimated from the length; nothing depends on it

TRAIN_HEADER: Final = """\
# Freight train of bags/altrios_manifest as an engineer would describe it: the Davis parameters are about
# 20 % off the truth (see truth.yaml), all else is right. See bags/README.md.
"""


@dataclass(frozen=True, slots=True)
class Run:
    """The part of the run that is used, forces in N; row i acts between t[i-1] and t[i]."""

    stamp_ns: NDArray[np.int64]  # Stamps of the speeds [ns]
    half_ns: int  # Half a time step [ns]
    speed: NDArray[np.float64]  # Speed at the stamp [m/s]
    position: NDArray[np.float64]  # Front of the train [m]
    force: NDArray[np.float64]  # Wheel force less friction brake [N]
    brakes: NDArray[np.bool_]  # True while a brake acts
    known: NDArray[np.bool_]  # False where the simulator reports an outdated friction force
    gradient: NDArray[np.float64]  # Gradient resistance [N]
    curve: NDArray[np.float64]  # Curve resistance [N]
    curvature: NDArray[np.float64]  # Mean curvature under the train [1/m]
    possible: NDArray[np.bool_]  # False where a piece of impossible curvature lies under the train
    meta: dict[str, Any]  # Parameters of the simulated train

    @property
    def weight(self) -> float:
        """Weight [N] under standard gravity, which all specific values of this project refer to."""
        return float(self.meta['mass_static_kg']) * G


def load(path: Path) -> Run:
    """Read the part of the run that is used."""
    with np.load(path) as data:
        table = {name: data[name] for name in data.files}
    meta = json.loads(str(table['meta']))
    part = slice(FIRST_ROW, None)
    before = table['s'][FIRST_ROW - 1 : -1]
    net, wheel = (table[name][part].astype(np.float64) for name in ('f_net', 'f_whl'))
    time_s = table['t'][part] - table['t'][FIRST_ROW]
    length = float(meta['length_m'])
    offset, _, bend = table['track_curve'].T
    curvature = mean_under_train(offset, bend, before, length)
    clipped = mean_under_train(offset, np.minimum(bend, GREATEST_CURVATURE), before, length)
    return Run(
        stamp_ns=START_NS + np.rint(time_s * NS_PER_S).astype(np.int64),
        half_ns=round(meta['dt_s'] * NS_PER_S / 2),
        speed=table['v'][part].astype(np.float64),
        position=table['s'][part],
        force=net,
        # The reported friction force is sometimes outdated, so it is taken from the balance of forces.
        brakes=(wheel - net > 0.0) | (wheel < 0.0),
        known=table['ok'][part],
        gradient=table['res_grade'][part].astype(np.float64),
        curve=table['res_curve'][part].astype(np.float64),
        curvature=curvature,
        possible=np.isclose(curvature, clipped, rtol=0.0, atol=STRAIGHT * 1e-3),
        meta=meta,
    )


def mean_under_train(
    offset: NDArray[np.float64], values: NDArray[np.float64], front: NDArray[np.float64], length: float
) -> NDArray[np.float64]:
    """Return the mean of a piecewise-constant profile over the train's length behind each front."""
    total = np.concatenate(([0.0], np.cumsum(values[:-1] * np.diff(offset))))

    def integral(at: NDArray[np.float64]) -> NDArray[np.float64]:
        piece = np.clip(np.searchsorted(offset, at, side='right') - 1, 0, len(offset) - 1)
        return total[piece] + values[piece] * (at - offset[piece])

    return (integral(front) - integral(front - length)) / length


def curve_coefficient(run: Run) -> float:
    """Return the coefficient of 1/R [N/kN m] that best fits the curve resistance where the map is plausible."""
    curvature = run.curvature[run.possible]
    resistance = run.curve[run.possible] / run.weight * 1000.0
    return float(curvature @ resistance / (curvature @ curvature))


def records(run: Run, coefficient: float, rng: np.random.Generator) -> list[Record]:
    """Return all records by stamp, with sensor noise."""
    count = len(run.speed)
    speed = np.maximum(run.speed + rng.normal(0.0, SPEED_NOISE, count), 0.0)
    speed = np.rint(speed / SPEED_QUANTUM) * SPEED_QUANTUM
    position = np.rint(run.position / POSITION_QUANTUM) * POSITION_QUANTUM
    scale, offset = rng.normal(0.0, FORCE_NOISE_SHARE, count), rng.normal(0.0, FORCE_NOISE_WEIGHT, count)
    force = run.force * (1.0 + scale) + offset * run.weight
    inertia = run.meta['mass_static_kg'] + run.meta['mass_rot_kg']
    target = np.where(run.brakes, np.minimum(run.force, 0.0) / inertia, 0.0)
    gradient, bend = run.gradient / run.weight * 1000.0, run.curve / run.weight * 1000.0
    # This radius gives the simulator's curve resistance exactly; its own formula is not exactly proportional to 1/R.
    radius = np.where(bend > coefficient * STRAIGHT, coefficient / np.maximum(bend, coefficient * STRAIGHT), 0.0)
    out: list[Record] = []
    for i, stamp in enumerate(run.stamp_ns.tolist()):
        middle = stamp - run.half_ns
        out.append(BrakeRecord(middle - run.half_ns, float(target[i]), emergency=False))
        if run.known[i]:
            out.append(ForceRecord(middle, float(force[i])))
        out.append(GradientRecord(middle, float(gradient[i]), float(radius[i]), tunnel=False))
        out.append(SpeedRecord(stamp, float(speed[i]), float(position[i])))
    return sorted(out, key=attrgetter('stamp_ns'))


def true_davis(run: Run) -> Davis:
    """Return the Davis parameters of the simulator [N/kN, speed in m/s]."""
    values = (run.meta[name] / run.weight * 1000.0 for name in ('A_N', 'B_N_per_mps', 'C_N_per_mps2'))
    return Davis(*map(float, values))


def stated_train(run: Run, coefficient: float) -> TrainFile:
    """Return the train file as an engineer would state it."""
    meta, davis = run.meta, true_davis(run)
    return TrainFile(
        Train(
            mass=float(meta['mass_static_kg']),
            rotary_mass=round(meta['mass_rot_kg'] / meta['mass_static_kg'], 6),
            length=float(meta['length_m']),
            cars=CARS,
            max_traction_force=3.4e6,
            max_traction_power=2.6e7,
            max_speed=20.2,
        ),
        Davis(*(round(x * factor, 6) for x, factor in zip((davis.a, davis.b, davis.c), STATED_FACTORS, strict=True))),
        # The simulator's friction brake acts without delay or lag.
        Brake(rate=1.0, time_constant=0.0, delay=0.0),
        effects=(
            Effect(
                'curve_resistance',
                (('coefficient', round(coefficient, 3)),),
                provenance='fitted to the curve resistance of the simulator over the mean curvature under the train',
            ),
        ),
    )


def speed_shares(run: Run) -> str:
    """Return the share of samples without brake by speed, as text."""
    free = run.speed[~run.brakes & run.known]
    edges = np.arange(0.0, 22.5, 2.5)
    shares = np.histogram(free, bins=edges)[0] / len(run.speed)
    lines = (f'{low:5.1f} .. {low + 2.5:4.1f} m/s {share:6.1%}' for low, share in zip(edges, shares, strict=False))
    return '\n'.join((f'{len(run.speed)} samples, without brake:', *lines))


def main() -> int:
    """Convert the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('npz', type=Path, help='manifest_5hz.npz')
    parser.add_argument('out', type=Path, help='bag to create')
    args = parser.parse_args()
    run = load(args.npz)
    coefficient = curve_coefficient(run)
    with BagWriter(args.out) as writer:
        for record in records(run, round(coefficient, 3), np.random.default_rng(SEED)):
            writer.write_record(record)
    davis = true_davis(run)
    save_truth(Truth(START_NS, ((0.0, davis.a, davis.b, davis.c),)), args.out / 'truth.yaml')
    text = TRAIN_HEADER + dump_train_file(stated_train(run, coefficient))
    (args.out / 'train.yaml').write_text(text, encoding='utf-8')
    print(speed_shares(run))
    print(f'curve coefficient {coefficient:.1f} N/kN m, truth {davis}')
    return 0


if __name__ == '__main__':
    sys.exit(main())

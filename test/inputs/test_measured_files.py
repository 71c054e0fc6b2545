# SPDX-License-Identifier: Apache-2.0
"""Files that others made, imported as they were found with the mappings of the repository; skipped without them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured_car import gradient, load_trip
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.forces import davis

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / 'shared' / 'data'

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason='the measured data are not beside the repository')


def convert(file: str, mapping: str, folder: Path) -> Path:
    path = folder / 'bag'
    assert main(['import', str(DATA / file), str(path), '--map', str(ROOT / 'config' / 'mappings' / mapping)]) == 0
    return path


def column(bag: Path, kind: type[Record], field: str) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps [s since the first] and values of a field, shape (n,)."""
    with BagReader(bag) as reader:
        found = [record for record in reader.records() if isinstance(record, kind)]
    stamps = np.array([record.stamp_ns for record in found])
    return (stamps - stamps[0]) / NS_PER_S, np.array([getattr(record, field) for record in found])


@pytest.mark.slow
def test_the_freight_run_has_the_resistance_of_its_simulator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = convert('altrios/manifest_5hz.npz', 'altrios_manifest.yaml', tmp_path)
    capsys.readouterr()
    stated = ROOT / 'bags' / 'altrios_manifest'
    assert main(['replay', str(bag), '--train', str(stated / 'train.yaml'), '--json']) == 0
    found = json.loads(capsys.readouterr().out)['resistance']
    truth = load_truth(stated / 'truth.yaml').truth_at(0.0).resistance
    for speed in (7.0, 20.0):
        w = found['a'] + found['b'] * speed + found['c'] * speed**2
        assert w == pytest.approx(davis(truth, speed), abs=0.1)


def test_the_ride_keeps_its_energy(tmp_path: Path) -> None:
    bag = convert('ride/ride_cycleRtools_1.npz', 'ride.yaml', tmp_path)
    time, force = column(bag, ForceRecord, 'force')
    speed = np.interp(time, *column(bag, SpeedRecord, 'speed'))
    with np.load(DATA / 'ride' / 'ride_cycleRtools_1.npz') as data:
        power = float(np.nanmean(data['P']))
    assert float(np.mean(force * speed)) == pytest.approx(power, rel=0.05)


def test_the_trip_is_that_of_the_benchmark(tmp_path: Path) -> None:
    bag = convert('bmw_i3/TripA06.npz', 'bmw_i3.yaml', tmp_path)
    trip = load_trip(DATA / 'bmw_i3', 'TripA06')
    for kind, field, expected, tolerance in (
        (SpeedRecord, 'speed', trip.speed, 1e-6),
        (ForceRecord, 'force', trip.force, 1e-3),
        (GradientRecord, 'gradient', gradient(trip), 15.0),  # by another filter
    ):
        _, found = column(bag, kind, field)
        assert float(np.sqrt(np.mean((found - expected) ** 2))) < tolerance
    with BagReader(bag) as reader:
        commands = [record for record in reader.records() if isinstance(record, BrakeRecord)]
    assert np.array_equal([record.emergency for record in commands], ~trip.pedal)

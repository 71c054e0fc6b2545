# SPDX-License-Identifier: Apache-2.0
"""Drives that tell effects apart: what they promise, and none where none helps."""

from __future__ import annotations

from dataclasses import replace

import pytest

from trainid_ros.explain.distinguishing_drive import FitSummary, distinguishing_drive
from trainid_ros.explain.effects import EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters, Noise
from trainid_ros.explain.nuisances import Spread
from trainid_ros.train.train_file import Davis, Train, TrainFile

DAVIS = Davis(1.5, 0.02, 0.004)
HYPER = Hyperparameters(Noise(speed=0.02, gust=0.1, gust_time=5.0, jitter=0.02), Spread(0.02, 0.02, 0.1), 0.0)
FIT = FitSummary(TrainFile(Train(200e3), DAVIS), DAVIS, (0.05, 0.01, 0.0003), HYPER)
START = {'value': 2.0, 'speed': 3.0}


def promised(text: str) -> float:
    return float(text.partition('±')[2].split()[0])


def test_a_resistance_at_low_speed_shows_at_low_speed_and_in_wind_less_clearly() -> None:
    gusty = replace(FIT, hyper=replace(FIT.hyper, noise=replace(FIT.hyper.noise, gust=0.3)))
    drive, in_wind = (distinguishing_drive('starting_resistance', START, 'mass_error', fit) for fit in (FIT, gusty))
    assert drive.startswith('hold 5 km/h for 60 s once')
    assert 'value ±' in drive
    assert drive.endswith('N/kN')
    assert promised(drive) < 2.0 / 4.0
    assert promised(in_wind) > 1.1 * promised(drive)


@pytest.mark.parametrize(
    ('name', 'parameters', 'twin'),
    [
        # Not on straight track, less than brakes differ, too small, and at a place of its own.
        ('curve_resistance', {'coefficient': 600.0}, 'starting_resistance'),
        ('mass_error', {'ratio': 1.03}, 'traction_scale'),
        ('starting_resistance', {'value': 0.05, 'speed': 3.0}, 'mass_error'),
        ('starting_resistance', START, 'local_drag'),
    ],
)
def test_no_drive_where_none_helps(name: str, parameters: dict[str, float], twin: str) -> None:
    assert distinguishing_drive(name, parameters, twin, FIT) == ''


def test_braking_tells_mass_from_traction_unless_the_brake_is_wrong_too() -> None:
    mass = 'mass_error', {'ratio': 1.15}
    drive = distinguishing_drive(*mass, 'traction_scale', FIT)
    assert 'ratio ±' in drive
    assert promised(drive) < 0.15 / 4.0
    assert distinguishing_drive(*mass, 'traction_scale', FIT, [EffectTerm('brake_scale', {'ratio': 0.95})]) == ''

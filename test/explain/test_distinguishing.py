# SPDX-License-Identifier: Apache-2.0
"""Tests of drives that tell two effects apart."""

from __future__ import annotations

from dataclasses import replace

import pytest

from trainid_ros.explain.distinguishing import FitSummary, distinguishing_drive
from trainid_ros.explain.likelihood import Hyperparameters
from trainid_ros.explain.noise import Noise, Spread
from trainid_ros.train.train_file import Davis, Train, TrainFile

DAVIS = Davis(1.5, 0.02, 0.004)
NOISE = Noise(speed=0.02, gust=0.1, gust_time=5.0, jitter=0.02)
KNOWN = FitSummary(
    TrainFile(Train(200e3), DAVIS), DAVIS, (0.05, 0.01, 0.0003), Hyperparameters(NOISE, Spread(0.02, 0.02, 0.1), 0.0)
)
START = {'value': 2.0, 'speed': 3.0}


def promised(text: str) -> float:
    return float(text.partition('±')[2].split()[0])


def test_a_resistance_at_low_speed_shows_at_low_speed() -> None:
    drive = distinguishing_drive('starting_resistance', START, 'mass_error', KNOWN)
    assert drive.startswith('hold 5 km/h for 60 s once')
    assert 'value ±' in drive
    assert drive.endswith('N/kN')
    assert promised(drive) < 2.0 / 4.0


def test_gusts_widen_what_is_promised() -> None:
    windy = replace(NOISE, gust=0.3)
    gusty = replace(KNOWN, hyper=replace(KNOWN.hyper, noise=windy))
    drives = [distinguishing_drive('starting_resistance', START, 'mass_error', known) for known in (KNOWN, gusty)]
    assert promised(drives[1]) > 1.1 * promised(drives[0])


@pytest.mark.parametrize(
    ('name', 'parameters', 'twin'),
    [
        # Not on straight track, equal on level track without braking, too small, and at a place of its own.
        ('curve_resistance', {'coefficient': 600.0}, 'starting_resistance'),
        ('mass_error', {'ratio': 1.1}, 'traction_scale'),
        ('starting_resistance', {'value': 0.05, 'speed': 3.0}, 'mass_error'),
        ('starting_resistance', START, 'local_drag'),
    ],
)
def test_no_drive_where_none_helps(name: str, parameters: dict[str, float], twin: str) -> None:
    assert distinguishing_drive(name, parameters, twin, KNOWN) == ''

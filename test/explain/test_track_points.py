# SPDX-License-Identifier: Apache-2.0
"""Inputs of effects along a run, at mid-stage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Maker
from trainid_ros.explain.track_points import track_points
from trainid_ros.train.effects import TrackPoint
from trainid_ros.train.forces import specific_inertia

Points = tuple[Any, list[TrackPoint]]


@pytest.fixture(scope='module', params=[0, 1], ids=['rising', 'falling'])
def run_and_points(request: pytest.FixtureRequest) -> Points:
    run = Maker(noise=0.0).runs(2, 5)[request.param]
    inertia = specific_inertia(1.0, TRAIN.train.rotary_mass)
    speed = np.concatenate([run.speed[:1], 0.5 * (run.speed[1:] + run.speed[:-1])])
    return run, track_points(run, speed, TRAIN.train.length, inertia, TRAIN.resistance)


def test_points_lie_at_mid_stage(run_and_points: Points) -> None:
    run, points = run_and_points
    middle = 0.5 * (run.time[1:] + run.time[:-1])
    np.testing.assert_allclose([p.time_s for p in points[1:]], middle)
    place = np.interp(middle, run.time, run.position)
    np.testing.assert_allclose([p.position for p in points[1:]], place, atol=0.05)
    assert {p.direction for p in points} == {run.direction}
    moved = np.diff(run.speed) / run.dt[1:]
    np.testing.assert_allclose([p.acceleration for p in points[1:-1]], moved[:-1], atol=1e-3)


def test_forces_before_and_gradients_ahead_are_interpolated(run_and_points: Points) -> None:
    run, points = run_and_points
    times = np.array([p.time_s for p in points])
    for seconds in (0.0, 0.33, -0.5):
        np.testing.assert_allclose(
            [(p.brake_before(seconds), p.traction_before(seconds)) for p in points],
            np.stack([np.interp(times - seconds, times, force) for force in (run.brake, run.traction)], axis=1),
        )
    way = run.direction * np.array([p.position for p in points])
    ahead = np.interp(way + 40.0, way, run.gradient)
    np.testing.assert_allclose([p.gradient_ahead(40.0) for p in points], ahead, atol=0.01)

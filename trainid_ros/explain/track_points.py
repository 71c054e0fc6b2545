# SPDX-License-Identifier: Apache-2.0
"""Inputs of effects at the stages of a run."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from trainid_ros.explain.dataset import Run
from trainid_ros.train.forces import TrackPoint, davis
from trainid_ros.train.train_file import Davis


class _Line:
    """Values [any unit] at rising x [s or m]; linear between them, constant beyond both ends."""

    def __init__(self, x: list[float], y: list[float]) -> None:
        self.x, self.y = x, y

    def at(self, x: float) -> float:
        """Return the value at one x; faster than numpy's interpolation for one point."""
        right = bisect_right(self.x, x)
        if right in {0, len(self.x)}:
            return self.y[min(right, len(self.x) - 1)]
        low, high = self.x[right - 1], self.x[right]
        share = (x - low) / (high - low)
        return self.y[right - 1] + share * (self.y[right] - self.y[right - 1])


class _From:
    """The values of a line at distances from one x, ahead of it (way 1) or before it (way -1)."""

    def __init__(self, line: _Line, x: float, way: float) -> None:
        self.line, self.x, self.way = line, x, way

    def __call__(self, distance: float) -> float:
        return self.line.at(self.x + self.way * distance)


def track_points(
    run: Run, speed: NDArray[np.float64], length: float, inertia: float, resistance: Davis
) -> list[TrackPoint]:
    """Return the track points at mid-stage of a run, by the mean speed of each stage [m/s], shape (n,).

    The train has a length [m], a specific force per acceleration [N/kN per m/s^2] and the resistance of its train file.
    """
    middle = run.time - 0.5 * run.dt
    place = run.position - 0.5 * run.direction * run.dt * speed
    # Acceleration implied by the forces: the measured one would bring the noise of the speed into the regressors.
    acceleration = (run.traction + run.brake - run.gradient - davis(resistance, speed)) / inertia
    travelled = np.maximum.accumulate(run.direction * place + 1e-6 * np.arange(place.size))
    times: list[float] = middle.tolist()
    brake, traction = _Line(times, run.brake.tolist()), _Line(times, run.traction.tolist())
    gradient = _Line(travelled.tolist(), run.gradient.tolist())
    rows = zip(
        times, place.tolist(), speed.tolist(), run.radius.tolist(), run.tunnel.tolist(), run.distance_run.tolist(),
        run.since_release.tolist(), traction.y, brake.y, run.heat.tolist(), acceleration.tolist(), gradient.x,
        strict=True,
    )  # fmt: skip
    return [
        TrackPoint(
            time_s=t,
            position=s,
            direction=run.direction,
            speed=v,
            curve_radius=radius,
            tunnel=tunnel > 0.5,
            length=length,
            distance_run=distance,
            since_release=release,
            traction=pull,
            brake=push,
            heat=heat,
            acceleration=a,
            brake_before=_From(brake, t, -1.0),
            traction_before=_From(traction, t, -1.0),
            gradient_ahead=_From(gradient, way, 1.0),
        )
        for t, s, v, radius, tunnel, distance, release, pull, push, heat, a, way in rows
    ]

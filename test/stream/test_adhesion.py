# SPDX-License-Identifier: Apache-2.0
"""Slip and slide are found on slippery rails and nowhere else; the force between wheel and rail is the true one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import AdhesionEstimate, Reason
from trainid_ros.interface.state import encode, restore
from trainid_ros.stream.adhesion import RAIL, RAIL_STD, AdhesionEstimator
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import BrakeActuator, BrakeCommandChange, G, davis, specific_inertia
from trainid_ros.train.train_file import TrainFile

_DRY: Final = 0.3  # adhesion [1]
_TRACTION, _COMMAND = 0.8, -0.9  # acceleration by the drive, and brake command [m/s^2]
_CRUISE: Final = 18.0  # speed at which the drive is cut off [m/s]
_BRAKES_S, _END_S = 40.0, 75.0  # times at which the train brakes, and at which a drive ends [s]


@dataclass(frozen=True)
class Rail:
    """Rails and train of a drive."""

    adhesion: float = _DRY  # while the train brakes, up to the end of the slide [1]
    slide_s: float = 12.0  # duration of the low adhesion since the brake command [s]
    traction_slip: float = 0.0  # speed by which the axle runs ahead for 2 s under traction [m/s]
    rate: float = 1.0  # brake rate
    gradient_error: float = 0.0  # of the map, in the middle of the drive [per mille]
    gust: float = 0.3  # standard deviation of the gusts [N/kN]
    quantum: float = 0.1 / 3.6  # of the speed [m/s]
    period: float = 0.2  # of the speed [s]


@dataclass(frozen=True)
class Point:
    """A sample, and the truth."""

    sample: Sample
    speed: float  # of the train [m/s]
    used: float  # force between wheel and rail over the weight [1]
    slips: bool  # whether the axle is off by more than 0.3 m/s


def drive(train_file: TrainFile, rail: Rail, seed: int) -> Iterator[Point]:
    """Yield a drive: power, coast, brake; the axle runs away where the brake asks for more than the adhesion."""
    rng, inertia = np.random.default_rng(seed), specific_inertia(1.0, train_file.train.rotary_mass)
    actuator, step, gust, v, lag, target, dt = BrakeActuator(train_file.brake), 0.05, 0.0, 0.0, 0.0, 0.0, rail.period
    returns, forces, gradient, changes = False, [0.0], 0.0, list[BrakeCommandChange]()
    for k in range(1, round(_END_S / step)):
        time_s, stamp_ns = k * step, round((100.0 + k * step) * NS_PER_S)
        if k == round(_BRAKES_S / step):
            changes = [BrakeCommandChange(stamp_ns, _COMMAND)]
            actuator.commands.follow(tuple(changes))
        brake = rail.rate * actuator.advance(stamp_ns - round(step * NS_PER_S), stamp_ns) / step
        is_wet = _BRAKES_S <= time_s < _BRAKES_S + rail.slide_s
        most = (rail.adhesion if is_wet else _DRY) * G / (1.0 + train_file.train.rotary_mass)
        forces.append(_TRACTION * inertia if v < _CRUISE and time_s < _BRAKES_S - 5.0 else 0.0)
        by_rail = max(brake, -most) + forces[-1] / inertia
        gust += 0.01 * -gust + rail.gust * math.sqrt(0.02) * float(rng.standard_normal())
        extra = rail.gradient_error if 15.0 < time_s < 45.0 else 0.0
        v = max(0.0, v + step * (by_rail - (davis(train_file.resistance, v) + gradient + gust + extra) / inertia))
        if brake >= -most or v < 1.0:
            returns, target = True, 0.0
        elif lag >= target or (returns and lag < 0.3 * target):
            returns = not returns and target > 0.0
            target = float(rng.uniform(0.1, 0.25)) * v if not returns else target
        lag = max(0.0, lag - 4.0 * step) if returns else min(target, lag + 4.0 * step)
        ahead = rail.traction_slip if 6.0 < time_s < 8.0 else 0.0
        if k % round(dt / step) == 0:
            noisy = max(v - lag + ahead, 0.0) + 0.02 * float(rng.standard_normal()) if v > 0.0 else 0.0
            sample = coasting_sample(stamp_ns, dt, round(max(noisy, 0.0) / rail.quantum) * rail.quantum)
            force = train_file.train.mass * G / 1000.0
            sample.force, sample.force_mean = force * forces[-1], force * float(np.mean(forces))
            sample.brake_command, sample.brake_changes = (_COMMAND if time_s >= _BRAKES_S else 0.0), tuple(changes)
            forces, changes = forces[-1:], []
            yield Point(sample, v, abs(by_rail) * inertia / 1000.0, abs(ahead - lag) > 0.3)


def follow(train_file: TrainFile, points: list[Point]) -> list[AdhesionEstimate]:
    """Return the estimate after each sample."""
    estimator, noise, found = AdhesionEstimator(KnownForce(train_file)), SpeedNoise.declared(0.02), []
    for point in points:
        noise.add(point.sample.speed, point.sample.dt)
        estimator.step(point.sample, noise)
        found.append(estimator.estimate())
    return found


HEALTHY: Final = (
    Rail(),
    Rail(rate=0.75),
    Rail(rate=1.25),
    Rail(gradient_error=5.0),
    Rail(gust=1.5),
    Rail(quantum=1.0 / 3.6),
    Rail(quantum=1.0 / 3.6, period=1.0),
)


@pytest.mark.parametrize('rail', HEALTHY)
def test_no_slip_is_found_on_dry_rails(metro: TrainFile, rail: Rail) -> None:
    for seed in range(4):
        points = list(drive(metro, rail, 9301 + seed))
        found = follow(metro, points)
        assert not any(estimate.slipping for estimate in found)
        assert found[-1].slip_share == 0.0
        assert all(estimate.at_least <= max(point.used for point in points) for estimate in found)


def test_the_used_adhesion_is_the_true_one_whatever_the_brake_rate(metro: TrainFile) -> None:
    for rate in (0.8, 1.2):
        points = list(drive(metro, Rail(rate=rate), 9311))
        found = follow(metro, points)
        moving = [(a.used, b.used) for a, b in zip(found, points, strict=True) if b.speed > 3.0]
        errors = np.array([a - b for a, b in moving[20:]])
        assert float(np.sqrt(np.mean(errors**2))) < 0.01
        assert found[-1].at_least > 0.06


@pytest.mark.parametrize('seed', range(9321, 9331))
def test_a_slide_is_found_and_gives_the_adhesion(metro: TrainFile, seed: int) -> None:
    rail = Rail(adhesion=0.03 + 0.004 * (seed - 9321), rate=0.95)
    points = list(drive(metro, rail, seed))
    found = follow(metro, points)
    slipping = np.array([estimate.slipping for estimate in found])
    truth = np.array([point.slips for point in points])
    first, last = int(np.argmax(truth)), int(len(truth) - np.argmax(truth[::-1]))
    assert abs(int(np.argmax(slipping)) - first) <= 3  # 0.6 s
    assert slipping[first + 3 : last].all()
    assert not slipping[last + 30 :].any()
    end = found[len(slipping) - int(np.argmax(slipping[::-1]))]  # dry rails have not yet shown themselves
    assert abs(end.adhesion - rail.adhesion) < min(4.0 * end.adhesion_std, 0.025)
    assert end.slip_share > 0.0
    assert min(estimate.slip for estimate in found) < -0.05
    speeds = [p.sample.speed / (1.0 + e.slip) - p.speed for p, e in zip(points, found, strict=True) if e.slipping]
    assert float(np.sqrt(np.mean(np.square(speeds)))) < 1.2


def test_slip_under_traction_has_the_other_sign(metro: TrainFile) -> None:
    points = list(drive(metro, Rail(traction_slip=1.5), 9341))
    found = follow(metro, points)
    slips = [estimate.slip for estimate in found if estimate.slipping]
    assert 8 <= len(slips) <= 20
    assert max(slips) > 0.1


def test_without_a_slide_it_states_what_rails_are_like(metro: TrainFile) -> None:
    estimator = AdhesionEstimator(KnownForce(metro))
    assert (estimator.estimate().adhesion, estimator.estimate().adhesion_std) == pytest.approx(
        (RAIL, RAIL_STD), rel=0.05
    )
    found = follow(metro, list(drive(metro, Rail(), 9351)))
    assert all(math.isfinite(e.adhesion) and e.adhesion > e.at_least and e.adhesion_std > 0.0 for e in found)


def test_a_saved_slide_goes_on(metro: TrainFile) -> None:
    points, noise = list(drive(metro, Rail(adhesion=0.04), 9361)), SpeedNoise.declared(0.02)
    first, second = (AdhesionEstimator(KnownForce(metro)) for _ in range(2))
    for k, point in enumerate(points):
        first.step(point.sample, noise)
        if k == 220:
            assert first.is_slipping
            restore(second, encode(first))
        if k > 220:
            second.step(point.sample, noise)
            assert second.estimate() == first.estimate()


def test_unknown_motion_is_rejected_with_its_reason(metro: TrainFile) -> None:
    points, noise = list(drive(metro, Rail(adhesion=0.04), 9371)), SpeedNoise.declared(0.02)
    estimator = AdhesionEstimator(KnownForce(metro))
    for point in points[:220]:
        estimator.step(point.sample, noise)
    gap = replace(points[220].sample, dt=math.nan)
    rejection = estimator.step(gap, noise)
    assert rejection is not None
    assert rejection.reason is Reason.GAP
    assert not estimator.is_slipping
    assert estimator.estimate().adhesion < 0.1  # the slide was not forgotten


def held(train_file: TrainFile, share: float, traction_slip: bool) -> list[Point]:
    """Return a drive whose wheel slide protection holds the axle at a share of the speed, after slip or without."""
    inertia, rails, v, axle, points = specific_inertia(1.0, train_file.train.rotary_mass), 0.4, 0.0, 0.0, list[Point]()
    actuator, dt = BrakeActuator(train_file.brake), 0.2
    changes = [BrakeCommandChange(round(34.0 * NS_PER_S), -1.0)]
    for k in range(1, 275):
        time_s, stamp_ns = k * dt, round(k * dt * NS_PER_S)
        due = changes if k == round(34.0 / dt) else []
        actuator.commands.follow(tuple(due))
        brake = actuator.advance(stamp_ns - round(dt * NS_PER_S), stamp_ns) / dt
        pulls = 0.8 if time_s < 22.0 or (traction_slip and 30.0 <= time_s < 34.0) else 0.0
        slips = traction_slip and 30.0 <= time_s < 34.0
        by_rail = min(pulls, 0.3) if slips else pulls + max(brake, -rails)
        v = max(0.0, v + dt * (by_rail - davis(train_file.resistance, v) / inertia))
        axle = min(axle + 2.0 * dt, 1.4 * v) if slips else max(axle - 2.5 * dt, share * v) if brake < -rails else v
        sample, force = coasting_sample(stamp_ns, dt, axle), train_file.train.mass * G / 1000.0 * pulls * inertia
        sample.force, sample.force_mean, sample.brake_command = force, force, -1.0 if time_s >= 34.0 else 0.0
        sample.brake_changes = tuple(due)
        points.append(Point(sample, v, abs(by_rail) * inertia / 1000.0, abs(axle - v) > 0.3))
    return points


@pytest.mark.parametrize('traction_slip', [False, True])
@pytest.mark.parametrize('share', [0.5, 0.8])
def test_an_axle_that_is_held_slides_also_after_slip(metro: TrainFile, share: float, traction_slip: bool) -> None:
    points = held(metro, share, traction_slip)
    rows = [(e, p) for e, p in zip(follow(metro, points), points, strict=True) if p.slips and p.sample.brake_command]
    late = [estimate for estimate, point in rows if point.sample.stamp_ns > 36.5 * NS_PER_S and point.speed > 3.0]
    assert len(late) > 40
    assert all(e.slipping and math.copysign(1.0, e.slip) < 0.0 for e in late)
    true = 0.4 * specific_inertia(1.0, metro.train.rotary_mass) / 1000.0
    assert all(true - 2.0 * e.adhesion_std < e.adhesion < 2.0 * true for e in late)


@pytest.mark.parametrize('period', [0.2, 1.0])
def test_a_slide_counts_until_it_is_a_km_away(metro: TrainFile, period: float) -> None:
    estimator, noise, away_m = AdhesionEstimator(KnownForce(metro)), SpeedNoise.declared(0.02), 0.0
    for point in drive(metro, Rail(adhesion=0.04), 9371):
        estimator.step(point.sample, noise)
        away_m = 0.0 if estimator.is_slipping else away_m + point.sample.dt * point.speed
    lowest = estimator.estimate().adhesion
    stamp_ns, speed = round(1000.0 * NS_PER_S), 20.0
    estimator.step(coasting_sample(stamp_ns, math.nan, speed), noise)
    while estimator.estimate().slip_share > 0.0:
        assert estimator.estimate().adhesion == lowest
        stamp_ns, away_m = stamp_ns + round(period * NS_PER_S), away_m + period * speed
        sample = coasting_sample(stamp_ns, period, speed)
        sample.force = sample.force_mean = metro.train.mass * G / 1000.0 * davis(metro.resistance, speed)
        estimator.step(sample, noise)
    assert 1000.0 <= away_m < 1150.0
    assert estimator.estimate().adhesion > lowest

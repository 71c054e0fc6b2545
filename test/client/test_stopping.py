# SPDX-License-Identifier: Apache-2.0
"""The distance is that of the simulated train, its derivatives are right, and bounds cover what they state."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.client.stopping import (
    DELAY,
    EXTRA_SPEEDS,
    GRADIENT,
    LAG,
    MAX_SPEED,
    NO_BRAKE,
    PARAMETERS,
    RATE,
    Braking,
    RateShape,
    StoppingBounds,
    StopPosterior,
)
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.sim.plant import Plant
from trainid_ros.train.forces import G
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Pairs, Train, TrainFile

EMU: Pairs = ((2.0, 1.25), (8.0, 0.9), (14.0, 0.6), (25.0, 0.4))
TRAIN = Train(mass=194e3)


def shape(table: Pairs = ()) -> RateShape:
    k = G / (1000.0 * (1.0 + TRAIN.rotary_mass))
    return RateShape([v for v, _ in table], [rate for _, rate in table], TRAIN.max_speed, 2.5, k)


def parameters(**changes: float) -> list[float]:
    theta = [0.9, 0.0, 0.0, 1.5, 0.02, 0.001, 0.0, 0.6, 0.4]
    for name, value in changes.items():
        theta[{'rate': RATE, 'gradient': GRADIENT, 'delay': DELAY, 'lag': LAG}[name]] = value
    return theta


def simulated(theta: list[float], table: Pairs, speed: float, command: float) -> float:
    """Return the stopping distance of the simulator's plant [m]."""
    brake = Brake(theta[RATE], theta[LAG], theta[DELAY], rate_table=table)
    line = Line(gradient=((0.0, theta[GRADIENT]),))
    train_file = TrainFile(TRAIN, Davis(*theta[3:6]), brake, line)
    plant = Plant(train_file, LineProfile(line, TRAIN.length), 0, 0.8)
    plant.speed = speed
    plant.command(-command)
    while plant.speed > 0.0:
        plant.step(0.0)
    return plant.distance_run


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize(
    ('speed', 'command', 'changes'),
    [
        (22.0, 1.0, {}),
        (22.0, 0.4, {'delay': 3.3, 'lag': 1.2}),
        (8.0, 1.0, {'gradient': -25.0}),
        (8.0, 0.6, {'gradient': 30.0, 'lag': 0.0}),
        (1.0, 1.0, {'delay': 0.0}),
        (0.4, 1.0, {}),
    ],
)
def test_the_distance_is_that_of_the_simulator(
    table: Pairs, speed: float, command: float, changes: dict[str, float]
) -> None:
    theta = parameters(**changes)
    found = Braking(shape(table), theta, command, 0.0).stop(speed).distance
    assert found == pytest.approx(simulated(theta, table, speed, command), rel=5e-4, abs=2e-3)


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize('speed', [0.7, 4.0, 19.0])
def test_derivatives_are_those_of_the_distance(table: Pairs, speed: float) -> None:
    theta, step = parameters(gradient=-5.0), 1e-4

    def distance(values: list[float], v: float = speed) -> float:
        return Braking(shape(table), values, 0.9, 0.2).stop(v).distance

    stop = Braking(shape(table), theta, 0.9, 0.2).stop(speed)
    for place in range(PARAMETERS):
        above, below = list(theta), list(theta)
        above[place] += step
        below[place] -= step
        numeric = (distance(above) - distance(below)) / (2.0 * step)
        assert stop.gradient[place] == pytest.approx(numeric, rel=0.05), place
    numeric = (distance(theta, speed + step) - distance(theta, speed - step)) / (2.0 * step)
    assert stop.dD_dv == pytest.approx(numeric, rel=0.01)


def test_a_table_is_interpolated_linearly() -> None:
    form = shape(EMU)
    for v in (0.0, 2.0, 5.0, 8.0, 13.9, 14.0, 20.0, 25.0, 40.0):
        assert form.parts(v)[0] == pytest.approx(Brake(rate_table=EMU).shape_at(v))


def test_an_extra_resistance_acts_as_that_of_the_train() -> None:
    form = replace(shape(), resistances=[0.002 * v**2 for v in EXTRA_SPEEDS])
    assert [form.extra(v) for v in (-1.0, 0.0, 10.0, 150.0, 400.0)] == pytest.approx([0.0, 0.0, 0.2, 45.0, 45.0])
    drag = parameters()
    drag[5] += 0.002
    extra, expected = (Braking(x, y, 0.7, 0.0).stop(20.0) for x, y in ((form, parameters()), (shape(), drag)))
    assert extra.distance == pytest.approx(expected.distance, rel=1e-5)
    assert extra.dD_dv == pytest.approx(expected.dD_dv, rel=1e-3)


def test_a_train_that_is_braking_already_stops_sooner() -> None:
    released, braking = (Braking(shape(), parameters(), 1.0, u0).stop(20.0).distance for u0 in (0.0, 1.0))
    # Half a second to a second of braking is lost otherwise.
    assert 0.8 * 20.0 < released - braking < 1.0 * 20.0


def test_a_brake_weaker_than_the_gradient_does_not_stop_the_train() -> None:
    steep = parameters(gradient=-60.0)
    assert math.isinf(Braking(shape(), steep, 0.3, 0.0).stop(10.0).distance)
    assert math.isinf(Braking(shape(), parameters(gradient=-499.0, delay=120.0), 0.3, 0.0).stop(10.0).distance)
    # A standing train needs no distance.
    assert Braking(shape(), parameters(), 1.0, 0.0).stop(0.0).distance == 0.0


@pytest.mark.parametrize('least', [0.2, 1e-2, 1e-4])
def test_a_train_that_hardly_slows_down_has_the_distance_of_its_balance(least: float) -> None:
    """Its deceleration falls linearly with speed, so that the distance has a closed form."""
    form = RateShape([], [], 22.2, 2.5, 0.01)
    slope = (0.9 - least) / 20.0  # d(v) = 0.9 - slope v with the brake and the resistance
    theta = [0.9, 0.0, 0.0, 0.0, -slope / 0.01, 0.0, 0.0, 0.0, 0.0]
    expected = 0.9 / slope**2 * math.log(0.9 / least) - 20.0 / slope
    assert Braking(form, theta, 1.0, 0.0).stop(20.0).distance == pytest.approx(expected, rel=1e-6)


Array = NDArray[np.float64]
DRAWS = 10_000
DAVIS = (0.04, -0.002, 0.0, -0.002, 2e-4, 0.0, 0.0, 0.0, 4e-8)
LEARNED = StopPosterior(
    (0.9, 0.0, 0.0, 1.5, 0.02, 0.001, 0.0, 0.6, 0.4),
    (0.02**2, 0.08**2, 0.06**2, 0.0, 0.0, 0.0, 0.2**2, 0.1**2, 0.06**2),
    DAVIS,
)
UNKNOWN = replace(
    LEARNED, variances=(0.2**2, *LEARNED.variances[1:]), davis=(0.94, 0.0, 0.0, 0.0, 5e-4, 0.0, 0.0, 0.0, 6e-7)
)


def on(posterior: StopPosterior, gradient: float, rate: float = 0.9) -> StopPosterior:
    """Return what is known of a stop on a gradient [per mille], with a brake rate."""
    return replace(posterior, mean=(rate, *posterior.mean[1:6], gradient, *posterior.mean[7:]))


def draw(posterior: StopPosterior, rng: np.random.Generator) -> Array:
    """Return parameters from the posterior, shape (9, draws)."""
    theta = np.array(posterior.mean)[:, None] + np.sqrt(posterior.variances)[:, None] * rng.standard_normal((9, DRAWS))
    davis = np.array(posterior.davis).reshape(3, 3)
    theta[3:6] = rng.multivariate_normal(posterior.mean[3:6], davis, DRAWS).T
    return theta


def distances(form: RateShape, theta: Array, speed: float, command: float, applied: float, dt: float = 0.02) -> Array:
    """Integrate the equations of stopping.py in small equal steps, for all draws at once."""
    f, e, h, a, b, c, i, delay, tau = theta
    table = (np.array(form.speeds), np.array(form.rates)) if form.speeds else (np.array([0.0]), np.array([1.0]))
    v, run, t = np.full(DRAWS, speed), np.zeros(DRAWS), 0.0
    while np.any(v > 0.0) and t < 60.0:
        since = np.maximum(0.0, t + 0.5 * dt - delay)
        target = command + (applied - command) * np.exp(-since / tau)
        by_speed = e * (np.minimum(v / form.max_speed, 1.0) - 0.5)
        by_speed += h * np.maximum(0.0, 1.0 - np.abs(v / form.blend_speed - 1.0))
        d = np.interp(v, *table) * (f + by_speed) * target + form.k * (a + i + v * (b + c * v))
        after = np.maximum(0.0, v - dt * d)
        run += np.where(after > 0.0, 0.5 * (v + after) * dt, 0.5 * v * v / np.maximum(d, 1e-9))
        v, t = np.where(v > 0.0, after, 0.0), t + dt
    return run


@pytest.mark.parametrize(
    ('posterior', 'table', 'speed', 'command', 'applied'),
    [
        (LEARNED, (), 20.0, 1.0, 0.0),
        (LEARNED, (), 3.0, 0.7, 0.7),
        pytest.param(LEARNED, EMU, 24.0, 1.0, 0.0, marks=pytest.mark.long),
        pytest.param(UNKNOWN, (), 20.0, 1.0, 0.0, marks=pytest.mark.long),
        (UNKNOWN, EMU, 12.0, 0.8, 0.3),
    ],
)
def test_bounds_cover_their_share_of_the_posterior(
    posterior: StopPosterior, table: Pairs, speed: float, command: float, applied: float
) -> None:
    found = distances(shape(table), draw(posterior, np.random.default_rng(7)), speed, command, applied)
    for confidence, tolerance in ((0.5, 0.02), (0.95, 0.008), (0.99, 0.004)):
        bound = StoppingBounds(shape(table), posterior, command, applied, confidence).at(speed)
        covered = float(np.mean(found <= bound.distance))
        print(f'{confidence}: {covered:.4f}, std {bound.std:.2f} m, sampled {float(np.std(found)):.2f} m')
        assert abs(covered - confidence) < tolerance


def mixed(dropped: float, loss: float, confidence: float, posterior: StopPosterior = LEARNED) -> StoppingBounds:
    """Return bounds of a brake that may have dropped."""
    return StoppingBounds(shape(), replace(posterior, dropped=dropped, loss=loss), 0.9, 0.0, confidence)


# Probability of a drop, its size, and confidence: drops that count little, much and not at all, and near certainty.
DROPS = [(0.03, 0.03, 0.95), (0.1, 0.1, 0.95), (0.3, 0.2, 0.95), (0.01, 0.6, 0.9), (1.0, 0.2, 0.95), (0.5, 0.3, 0.5)]


@pytest.mark.parametrize(('dropped', 'loss', 'confidence'), DROPS[:3])
def test_bounds_cover_their_share_of_brakes_as_known_and_dropped(
    dropped: float, loss: float, confidence: float
) -> None:
    known = draw(LEARNED, np.random.default_rng(11))
    lower = np.concatenate([(1.0 - loss) * known[:3], known[3:]])
    bounds = mixed(dropped, loss, confidence)
    distance = bounds.at(18.0).distance
    held = [float(np.mean(distances(shape(), theta, 18.0, 0.9, 0.0, 0.05) <= distance)) for theta in (known, lower)]
    assert abs((1.0 - dropped) * held[0] + dropped * held[1] - confidence) < 0.008
    assert bounds.at(18.0).std == pytest.approx(StoppingBounds(shape(), LEARNED, 0.9, 0.0, confidence).at(18.0).std)


@pytest.mark.parametrize(('dropped', 'loss', 'confidence'), DROPS)
@pytest.mark.parametrize('posterior', [LEARNED, UNKNOWN])
def test_a_bound_with_a_drop_is_longer_and_smooth_and_has_an_inverse(
    posterior: StopPosterior, dropped: float, loss: float, confidence: float
) -> None:
    bounds, step = mixed(dropped, loss, confidence, posterior), 1e-3
    for speed in (2.5, 22.2):
        found = bounds.at(speed)
        assert found.distance > StoppingBounds(shape(), posterior, 0.9, 0.0, confidence).at(speed).distance
        numeric = (bounds.at(speed + step).distance - bounds.at(speed - step).distance) / (2.0 * step)
        assert found.dD_dv == pytest.approx(numeric, rel=0.01)
        other = mixed(dropped, loss, confidence, posterior)  # by other speeds on the way
        assert other.speed(found.distance)[0] == pytest.approx(speed, abs=1e-6)


def test_a_drop_that_cannot_be_changes_nothing_to_the_bit() -> None:
    before = StoppingBounds(shape(), LEARNED, 0.9, 0.0, 0.95).at(20.0).distance
    assert mixed(0.0, 0.3, 0.95).at(20.0).distance == mixed(0.4, 0.0, 0.95).at(20.0).distance == before


def test_a_train_that_a_drop_may_keep_from_stopping_has_a_bound_while_that_is_within_the_risk() -> None:
    rare, often = (mixed(dropped, 0.9, 0.95, on(LEARNED, -20.0)) for dropped in (0.04, 0.06))
    known = StoppingBounds(shape(), on(LEARNED, -20.0), 0.9, 0.0, 0.95 / 0.96)
    assert rare.at(20.0).distance == pytest.approx(known.at(20.0).distance)
    assert math.isinf(often.at(20.0).distance)


def test_the_variance_along_a_gradient_is_that_of_the_whole_covariance() -> None:
    davis = (0.04, -0.002, 1e-5, -0.002, 2e-4, -1e-6, 1e-5, -1e-6, 4e-8)
    whole, along = np.diag(LEARNED.variances), unit(np.random.default_rng(5))
    whole[3:6, 3:6] = np.reshape(davis, (3, 3))
    posterior = replace(LEARNED, davis=davis)
    np.testing.assert_allclose(posterior.spread(along.tolist()), whole @ along, rtol=1e-9)
    assert posterior.std(along.tolist()) ** 2 == pytest.approx(along @ whole @ along)


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize('gradient', [-30.0, 0.0, 25.0])
@pytest.mark.parametrize('confidence', [0.5, 0.999])
def test_the_speed_is_the_exact_inverse_of_the_distance(table: Pairs, gradient: float, confidence: float) -> None:
    posterior = on(LEARNED, gradient)
    bounds = StoppingBounds(shape(table), posterior, 0.9, 0.0, confidence)
    for speed in (0.6, 2.5, 5.0, 9.3, 22.2, 41.0, 140.0):
        assert bounds.speed(bounds.at(speed).distance)[0] == pytest.approx(speed, abs=1e-6)


def test_the_std_of_a_speed_is_that_of_its_distance() -> None:
    bounds = StoppingBounds(shape(), LEARNED, 0.9, 0.0, 0.95)
    speed, std = bounds.speed(200.0)
    assert std == pytest.approx(bounds.at(speed).std * (bounds.speed(201.0)[0] - speed), rel=0.01)


def test_the_longest_distance_gives_the_largest_speed_and_none_allows_no_speed_also_downhill() -> None:
    assert StoppingBounds(shape(), LEARNED, 0.9, 0.0, 0.95).speed(1e5)[0] == MAX_SPEED
    downhill = on(LEARNED, -30.0)
    assert StoppingBounds(shape(), LEARNED, 0.9, 0.0, 0.95).speed(0.0) == (0.0, 0.0)
    assert StoppingBounds(shape(), downhill, 0.9, 0.0, 0.95).speed(0.01) == (0.0, 0.0)


def test_a_train_that_may_not_stop_has_no_answer() -> None:
    steep = on(UNKNOWN, -60.0)
    bounds = StoppingBounds(shape(), steep, 0.6, 0.0, 0.95)
    assert math.isinf(bounds.at(10.0).distance)
    with pytest.raises(NoAnswerError, match=r'may not stop: command = -0.6 m/s\^2 is too weak'):
        bounds.speed(100.0)


def test_a_train_that_only_stops_from_low_speeds_gets_one_of_them() -> None:
    fading = ((5.0, 1.0), (15.0, 0.02))
    posterior = on(LEARNED, -25.0)
    bounds = StoppingBounds(shape(fading), posterior, 0.6, 0.0, 0.95)
    assert math.isinf(bounds.at(15.0).distance)
    speed, std = bounds.speed(1e4)
    assert 5.0 < speed < 15.0
    assert math.isfinite(std)


@pytest.mark.parametrize('gradient', [-40.0, -35.0, -25.0, -15.0])
@pytest.mark.parametrize('confidence', [0.9, 0.95, 0.99, 0.999])
def test_bounds_near_a_runaway_rise_with_speed_and_have_an_inverse(gradient: float, confidence: float) -> None:
    steep = on(UNKNOWN, gradient, 1.0)
    answered = 0
    for command in (0.4, 0.55, 0.7, 1.0):
        bounds, before = StoppingBounds(shape(), steep, command, 0.0, confidence), 0.0
        for speed in (0.5, 2.5, 2.9, 3.0, 6.0, 10.0, 20.0, 35.0):
            distance = bounds.at(speed).distance
            assert distance >= before
            before = distance
            if math.isfinite(distance):
                assert bounds.speed(distance)[0] == pytest.approx(speed, abs=1e-6)
                answered += 1
    assert answered > 0


def test_a_bound_near_a_runaway_is_the_longest_distance_of_its_confidence() -> None:
    """No draw at the edge of the confidence region, nor a small change of the design point, is longer."""
    steep = on(UNKNOWN, -35.0, 1.0)
    bounds = StoppingBounds(shape(), steep, 0.9, 0.0, 0.95)
    bound, z = bounds.at(10.0), NormalDist().inv_cdf(0.95)
    mean = StoppingBounds(shape(), steep, 0.9, 0.0, 0.5).at(10.0).distance
    assert bound.distance > 1.5 * mean
    rng = np.random.default_rng(11)
    spread = np.zeros((9, 9))
    spread[3:6, 3:6] = np.array(steep.davis).reshape(3, 3)
    root = np.linalg.cholesky(spread + np.diag(steep.variances) + 1e-18 * np.eye(9))
    worst = root.T @ np.array(bound.gradient)
    for share in (0.0, 0.7, 0.9, 0.99, 0.999):
        for _ in range(50):
            away = share * worst / np.linalg.norm(worst) + (1.0 - share) * unit(rng)
            theta = np.array(steep.mean) + z * root @ (away / np.linalg.norm(away))
            theta[7:] = np.maximum(theta[7:], 0.0)
            assert Braking(shape(), theta.tolist(), 0.9, 0.0).stop(10.0).distance <= bound.distance * (1.0 + 1e-9)


def unit(rng: np.random.Generator) -> Array:
    """Return a random direction in nine dimensions."""
    drawn = rng.standard_normal(9)
    return drawn / np.linalg.norm(drawn)


def test_no_speed_is_allowed_beyond_one_at_which_the_train_may_not_stop() -> None:
    """At 2.5 m/s the changeover of the brakes may leave too little: that holds for all faster trains."""
    changeover = replace(UNKNOWN, variances=(0.02**2, 0.0, 0.3**2, *UNKNOWN.variances[3:]))
    steep = on(changeover, -30.0, 1.0)
    bounds = StoppingBounds(shape(), steep, 0.5, 0.0, 0.95)
    assert math.isfinite(bounds.at(1.0).distance)
    assert [bounds.at(speed).distance for speed in (2.6, 5.0, 20.0, 40.0)] == [math.inf] * 4
    speed, _ = bounds.speed(2000.0)
    assert 1.0 < speed < 2.5


def test_speed_and_bound_agree_however_little_is_known() -> None:
    """With delay and lag less known than they are long the distance has several maxima at one confidence."""
    rng, answered = np.random.default_rng(17), 0
    for _ in range(160):
        rate, *known = (10.0 ** rng.uniform((-1.0, -6.0, -6.0, -6.0, -6.0), (0.6, 0.0, 0.0, 0.0, 0.0))).tolist()
        mean = (rate, *LEARNED.mean[1:6], *rng.uniform((-50.0, 0.0, 0.0), (50.0, 3.0, 3.0)).tolist())
        posterior = StopPosterior(mean, (known[0], 0.0, 0.0, 0.0, 0.0, 0.0, *known[1:]), DAVIS)
        bounds = StoppingBounds(shape(), posterior, 1.0, float(rng.integers(2)), 0.999)
        for distance in (10.0 ** rng.uniform(-2.0, 4.0, 4)).tolist():
            try:
                speed, std = bounds.speed(distance)
            except NoAnswerError:
                continue
            if speed > 0.0:
                answered += 1
                assert bounds.at(speed).distance <= distance + 1e-6
                assert 0.0 < std < math.inf
    assert answered > 100


def test_a_brake_rate_that_may_be_zero_gives_no_bound_even_where_the_train_would_roll_out() -> None:
    """On a gradient of 50 per mille resistance alone stops the train."""
    uphill = on(LEARNED, 50.0, 0.5)
    for std, is_known in ((0.2, True), (0.4, False)):
        posterior = replace(uphill, variances=(std**2, *uphill.variances[1:]))
        bound = StoppingBounds(shape(), posterior, 0.3, 0.0, 0.95).at(10.0)
        assert math.isfinite(bound.distance) is is_known


@pytest.mark.parametrize('share', [1.0, 0.999])
def test_a_known_brake_rate_below_the_least_one_is_no_brake(share: float) -> None:
    known = StopPosterior((share * NO_BRAKE, *LEARNED.mean[1:6], 50.0, 0.6, 0.4), (0.0,) * 9, (0.0,) * 9)
    assert math.isfinite(StoppingBounds(shape(), known, 0.3, 0.0, 0.95).at(10.0).distance) is (share == 1.0)


@pytest.mark.parametrize('speed', [0.01, 10.0])
def test_another_iteration_of_the_design_point_does_not_lengthen_a_bound(speed: float) -> None:
    steep = on(UNKNOWN, -28.0, 1.0)
    bounds = StoppingBounds(shape(), steep, 0.7, 0.0, 0.999)
    bound = bounds.at(speed)
    assert bounds.design_point_step(speed, bound.gradient).distance == pytest.approx(bound.distance, rel=1e-8)


def weak(davis: tuple[float, float, float], command: float) -> StoppingBounds:
    """Return the bounds of a train of which everything is known."""
    known = StopPosterior((0.9, 0.0, 0.0, *davis, 0.0, 0.6, 0.4), (0.0,) * 9, (0.0,) * 9)
    return StoppingBounds(shape(), known, command, 0.0, 0.95)


@pytest.mark.parametrize(('command', 'speed', 'stops'), [(0.06, 5.0, True), (0.06, 40.0, False), (0.2, 40.0, True)])
def test_a_train_that_does_not_slow_down_between_two_knots_is_found(command: float, speed: float, stops: bool) -> None:
    """The resistance is least at 17 m/s, far from the knots 5 and 40 m/s."""
    assert math.isfinite(weak((1.5, -1.0, 0.03), command).at(speed).distance) is stops


def test_no_speed_at_which_the_train_might_not_slow_down_is_left_out() -> None:
    def slowest_at(speed: float) -> StoppingBounds:
        return weak((speed**2 - 30.0, -2.0 * speed, 1.0), 0.2)

    for speed in slowest_at(0.0)._grid:
        assert not slowest_at(speed)._slows_down(MAX_SPEED)

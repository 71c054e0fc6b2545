# SPDX-License-Identifier: Apache-2.0
"""The line profile under a train against hand calculation, in both directions."""

from __future__ import annotations

import math

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Line

LINE = Line(
    stops=(0.0, 1450.0, 3000.0),
    gradient=((0.0, 0.0), (620.0, -12.5), (700.0, 20.0)),
    curve=((0.0, 0.0), (300.0, 400.0), (500.0, 0.0)),
    tunnel=((700.0, 1400.0),),
    speed_limit=((0.0, 10.0), (500.0, 20.0), (1000.0, 15.0)),
)


@pytest.fixture
def profile() -> LineProfile:
    return LineProfile(LINE, 100.0)


def test_gradient_is_averaged_over_the_length(profile: LineProfile) -> None:
    # Front at 660: 60 m level, 40 m at -12.5.
    assert profile.gradient(660.0, 1) == pytest.approx(0.4 * -12.5)
    # Front at 710: 10 m level, 80 m at -12.5, 10 m at 20.
    assert profile.gradient(710.0, 1) == pytest.approx(0.8 * -12.5 + 0.1 * 20.0)


def test_the_gradient_changes_sign_on_the_way_back_with_the_rear_on_the_other_side(profile: LineProfile) -> None:
    # Front at 660 going down: the rear is at 760; 40 m at -12.5, 60 m at 20, with the opposite sign.
    assert profile.gradient(660.0, -1) == pytest.approx(-(0.4 * -12.5 + 0.6 * 20.0))
    # The same track under the train, in the opposite direction.
    assert profile.gradient(700.0, 1) == pytest.approx(-profile.gradient(600.0, -1))


def test_the_first_and_last_values_extend_beyond_the_ends(profile: LineProfile) -> None:
    assert profile.gradient(5000.0, 1) == pytest.approx(20.0)
    assert profile.gradient(-5000.0, 1) == 0.0
    assert LineProfile(Line(gradient=((0.0, 7.0),)), 50.0).gradient(-900.0, 1) == pytest.approx(7.0)


def test_a_line_ends_a_train_beyond_its_last_stop_or_gradient(profile: LineProfile) -> None:
    assert (profile.first, profile.last) == (-100.0, 3100.0)
    longer = LineProfile(Line(stops=(50.0, 3000.0), gradient=((0.0, 1.0), (4000.0, 2.0))), 60.0)
    assert (longer.first, longer.last) == (-60.0, 4060.0)
    endless = LineProfile(Line(gradient=((0.0, 7.0),)), 50.0)
    assert (endless.first, endless.last) == (-math.inf, math.inf)


def test_the_radius_follows_the_mean_curvature(profile: LineProfile) -> None:
    assert profile.curve_radius(450.0, 1) == pytest.approx(400.0)
    # Half of the train in the curve: half the curvature.
    assert profile.curve_radius(350.0, 1) == pytest.approx(800.0)
    assert profile.curve_radius(450.0, -1) == pytest.approx(800.0)
    assert profile.curve_radius(250.0, 1) == 0.0


def test_the_train_is_in_a_tunnel_with_at_least_half_its_length(profile: LineProfile) -> None:
    assert [profile.tunnel(x, 1) for x in (740.0, 760.0, 1440.0, 1460.0)] == [False, True, True, False]
    assert [profile.tunnel(x, -1) for x in (640.0, 660.0, 1340.0, 1360.0)] == [False, True, True, False]


def test_adjacent_tunnels_are_joined() -> None:
    profile = LineProfile(Line(tunnel=((0.0, 100.0), (100.0, 200.0))), 20.0)
    inside = [profile.tunnel(x, 1) for x in (5.0, 105.0, 110.0, 200.0, 215.0)]
    assert inside == [False, True, True, True, False]


def test_speed_limit_is_the_lowest_under_the_train(profile: LineProfile) -> None:
    assert profile.speed_limit(599.0, 1) == 10.0
    assert profile.speed_limit(600.0, 1) == 20.0
    assert profile.speed_limit(1001.0, 1) == 15.0
    assert profile.speed_limit(1000.0, 1) == 20.0
    assert profile.speed_limit(499.0, -1) == 10.0
    assert profile.speed_limit(-50.0, 1) == 10.0
    assert LineProfile(Line(), 10.0).speed_limit(0.0, 1) == math.inf


def test_limits_ahead_in_both_directions(profile: LineProfile) -> None:
    assert profile.limits_ahead(450.0, 1, 600.0) == ((50.0, 20.0), (550.0, 15.0))
    assert profile.limits_ahead(450.0, 1, 100.0) == ((50.0, 20.0),)
    assert profile.limits_ahead(1100.0, -1, 700.0) == ((100.0, 20.0), (600.0, 10.0))


def test_next_stop(profile: LineProfile) -> None:
    assert profile.next_stop(1450.3, 1) == 3000.0
    assert profile.next_stop(1449.7, 1) == 3000.0
    assert profile.next_stop(1440.0, 1) == 1450.0
    assert profile.next_stop(1449.7, -1) == 0.0
    assert profile.next_stop(3000.0, 1) is None
    assert profile.next_stop(0.0, -1) is None


HEAVY_HEAD = ((60e3, 20.0), (20e3, 40.0), (20e3, 40.0))


def test_gradient_and_curvature_are_weighted_by_the_masses_of_the_cars() -> None:
    profile = LineProfile(LINE, 100.0, HEAVY_HEAD)
    # Rising positions: the first car leads. Front at 660: it lies at 640 to 660, beyond the change at 620.
    assert profile.gradient(660.0, 1) == pytest.approx((0.6 + 0.4 * 20.0 / 80.0) * -12.5)
    # Falling positions: the last car leads, the first one lies at the end with the higher position, at 740 to 760.
    assert profile.gradient(660.0, -1) == pytest.approx(-(0.6 * 20.0 + 0.4 * (0.5 * -12.5 + 0.5 * 20.0)))
    assert profile.curve_radius(310.0, 1) == pytest.approx(400.0 / 0.3)
    assert profile.curve_radius(450.0, -1) == pytest.approx(400.0 / (0.4 * 50.0 / 80.0))
    # Air drag in a tunnel is by length.
    assert [profile.tunnel(x, 1) for x in (740.0, 760.0)] == [False, True]


def test_a_train_of_two_cars_feels_the_sum_of_two_short_ones() -> None:
    train = LineProfile(LINE, 100.0, ((90e3, 30.0), (30e3, 70.0)))
    first, last = LineProfile(LINE, 30.0), LineProfile(LINE, 70.0)
    for x in (610.0, 655.5, 700.0, 741.0, 790.0):
        assert train.gradient(x, 1) == pytest.approx(0.75 * first.gradient(x, 1) + 0.25 * last.gradient(x - 30.0, 1))
        ahead = 0.25 * last.gradient(x, -1) + 0.75 * first.gradient(x + 70.0, -1)
        assert train.gradient(x, -1) == pytest.approx(ahead)


def test_cars_of_equal_mass_per_metre_change_nothing(profile: LineProfile) -> None:
    even = LineProfile(LINE, 100.0, ((30e3, 30.0), (20e3, 20.0), (50e3, 50.0)))
    for x in (610.3, 655.7, 700.1, 741.9):
        for way in (1, -1):
            assert even.gradient(x, way) == profile.gradient(x, way)
            assert even.curve_radius(x - 300.0, way) == profile.curve_radius(x - 300.0, way)


@pytest.mark.parametrize('length', [0.0, -1.0, math.nan])
def test_a_train_length_that_is_not_positive_is_rejected(length: float) -> None:
    with pytest.raises(InputError, match='train length'):
        LineProfile(LINE, length)

# SPDX-License-Identifier: Apache-2.0
"""Which adhesions are used, and how long a slide limits the brake."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from decimal import Decimal
from types import SimpleNamespace
from typing import Any

import pytest

from trainid_ros.client.live_adhesion import LiveAdhesion, Rail
from trainid_ros.client.live_estimate import MAX_AGE_S
from trainid_ros.interface.results import AdhesionEstimate, Status
from trainid_ros.stream.adhesion import RAIL, RAIL_STD

DRY = AdhesionEstimate(0.05, 0.09, 0.20, 0.06, 0.0, slipping=False, slip_share=0.0)
SLIDE = AdhesionEstimate(0.05, 0.0, 0.05, 0.01, -0.12, slipping=True, slip_share=0.1)
PASSED = replace(SLIDE, slipping=False, slip=0.0)
OF_SLIDE = Rail(0.05, 0.01)


def adhesion_after(*estimates: AdhesionEstimate, status: Status = Status.VALID) -> LiveAdhesion:
    """Return an adhesion that has had estimates at 5 Hz from 0 s on."""
    out = LiveAdhesion(MAX_AGE_S)
    for k, one in enumerate(estimates):
        out.take_new(status, one, 0.2 * k, k)
    return out


def test_the_adhesion_is_that_of_usual_rails_unless_a_new_estimate_states_it() -> None:
    assert adhesion_after().value() == (RAIL, RAIL_STD, False, 'dry to wet rail: no estimate yet')
    one = adhesion_after(DRY, SLIDE)
    assert one.value() == (0.05, 0.01, True, 'VALID')
    one.go_on(2.0)
    assert one.value() == (RAIL, RAIL_STD, False, 'dry to wet rail: no new estimate for more than 0.75 s')


def test_a_slide_limits_the_brake_until_it_is_a_km_away_also_while_nothing_comes() -> None:
    assert adhesion_after(DRY).limit() is None
    for one in (adhesion_after(SLIDE), adhesion_after(SLIDE, PASSED)):
        one.go_on(60.0)
        limit = one.limit()
        assert limit is not None
        assert limit.least(0.95) == pytest.approx(0.05 * math.exp(-1.6449 * 0.2), rel=1e-4)
        assert limit.least(0.5) == pytest.approx(0.05)
    assert adhesion_after(SLIDE, DRY).limit() is None


def test_slip_that_has_begun_unheard_may_be_a_slide() -> None:
    assert adhesion_after(PASSED).limit() == OF_SLIDE
    assert adhesion_after(PASSED, status=Status.CONVERGING).limit() == OF_SLIDE
    assert adhesion_after(DRY, PASSED).limit() is None
    silent, refused = adhesion_after(DRY), adhesion_after(DRY)
    refused.refuse('two publishers', 0.2)
    silent.take_new(Status.VALID, PASSED, 60.0, 300)
    refused.take_new(Status.VALID, PASSED, 0.4, 2)
    assert [one.limit() for one in (silent, refused)] == [OF_SLIDE, OF_SLIDE]


def test_a_slide_is_one_while_the_axle_has_come_back() -> None:
    back = replace(SLIDE, slip=-0.0)
    assert adhesion_after(DRY, back, PASSED).limit() == OF_SLIDE
    assert adhesion_after(DRY, replace(SLIDE, slip=0.0), PASSED).limit() is None


def test_slip_under_traction_neither_limits_the_brake_nor_lifts_the_limit_of_a_slide() -> None:
    slip = replace(SLIDE, slip=0.2, adhesion=0.2)
    assert adhesion_after(DRY, slip, PASSED).limit() is None
    assert adhesion_after(DRY, SLIDE, slip).limit() == OF_SLIDE
    assert adhesion_after(DRY, SLIDE, PASSED, slip).limit() == OF_SLIDE
    assert adhesion_after(DRY, SLIDE, slip, DRY, slip).limit() is None


def test_the_limit_is_the_lowest_of_several_slides_and_of_one_the_newest() -> None:
    milder = replace(SLIDE, adhesion=0.15)
    assert adhesion_after(SLIDE, milder).limit() == Rail(0.15, 0.01)
    assert adhesion_after(SLIDE, PASSED, milder).limit() == OF_SLIDE
    assert adhesion_after(milder, SLIDE, replace(milder, slipping=False, slip=0.0)).limit() == Rail(0.15, 0.01)
    failed = adhesion_after(milder)
    for adhesion, expected in ((0.3, 0.15), (0.08, 0.08)):
        failed.take_new(Status.FAULT, replace(SLIDE, adhesion=adhesion), 0.2, 1)
        limit = failed.limit()
        assert limit is not None
        assert limit.adhesion == expected


def test_after_silence_a_refusal_or_an_unusable_status_it_is_another_slide() -> None:
    milder = replace(SLIDE, adhesion=0.15)
    silent, refused, stale = (adhesion_after(SLIDE) for _ in range(3))
    refused.take_new(Status.VALID, replace(PASSED, adhesion=math.nan), 0.2, 1)
    stale.take_new(Status.STALE, PASSED, 0.2, 1)
    for one, time_s in ((silent, 60.0), (refused, 0.4), (stale, 0.4)):
        one.take_new(Status.VALID, milder, time_s, 2)
        assert one.limit() == OF_SLIDE


def test_a_status_that_is_not_fit_to_use_does_not_make_a_slide_two() -> None:
    one = adhesion_after(SLIDE)
    one.take_new(Status.CONVERGING, replace(SLIDE, adhesion=0.02), 0.2, 1)
    assert one.limit() == Rail(0.02, 0.01)
    one.take_new(Status.VALID, PASSED, 0.4, 2)
    assert one.limit() == OF_SLIDE
    one.take_new(Status.CONVERGING, SLIDE, 0.6, 3)
    one.go_on(60.0)
    one.take_new(Status.VALID, replace(SLIDE, adhesion=0.15), 60.0, 4)
    assert one.limit() == OF_SLIDE


def test_slip_under_traction_does_not_lower_the_limit_of_a_slide_nor_is_one_that_was_heard_from_its_start() -> None:
    slip = replace(SLIDE, slip=0.2, adhesion=0.02)
    over = replace(slip, slip=0.0, slipping=False)
    assert adhesion_after(DRY, SLIDE, PASSED, *[slip, over] * 9).limit() == OF_SLIDE
    one = adhesion_after(DRY, slip, over, status=Status.CONVERGING)
    one.take_new(Status.VALID, over, 0.6, 9)
    assert one.limit() is None


def test_a_certain_adhesion_and_the_least_of_uncertain_ones() -> None:
    certain = adhesion_after(replace(SLIDE, adhesion_std=0.0)).limit()
    assert certain is not None
    assert 0.04 < certain.least(0.999) < 0.05
    unsure = replace(SLIDE, adhesion=0.055, adhesion_std=0.05)
    assert adhesion_after(SLIDE, PASSED, unsure).limit() == Rail(0.055, 0.05)


@pytest.mark.parametrize('status', [Status.UNINITIALIZED, Status.CONVERGING, Status.STALE, Status.FAULT])
def test_an_estimate_that_must_not_be_used_does_not_lift_the_limit_of_a_slide(status: Status) -> None:
    one = adhesion_after(SLIDE)
    one.take_new(status, DRY, 0.2, 1)
    assert one.limit() == OF_SLIDE
    assert one.value()[:3] == (RAIL, RAIL_STD, False)


@pytest.mark.parametrize('stamps', [(9, 8), (9, 9)])
def test_stamps_that_do_not_rise_do_not_lift_the_limit_of_a_slide(stamps: tuple[int, int]) -> None:
    one = LiveAdhesion(MAX_AGE_S)
    for estimate, stamp_ns in zip((SLIDE, DRY), stamps, strict=True):
        one.take_new(Status.VALID, estimate, 0.0, stamp_ns)
    assert one.limit() == OF_SLIDE


WRONG: list[dict[str, Any]] = [
    *({'adhesion': x} for x in (0.0, 1e-310, math.nan, None, 'x', 10**400, Decimal('0.05'))),
    *({'adhesion_std': x} for x in (-1.0, 0.5, 1e308)),
    *({'slip': -5.0}, {'slip_share': -1.0}, {'slip_share': 2.0}),
]


@pytest.mark.parametrize('wrong', WRONG, ids=lambda wrong: f'{wrong}'[:40])
def test_an_adhesion_that_cannot_be_is_not_used(wrong: dict[str, Any]) -> None:
    names = (field.name for field in fields(SLIDE))
    estimate: Any = SimpleNamespace(**({name: getattr(SLIDE, name) for name in names} | wrong))
    one = adhesion_after(estimate)
    assert one.value()[:3] == (RAIL, RAIL_STD, False)
    assert one.value()[3].endswith(' not possible')
    assert one.limit() is None
    # What was refused may have been a slide.
    one.take_new(Status.VALID, PASSED, 0.2, 1)
    assert one.limit() == OF_SLIDE


def test_an_adhesion_of_no_rail_is_not_used() -> None:
    one = adhesion_after(SLIDE, replace(DRY, adhesion=50.0))
    assert one.value()[3] == 'dry to wet rail: adhesion = 50 is more than any rail has'
    assert one.limit() == OF_SLIDE


def test_a_status_that_is_not_fit_to_use_gives_usual_rails_but_keeps_the_limit() -> None:
    one = adhesion_after(SLIDE, status=Status.CONVERGING)
    assert one.value() == (RAIL, RAIL_STD, False, 'dry to wet rail: CONVERGING, not fit to use')
    assert one.limit() == OF_SLIDE

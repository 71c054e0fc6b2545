# SPDX-License-Identifier: Apache-2.0
"""The adhesion in answers of the client: its value, and the limit that a slide puts on bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from test.client.test_train_model import FILE, Drive
from trainid_ros.client import TrainModel
from trainid_ros.interface.results import AdhesionEstimate, Output, Status
from trainid_ros.stream.adhesion import RAIL

DRY = AdhesionEstimate(0.05, 0.09, 0.20, 0.06, 0.0, slipping=False, slip_share=0.0)
SLIDE = AdhesionEstimate(0.05, 0.0, 0.05, 0.01, -0.12, slipping=True, slip_share=0.1)


def drive_with(*estimates: AdhesionEstimate, status: Status = Status.VALID) -> Drive:
    drive = Drive()
    drive.on(60.0)
    for estimate in estimates:
        drive.on(0.2)
        drive.model.take(Output(round(drive.now * 1e9), estimate, status, 1, 0, None))
    return drive


def test_the_adhesion_is_live_or_that_of_usual_rails() -> None:
    assert TrainModel(None, FILE).adhesion().value == RAIL
    drive = drive_with(SLIDE)
    value = drive.model.adhesion()
    assert (value.value, value.std, value.live, value.reason) == (0.05, 0.01, True, 'VALID')
    drive.now += 2.0
    value = drive.model.adhesion()
    assert (value.value, value.live) == (RAIL, False)
    assert 'no new estimate' in value.reason


def test_a_bound_relies_on_no_more_than_the_adhesion_of_a_slide() -> None:
    before, after = drive_with(DRY).model.stopping_distance(20.0), drive_with(SLIDE).model.stopping_distance(20.0)
    least = 0.05 * math.exp(-1.645 * 0.2)
    # The resistance of the train helps the brake.
    longest = 20.0**2 / (2.0 * least * 9.81 / 1.1) + 20.0 * 1.5
    assert 0.7 * longest < after.value < longest
    assert after.value > 2.0 * before.value
    assert 'limited to an adhesion of 0.036 by a slide' in after.reason
    assert 'adhesion' not in before.reason


def test_the_limit_ends_with_the_last_km_and_stays_while_nothing_comes() -> None:
    past = replace(SLIDE, slipping=False, slip=0.0)
    drive = drive_with(SLIDE, past)
    limited = drive.model.stopping_distance(20.0).value
    drive.on(5.0)
    assert drive.model.stopping_distance(20.0).value == pytest.approx(limited, rel=1e-3)
    drive.model.take(Output(round(drive.now * 1e9) + 1, DRY, Status.VALID, 1, 0, None))
    assert drive.model.stopping_distance(20.0).value < 0.6 * limited


def test_slip_under_traction_does_not_limit_the_brake() -> None:
    slip = replace(SLIDE, slip=0.2)
    assert drive_with(slip).model.stopping_distance(20.0) == drive_with(DRY).model.stopping_distance(20.0)


@pytest.mark.parametrize('wrong', [{'adhesion': 0.0}, {'adhesion_std': -1.0}, {'adhesion': math.nan}])
def test_an_adhesion_that_cannot_be_is_not_used(wrong: dict[str, Any]) -> None:
    value = drive_with(replace(SLIDE, **wrong)).model.adhesion()
    assert (value.value, value.live) == (RAIL, False)
    assert 'not possible' in value.reason


def test_a_status_that_is_not_fit_to_use_gives_usual_rails_but_keeps_the_limit() -> None:
    model = drive_with(SLIDE, status=Status.CONVERGING).model
    assert model.adhesion().live is False
    assert 'slide' in model.stopping_distance(20.0).reason

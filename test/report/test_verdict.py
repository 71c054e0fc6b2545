# SPDX-License-Identifier: Apache-2.0
"""The verdict says how far a drive can be used, the main reason, and what to do next."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from test.report.conftest import BRAKE, MODEL, RESISTANCE, output
from trainid_ros.bag.bag_replay import Replay, Result
from trainid_ros.estimators.pipeline import Consistency, ConsistencyVerdict
from trainid_ros.interface.results import AdhesionEstimate, Output, Reason, Status
from trainid_ros.report.verdict import Level, Verdict, estimate_rows, judge
from trainid_ros.stream.sample_stream import Contradiction

CONSISTENT = Consistency(ConsistencyVerdict.CONSISTENT, 1.0, 0.8, 1.3, 200, 0)
ADHESION = AdhesionEstimate(0.02, 0.05, 0.2, 0.066, 0.0, slipping=False, slip_share=0.0)
WRONG_SIGN = 'ato/force has the wrong sign'


def result(estimate: Any, status: Status, **options: Any) -> Result[Any]:
    rejections = options.pop('rejections', ((Reason.BRAKING, 60),))
    return Result(estimate, output(100, estimate, status), 200, rejections, (), 0, CONSISTENT, **options)


def drive(*statuses: Status, contradiction: Contradiction | None = None, **options: Any) -> Replay:
    estimates = (RESISTANCE, MODEL, BRAKE)
    first, second, third = (result(e, status, **options) for e, status in zip(estimates, statuses, strict=True))
    adhesion = Output(1, ADHESION, Status.VALID, 1, 0, None)
    return Replay(1000, 40.0, first, second, third, adhesion, contradiction or Contradiction())


def verdict(outcome: Replay) -> Verdict:
    return judge(outcome, (None, None), 'day', 'train.yaml')


def test_a_drive_that_agrees_with_the_train_file_is_usable() -> None:
    found = verdict(drive(Status.VALID, Status.VALID, Status.HOLDING))
    assert found.level is Level.USABLE
    assert found.text == (
        'Usable: w at 10 m/s 1.90 ± 0.22 N/kN and brake rate 0.900 ± 0.050 agree with the train file. '
        'Next: go on with this train file.'
    )


def test_what_differs_from_the_train_file_is_to_be_explained() -> None:
    outcome = drive(Status.VALID, Status.VALID, Status.HOLDING)
    prior = replace(RESISTANCE, a=RESISTANCE.a - 1.0)
    found = verdict(replace(outcome, resistance=replace(outcome.resistance, prior=prior)))
    assert found.level is Level.USABLE
    assert 'differ from the train file by 4.5 and 0.0 std. Next: trainid explain day --train train.yaml' in found.text


def test_a_contradiction_that_lasts_comes_first() -> None:
    rejections = ((Reason.BRAKING, 120), (Reason.CONTRADICTION, 50))
    last = Contradiction(WRONG_SIGN, 12.0, math.nan, ('ato/force',))
    found = verdict(drive(*[Status.CONVERGING] * 3, contradiction=last, rejections=rejections))
    assert found.level is Level.NOT
    assert found.text.startswith(
        f'Not usable: inputs contradict each other since 12.0 s: {WRONG_SIGN} (25% of the samples left out). '
        'Next: correct what publishes ato/force,'
    )


def test_what_is_not_certain_yet_needs_a_longer_drive_and_what_failed_a_look_at_the_bag() -> None:
    texts = [verdict(drive(Status.VALID, status, Status.VALID)).text for status in (Status.CONVERGING, Status.FAULT)]
    assert [text.partition('Next: ')[2] for text in texts] == [
        'a longer drive tells the rest.', 'trainid info day shows what the bag holds.'
    ]  # fmt: skip


@pytest.mark.parametrize(('status', 'level'), [(Status.HOLDING, Level.CARE), (Status.CONVERGING, Level.PART)])
def test_one_that_is_over_is_named(status: Status, level: Level) -> None:
    last = Contradiction(WRONG_SIGN, 12.0, 20.0, ('ato/force',))
    found = verdict(drive(Status.VALID, Status.VALID, status, contradiction=last))
    assert found.level is level
    assert 'from 12.0 to 20.0 s' in found.text
    assert ('Usable in part, not brake rate: brake rate is CONVERGING' in found.text) == (level is Level.PART)


def test_a_brake_that_the_train_file_states_wrongly_is_to_be_fitted() -> None:
    outcome = replace(drive(Status.VALID, Status.VALID, Status.CONVERGING), brake_findings=('brake.delay is wrong',))
    assert verdict(outcome).text == (
        'Usable in part, not brake rate: brake.delay is wrong. '
        'Next: trainid fit --brake day --train train.yaml finds the brake.'
    )


@pytest.mark.parametrize('stated', [1.0, 1.012, 1.02])
def test_wheels_that_are_not_those_of_the_train_file_are_named(stated: float) -> None:
    outcome = drive(Status.VALID, Status.VALID, Status.HOLDING)
    found = verdict(replace(outcome, wheel_ratio=(1.02, 0.0002), stated_ratio=stated))
    wanted = 'wheel ratio 1.0200 ± 0.0002: state the effect wheel_diameter with ratio: 1.0200'
    assert (found.level is Level.CARE) == (wanted in found.text) == (stated == 1.0)
    wrong = replace(outcome, contradiction=Contradiction('ato/speed is in mph', 12.0, 20.0, ('ato/speed',)))
    assert 'wheel' not in verdict(replace(wrong, wheel_ratio=(1.02, 0.0002))).text
    assert verdict(replace(outcome, wheel_ratio=(1.3, 0.0002))).level is Level.USABLE
    unsure = verdict(replace(outcome, wheel_ratio=(1.02, 0.006)))
    assert unsure.level is Level.USABLE


def test_errors_larger_than_stated_need_care() -> None:
    outcome = drive(Status.VALID, Status.VALID, Status.VALID)
    optimistic = replace(CONSISTENT, verdict=ConsistencyVerdict.OPTIMISTIC, ratio=4.0)
    found = verdict(replace(outcome, brake_rate=replace(outcome.brake_rate, consistency=optimistic)))
    assert found.level is Level.CARE
    assert 'uncertainty of brake rate: predictions miss by 2.00 times the stated std' in found.text
    assert found.text.endswith('Next: trainid explain day --train train.yaml names what the train file lacks.')


def test_the_next_step_is_for_what_cannot_be_used() -> None:
    outcome, suggested = drive(Status.VALID, Status.VALID, Status.CONVERGING), SimpleNamespace(text='coast')
    unused = replace(outcome.brake_rate, output=Output(1, BRAKE, Status.CONVERGING, 0, 60, None))
    found = judge(replace(outcome, brake_rate=unused), (cast('Any', suggested), None), 'day', 'train.yaml')
    assert 'brake rate is CONVERGING, no sample was used (most often: braking)' in found.text
    assert found.text.endswith('Next: trainid info day shows what the bag holds.')
    assert judge(outcome, (None, cast('Any', suggested)), 'day', 'train.yaml').text.endswith('Next: coast.')


def test_without_a_sample_the_reason_is_the_most_frequent_rejection() -> None:
    outcome = drive(*[Status.UNINITIALIZED] * 3)
    nothing = Output(1, replace(RESISTANCE, speed_max=0.0), Status.UNINITIALIZED, 0, 60, None)
    found = verdict(replace(outcome, resistance=replace(outcome.resistance, output=nothing)))
    assert found.text.startswith('Not usable: nothing was learned of the resistance')
    assert 'BRAKING (60 times)' in found.text
    assert found.text.endswith('Next: trainid info day shows what the bag holds.')


def test_rows_hold_what_is_known() -> None:
    outcome = drive(*[Status.VALID] * 3)
    scaled = replace(RESISTANCE, force_scale=1.01, force_scale_std=0.01, force_delay=0.02, force_delay_std=0.01)
    names = []
    for estimate, adhesion in ((RESISTANCE, None), (scaled, outcome.adhesion)):
        rows = estimate_rows(output(1, estimate, Status.VALID), outcome.brake_rate.output, adhesion)
        names.append({row.name for row in rows})
    assert names[1] - names[0] == {'force scale', 'force delay', 'adhesion'}

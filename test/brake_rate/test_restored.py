# SPDX-License-Identifier: Apache-2.0
"""An invalid saved state of a drive is rejected with the name of the field, and the estimator is unchanged."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Journey = Callable[..., list[Sample]]


@pytest.fixture(scope='module')
def braked(journey: Journey) -> list[Sample]:
    return journey(
        12.0, brake=lambda t: 0.0 if t < 4.0 else -0.4, speed=25.0, resistance=lambda _: Davis(1.5, 0.03, 0.004)
    )


@pytest.mark.parametrize(
    ('path', 'wrong'),
    [
        (('unbraked_s',), -1e3),
        (('disturbance', 'variance'), -1.0),
        (('disturbance', 'candidates', 3, 'vv'), -1.0),
        (('noise', 'learned'), -1.0),
        (('noise', 'declared_std'), 0.0),
        (('gain',), 0.0),
        (('excess',), -1.0),
        (('excess',), 0.5),
        (('excess',), 1e3),
        (('blending',), -1.0),
        (('rejected_in_a_row',), -1),
        (('timing', 'delay'), -0.1),
        (('timing', 'delay'), math.nan),
        (('timing', 'lag'), -0.1),
        (('timing', 'delay_std'), -0.1),
        (('timing', 'lag_std'), -0.1),
        (('timing', 'slower'), 0.5),
        (('noise', 'last'), math.nan),
        (('innovation_variance',), -1.0),
        (('filtered_target',), 1e308),
        (('commands', 'changes', 0, 'target_acceleration'), 0.5),
        (('stamp_ns',), 10**40),
    ],
)
def test_an_invalid_saved_drive_state_is_rejected(
    train_file: TrainFile,
    braked: list[Sample],
    path: tuple[Any, ...],
    wrong: object,
    changed_state: Callable[[str, tuple[Any, ...], object], str],
) -> None:
    estimator = Gsma(train_file, GsmaConfig(), np.random.default_rng(3))
    for item in braked[:60]:
        estimator.step(item)
    before = estimator.save()
    with pytest.raises(InputError, match=path[0]):
        estimator.restore(changed_state(before, path, wrong))
    assert estimator.save() == before

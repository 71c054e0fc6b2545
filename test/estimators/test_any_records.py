# SPDX-License-Identifier: Apache-2.0
"""Whatever records arrive, a pipeline raises nothing and publishes finite numbers."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainid_ros.interface.records import NS_PER_S, Row
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.train.train_file import Davis, Train, TrainFile

START_NS = 1_700_000_000 * NS_PER_S
TRAIN = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001))
STAMPS = st.one_of(
    st.integers(START_NS, START_NS + 60 * NS_PER_S),
    st.integers(0, 2**31 * NS_PER_S),
    st.integers(START_NS // NS_PER_S, START_NS // NS_PER_S + 60).map(lambda s: s * NS_PER_S),
)
VALUES = st.one_of(st.floats(), st.floats(-30.0, 30.0), st.floats(-1e6, 1e6))
ROWS = st.tuples(st.integers(0, 4), STAMPS, VALUES, VALUES, st.booleans())
DRIVE: list[Row] = [
    (topic, START_NS + i * NS_PER_S // 5, x, 0.0, False)
    for i in range(50)
    for topic, x in ((1, 1e4), (2, -2.0), (3, 0.0), (0, 10.0 + 0.01 * i))
]


def numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float) else []


@pytest.mark.parametrize('make', [resistance_pipeline, speed_model_pipeline, brake_rate_pipeline])
@settings(deadline=None, max_examples=60)
@given(rows=st.lists(ROWS, max_size=60), at=st.integers(0, len(DRIVE)))
def test_no_record_raises_or_makes_a_number_infinite(make: Any, rows: list[Row], at: int) -> None:
    pipeline = make(TRAIN, EstimatorSettings())
    for row in [*DRIVE[:at], *rows, *DRIVE[at:]]:
        outputs: list[Any] = []
        pipeline.take(pipeline.stream.push_row(*row), outputs.append)
        for output in outputs:
            assert not any(math.isinf(number) for number in numbers(astuple(output.estimate)))

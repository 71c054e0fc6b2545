# SPDX-License-Identifier: Apache-2.0
"""What the workflow could have found, made by hand: for tests of what is printed and drawn of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.discrepancy.explanation import (
    Explanation,
    FoundEffect,
    Gap,
    Likeness,
    Location,
    NoiseSizes,
    Place,
    RunTrace,
    Verdict,
)
from trainid_ros.physics.train_file import Davis, Effect, Line, Train, TrainFile

BELIEVED = TrainFile(
    Train(mass=194e3),
    Davis(1.5, 0.02, 0.001),
    line=Line(stops=(0.0, 900.0), curve=((0.0, 0.0), (100.0, 400.0), (200.0, 0.0)), tunnel=((600.0, 700.0),)),
)
DRAG = FoundEffect(
    name='local_drag',
    title='drag at one place',
    equation='w = permille between start and end',
    origin='physics',
    parameters=(('start', 300.0), ('end', 500.0), ('permille', 1.5)),
    std=(('start', 12.0), ('end', 9.0), ('permille', 0.05)),
    evidence=48.0,
    where='position 300 to 500 m (+1.50 N/kN)',
    twins=(),
)
TWIN = Likeness('gradient_error', 'run <both> ways')
NAN = (math.nan, math.nan)


def trace(direction: int) -> RunTrace:
    time = np.arange(0.0, 60.0)
    position = 15.0 * time if direction > 0 else 900.0 - 15.0 * time
    gap = 0.3 * np.sin(time / 10.0)
    return RunTrace(0, direction, time, position, np.full(60, 15.0), gap, 0.1 * gap, np.full(60, 0.05))


@pytest.fixture(scope='session')
def believed() -> TrainFile:
    """Return the train file that the explanation is of."""
    return BELIEVED


@pytest.fixture(scope='session')
def make_explanation() -> Callable[..., Explanation]:
    """Return a function that makes an explanation by one effect, with other fields as wanted."""
    parts = tuple(
        Place(f'{100 * k} to {100 * k + 100} m', 100.0 * k, 100.0 * k + 100.0, 1.5 * (k in (3, 4)), 0.01, 0.1, 0.1)
        for k in range(9)
        if k != 6  # never driven
    )
    modes = tuple(Place(name, *NAN, 0.3, 0.1, 0.2, 0.5) for name in ('traction', 'coasting'))
    runs = tuple(Place(str(k), *NAN, 9.0, 9.0, 0.1, 0.1) for k in range(20))
    whole = Explanation(
        verdict=Verdict.EXPLAINED,
        effects=(DRAG,),
        gap=Gap(0.4, 0.05, 0.049, 2),
        remaining='What is left is noise.',
        train_file=replace(
            BELIEVED, resistance=Davis(1.61, 0.02, 0.0011), effects=(Effect('local_drag', DRAG.parameters, DRAG.std),)
        ),
        davis_std=(0.12, 0.004, 0.0001),
        locations=(Location('position', 'm', parts), Location('mode', '', modes), Location('run', '', runs)),
        traces=(trace(1), trace(-1)),
        noise=NoiseSizes(0.02, 0.1, 4.0, 0.003, 0.002, 0.1),
        outliers=0.012,
        weighed=True,
        gradient_point=None,
    )

    def make(*, ambiguous: bool = False, **changes: Any) -> Explanation:
        if ambiguous:
            changes = {'verdict': Verdict.AMBIGUOUS, 'effects': (replace(DRAG, twins=(TWIN,)),), **changes}
        return replace(whole, **changes)

    return make

# SPDX-License-Identifier: Apache-2.0
"""Text for parts of the data: every axis has its own phrase, and none repeats the name of the axis."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.gap_location import locate
from trainid_ros.explain.model import Model
from trainid_ros.explain.phrases import place_text
from trainid_ros.train.train_file import TrainFile


@pytest.mark.parametrize(
    ('axis', 'label', 'text'),
    [
        ('tunnel', 'tunnel', 'in tunnels'),
        ('mode', 'just released', 'just after the brake is released'),
        ('direction', 'rising', 'towards rising positions'),
        ('position, falling', '300 to 400 m', 'at 300 to 400 m towards falling positions'),
        ('speed', '10 to 12 m/s', 'at speeds of 10 to 12 m/s'),
        ('run', '3', 'run 3'),
    ],
)
def test_phrases(axis: str, label: str, text: str) -> None:
    assert place_text(axis, label) == text


def test_every_located_part_has_a_phrase(maker: Any, train_file: TrainFile) -> None:
    runs = []
    for run in maker().runs(2, 3):
        inside = (run.position > 300.0) & (run.position < 600.0)
        runs.append(replace(run, tunnel=inside.astype(float), radius=300.0 * inside, heat=np.cumsum(-run.brake)))
    model = Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file)
    hyper, _ = model.evidence().maximise()
    locations = locate(model, model, hyper)
    assert {'position, rising', 'speed', 'mode', 'direction', 'tunnel', 'curve', 'heat of the brake'} <= {
        location.axis for location in locations
    }
    for location in locations:
        for place in location.places:
            if location.axis != 'run':
                assert place_text(location.axis, place.label) != f'{location.axis} {place.label}'

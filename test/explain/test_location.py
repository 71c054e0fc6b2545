# SPDX-License-Identifier: Apache-2.0
"""Where the gap is, and its parts as text."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.effects import EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters
from trainid_ros.explain.model import Model
from trainid_ros.explain.proof import locate
from trainid_ros.explain.result import place_text
from trainid_ros.train.train_file import TrainFile


def test_missing_resistance_is_located_at_the_effect(
    dragged_model: Model, dragged_sizes: tuple[Hyperparameters, object]
) -> None:
    model, (hyper, _) = dragged_model, dragged_sizes
    drag = EffectTerm('local_drag', {'start': 100.0, 'end': 350.0, 'permille': 2.5})
    locations = {one.axis: one for one in locate(model, model.with_terms((drag,)), hyper)}
    assert {'position, rising', 'position, falling', 'speed', 'mode', 'direction', 'run'} == locations.keys() - {
        'heat of the brake'
    }
    rising = locations['position, rising'].places
    strongest = max(rising, key=lambda place: place.before / place.std)
    assert strongest.high > 100.0
    assert strongest.low < 450.0
    assert strongest.before > 3.0 * strongest.std
    assert abs(strongest.after) < 0.5 * strongest.before
    for location in locations.values():
        # Parts are deviations from the mean of all parts.
        total = sum(place.share for place in location.places)
        assert sum(place.share * place.before for place in location.places) / total == pytest.approx(0.0, abs=1e-6)
    assert [place.label for place in locations['mode'].places] == ['traction', 'coasting', 'braking']


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
    model = Model.of(runs, train_file)
    hyper, _ = model.evidence().maximise()
    locations = locate(model, model, hyper)
    assert {'position, rising', 'speed', 'mode', 'direction', 'tunnel', 'curve', 'heat of the brake'} <= {
        location.axis for location in locations
    }
    for location in locations:
        for place in location.places:
            if location.axis != 'run':
                assert place_text(location.axis, place.label) != f'{location.axis} {place.label}'

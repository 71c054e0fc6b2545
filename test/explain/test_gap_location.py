# SPDX-License-Identifier: Apache-2.0
"""Missing resistance along axes: greatest where an effect is missing, near zero once it is added."""

from __future__ import annotations

import pytest

from trainid_ros.explain.gap_location import locate
from trainid_ros.explain.marginal_likelihood import Hyperparameters
from trainid_ros.explain.model import EffectTerm, Model


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

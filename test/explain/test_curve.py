# SPDX-License-Identifier: Apache-2.0
"""A missing force without a name: its variable, curve, function and effect file; nothing is learned from noise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Extra, Maker, evaluated, points
from trainid_ros.explain.curve import FORMS, Form, Function, learn, scored
from trainid_ros.explain.dataset import Run
from trainid_ros.explain.likelihood import Information
from trainid_ros.explain.model import Model
from trainid_ros.explain.proof import read_gap
from trainid_ros.explain.result import Learned
from trainid_ros.explain.search import State
from trainid_ros.train.effects import FOLDERS_VARIABLE, resistance_terms
from trainid_ros.train.train_file import dump_train_file, parse_train_file


def hunting(_: float, v: float, __: int) -> float:
    return 4.0 * math.exp(-(((v - 10.0) / 1.5) ** 2))


def wave(position: float, _: float, __: int) -> float:
    return 2.0 * math.sin(2.0 * math.pi * position / 200.0)


def kink(_: float, v: float, __: int) -> float:
    return 0.9 * max(0.0, v - 9.0)


def learned_from(runs: list[Run]) -> Learned | None:
    model = Model.of(runs, TRAIN)
    return learn(State(model, *model.evidence().maximise()), model, read_gap(model), 'by a test')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('extra', 'name', 'term', 'shape'),
    [(hunting, 'speed', 'exp(-(((x - ', 10.0), (wave, 'place', 'sin(', 0.0314), (kink, 'speed', 'max(0.0, x - ', 9.0)],
)
def test_variable_and_function_are_found_and_confirmed(extra: Extra, name: str, term: str, shape: float) -> None:
    found = learned_from(Maker().runs(8, 43, extra))
    assert found is not None
    assert found.name == name
    assert found.is_confirmed
    assert found.gap is not None
    assert found.gap.after < 0.5 * found.gap.before
    assert term in found.function
    assert float(found.function.split(term)[1].split()[0].rstrip(')')) == pytest.approx(shape, rel=0.1)


@pytest.mark.slow
def test_the_band_holds_the_missing_resistance() -> None:
    found = learned_from(Maker().runs(8, 43, hunting))
    assert found is not None
    true = np.array([hunting(0.0, v, 1) for v in found.x.tolist()])
    inside = (found.x > 3.0) & (found.x < 13.0)  # m/s, where the train has been for long
    off = (found.value - true)[inside]
    assert np.ptp(true[inside]) > 3.0
    assert np.all(np.abs(off - off.mean()) < 4.0 * found.std[inside])


@pytest.mark.slow
def test_the_file_written_is_an_effect_with_the_resistance_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = Maker().runs(8, 43, hunting)
    found = learned_from(runs)
    assert found is not None
    assert found.train_file is not None
    assert found.gap is not None
    (tmp_path / f'{found.effect}.py').write_text(found.source, encoding='utf-8')
    monkeypatch.setenv(FOLDERS_VARIABLE, str(tmp_path))
    file = parse_train_file(dump_train_file(found.train_file), 'learned')
    (effect,) = file.effects
    assert (effect.name, effect.parameters, effect.provenance) == ('learned_speed', (('share', 1.0),), 'by a test')
    (term,) = resistance_terms(file.effects)
    for point in points(Model.of(runs[:1], TRAIN)):
        x = min(max(point.speed, found.x[0]), found.x[-1])
        assert term(TRAIN.resistance, point) == pytest.approx(evaluated(found.function, x=x), abs=1e-9)
    # It leaves no more than a train file that lacks nothing.
    model = Model.of(runs, file)
    assert np.sqrt(np.mean(np.square(read_gap(model)))) < 1.3 * found.gap.noise_floor


@pytest.mark.slow
def test_nothing_is_learned_from_noise() -> None:
    assert learned_from(Maker().runs(8, 41)) is None


@pytest.mark.slow
def test_what_a_single_run_shows_is_not_confirmed() -> None:
    odd, plain = Maker().runs(8, 44, hunting), Maker().runs(8, 44)
    found = learned_from([*plain[:3], odd[3], *plain[4:]])
    assert found is None or not (found.is_confirmed or found.effect or found.source or found.train_file)


@pytest.mark.parametrize('form', FORMS, ids=lambda form: form.terms[0])
@pytest.mark.parametrize('level', [False, True])
def test_the_text_of_a_function_has_its_values(form: Form, *, level: bool) -> None:
    knots = np.linspace(-3.0, 20.0, 24)
    shape = [*form.shapes(knots)][-1]
    terms = len(form.terms) + level
    size = np.array([1.5, -0.25, 3.0])[:terms]
    function = Function(form, shape, level, np.ones(terms), knots, np.eye(24))
    x = np.linspace(-2.9, 19.9, 11)
    values = [evaluated(function.text(size), x=value) for value in x.tolist()]
    assert values == pytest.approx(function.at(x) @ size, abs=1e-3)


@pytest.mark.parametrize('form', [form for form in FORMS if form.free and 'x >=' not in form.terms[0]])
def test_a_shape_without_width_is_no_function(form: Form) -> None:
    knots = np.linspace(0.0, 20.0, 24)
    found = Information(np.eye(24), np.ones(24), 1.0, 0.0)
    value, size = scored(form, level=True, knots=knots, found=found, count=100, shape=(0.0, 0.0))
    assert not math.isnan(value)
    assert np.isfinite(size).all()


def test_a_bump_between_two_knots_is_no_function() -> None:
    """Nothing of it is known, so its size would have no limit."""
    bump, knots = next(form for form in FORMS if 'exp(-((' in form.terms[0]), np.linspace(0.0, 23.0, 24)
    found = Information(np.eye(24), np.ones(24), 1.0, 0.0)
    narrow, wide = (scored(bump, (5.5, q), level=False, knots=knots, found=found, count=100) for q in (0.02, 0.5))
    assert narrow[0] == -math.inf
    assert wide[0] > -math.inf

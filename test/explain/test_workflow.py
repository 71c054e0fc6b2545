# SPDX-License-Identifier: Apache-2.0
"""The complete workflow: a case of each verdict, a user effect, poor data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from benchmarks import hidden_cases
from benchmarks.explain import runs_of
from benchmarks.hidden_cases_c import make_case
from test.explain.made_runs import TRAIN, Maker, drag
from trainid_ros.explain.dataset import Run, numbered
from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.explain.search import CERTAIN
from trainid_ros.explain.workflow import explain
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.report import words
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis, parse_train_file

# Categories have no edges; without runs to hold out there is no gap.
UNKNOWN = {'locations[].places[].low', 'locations[].places[].high'}
UNKNOWN_OF_ONE_RUN = UNKNOWN | {'traces[].before', 'traces[].after', 'traces[].band'}


def hunting(_: float, v: float, _direction: int) -> float:
    return 4.0 * math.exp(-(((v - 10.0) / 1.5) ** 2))


def not_finite(value: Any, path: str = '') -> Iterator[str]:
    """Yield the paths of values that are not finite."""
    if isinstance(value, np.ndarray):
        if not np.isfinite(value).all():
            yield path
    elif is_dataclass(value):
        for item in fields(value):
            yield from not_finite(getattr(value, item.name), f'{path}.{item.name}'.lstrip('.'))
    elif isinstance(value, tuple):
        for part in value:
            yield from not_finite(part, f'{path}[]')
    elif isinstance(value, float) and not math.isfinite(value):
        yield path


def names(reported: Explanation) -> list[str]:
    return [effect.name for effect in reported.effects]


def test_no_gap() -> None:
    steps: list[str] = []
    reported = explain(Maker().runs(4, 41), TRAIN, advance=steps.append)
    assert (reported.verdict, reported.effects, reported.train_file.effects) == (Verdict.NO_GAP, (), ())
    assert reported.gap is not None
    assert reported.gap.fitted_before == reported.gap.fitted_after
    assert max(reported.gap.before, reported.gap.after) < 1.3 * reported.gap.noise_floor
    assert abs(reported.train_file.resistance.a - TRAIN.resistance.a) < 4.0 * reported.davis_std[0]
    assert reported.davis_distance < 3.8
    assert reported.remaining.startswith('What is left is noise')
    assert len(reported.traces) == 4
    assert {'noise', 'held-out runs', 'places'} <= set(steps)
    assert set(not_finite(reported)) <= UNKNOWN


def test_a_dependence_that_leaves_no_more_than_noise_is_no_gap() -> None:
    """Brakes of trains that blend are not exactly as the train file says, but that is within the noise."""
    case = make_case('none', 13000490042)
    train_file = parse_train_file(case.train_yaml, 'made')
    reported = explain(runs_of(case.bags, train_file), train_file)
    assert (reported.verdict, reported.effects, reported.learned) == (Verdict.NO_GAP, (), None)
    assert reported.remaining.startswith('The gap is near what a correct train file leaves.')
    assert 'depends on the time since the brake was applied' in reported.remaining
    assert reported.gap is not None
    assert reported.gap.before < 1.2 * reported.gap.noise_floor


def test_what_passes_for_strong_gusts_stays_unexplained() -> None:
    """The drag of a wavy line raises the noise that is fitted, and so the noise floor, up to the gap."""
    case = hidden_cases.make_case('wavy_drag', 13000490368)
    train_file = parse_train_file(case.train_yaml, 'made')
    reported = explain(runs_of(case.bags, train_file), train_file)
    assert reported.gap is not None
    assert reported.gap.before < 1.2 * reported.gap.noise_floor
    assert reported.verdict is Verdict.UNEXPLAINED
    assert reported.learned is not None
    assert reported.learned.name == 'place'


@pytest.mark.slow
def test_another_davis_a_is_no_effect_but_a_finding() -> None:
    (run, back), more = Maker().runs(2, 41, lambda *_: 0.6), Maker().runs(4, 41, lambda *_: 0.6)
    assert run.direction != back.direction
    for runs in ([run, more[2]], more):  # in one direction, and in both
        reported = explain(runs, TRAIN)
        assert reported.verdict is Verdict.NO_GAP
        assert reported.davis_distance > 3.8
        assert davis(reported.davis, 10.0) - davis(TRAIN.resistance, 10.0) == pytest.approx(
            0.6, abs=0.15
        )  # the prior draws it back


@pytest.mark.slow
def test_effect_is_named_added_and_validated(dragged: list[Run]) -> None:
    reported = explain(dragged, TRAIN, provenance='by a test')
    assert reported.verdict in {Verdict.EXPLAINED, Verdict.AMBIGUOUS}
    assert names(reported) == ['local_drag']
    (effect,) = reported.effects
    assert effect.evidence > 15.0
    assert 'position' in effect.where
    for name, true in (('start', 100.0), ('end', 350.0), ('permille', 2.5)):
        assert abs(dict(effect.parameters)[name] - true) < 3.5 * dict(effect.std)[name] + 0.01 * true
    assert reported.gap is not None
    assert reported.gap.after < 0.6 * reported.gap.before
    (added,) = reported.train_file.effects
    assert (added.name, added.parameters, added.provenance) == ('local_drag', effect.parameters, 'by a test')
    assert not set(not_finite(reported)) - UNKNOWN
    # The resulting train file is a valid input.
    again = explain(dragged, reported.train_file)
    assert again.verdict is Verdict.NO_GAP
    assert again.train_file.effects == reported.train_file.effects


@pytest.mark.slow
def test_gap_that_no_effect_fits_is_unexplained() -> None:
    reported = explain(Maker().runs(8, 43, hunting), TRAIN)
    assert (reported.verdict, reported.effects, reported.train_file.effects) == (Verdict.UNEXPLAINED, (), ())
    assert 'speed, and no effect of the library fits' in reported.remaining
    assert not set(not_finite(reported)) - UNKNOWN


def wave(position: float, _: float, __: int) -> float:
    return 2.5 * math.sin(2.0 * math.pi * position / 600.0)


@pytest.mark.slow
def test_a_curve_replaces_effects_that_only_say_where() -> None:
    """Three sections with a drag fit a wave along the line, but worse than the wave."""
    reported = explain(Maker().runs(8, 43, wave), TRAIN)
    assert (reported.verdict, reported.effects, reported.train_file.effects) == (Verdict.UNEXPLAINED, (), ())
    assert reported.learned is not None
    assert (reported.learned.name, reported.learned.is_confirmed) == ('place', True)
    assert 'depends on the place' in reported.remaining
    assert dict(reported.probabilities)['other'] > 0.79


@pytest.mark.slow
@pytest.mark.parametrize('permille', [0.1, 0.25, 0.5])
def test_an_effect_is_named_if_it_is_certain(permille: float) -> None:
    reported = explain(Maker().runs(6, 46, drag(permille)), TRAIN)
    shares = dict(reported.probabilities)
    missing = 1.0 - shares.get('none', 0.0) - shares.get('other', 0.0)
    assert bool(reported.effects) == (missing >= CERTAIN)


def of_sizes(*sizes: float) -> list[Run]:
    """Return runs, each with a further resistance [N/kN]."""
    made = {size: Maker().runs(len(sizes), 44, lambda *_, size=size: size) for size in set(sizes)}
    return numbered(made[size][k] for k, size in enumerate(sizes))


@pytest.mark.slow
def test_an_effect_of_some_runs_is_told_with_them() -> None:
    """Rain on two of eight runs."""
    reported = explain(of_sizes(0.0, 0.0, 3.0, 0.0, 0.0, 3.0, 0.0, 0.0), TRAIN)
    (found,) = reported.effects
    assert (reported.verdict, found.name, found.runs) == (Verdict.EXPLAINED, 'run_drag', (3, 6))
    assert dict(found.parameters)['size'] == pytest.approx(3.0, abs=3.0 * dict(found.std)['size'])
    assert words.parameters_text(found).endswith('N/kN, on runs 3 and 6 only')
    assert reported.train_file.effects[0].runs == (3, 6)
    assert reported.gap is not None
    assert reported.gap.after < 0.5 * reported.gap.before


@pytest.mark.slow
def test_runs_of_which_each_has_another_resistance_are_named() -> None:
    """No effect acts on some runs only."""
    reported = explain(of_sizes(0.0, 0.0, 1.5, 0.0, 0.0, -1.5, 0.0, 0.0), TRAIN)
    assert reported.verdict is Verdict.UNEXPLAINED
    assert 'depends on the run' in reported.remaining
    assert reported.learned is not None
    assert (reported.learned.name, reported.learned.gap, reported.learned.is_confirmed) == ('run', None, False)
    assert 'It is that of 2 runs: 3 (+' in reported.remaining
    assert ', 6 (-' in reported.remaining
    # What no effect explains bends a, b, c of the fit; they are not written.
    assert reported.train_file.resistance == TRAIN.resistance
    assert reported.gap is not None
    assert reported.gap.after == pytest.approx(reported.gap.before)


def windy(_: float, v: float, direction: int) -> float:
    air = v + 6.0 * direction
    return 0.003 * (air * abs(air) - v * v)


@pytest.mark.slow
def test_result_explains_the_data_for_a_wrong_initial_c() -> None:
    runs = Maker().runs(10, 47, windy)
    reported = explain(runs, replace(TRAIN, resistance=replace(TRAIN.resistance, c=0.0022)))
    assert names(reported) == ['headwind']
    assert abs(dict(reported.effects[0].parameters)['speed'] - 6.0) < 3.0 * dict(reported.effects[0].std)['speed']
    assert abs(reported.train_file.resistance.c - 0.003) < 3.0 * reported.davis_std[2]
    assert explain(runs, reported.train_file).verdict is Verdict.NO_GAP


@pytest.mark.slow
def test_effect_too_small_in_the_train_file_is_replaced() -> None:
    runs = Maker().runs(10, 48, windy)
    reported = explain(runs, replace(TRAIN, effects=parse_effects(['headwind:speed=2'])))
    assert names(reported) == [effect.name for effect in reported.train_file.effects] == ['headwind']
    assert abs(dict(reported.effects[0].parameters)['speed'] - 6.0) < 3.0 * dict(reported.effects[0].std)['speed']


@pytest.mark.slow
def test_many_runs_of_unequal_length() -> None:
    runs = [run for k in range(6) for run in Maker(coast_s=20.0 + 6.0 * k).runs(2, 60 + k, drag(2.5))]
    reported = explain(runs, TRAIN)
    assert names(reported) == ['local_drag']
    assert reported.gap is not None
    assert reported.gap.runs_held_out == 12


@pytest.mark.slow
def test_without_positions_no_place_is_reported(dragged: list[Run]) -> None:
    reported = explain([replace(run, positioned=False) for run in dragged], TRAIN)
    assert not {'local_drag', 'gradient_error'} & set(names(reported))
    assert 'position' not in ' '.join(location.axis for location in reported.locations)


@pytest.mark.slow
def test_user_effect_is_found(user_effect: Callable[[str, str, str], None]) -> None:
    resistance = "p['value'] * math.exp(-(((at.speed - 10.0) / 1.5) ** 2))"
    user_effect('resonance', "{'value': Parameter('N/kN', 0.0, 20.0)}", resistance)
    reported = explain(Maker().runs(8, 43, hunting), TRAIN)
    assert names(reported) == ['resonance']
    (effect,) = reported.effects
    assert abs(dict(effect.parameters)['value'] - 4.0) < 3.0 * dict(effect.std)['value']
    assert reported.gap is not None
    assert reported.gap.after < reported.gap.before
    assert reported.train_file.effects[0].name == 'resonance'


def cut(run: Run, count: int) -> Run:
    values: dict[str, Any] = {name: getattr(run, name) for name in run.__slots__}
    return replace(run, **{name: value[:count] for name, value in values.items() if hasattr(value, 'dtype')})


def test_too_little_motion_is_an_error() -> None:
    for runs in ([], [cut(run, 3) for run in Maker().runs(6, 44)]):
        with pytest.raises(NoAnswerError, match='too little motion'):
            explain(runs, TRAIN)


def without_position(run: Run) -> Run:
    return replace(run, position=run.distance_run, positioned=False, stops=(math.nan, math.nan))


def at_constant_speed(run: Run) -> Run:
    """Return a run without information: constant force, place and speed, without braking."""
    one, zero = np.ones(run.time.size), np.zeros(run.time.size)
    return replace(run, speed=10.0 * one, traction=2.0 * one, brake=zero, position=100.0 * one, gradient=zero)


SPOILT: dict[str, Callable[[list[Run]], list[Run]]] = {
    'one run': lambda runs: runs[:1],
    'two runs': lambda runs: runs[:2],
    'without position': lambda runs: [without_position(run) for run in runs],
    'at constant speed': lambda runs: [at_constant_speed(run) for run in runs],
    'without brake': lambda runs: [cut(run, int(np.argmax(run.brake < 0.0))) for run in runs],
    'without traction': lambda runs: [replace(run, traction=np.zeros(run.time.size)) for run in runs],
    'very short runs': lambda runs: [*runs[:2], cut(runs[2], 1), cut(runs[3], 2)],
    'in whole km/h': lambda runs: [replace(run, speed=np.round(run.speed * 3.6) / 3.6) for run in runs],
}


@pytest.mark.slow
@pytest.mark.parametrize('how', SPOILT)
def test_poor_data_give_finite_values(how: str) -> None:
    reported = explain(SPOILT[how](Maker().runs(6, 45)), TRAIN)
    # A force that was not measured is a gap that no named effect fits.
    fits = (Verdict.NO_GAP, Verdict.UNEXPLAINED) if how == 'without traction' else (Verdict.NO_GAP,)
    assert reported.verdict in fits
    assert reported.effects == ()
    assert not set(not_finite(reported)) - (UNKNOWN_OF_ONE_RUN if how == 'one run' else UNKNOWN)
    assert (reported.gap is None) == (how == 'one run')


@pytest.mark.slow
def test_one_run_explains_nothing_for_certain() -> None:
    (run,) = Maker().runs(1, 45)
    reported = explain([replace(run, traction=run.traction / 0.8)], TRAIN)
    assert names(reported) == ['traction_scale']
    assert (reported.verdict, reported.gap) == (Verdict.AMBIGUOUS, None)
    assert reported.remaining == 'No other run confirms it.'


@pytest.mark.slow
def test_unusual_train_files() -> None:
    runs = Maker().runs(4, 46)
    unusual: list[dict[str, Any]] = [
        {'resistance': Davis(0.0, 0.0, 0.0)},
        {'train': replace(TRAIN.train, length=1e-3)},
        {'train': replace(TRAIN.train, length=3000.0)},
        {'effects': parse_effects(['wheel_diameter:ratio=1.01', 'local_drag:start=0,end=9,permille=0'])},
    ]
    for changes in unusual:
        assert not set(not_finite(explain(runs, replace(TRAIN, **changes)))) - UNKNOWN


@pytest.mark.slow
def test_a_wrong_mass_is_also_all_forces_wrong_and_no_drive_tells() -> None:
    runs = [replace(run, traction=1.06 * run.traction, brake=1.06 * run.brake) for run in Maker().runs(8, 49)]
    reported = explain(runs, TRAIN)
    assert (reported.verdict, names(reported)) == (Verdict.EXPLAINED, ['mass_error'])
    ratio = dict(reported.effects[0].parameters)['ratio']
    (twin,) = reported.effects[0].twins
    assert twin.name == 'brake_scale+traction_scale'
    assert twin.drive == f'no drive does, as {1.0 / ratio:.3f} of both acts alike; weigh the train'


@pytest.mark.slow
def test_two_wrong_forces_are_not_told_from_a_wrong_mass() -> None:
    runs = [replace(run, traction=1.06 * run.traction, brake=0.9 * run.brake) for run in Maker().runs(8, 49)]
    reported = explain(runs, TRAIN)
    forces = {'mass_error', 'traction_scale', 'brake_scale'}
    assert reported.verdict is Verdict.AMBIGUOUS
    assert len(forces & set(names(reported))) == 2
    for effect in reported.effects:
        for twin in effect.twins:
            assert (twin.name in forces) == twin.drive.startswith('no drive does')

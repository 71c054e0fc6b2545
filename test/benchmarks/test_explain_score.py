# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.explain import (
    CRASHED,
    GENERATORS,
    Generator,
    Named,
    Outcome,
    Rate,
    Spec,
    acceptable,
    alarmed,
    both,
    causes,
    draw_specs,
    exact,
    gap_plot,
    generic,
    given_to_truth,
    parameter_errors,
    reliability,
    reported,
    rms,
    seconds_for_eight,
    tables_of,
    targets,
    visibility_plot,
    visible,
    within_std,
    within_two,
)
from benchmarks.hidden_case import Answer, HiddenEffect
from benchmarks.tables import Plot, as_markdown

WIND = HiddenEffect('headwind', (('speed', 5.0),), (), 60.0)
DRAG = HiddenEffect('local_drag', (), (), 40.0)
WAVE = HiddenEffect('wavy_drag', (), ('gradient_error',), 50.0)


def outcome_of(
    *hidden: HiddenEffect,
    kind: str = 'single',
    verdict: str = 'explained',
    found: tuple[Named, ...] = (),
    contamination: tuple[str, ...] = (),
) -> Outcome:
    seen = max((effect.visible for effect in hidden), default=0.0)
    answer = Answer(kind, hidden, seen, 0.05, False, contamination, ('metro',))
    probabilities = (('headwind', 0.75), ('none', 0.25))
    return Outcome(Spec('A', 'x', 1), answer, verdict, found, probabilities, (0.2, 0.06, 0.05), 'the speed', 6, 1.5)


def name(text: str, *twins: str, speed: float = 5.0, std: float = 1.0) -> Named:
    return Named(text, (('speed', speed),), (('speed', std),), 50.0, twins)


SLIP = name('wheel_slip')


def test_exact_requires_all_hidden_effects_and_no_other() -> None:
    assert exact(outcome_of(WIND, found=(name('headwind'),)))
    assert exact(outcome_of(WIND, verdict='ambiguous', found=(name('headwind', 'tunnel_drag'),)))
    assert not exact(outcome_of(WIND, found=(name('tunnel_drag', 'headwind'),)))
    assert not exact(outcome_of(WIND, found=(name('headwind'), name('mass_error'))))
    assert not exact(outcome_of(WIND, verdict='no_gap'))
    assert exact(outcome_of(WIND, DRAG, kind='pair', found=(name('local_drag'), name('headwind'))))


def test_within_two_accepts_at_most_two_reported_names() -> None:
    assert within_two(outcome_of(WIND, verdict='ambiguous', found=(name('tunnel_drag', 'headwind'),)))
    assert not within_two(outcome_of(WIND, verdict='ambiguous', found=(name('tunnel_drag', 'mass_error', 'headwind'),)))
    assert not within_two(outcome_of(WIND, found=(name('tunnel_drag'),)))
    assert not within_two(outcome_of(WIND, verdict='unexplained'))
    assert reported(outcome_of(WIND, found=(name('a', 'b'), name('b', 'a')))) == ('a', 'b')


def test_any_report_on_a_case_without_effect_is_a_false_alarm() -> None:
    assert not alarmed(outcome_of(kind='none', verdict='no_gap'))
    assert alarmed(outcome_of(kind='none', verdict='unexplained'))
    assert alarmed(outcome_of(kind='none', verdict='ambiguous', found=(name('headwind'),)))
    assert alarmed(outcome_of(kind='none', verdict=CRASHED))
    assert alarmed(outcome_of(kind='none', found=(SLIP,)))


def test_slip_that_contaminates_the_data_may_be_named() -> None:
    spoiled = ('slip',)
    assert not alarmed(outcome_of(kind='none', found=(SLIP,), contamination=spoiled))
    assert alarmed(outcome_of(kind='none', found=(SLIP, name('headwind')), contamination=spoiled))
    assert alarmed(outcome_of(kind='none', verdict='unexplained', found=(SLIP,), contamination=spoiled))
    assert exact(outcome_of(WIND, found=(SLIP, name('headwind')), contamination=spoiled))
    assert exact(outcome_of(WIND, found=(name('headwind'),), contamination=spoiled))
    assert not exact(outcome_of(WIND, found=(SLIP, name('headwind'))))


def test_acceptable_names_outside_the_library() -> None:
    assert acceptable(outcome_of(WAVE, kind='outside', verdict='unexplained'))
    assert acceptable(outcome_of(WAVE, kind='outside', found=(name('local_drag'),)))
    near = outcome_of(WAVE, kind='outside', found=(name('gradient_error'),))
    assert acceptable(near)
    assert not generic(near)
    assert not acceptable(outcome_of(WAVE, kind='outside', found=(name('gradient_error'), name('headwind'))))
    assert not acceptable(outcome_of(WAVE, kind='outside', verdict='no_gap'))
    assert not acceptable(outcome_of(WAVE, kind='outside', verdict=CRASHED))


def test_pair_is_visible_if_each_effect_is() -> None:
    small = HiddenEffect('mass_error', (), (), 3.0)
    assert visible(outcome_of(WIND, DRAG, kind='pair'))
    assert not visible(outcome_of(WIND, small, kind='pair'))
    assert both(outcome_of(WIND, DRAG, kind='pair', found=(name('headwind'), name('local_drag'), name('mass_error'))))
    assert not both(outcome_of(WIND, DRAG, kind='pair', found=(name('headwind'),)))


def test_parameter_errors_are_in_units_of_their_std() -> None:
    errors = parameter_errors(outcome_of(WIND, found=(name('headwind', speed=8.0, std=2.0), name('mass_error'))))
    assert errors == (('headwind.speed', 1.5),)
    [(_, unknown)] = parameter_errors(outcome_of(WIND, found=(name('headwind', std=math.nan),)))
    assert math.isinf(unknown)
    twice = outcome_of(WIND, found=(name('headwind', speed=6.0), name('headwind', speed=9.0)))
    assert parameter_errors(twice) == (('headwind.speed', 1.0),)
    assert exact(twice)
    assert within_std([1.5, -2.5, math.inf, -0.2]).hits == 2
    assert rms([3.0, -4.0, math.inf]) == pytest.approx(math.sqrt(12.5))


def test_probabilities_are_compared_with_how_often_they_are_true() -> None:
    windy, draughty = outcome_of(WIND), outcome_of(DRAG)
    wavy = outcome_of(WAVE, kind='outside', contamination=('slip',))
    assert [causes(one) for one in (windy, wavy)] == [{'headwind'}, {'other', 'wheel_slip'}]
    assert causes(outcome_of(kind='none')) == {'none'}
    iron = HiddenEffect('iron_blocks', (), ('brake_slope',), 50.0)
    assert causes(outcome_of(iron, kind='outside')) == {'brake_slope'}
    assert [given_to_truth(one) for one in (windy, draughty)] == [0.75, 0.0]
    table = reliability([windy, draughty])
    assert table.rows == (('0.2 to 0.3', '2', '0.250', '0.000'), ('0.7 to 0.8', '2', '0.750', '0.500'))
    assert '0.38 in all 2 cases' in table.note
    assert reliability([outcome_of(WIND, DRAG, kind='pair')]).rows[-1] == ('0.7 to 0.8', '1', '0.750', '0.500')


def test_wilson_interval() -> None:
    assert Rate(45, 50).interval() == pytest.approx((0.786, 0.957), abs=0.001)
    assert Rate(0, 40).interval()[1] == pytest.approx(0.088, abs=0.001)
    assert Rate(0, 0).interval() == (0.0, 1.0)


def test_targets_are_judged_from_the_outcomes() -> None:
    right = [outcome_of(WIND, found=(name('headwind'),))] * 9
    wrong = [outcome_of(WIND, verdict='no_gap')]
    quiet = [outcome_of(kind='none', verdict='no_gap')] * 49
    table = targets([*right, *wrong, *quiet, outcome_of(kind='none', verdict='unexplained')], 'test')
    met = {row[0].split(',')[0]: row[-1] for row in table.rows}
    assert met['false alarms on no-effect cases'] == 'yes'
    assert met['exact name'] == 'yes'
    assert met['truth in a reported set of at most two'] == 'no'
    assert met['both of two'] == '-'
    # 0.06 / 0.05 is more than 1.1.
    assert met['gap after / noise floor'] == 'no'
    assert seconds_for_eight(right[0]) == pytest.approx(2.0)


def test_tables_contain_the_reported_effects() -> None:
    mixed = [
        outcome_of(WIND, found=(name('headwind', 'tunnel_drag'),), verdict='ambiguous', contamination=('outliers',)),
        outcome_of(kind='none', verdict='no_gap'),
        outcome_of(WAVE, kind='outside', verdict='unexplained'),
        outcome_of(WIND, DRAG, kind='pair', found=(name('headwind'),)),
        outcome_of(WIND, verdict=CRASHED),
    ]
    text = '\n'.join(as_markdown(table) for table in tables_of(mixed, 'test'))
    for part in ('headwind~tunnel_drag: 1', 'crashed: 1', 'wavy_drag', 'outliers', 'headwind.speed'):
        assert part in text


def drawn(plot: Plot) -> list[list[float]]:
    """Return the heights of the points of each series of a plot, once it is drawn."""
    plot.figure.savefig(io.BytesIO(), format='svg')
    (axes,) = plot.figure.axes
    bars: list[Any] = list(axes.containers)
    series = [bar.lines[0] for bar in bars] or axes.get_lines()[:2]
    return [np.asarray(line.get_ydata()).tolist() for line in series]


def test_plots_show_one_case_and_none() -> None:
    one = [outcome_of(WIND, found=(name('headwind'),))]
    assert (drawn(visibility_plot(one)), drawn(visibility_plot([]))) == ([[100.0], [100.0]], [[], []])
    assert (drawn(gap_plot(one)), drawn(gap_plot([]))) == ([[50.0], [50.0]], [[], []])


@pytest.mark.parametrize('generator', GENERATORS)
def test_no_case_is_drawn_twice(generator: Generator) -> None:
    assert len(set(draw_specs(generator, 3, 60))) == 60

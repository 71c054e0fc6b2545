# SPDX-License-Identifier: Apache-2.0
"""Text of an explanation: rounding, sentences for each verdict, and text where values are unknown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.explain.result import Explanation, Gap, Verdict
from trainid_ros.report import words
from trainid_ros.report.words import alternatives, drive_text, gap_sentence, headline, how_sure, parameters_text
from trainid_ros.train.effects import Twin
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Explanation]


@pytest.mark.parametrize(
    ('value', 'std', 'text'),
    [
        (1.8234, 0.0812, '1.823 ± 0.081'),
        (4519.437, 12.46, '4519 ± 12'),
        (0.010423, 0.000381, '0.01042 ± 0.00038'),
        (-2.0, 0.0, '-2'),
        (1.5, math.nan, '1.5'),
        (math.nan, 1.0, '–'),
        (1.0, 3e-9, '1 ± 3e-09'),
    ],
)
def test_values_are_rounded_by_their_std(value: float, std: float, text: str) -> None:
    assert words.plus_minus(value, std) == text


def test_enumerations() -> None:
    assert [words.join('abc'[:count]) for count in range(4)] == ['', 'a', 'a and b', 'a, b and c']


def test_each_verdict_has_its_headline(make_explanation: Make) -> None:
    assert headline(make_explanation()) == 'The current model lacks local_drag.'
    assert 'local_drag fits best, but gradient_error fits equally well' in headline(make_explanation(ambiguous=True))
    drag, wind = make_explanation().effects[0], replace(make_explanation().effects[0], name='headwind')
    assert headline(make_explanation(effects=(drag, wind, drag))).endswith('lacks local_drag twice and headwind.')
    assert headline(make_explanation(effects=(drag, drag, drag))).endswith('lacks local_drag three times.')
    both = tuple(replace(effect, twins=(Twin('gradient_error', ''),)) for effect in (drag, wind))
    ambiguous = make_explanation(verdict=Verdict.AMBIGUOUS, effects=both)
    assert 'local_drag and headwind fit best, but' in headline(ambiguous)
    assert 'no effect of the library fits' in headline(make_explanation(verdict=Verdict.UNEXPLAINED, effects=()))
    # Slip is reported whatever else is missing.
    assert 'lacks local_drag, and something that no' in headline(make_explanation(verdict=Verdict.UNEXPLAINED))
    assert 'lacks no effect' in headline(make_explanation(verdict=Verdict.NO_GAP, effects=()))


def test_effect_is_reported_with_units_and_evidence(make_explanation: Make) -> None:
    effect = make_explanation().effects[0]
    assert parameters_text(effect) == 'start = 300 ± 12 m, end = 500.0 ± 9.0 m and permille = 1.500 ± 0.050 per mille'
    # e^24 to one, and 1.5 over 0.05
    assert how_sure(effect).startswith('evidence 48: the data are more than a million times')
    assert how_sure(effect).endswith('; its amplitude is 30.0 std from zero effect')
    assert 'are 4e+02 times' in how_sure(replace(effect, evidence=12.0))
    unknown = replace(effect, name='snow')  # not in the library
    assert parameters_text(unknown).endswith('permille = 1.500 ± 0.050')
    assert 'std' not in how_sure(unknown)


def test_alternatives_name_the_test_run_that_distinguishes_them(make_explanation: Make) -> None:
    assert alternatives(make_explanation()) == []
    assert alternatives(make_explanation(ambiguous=True)) == [
        'local_drag could also be gradient_error. To distinguish them: run <both> ways.'
    ]
    twice = make_explanation(ambiguous=True, effects=make_explanation(ambiguous=True).effects * 2)
    assert len(alternatives(twice)) == 1


def test_gap_sentence(make_explanation: Make) -> None:
    text = gap_sentence(make_explanation())
    assert all(part in text for part in ('2 runs', '0.400 m/s (rms) without', '0.050 m/s with', '0.049 m/s'))
    assert 'above the noise' not in text
    assert '100% above the noise' in gap_sentence(make_explanation(gap=Gap(0.4, 0.1, 0.05, 2, 0.3, 0.1, 25.0)))
    assert 'with them' not in gap_sentence(make_explanation(effects=()))
    assert gap_sentence(make_explanation(gap=Gap(0.4, 0.1, 0.05, 1, 0.3, 0.1, 25.0))).startswith('On 1 run, ')
    assert 'too few runs' in gap_sentence(make_explanation(gap=None))


def test_parts_with_most_missing_resistance_and_table_rows(make_explanation: Make, stated: TrainFile) -> None:
    # Runs are not a cause, and parts within 3 std of zero are left out.
    assert words.strongest(make_explanation()) == [
        f'At {where} m: 1.50 ± 0.10 N/kN more resistance than modelled' for where in ('300 to 400', '400 to 500')
    ]
    assert words.davis_rows(make_explanation(), stated)[0] == ('a', '1.5', '1.61 ± 0.12', 'N/kN')
    rows = words.noise_rows(make_explanation())
    assert ('speeds excluded (slip, outliers)', '%', '1.2') in rows
    assert ('error of the weighed load', '% of the mass', '0.3') in rows
    assert any('not weighed)' in name for name, _, _ in words.noise_rows(make_explanation(weighed=False)))


def test_drive_text(make_explanation: Make) -> None:
    assert drive_text(make_explanation()) == '2 runs, 1.8 km in 2 min, both directions'
    one = make_explanation(traces=make_explanation().traces[:1])
    assert drive_text(one).startswith('1 run, ')
    assert drive_text(one).endswith('one direction only')
    assert 'at the front of the train' in drive_text(make_explanation(gradient_point='front'))
    assert drive_text(make_explanation(traces=())).startswith('0 runs, 0.0 km')

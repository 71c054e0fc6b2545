# SPDX-License-Identifier: Apache-2.0
"""Text of an explanation: rounding, sentences for each verdict, and text where values are unknown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from trainid_ros.explain.result import Explanation, Gap, Verdict
from trainid_ros.report import words
from trainid_ros.report.words import (
    alternatives,
    drive_text,
    gap_sentence,
    headline,
    how_sure,
    next_steps,
    parameters_text,
)
from trainid_ros.train.effects import Twin
from trainid_ros.train.train_file import Davis, TrainFile

Make = Callable[..., Explanation]


def test_enumerations() -> None:
    assert [words.join('abc'[:count]) for count in range(4)] == ['', 'a', 'a and b', 'a, b and c']


def test_each_verdict_has_its_headline_with_probabilities(make_explanation: Make) -> None:
    assert headline(make_explanation()) == 'The current model lacks local_drag (probability 97%).'
    ambiguous = 'local_drag (probability 97%) fits best, but it may be gradient_error (2%) instead.'
    assert headline(make_explanation(ambiguous=True)).endswith(ambiguous)
    alone = headline(make_explanation(verdict=Verdict.AMBIGUOUS))
    assert alone == 'The current model may lack local_drag (probability 97%), but no run is left to confirm it.'
    drag = make_explanation().effects[0]
    wind = replace(drag, name='headwind', probability=1.0)
    both = '(probability 97%) and headwind (>99%).'
    assert headline(make_explanation(effects=(drag, wind, drag))).endswith(f'lacks local_drag twice {both}')
    assert 'lacks local_drag three times (' in headline(make_explanation(effects=(drag, drag, drag)))
    pair = tuple(replace(effect, twins=(Twin('gradient_error', ''),)) for effect in (drag, wind))
    assert 'fit best, but it may be gradient_error (2%) instead' in headline(
        make_explanation(verdict=Verdict.AMBIGUOUS, effects=pair)
    )
    unknown = headline(make_explanation(verdict=Verdict.UNEXPLAINED, effects=(), other=0.96))
    assert unknown == 'The current model lacks something outside the library (probability 96%).'
    unsure = headline(make_explanation(verdict=Verdict.UNEXPLAINED, effects=(), other=0.01))
    assert unsure.endswith('something that the data do not confirm: local_drag fits best (probability 97%).')
    # Slip is reported whatever else is missing.
    assert 'lacks local_drag (probability 97%), and some' in headline(make_explanation(verdict=Verdict.UNEXPLAINED))
    none = make_explanation(verdict=Verdict.NO_GAP, effects=())
    assert headline(none).startswith(
        'The data do not tell whether an effect is missing (probability of none <1%, local_d'
    )
    none = replace(none, probabilities=(('none', 0.97), ('other', 0.03)))
    text = 'The data show no missing effect (probability that none is missing 97%)'
    assert headline(none) == f'{text}, but a, b and c that differ from the train file by 5.2 std.'
    assert headline(replace(none, davis_distance=3.0)) == f'{text}.'


def test_effect_is_reported_with_units_and_evidence(make_explanation: Make) -> None:
    effect = make_explanation().effects[0]
    assert parameters_text(effect) == 'start = 300 ± 12 m, end = 500.0 ± 9.0 m and permille = 1.500 ± 0.050 per mille'
    # e^24 to one, and 1.5 over 0.05
    assert how_sure(effect).startswith('evidence 48: the data are more than a million times')
    assert how_sure(effect).endswith('; its amplitude is 30.0 std from zero effect')
    assert 'are 400 times' in how_sure(replace(effect, evidence=12.0))
    unknown = replace(effect, name='snow')  # not in the library
    assert parameters_text(unknown).endswith('permille = 1.500 ± 0.050')


def test_alternatives_name_the_test_run_that_distinguishes_them(make_explanation: Make) -> None:
    assert alternatives(make_explanation()) == []
    assert alternatives(make_explanation(ambiguous=True)) == [
        'local_drag could also be gradient_error. To distinguish them: run <both> ways.'
    ]
    twice = make_explanation(ambiguous=True, effects=make_explanation(ambiguous=True).effects * 2)
    assert len(alternatives(twice)) == 1


def test_what_to_do_next_follows_from_verdict_and_probabilities(make_explanation: Make) -> None:
    assert ['Use the train file' in text for text in next_steps(make_explanation())] == [True]
    slip = make_explanation(effects=tuple(replace(one, name='wheel_slip') for one in make_explanation().effects))
    assert next_steps(slip)[0].endswith('no gap but that of slip.')
    lacks = 'The data should also contain 6 runs or more.'
    assert next_steps(make_explanation(ambiguous=True)) == [*alternatives(make_explanation(ambiguous=True)), lacks]
    kept = replace(make_explanation().train_file, resistance=Davis(1.0, 0.0, 0.0))  # a, b and c are not written
    shares = (('other', 0.94), ('headwind', 0.05), ('mass_error', 0.01))
    unexplained = make_explanation(verdict=Verdict.UNEXPLAINED, effects=(), train_file=kept, probabilities=shares)
    wind = 'Otherwise likeliest: headwind (5%). To see it: runs in both directions, at different speeds.'
    assert next_steps(unexplained) == next_steps(replace(unexplained, verdict=Verdict.NO_GAP)) == [wind, lacks]
    # What was found needs no other drive.
    slipping = replace(unexplained, effects=(replace(make_explanation().effects[0], name='headwind'),))
    assert 'mass_error (1%)' in next_steps(slipping)[0]
    certain = replace(unexplained, probabilities=(('none', 1.0),))
    assert next_steps(certain) == [lacks]
    fitted = replace(certain, train_file=replace(kept, resistance=certain.davis))
    assert next_steps(fitted) == ['Use the train file of --out, with a, b and c as fitted.', lacks]


def test_data_lack_what_would_make_an_answer_certain(make_explanation: Make, stated: TrainFile) -> None:
    made = make_explanation(verdict=Verdict.NO_GAP, effects=(), probabilities=(), weighed=False, train_file=stated)
    powered = replace(made.locations[1], places=made.locations[1].places[:1])
    texts = next_steps(replace(made, locations=(powered,)))
    assert texts == ['The data should also contain 6 runs or more, coasting and the weighed mass.']
    enough = replace(made, traces=made.traces * 3, weighed=True)
    assert next_steps(enough) == []
    assert next_steps(replace(enough, traces=made.traces[:1] * 6)) == ['The data should also contain both directions.']


def test_rejected_causes_are_compared_with_the_answer(make_explanation: Make) -> None:
    assert words.rejected_rows(make_explanation()) == [
        ('gradient_error', 'wrong gradient in the map', '2%', '39'),
        ('other', 'something outside the library', '<1%', '240'),
        ('none', 'nothing is missing', '<1%', '970'),
    ]
    # An alternative that fits as well is not rejected.
    assert [row[0] for row in words.rejected_rows(make_explanation(ambiguous=True))] == ['other', 'none']
    # What nothing explains is more likely than any effect, by a ratio that is not a number of fifteen digits.
    tiny = make_explanation(
        effects=(), verdict=Verdict.UNEXPLAINED, probabilities=(('other', 1.0), ('headwind', 1e-310))
    )
    assert words.rejected_rows(tiny) == [('headwind', 'wind along the line', '<1%', 'more than a million')]


def test_gap_sentence(make_explanation: Make) -> None:
    text = gap_sentence(make_explanation())
    both = 'differ by 0.400 m/s (rms) with the train file read and 0.050 m/s with the one written; a correct one'
    assert both in text
    assert text.endswith('would leave 0.049 m/s. The evidence of these runs for the effects is 25.')
    assert gap_sentence(make_explanation(effects=())).endswith('would leave 0.049 m/s.')
    same = gap_sentence(make_explanation(effects=(), gap=Gap(0.4, 0.4, 0.05, 1, 0.3, 0.3, 0.0)))
    assert same.endswith('0.400 m/s (rms) with the train file read; a correct one would leave 0.050 m/s.')
    assert same.startswith('On 1 run, ')
    assert 'too few runs' in gap_sentence(make_explanation(gap=None))
    noisy = make_explanation(gap=Gap(0.4, 0.4, 0.5, 8, 0.3, 0.3, 0.0), verdict=Verdict.UNEXPLAINED, effects=())
    assert gap_sentence(noisy).endswith('more than the gap, so these data cannot tell what is missing.')


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

# SPDX-License-Identifier: Apache-2.0
"""The report is one self-contained file, also for drives with little data; its scores are those calculated by hand."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test.report.conftest import TRUTH
from test.report.pages import check_page, colours_of_figures, no_layout, words
from test.report.test_verdict import ADHESION
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Output, Status
from trainid_ros.report.drive_report import (
    render_report,
    resistance_at,
    resistance_std,
    score_brake_rate,
    score_resistance,
    stop_errors,
    stop_sentences,
    write_report,
)
from trainid_ros.report.page import keep_room, styled_figure, to_svg
from trainid_ros.report.recording import CONTRADICTED, GAP, Recorder, Span
from trainid_ros.report.verdict import Level, Verdict
from trainid_ros.sim.truth import Truth

FIGURES = (
    'Running resistance and Davis parameters over time', 'Resistance curve against speed', 'Brake rate over time',
    'Speed profile with driving modes', 'Status of the estimators over time', 'Innovation test ratios over time',
    'Speed model over time', 'Errors of stops by one brake command',
)  # fmt: skip


BAD = '<img src=x onerror=alert(1)>&"'


@pytest.fixture(scope='module')
@no_layout()
def text(make_chapter: Callable[..., Any]) -> str:
    """Return a report of two chapters, the second with names that are markup."""
    hostile = replace(make_chapter(120), title=BAD, bag=BAD, train_file_name=BAD, how=BAD, notes=(BAD,))
    return render_report('Two <trials>', (make_chapter(240), hostile))


@pytest.mark.slow
def test_every_chapter_has_each_figure_once(text: str) -> None:
    for label in FIGURES:
        assert text.count(f'aria-label="{label}"') == 2
    assert text.count('<svg') == 2 * len(FIGURES)


@pytest.mark.slow
def test_page_is_whole_and_alone_and_text_is_escaped(text: str) -> None:
    assert {'table', 'svg', 'dl', 'nav'} <= check_page(text, 3_000_000)
    assert '<title>Two &lt;trials&gt;</title>' in text
    assert 'Trial &lt;1&gt;' in text


@pytest.mark.slow
def test_names_are_text_wherever_they_appear(text: str) -> None:
    assert '<img' not in text
    assert text.count('&lt;img src=x onerror=alert(1)&gt;&amp;') >= 5


@pytest.mark.slow
def test_numbers_of_the_table(text: str) -> None:
    cells = re.findall(r'<td[^>]*>(.*?)</td>', text)
    at = cells.index('w at 10 m/s (36 km/h)')
    # a + 10 b + 100 c = 1.9, std sqrt(0.0501); train file 1.7, truth 2.0
    assert cells[at + 1 : at + 8] == ['N/kN', '1.90', '0.22', '1.7', '2', '-0.1', '-0.4']
    braking = cells.index('braking')
    assert cells[braking + 1 : braking + 3] == ['60', '–']
    assert 'a note' in text


@pytest.mark.slow
@no_layout()
def test_the_verdict_comes_first_and_what_is_wrong_is_shaded(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(60)
    recording = chapter.recording
    faults = (Span(10.0, 30.0, CONTRADICTED), Span(30.0, 30.1, CONTRADICTED), Span(40.0, 50.0, GAP))
    resistance = replace(recording.resistance, faults=faults)
    slips = (ADHESION, replace(ADHESION, slipping=True), ADHESION)
    adhesion = replace(resistance, time_ns=np.array([0, 1, 2]) * NS_PER_S, estimates=slips, usable=np.ones(3, bool))
    chapter = replace(
        chapter,
        recording=replace(recording, resistance=resistance, adhesion=adhesion),
        adhesion=Output(1, ADHESION, Status.VALID, 1, 0, None),
        verdict=Verdict(Level.NOT, 'Not usable: <why>.'),
        certainty=('the uncertainty is right',),
    )
    text = render_report('r', (chapter,))
    assert text.index('<p class="verdict NOT">Not usable: &lt;why&gt;.</p>') < text.index('<dl>')
    # Resistance over time, and the drive.
    assert [text.count(f'>{name}</text>') for name in (CONTRADICTED, GAP, 'slip')] == [2, 2, 1]
    assert 'aria-label="Adhesion over time"' in text
    assert '<td class="text">1, at least 0.050</td>' in text
    assert 'the uncertainty is right' in text


@pytest.mark.slow
def test_figures_use_the_colours_of_the_page(text: str) -> None:
    assert {'ink', 'estimate', 'grid'} <= colours_of_figures(text)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('seconds', 'options', 'figures'),
    [
        (50, {'truth': None, 'braking': False}, 7),
        (120, {'truth': Truth(0, ((0.0, 1.5, 0.02, 0.001),))}, 7),
        (1, {}, 6),
    ],
    ids=['no truth and no braking', 'no true brake rate', 'one sample'],
)
def test_little_is_known(make_chapter: Callable[..., Any], seconds: int, options: dict[str, Any], figures: int) -> None:
    text = render_report('r', (make_chapter(seconds, **options),))
    assert text.count('<svg') == figures
    assert 'nan' not in words(text)
    has_truth = options.get('truth', TRUTH) is not None
    assert ('truth' in text, 'error / std' in text) == (has_truth, has_truth)


@pytest.mark.slow
def test_empty_traces_give_tables_without_figures(make_chapter: Callable[..., Any]) -> None:
    chapter = replace(make_chapter(30), recording=Recorder().finish())
    text = render_report('r', (chapter,))
    assert '<svg' not in text
    assert 'nan' not in words(text)


@pytest.mark.slow
def test_folders_are_created_and_write_errors_reported(make_chapter: Callable[..., Any], tmp_path: Path) -> None:
    chapters = (replace(make_chapter(30), recording=Recorder().finish()),)
    write_report('r', chapters, tmp_path / 'a' / 'b' / 'report.html')
    assert (tmp_path / 'a' / 'b' / 'report.html').read_text(encoding='utf-8') == render_report('r', chapters)
    (tmp_path / 'file').write_text('x', encoding='utf-8')
    with pytest.raises(InputError, match=r'file.*cannot be written'):
        write_report('r', chapters, tmp_path / 'file' / 'report.html')


def test_an_axis_does_not_magnify_what_is_no_difference() -> None:
    with styled_figure(1.0) as figure:
        axes = figure.subplots()
        for low, high, least, expected in ((3.757443, 3.757444, 0.1, 0.2), (3.0, 4.0, 0.1, 1.0)):
            axes.set_ylim(low, high)
            keep_room(axes, least)
            bottom, top = axes.get_ylim()
            assert top - bottom == pytest.approx(expected)
            assert bottom <= low < high <= top


def test_a_figure_is_the_same_each_time_and_its_label_no_markup() -> None:
    texts = []
    for _ in range(2):
        with styled_figure(1.0) as figure:
            figure.subplots().plot([0.0, 1.0])
            texts.append(to_svg(figure, 'Train T1" onclick="x'))
    assert texts[0] == texts[1]
    assert 'aria-label="Train T1&quot; onclick=&quot;x"' in texts[0]


def test_axes_show_values_and_not_what_to_add_to_them() -> None:
    with styled_figure(2.0) as figure:
        figure.subplots().plot([0.0, 1.0, 2.0], [1.0001, 1.0002, 1.0004])
        text = to_svg(figure, 'wheel ratio')
    assert '1.0002' in text
    assert '+1' not in text


def test_resistance_and_its_standard_deviation() -> None:
    theta = np.array([[1.0, 0.1, 0.01], [2.0, 0.0, 0.0]])
    np.testing.assert_allclose(resistance_at(theta, 10.0), [3.0, 2.0])
    P = np.array([[4.0, -0.1, 0.0], [-0.1, 0.01, 0.0], [0.0, 0.0, 1e-4]])
    # phi = (1, 10, 100): 4 - 2 * 10 * 0.1 + 100 * 0.01 + 10000 * 1e-4 = 4
    assert resistance_std(P, 10.0) == pytest.approx(2.0)
    assert resistance_std(np.diag([-1e-18, 0.0, 0.0]), 5.0) == 0.0  # negative by rounding


def test_scores_follow_steps_of_the_truth(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(120)
    score = score_resistance(chapter.recording, chapter.truth)
    assert score is not None
    # a = 1.6 throughout, truth 1.5 up to 60 s and 1.7 after; the first 20 s are not usable.
    assert score.outputs == 100
    assert score.bias == pytest.approx((40 * 0.1 - 60 * 0.1) / 100)
    assert score.rms == pytest.approx(0.1)
    assert score.last == pytest.approx(-0.1)
    # std of w at 10 m/s: sqrt(0.04 + 100 * 1e-4 + 1e4 * 1e-8) = 0.224
    assert score.inside_68 == 1.0


def test_coverage_is_the_share_inside_the_band(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(120)
    score = score_brake_rate(chapter.recording, chapter.truth)
    assert score is not None
    # Rate 0.9 with std 0.05: the truth is 1.0 (outside of both bands) for 40 s, then 0.9 for 60 s.
    assert score.inside_68 == score.inside_95 == pytest.approx(0.6)


def test_no_score_without_a_true_brake_rate_or_a_usable_output(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(15)
    assert score_resistance(chapter.recording, chapter.truth) is None
    assert score_brake_rate(make_chapter(120).recording, Truth(0, ((0.0, 1.0, 0.0, 0.0),))) is None


def test_modes_statuses_and_observability_are_spans(make_chapter: Callable[..., Any]) -> None:
    recording = make_chapter(240).recording
    modes = recording.modes
    assert [span.label for span in modes] == ['traction', 'coast', 'brake', 'standstill'] * 2
    assert all(first.end_s == second.start_s for first, second in pairwise(modes))
    assert [span.end_s - span.start_s for span in modes[:-1]] == [30.0] * 7
    assert [span.label for span in recording.resistance.statuses[:3]] == ['CONVERGING', 'VALID', 'HOLDING']
    assert [(span.start_s, span.end_s) for span in recording.observable] == [(60.0, 90.0), (180.0, 210.0)]
    assert recording.duration_s == 239.0


def test_stops_by_one_command_are_off_by_what_the_values_do_not_know(make_chapter: Callable[..., Any]) -> None:
    """The brake has dropped to .9 when the first braking begins; live values know that, and the second stop does."""
    chapter = make_chapter(240)
    time_s, errors = stop_errors(chapter.recording, chapter.truth, chapter.train_file)
    stated, last, live = errors.values()
    assert time_s.tolist() == [60.0, 180.0]
    # From 10 m/s a brake of .72 instead of .8 m/s^2 takes 7 m more, the resistance unchanged.
    assert stated == pytest.approx([7.0, 7.0], abs=1.0)
    assert last == pytest.approx([stated[0], -0.2], abs=0.3)
    assert live == pytest.approx([0.0, 0.0], abs=0.3)
    assert stop_sentences(errors)[0].endswith(f'{abs(live).mean():.1f} m by live values')


def test_without_a_known_brake_rate_no_stops_are_shown(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(120, truth=replace(TRUTH, brake_rate=()))
    time_s, errors = stop_errors(chapter.recording, chapter.truth, chapter.train_file)
    assert time_s.size == 0
    assert stop_sentences(errors) == ()
    assert 'by one brake command' not in render_report('A drive', (chapter,))

# SPDX-License-Identifier: Apache-2.0
"""The report is one self-contained file, also for drives with little data."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from test.report.conftest import TRUTH
from test.report.pages import check_page, colours_of_figures, words
from trainid_ros.interface.errors import InputError
from trainid_ros.report.drive_report import render_report, write_report
from trainid_ros.report.page import styled_figure, to_svg
from trainid_ros.report.recording import Recorder
from trainid_ros.sim.truth import Truth

pytestmark = pytest.mark.slow  # drawing takes seconds

FIGURES = (
    'Running resistance and Davis parameters over time', 'Resistance curve against speed', 'Brake rate over time',
    'Speed profile with driving modes', 'Status of the estimators over time', 'Innovation test ratios over time',
    'Speed model over time',
)  # fmt: skip


@pytest.fixture(scope='module')
def text(make_chapter: Callable[..., Any]) -> str:
    return render_report('Two <trials>', (make_chapter(240), replace(make_chapter(120), title='Second')))


def test_every_chapter_has_each_figure_once(text: str) -> None:
    for label in FIGURES:
        assert text.count(f'aria-label="{label}"') == 2
    assert text.count('<svg') == 2 * len(FIGURES)


def test_page_is_whole_and_alone_and_text_is_escaped(text: str) -> None:
    assert {'table', 'svg', 'dl', 'nav'} <= check_page(text, 3_000_000)
    assert '<title>Two &lt;trials&gt;</title>' in text
    assert 'Trial &lt;1&gt;' in text


def test_numbers_of_the_table(text: str) -> None:
    cells = re.findall(r'<td[^>]*>(.*?)</td>', text)
    at = cells.index('w at 10 m/s (36 km/h)')
    # a + 10 b + 100 c = 1.9, std sqrt(0.0501); train file 1.7, truth 2.0
    assert cells[at + 1 : at + 8] == ['N/kN', '1.9', '0.22', '1.7', '2', '-0.1', '-0.4']
    braking = cells.index('braking')
    assert cells[braking + 1 : braking + 3] == ['60', '–']
    assert 'a note' in text


def test_figures_use_the_colours_of_the_page(text: str) -> None:
    assert {'ink', 'estimate', 'grid'} <= colours_of_figures(text)


@pytest.mark.parametrize(
    ('seconds', 'options', 'figures'),
    [
        (120, {'truth': None}, 7),
        (120, {'truth': Truth(0, ((0.0, 1.5, 0.02, 0.001),))}, 7),
        (50, {'braking': False}, 7),
        (1, {}, 6),
    ],
    ids=['no truth', 'no true brake rate', 'no braking', 'one sample'],
)
def test_little_is_known(make_chapter: Callable[..., Any], seconds: int, options: dict[str, Any], figures: int) -> None:
    text = render_report('r', (make_chapter(seconds, **options),))
    assert text.count('<svg') == figures
    assert 'nan' not in words(text)
    has_truth = options.get('truth', TRUTH) is not None
    assert ('truth' in text, 'error / std' in text) == (has_truth, has_truth)


def test_empty_traces_give_tables_without_figures(make_chapter: Callable[..., Any]) -> None:
    chapter = replace(make_chapter(30), recording=Recorder().finish())
    text = render_report('r', (chapter,))
    assert '<svg' not in text
    assert 'nan' not in words(text)


def test_output_is_deterministic(make_chapter: Callable[..., Any]) -> None:
    chapters = (make_chapter(60),)
    assert render_report('r', chapters) == render_report('r', chapters)


def test_folders_are_created_and_write_errors_reported(make_chapter: Callable[..., Any], tmp_path: Path) -> None:
    chapters = (replace(make_chapter(30), recording=Recorder().finish()),)
    write_report('r', chapters, tmp_path / 'a' / 'b' / 'report.html')
    assert (tmp_path / 'a' / 'b' / 'report.html').read_text(encoding='utf-8') == render_report('r', chapters)
    (tmp_path / 'file').write_text('x', encoding='utf-8')
    with pytest.raises(InputError, match=r'file.*cannot be written'):
        write_report('r', chapters, tmp_path / 'file' / 'report.html')


def test_names_are_text_wherever_they_appear(make_chapter: Callable[..., Any]) -> None:
    bad = '<img src=x onerror=alert(1)>&"'
    chapter = replace(make_chapter(60), title=bad, bag=bad, train_file_name=bad, how=bad, notes=(bad,))
    text = render_report(bad, (chapter, chapter))
    assert '<img' not in text
    assert text.count('&lt;img src=x onerror=alert(1)&gt;&amp;') >= 10


def test_the_label_of_a_figure_is_no_markup() -> None:
    with styled_figure(1.0) as figure:
        text = to_svg(figure, 'Train T1" onclick="x')
    assert 'aria-label="Train T1&quot; onclick=&quot;x"' in text

# SPDX-License-Identifier: Apache-2.0
"""The report is one self-contained file, also for drives with little data."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.report.drive_report import render_report, write_report
from trainid_ros.report.page import styled_figure, to_svg
from trainid_ros.report.recording import Recorder
from trainid_ros.sim.truth import Truth

pytestmark = pytest.mark.slow  # drawing takes seconds

FIGURES = (
    'Running resistance and Davis parameters over time',
    'Resistance curve against speed',
    'Brake rate over time',
    'Speed profile with driving modes',
    'Status of the estimators over time',
    'Innovation test ratios over time',
    'Speed model over time',
)
VOID = {'meta', 'br', 'img', 'use', 'path', 'rect'}


class Balance(HTMLParser):
    """Checks that elements are closed in reverse order of opening."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, _attrs: object) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, _attrs: object) -> None:
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


@pytest.fixture(scope='module')
def text(make_chapter: Callable[..., Any]) -> str:
    return render_report('Two <trials>', (make_chapter(240), replace(make_chapter(120), title='Second')))


def test_every_chapter_has_each_figure_once(text: str) -> None:
    for label in FIGURES:
        assert text.count(f'aria-label="{label}"') == 2
    assert text.count('<svg') == 2 * len(FIGURES)


def test_page_loads_and_runs_nothing(text: str) -> None:
    assert 'http' not in text
    assert not re.search(r'<(script|link|iframe|img)\b', text)
    assert '@import' not in text
    assert set(re.findall(r'url\(([^)]{1,2})', text)) <= {'#p', '#m'}
    assert len(text.encode()) < 3_000_000


def test_elements_are_balanced_and_text_is_escaped(text: str) -> None:
    parser = Balance()
    parser.feed(text)
    parser.close()
    assert parser.open == []
    assert {'table', 'svg', 'dl', 'nav'} <= parser.tags
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
    figures = ''.join(re.findall(r'<svg.*?</svg>', text, flags=re.DOTALL))
    used = set(re.findall(r'var\(--(\w+)\)', figures))
    assert {'ink', 'estimate', 'grid'} <= used
    assert not re.search(r'#[0-9a-f]{6}\b', figures)
    for name in used:
        # Once for light, once for dark.
        assert len(re.findall(rf'--{name}:#', text)) == 2


def test_without_truth_none_is_shown(make_chapter: Callable[..., Any]) -> None:
    text = render_report('r', (make_chapter(120, truth=None),))
    assert 'truth' not in text
    assert 'nan' not in words(text)


def test_truth_without_brake_rate(make_chapter: Callable[..., Any]) -> None:
    truth = Truth(0, ((0.0, 1.5, 0.02, 0.001),))
    text = render_report('r', (make_chapter(120, truth=truth),))
    assert 'error / std' in text
    assert 'nan' not in words(text)


def test_drive_without_braking(make_chapter: Callable[..., Any]) -> None:
    text = render_report('r', (make_chapter(50, braking=False),))
    assert text.count('<svg') == len(FIGURES)
    assert 'nan' not in words(text)


def test_empty_traces_give_tables_without_figures(make_chapter: Callable[..., Any]) -> None:
    chapter = replace(make_chapter(30), recording=Recorder().finish())
    text = render_report('r', (chapter,))
    assert '<svg' not in text
    assert 'nan' not in words(text)


def test_single_sample_is_plotted(make_chapter: Callable[..., Any]) -> None:
    assert '<svg' in render_report('r', (make_chapter(1),))


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


def words(text: str) -> set[str]:
    """Return the words a reader sees, in lower case."""
    shown = re.sub(r'<style.*?</style>|<[^>]+>', ' ', text, flags=re.DOTALL)
    return set(re.findall(r'[a-z]+', shown.lower()))


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

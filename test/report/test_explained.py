# SPDX-License-Identifier: Apache-2.0
"""Report of an explanation: one file, findings before figures, and little data causes no errors."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from test.report.pages import check_page, colours_of_figures, no_layout, words
from trainid_ros.explain.result import Explanation, Learned, Verdict
from trainid_ros.interface.files import write_text
from trainid_ros.report.explained import render_explained
from trainid_ros.train.train_file import Line, TrainFile

pytestmark = pytest.mark.slow  # drawing takes seconds

Make = Callable[..., Explanation]
FIGURES = (
    'Measured and simulated speed of the run with the largest gap',
    'Missing resistance by position',
    'Speed gap by position in both directions',
    'Missing resistance by speed, driving mode and so on',
    'Speed gap of single runs by time',
)


def render(explanation: Explanation, train_file: TrainFile) -> str:
    return render_explained('Why <slow>', explanation, train_file, 't.yaml', ('a', 'b'), ('a <note>',))


@pytest.fixture(scope='module')
@no_layout()
def text(make_explanation: Make, stated: TrainFile) -> str:
    return render(make_explanation(ambiguous=True), stated)


def test_the_answer_comes_first_then_what_follows_from_it_then_the_evidence(text: str) -> None:
    verdict, evidence = re.findall(r'<h2>(.*?)</h2>', text)
    assert 'ambiguous' in verdict
    assert 'local_drag (probability 97%)' in verdict
    answers = ['What', 'Where', 'How sure', 'What next', 'Drive', 'Bags', 'Train file']
    assert re.findall(r'<dt>(.*?)</dt>', text) == answers
    figures = [f'aria-label="{label}"' for label in FIGURES]
    assert all(text.count(label) == 1 for label in figures)
    order = ['<dt>What next', figures[0], 'Other causes', 'What the new train file changes', '<h2>Evidence', figures[1]]
    assert evidence == 'Evidence'
    assert [text.index(part) for part in order] == sorted(text.index(part) for part in order)


def test_page_loads_and_runs_nothing_and_text_is_escaped(text: str) -> None:
    check_page(text, 1_500_000)
    assert 'run &lt;both&gt; ways' in text
    assert '<title>Why &lt;slow&gt;</title>' in text
    assert 'a &lt;note&gt;' in text


def test_table_values(text: str) -> None:
    cells = re.findall(r'<td[^>]*>(.*?)</td>', text)
    other = cells.index('other')
    assert cells[other : other + 4] == ['other', 'something outside the library', '&lt;1%', '240']
    energy = cells.index('traction energy, rising positions')
    assert cells[energy + 1] == 'kWh'
    assert float(cells[energy + 3]) > float(cells[energy + 2]) > 0.0  # the file written states a drag
    a = cells.index('a')
    assert cells[a : a + 4] == ['a', 'N/kN', '1.5', '1.61 ± 0.12']


def test_figures_use_the_colours_of_the_page(text: str) -> None:
    assert {'brake', 'estimate', 'stand', 'wait'} <= colours_of_figures(text)


@pytest.mark.parametrize(('unit', 'axis'), [('m/s', 'the speed while braking [m/s]'), ('', 'the run')])
@no_layout()
def test_what_was_learned_is_a_curve_before_the_evidence(
    make_explanation: Make, make_learned: Callable[..., Learned], stated: TrainFile, unit: str, axis: str
) -> None:
    learned = make_learned(unit=unit, text=axis.removesuffix(' [m/s]'))
    text = render(make_explanation(verdict=Verdict.UNEXPLAINED, effects=(), learned=learned), stated)
    curve = text.index('aria-label="Learned curve of the missing resistance"')
    assert text.index('aria-label="Measured and simulated speed') < curve < text.index('<h2>Evidence')
    assert axis in text
    assert 'more resistance than modelled' in text
    assert ('the gap falls from 0.400 to 0.050' in text) == bool(unit)
    assert 'Find the cause. Until then use folder learned' in text


@no_layout()
def test_without_effects(make_explanation: Make, stated: TrainFile) -> None:
    text = render(make_explanation(verdict=Verdict.NO_GAP, effects=()), stated)
    assert '<dd>What is left is noise.</dd>' in text
    assert '>with the effects<' not in text  # no legend for a line that would hide the other
    assert 'more resistance than modelled' in text


def test_little_data_causes_no_error(make_explanation: Make, stated: TrainFile) -> None:
    full = make_explanation()
    short = replace(full.traces[0], **{name: getattr(full.traces[0], name)[:1] for name in (
        'time', 'position', 'speed', 'before', 'after', 'band')})  # fmt: skip
    unknown = replace(full.traces[0], before=np.full(60, np.nan), after=np.full(60, np.nan), band=np.full(60, np.nan))
    bare = replace(stated, line=Line())
    for explanation in (
        make_explanation(traces=(), locations=(), gap=None),
        make_explanation(traces=(short,), locations=(replace(full.locations[0], places=()),)),
        make_explanation(traces=(unknown,), gap=None),
    ):
        page = render(explanation, bare)
        assert 'What next' in page
        known = any(np.isfinite(t.before).any() for t in explanation.traces)
        assert ('Speed gap along the line' in page, FIGURES[0] in page) == (known, known)
        assert not re.search(r'\b1 runs', page)
        assert 'nan' not in words(page)


@no_layout()
def test_report_of_hundreds_of_runs_is_small(make_explanation: Make, stated: TrainFile, tmp_path: Path) -> None:
    many, path = make_explanation(traces=make_explanation().traces * 150), tmp_path / 'new' / 'report.html'
    write_text(render_explained('Many', many, stated, 't', ('a',)), path)
    assert 'Of 300 runs those with the largest gaps' in path.read_text(encoding='utf-8')
    assert path.stat().st_size < 1_500_000


@no_layout()
def test_names_are_text_wherever_they_appear(make_explanation: Make, stated: TrainFile, tmp_path: Path) -> None:
    bad = '<img src=x onerror=alert(1)>&"$x$\udcff'
    explanation = make_explanation(ambiguous=True)
    effects = tuple(
        replace(
            effect, name=bad, title=bad, equation=bad, where=bad,
            parameters=tuple((bad, value) for _, value in effect.parameters),
            twins=tuple(replace(twin, name=bad, drive=bad) for twin in effect.twins),
        )
        for effect in explanation.effects
    )  # fmt: skip
    hostile = replace(explanation, effects=effects, remaining=bad)
    text = render_explained(bad, hostile, stated, bad, (bad, bad), (bad,))
    assert '<img' not in text
    assert text.count('&lt;img src=x onerror=alert(1)&gt;') > 10
    write_text(text, tmp_path / 'r.html')
    assert '$x$\\udcff</title>' in (tmp_path / 'r.html').read_text(encoding='utf-8')

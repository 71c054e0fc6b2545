# SPDX-License-Identifier: Apache-2.0
"""Reports in a real browser: nothing is logged or fetched, every plot has ink, and pages look as approved.

To approve the pictures of pages that are meant to look otherwise, run this file with TRAINID_APPROVE=1, look at the
pages, and commit ``approved``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from matplotlib.image import imread, imsave
from numpy.typing import NDArray

from test.chromium import HEIGHT, Chromium, find_chromium, ink
from test.fleet.surrogate import fleet_rows
from test.report.test_verdict import ADHESION
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation
from trainid_ros.fleet.table_file import write_table
from trainid_ros.interface.files import write_text
from trainid_ros.report.drive_report import Chapter, write_report
from trainid_ros.report.explained import render_explained
from trainid_ros.report.recording import CONTRADICTED, GAP, Span
from trainid_ros.report.verdict import Level, Verdict
from trainid_ros.train.train_file import TrainFile

pytestmark = pytest.mark.slow  # a browser starts, and drawing takes seconds

PLOTS = 'figure svg, figure img'
# A line of text alone covers less of a plot.
MIN_INK = 0.02
APPROVED = Path(__file__).parent / 'approved'
# Rows and columns of a tile. Mean difference of grey that other letters make: .006 of the screen, .0014 of a plot; a
# card, a table or a verdict less makes .012 to .021 of the screen.
GRID = (24, 48)
SCREEN_OFF, PLOT_OFF = 0.009, 0.004

Picture = NDArray[np.float64]


@pytest.fixture(scope='module')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    started = Chromium(find_chromium(), tmp_path_factory.mktemp('profile'))
    yield started
    started.close()


@pytest.fixture(scope='module')
def replayed(make_chapter: Callable[..., Chapter], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the report of a replay; that of the demo is the same with more chapters."""
    path = tmp_path_factory.mktemp('pages') / 'replay.html'
    chapter = make_chapter(240)
    faults = (Span(60.0, 90.0, GAP), Span(150.0, 240.0, CONTRADICTED))
    resistance = replace(chapter.recording.resistance, faults=faults)
    slips = [replace(ADHESION, slipping=20 < i < 40) for i in range(len(resistance.estimates))]
    recording = replace(chapter.recording, resistance=resistance, adhesion=replace(resistance, estimates=tuple(slips)))
    verdict = Verdict(Level.NOT, 'Not usable: inputs contradict each other since 150 s. Next: correct what publishes.')
    write_report('One', (replace(chapter, recording=recording, verdict=verdict),), path)
    return path


@pytest.fixture(scope='module')
def explained(
    make_explanation: Callable[..., Explanation], stated: TrainFile, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp('pages') / 'explained.html'
    write_text(render_explained('Why', make_explanation(ambiguous=True), stated, 't.yaml', ('a',), ('note',)), path)
    return path


@pytest.fixture(scope='module')
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('pages')
    write_table(fleet_rows(1, 4, 12, {3: (6, np.array([0.0, -0.08, 0.0, 0.0]))}), folder / 't.csv', {})
    assert main(['fleet', 'report', str(folder / 't.csv'), '--out', str(folder / 'fleet.html')]) == 0
    return folder / 'fleet.html'


class Shown(NamedTuple):
    """A page as a browser shows it."""

    name: str
    uri: str
    errors: list[str]
    requests: list[str]
    picture: Picture
    plots: list[tuple[int, int, int, int]]


@pytest.fixture(scope='module', params=['replayed', 'explained', 'fleet'])
def shown(request: pytest.FixtureRequest, browser: Chromium) -> Shown:
    uri = request.getfixturevalue(request.param).as_uri()
    browser.open(uri)
    seen = browser.picture(whole=True), browser.boxes(PLOTS)
    return Shown(request.param, uri, browser.errors(), browser.requests(), *seen)


def test_a_report_is_whole(shown: Shown) -> None:
    assert shown.errors == []
    assert [url for url in shown.requests if not url.startswith('data:')] == [shown.uri]
    assert len(shown.plots) == {'replayed': 8, 'explained': 5, 'fleet': 6}[shown.name]
    for left, top, right, bottom in shown.plots:
        assert right - left > 200
        assert bottom - top > 50
        assert ink(shown.picture[top:bottom, left:right]) > MIN_INK, (left, top)


def tiles(picture: Picture, plots: list[tuple[int, int, int, int]]) -> Picture:
    """Return the first screen and each plot in coarse grey, one below the other, shape (tiles, rows, columns).

    Plots have the same shape whatever the fonts; in cells as large as words, letters do not count.
    """
    parts = [picture[:HEIGHT], *(picture[top:bottom, left:right] for left, top, right, bottom in plots)]
    return np.array([shrunk(part.mean(axis=2)) for part in parts])


def shrunk(grey: Picture) -> Picture:
    """Return the means of the cells of a grid."""
    for axis, count in enumerate(GRID):
        edges = np.linspace(0, grey.shape[axis], count + 1).astype(np.intp)
        sizes = np.expand_dims(np.diff(edges), 1 - axis)
        grey = np.add.reduceat(grey, edges[:-1], axis=axis) / sizes
    return grey


def looks_as(one: Picture, other: Picture) -> bool:
    """Return whether each tile has the same grey, but for letters in other places."""
    if one.shape != other.shape:
        return False
    screen, *plots = np.abs(one - other).mean(axis=(1, 2))
    return bool(screen < SCREEN_OFF and max(plots) < PLOT_OFF)


def approved(name: str) -> Picture:
    grey: Picture = np.asarray(imread(APPROVED / f'{name}.png'), dtype=np.float64)[:, :, 0]
    return grey.reshape(-1, *GRID)


def test_a_page_looks_as_approved(shown: Shown) -> None:
    found = tiles(shown.picture, shown.plots)
    if os.environ.get('TRAINID_APPROVE'):
        imsave(APPROVED / f'{shown.name}.png', found.reshape(-1, GRID[1]), cmap='gray', vmin=0.0, vmax=1.0)
    assert looks_as(found, approved(shown.name))


@pytest.mark.parametrize(
    ('change', 'alike'),
    [
        ('document.body.style.font = "15.2px/1.5 serif"', True),
        ('document.querySelector(".cards").remove()', False),
        ('document.querySelectorAll("figure svg")[2].querySelectorAll("path").forEach(e => e.remove())', False),
        ('document.querySelectorAll("figure svg")[4].remove()', False),
    ],
    ids=['other letters', 'no cards', 'no lines', 'a plot less'],
)
def test_what_looks_otherwise_is_found(browser: Chromium, replayed: Path, change: str, *, alike: bool) -> None:
    browser.open(replayed.as_uri())
    browser.evaluate(change)
    assert looks_as(tiles(browser.picture(whole=True), browser.boxes(PLOTS)), approved('replayed')) == alike


@pytest.mark.parametrize('name', ['replayed', 'explained', 'fleet'])
def test_a_report_fits_on_a_phone(browser: Chromium, name: str, request: pytest.FixtureRequest) -> None:
    browser.call('Emulation.setDeviceMetricsOverride', width=390, height=844, deviceScaleFactor=1, mobile=True)
    browser.open(request.getfixturevalue(name).as_uri())
    width = browser.evaluate('document.documentElement.scrollWidth')
    # What scrolls in a box of its own may be wider.
    cut = browser.evaluate(
        '[...document.querySelectorAll("body *")].filter(e => !e.closest(".wide") && e.scrollWidth > e.clientWidth + 1'
        ' && getComputedStyle(e).display != "inline").map(e => e.outerHTML.slice(0, 80))'
    )
    browser.call('Emulation.clearDeviceMetricsOverride')
    assert width == 390
    assert cut == []


def test_faults_of_a_page_are_found(browser: Chromium, tmp_path: Path) -> None:
    page = tmp_path / 'bad.html'
    page.write_text(
        '<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><img src="http://example.org/x.png">'
        '<figure><svg width="300" height="100"></svg></figure><script>console.error("bad"); nothing();</script>',
        encoding='utf-8',
    )
    browser.open(page.as_uri())
    found: Any = ' '.join(browser.errors())
    assert 'bad' in found
    assert 'nothing is not defined' in found
    assert 'http://example.org/x.png' in browser.requests()
    ((left, top, right, bottom),) = browser.boxes(PLOTS)
    assert ink(browser.picture(whole=True)[top:bottom, left:right]) == 0.0

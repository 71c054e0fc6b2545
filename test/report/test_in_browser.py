# SPDX-License-Identifier: Apache-2.0
"""Reports in a real browser: nothing is logged, nothing is fetched, and every plot has ink."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test.chromium import Chromium, find_chromium, ink
from test.fleet.surrogate import fleet_rows
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation
from trainid_ros.fleet.table_file import write_table
from trainid_ros.report.drive_report import Chapter, write_report
from trainid_ros.report.explained import render_explained
from trainid_ros.report.page import write_page
from trainid_ros.train.train_file import TrainFile

pytestmark = pytest.mark.slow  # a browser starts, and drawing takes seconds

PLOTS = 'figure svg, figure img'
# A line of text alone covers less of a plot.
MIN_INK = 0.02


@pytest.fixture(scope='module')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    started = Chromium(find_chromium(), tmp_path_factory.mktemp('profile'))
    yield started
    started.close()


@pytest.fixture(scope='module')
def replayed(make_chapter: Callable[..., Chapter], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the report of a replay; that of the demo is the same with more chapters."""
    path = tmp_path_factory.mktemp('pages') / 'replay.html'
    write_report('One', (make_chapter(240),), path)
    return path


@pytest.fixture(scope='module')
def explained(
    make_explanation: Callable[..., Explanation], stated: TrainFile, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp('pages') / 'explained.html'
    write_page(render_explained('Why', make_explanation(ambiguous=True), stated, 't.yaml', ('a',), ('note',)), path)
    return path


@pytest.fixture(scope='module')
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('pages')
    write_table(fleet_rows(1, 4, 12, {3: (6, np.array([0.0, -0.08, 0.0, 0.0]))}), folder / 't.csv', {})
    assert main(['fleet', 'report', str(folder / 't.csv'), '--out', str(folder / 'fleet.html')]) == 0
    return folder / 'fleet.html'


@pytest.mark.parametrize(('name', 'plots'), [('replayed', 7), ('explained', 5), ('fleet', 6)])
def test_a_report_is_whole(browser: Chromium, name: str, plots: int, request: pytest.FixtureRequest) -> None:
    page: Path = request.getfixturevalue(name)
    browser.open(page.as_uri())
    assert browser.errors() == []
    assert [url for url in browser.requests() if not url.startswith('data:')] == [page.as_uri()]
    picture, boxes = browser.picture(whole=True), browser.boxes(PLOTS)
    assert len(boxes) == plots
    for left, top, right, bottom in boxes:
        assert right - left > 200
        assert bottom - top > 50
        assert ink(picture[top:bottom, left:right]) > MIN_INK, (left, top)


@pytest.mark.parametrize('name', ['replayed', 'explained', 'fleet'])
def test_a_report_fits_on_a_phone(browser: Chromium, name: str, request: pytest.FixtureRequest) -> None:
    browser.call('Emulation.setDeviceMetricsOverride', width=400, height=800, deviceScaleFactor=1, mobile=True)
    browser.open(request.getfixturevalue(name).as_uri())
    width = browser.evaluate('document.documentElement.scrollWidth')
    browser.call('Emulation.clearDeviceMetricsOverride')
    assert width == 400


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

# SPDX-License-Identifier: Apache-2.0
"""Pictures of pages are small and whole; a figure of a report becomes one."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest
from matplotlib.figure import Figure

from tools.documents import DOCS, ROOT
from tools.report_picture import report_picture
from trainid_ros.report.page import ESTIMATE, PAPER, to_svg

TUTORIALS = sorted(path.name for path in (ROOT / DOCS).glob('tutorial_*.md'))
LARGEST = 60_000  # bytes


@pytest.mark.parametrize('page', TUTORIALS)
def test_a_tutorial_ends_with_a_picture_and_what_is_next(page: str) -> None:
    text = (ROOT / DOCS / page).read_text(encoding='utf-8')
    picture = page.replace('.md', '.svg')
    assert text.index('\n## Next\n') > text.index(f']({picture})')
    assert text.count('\n## ') == text[: text.index('\n## Next')].count('\n## ') + 1
    drawn = (ROOT / DOCS / picture).read_bytes()
    assert len(drawn) <= LARGEST
    assert ET.fromstring(drawn).tag == '{http://www.w3.org/2000/svg}svg'
    assert b'var(--' not in drawn


def test_a_figure_of_a_report_becomes_a_picture() -> None:
    figure = Figure()
    figure.subplots().plot([1.0, 2.0], color=ESTIMATE)
    page = f'<html>{to_svg(Figure(), "empty")}{to_svg(figure, "a line")}</html>'
    drawn = report_picture(page, 'a line')
    ET.fromstring(drawn)
    assert ESTIMATE in drawn
    assert PAPER in drawn
    assert 'var(--' not in drawn
    with pytest.raises(ValueError, match="0 figures are named 'none'; the report has: empty, a line"):
        report_picture(page, 'none')

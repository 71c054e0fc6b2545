# SPDX-License-Identifier: Apache-2.0
"""Reports as one self-contained HTML file: styles and figures are embedded, there are no scripts."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trainid_ros import __version__
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.report import HTML_START
from trainid_ros.report.figures import (
    brake_rate_over_time,
    innovation_ratios,
    resistance_curve,
    resistance_over_time,
    speed_model_over_time,
    speed_profile,
    status_timeline,
)
from trainid_ros.report.style import css
from trainid_ros.report.tables import cards, estimates_table, rejections_table, scores_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.report.content import Chapter, Report

_LIBRARIES: Final = ('numpy', 'scipy', 'rclpy')


def page(title: str, body: str, footer: str) -> str:
    """Return a page as HTML text.

    Args:
        title: Heading, as text.
        body: Content, as HTML.
        footer: Last line, as text.
    """
    name = escape(title)
    return (
        f'{HTML_START}{escape(__version__)}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<title>{name}</title><style>{css()}</style></head><body>'
        f'<h1>{name}</h1><p class="sub">{escape(" · ".join(versions()))}</p>{body}'
        f'<footer>{escape(footer)}</footer></body></html>\n'
    )


def write_page(text: str, path: str | Path) -> None:
    """Write a page and create missing folders.

    Raises:
        InputError: The file cannot be written.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Names of files may hold bytes that are no text.
        target.write_text(text, encoding='utf-8', errors='backslashreplace')
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None


def versions() -> tuple[str, ...]:
    """Return names and versions of the software used; libraries that are not installed are left out."""
    found = [f'trainid_ros {__version__}', f'Python {platform.python_version()}']
    for library in _LIBRARIES:
        try:
            found.append(f'{library} {version(library)}')
        except PackageNotFoundError:
            continue
    return tuple(found)


def facts_list(facts: Iterable[tuple[str, str]]) -> str:
    """Return names and texts as a definition list."""
    return f'<dl>{"".join(f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in facts)}</dl>'


def bullets(lines: Sequence[str]) -> str:
    """Return lines of text as a list, nothing without lines."""
    return f'<ul>{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>' if lines else ''


def captioned(figures: Iterable[tuple[str, str, str]]) -> str:
    """Return figures, given as heading, caption and SVG element, without those that have no data."""
    return ''.join(
        f'<figure><h3>{name}</h3><p class="caption">{escape(caption)}</p>{svg}</figure>'
        for name, caption, svg in figures
        if svg
    )


def write_report(report: Report, path: str | Path) -> None:
    """Write a report and create missing folders.

    Raises:
        InputError: The file cannot be written.
    """
    write_page(render(report), path)


def render(report: Report) -> str:
    """Return a report as HTML text."""
    links = ''.join(f'<a href="#chapter-{i}">{escape(c.title)}</a>' for i, c in enumerate(report.chapters))
    nav = f'<nav>{links}</nav>' if len(report.chapters) > 1 else ''
    body = ''.join(_chapter(i, chapter) for i, chapter in enumerate(report.chapters))
    footer = (
        'w(v) = a + b v + c v², in N per kN of train weight, v in m/s. Bands are the published standard deviations.'
    )
    return page(report.title, nav + body, footer)


def _chapter(index: int, chapter: Chapter) -> str:
    parts = (
        f'<h2 id="chapter-{index}">{escape(chapter.title)}</h2>',
        _facts(chapter),
        bullets(chapter.notes),
        cards(chapter),
        estimates_table(chapter),
        scores_table(chapter),
        _figures(chapter),
        rejections_table(chapter),
    )
    return f'<section>{"".join(parts)}</section>'


def _facts(chapter: Chapter) -> str:
    train, duration_s = chapter.train_file.train, chapter.traces.duration_s
    start = datetime.fromtimestamp(chapter.traces.start_ns / NS_PER_S, UTC)
    facts = (
        ('Bag', chapter.bag),
        ('Train file', chapter.train_file_name),
        ('Train', f'{train.mass / 1000.0:.0f} t, {train.length:.0f} m, {train.cars} cars'),
        ('Duration', f'{duration_s / 60.0:.1f} min from {start:%Y-%m-%d %H:%M:%S} UTC'),
        ('Run', chapter.how),
    )
    return facts_list(facts)


def _figures(chapter: Chapter) -> str:
    figures = (
        ('Resistance over time', _over_time_caption(chapter), resistance_over_time(chapter)),
        ('Resistance curve', 'Resistance for use by ATO or driver advisory systems.', resistance_curve(chapter)),
        (
            'Brake rate',
            'Ratio of actual to nominal braking. Observable only while the brake acts; in between the band widens.',
            brake_rate_over_time(chapter),
        ),
        ('Drive', 'Speed, gradient and driving modes.', speed_profile(chapter)),
        ('Status', 'HOLDING: inputs are valid, but there is no information to learn from.', status_timeline(chapter)),
        (
            'Innovations',
            'Squared innovation over squared gate times its variance, the greatest of each bin; above 1 (red) the '
            'sample is rejected.',
            innovation_ratios(chapter),
        ),
        ('Speed model', 'Parameters of the speed model in the same physical terms.', speed_model_over_time(chapter)),
    )
    return captioned(figures)


def _over_time_caption(chapter: Chapter) -> str:
    truth = ' Dashed: truth.' if chapter.truth is not None else ''
    return f'Left: running resistance at three speeds. Right: its Davis parameters.{truth}'

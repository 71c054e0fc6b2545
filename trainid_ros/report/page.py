# SPDX-License-Identifier: Apache-2.0
"""Reports as one self-contained HTML file, from the templates in this folder."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from trainid_ros import __version__
from trainid_ros.interface.errors import InputError
from trainid_ros.report import HTML_START
from trainid_ros.report.style import COLOURS

if TYPE_CHECKING:
    from collections.abc import Sequence

_LIBRARIES: Final = ('numpy', 'scipy', 'rclpy')
_TEMPLATES: Final = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_PARTS: Final[Any] = _TEMPLATES.get_template('parts.html.j2').module
# For pages made by others: lists of text, figures as (heading, caption, SVG), tables.
bullets: Final = _PARTS.bullets
captioned: Final = _PARTS.figures
html_table: Final = _PARTS.table


class Table(NamedTuple):
    """A table: the first ``text_columns`` hold text, the others numbers; one without rows is not shown."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1


def render(template: str, title: str, **content: Any) -> str:
    """Return a page as HTML text.

    Args:
        template: File name of the template.
        title: Heading.
        content: What the template shows, by the names that it uses.
    """
    return _TEMPLATES.get_template(template).render(
        start=Markup(HTML_START),
        version=__version__,
        versions=versions(),
        colours=COLOURS,
        title=title,
        **content,
    )


def page(title: str, body: str, footer: str) -> str:
    """Return a page as HTML text; the body is HTML, heading and last line are text."""
    return render('page.html.j2', title, body=Markup(body), footer=footer)


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

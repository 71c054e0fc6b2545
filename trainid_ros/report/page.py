# SPDX-License-Identifier: Apache-2.0
"""Page frame of all reports: one HTML file with embedded style, without scripts."""

from __future__ import annotations

from html import escape
from pathlib import Path

from trainid_ros.errors import InputError
from trainid_ros.report.content import versions
from trainid_ros.report.style import css


def page(title: str, body: str, footer: str) -> str:
    """Return a page as HTML text.

    Args:
        title: Heading, as text.
        body: Content, as HTML.
        footer: Last line, as text.

    """
    name = escape(title)
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
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
        target.write_text(text, encoding='utf-8')
    except OSError as error:
        msg = f'{path}: cannot be written ({error.strerror})'
        raise InputError(msg) from None

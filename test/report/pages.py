# SPDX-License-Identifier: Apache-2.0
"""What holds of every report: it loads and runs nothing, its elements are balanced, its figures have its colours."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser

import pytest


@contextmanager
def no_layout() -> Iterator[None]:
    """Draw figures without moving their axes, which takes half of the time; a browser shows pages with it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('matplotlib.layout_engine.ConstrainedLayoutEngine.execute', lambda *_: None)
        yield


class Balance(HTMLParser):
    """Checks that elements are closed in reverse order of opening."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, _attrs: object) -> None:
        self.tags.add(tag)
        if tag not in {'meta', 'br', 'img', 'use', 'path', 'rect'}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, _attrs: object) -> None:
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in {'meta', 'br', 'img', 'use', 'path', 'rect'}:
            assert self.open.pop() == tag


def check_page(text: str, size: int) -> set[str]:
    """Check that a page is whole, alone and smaller than a number of bytes; return the tags in it."""
    assert 'http' not in text
    assert not re.search(r'<(script|link|iframe|img)\b', text)
    assert '@import' not in text
    assert set(re.findall(r'url\(([^)]{1,2})', text)) <= {'#p', '#m'}
    assert len(text.encode()) < size
    parser = Balance()
    parser.feed(text)
    parser.close()
    assert parser.open == []
    return parser.tags


def colours_of_figures(text: str) -> set[str]:
    """Return the colours of the page in its figures; no other is there, and each is stated for light and dark pages."""
    figures = ''.join(re.findall(r'<svg.*?</svg>', text, flags=re.DOTALL))
    used = set(re.findall(r'var\(--(\w+)\)', figures))
    assert not re.search(r'#[0-9a-f]{6}\b', figures)
    for name in used:
        assert len(re.findall(rf'--{name}:#', text)) == 2
    return used


def words(text: str) -> set[str]:
    """Return the words a reader sees, in lower case."""
    shown = re.sub(r'<style.*?</style>|<[^>]+>', ' ', text, flags=re.DOTALL)
    return set(re.findall(r'[a-z]+', shown.lower()))

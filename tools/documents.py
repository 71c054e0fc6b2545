# SPDX-License-Identifier: Apache-2.0
"""What the Markdown documents hold: links, headings and code blocks; for the site and for the tests."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
DOCS: Final = 'docs'
LINK: Final = re.compile(r'(?<=\]\()([^()\s]+)(?=\))')
_FENCE: Final = re.compile(r'^```(\w*)\s*(?:title="([^"]*)")?\s*$')
_OTHER_SITE: Final = re.compile(r'^[a-z]+:')
_HEADING: Final = re.compile(r'^#{1,6} (.*)$')


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced code block."""

    language: str  # Word after the fence, empty without one
    title: str  # File name given in the fence, empty without one
    line: int  # Line number of its first line of code
    text: str  # The code


@dataclass(frozen=True, slots=True)
class _Line:
    number: int
    text: str
    is_code: bool


def documents() -> tuple[Path, ...]:
    """Return README, CONTRIBUTING, SECURITY and the pages of the site."""
    return (
        *(ROOT / f'{name}.md' for name in ('README', 'CONTRIBUTING', 'SECURITY')),
        *sorted((ROOT / DOCS).glob('*.md')),
    )


def blocks(text: str) -> list[Block]:
    """Return the fenced code blocks of a document."""
    found: list[Block] = []
    opened: re.Match[str] | None = None
    code: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if opened is None:
            opened, code = _FENCE.match(line), []
        elif line == '```':
            first = number - len(code)
            found.append(Block(opened[1], opened[2] or '', first, ''.join(f'{item}\n' for item in code)))
            opened = None
        else:
            code.append(line)
    return found


def _lines(text: str) -> Iterator[_Line]:
    inside = False
    for number, line in enumerate(text.splitlines(), 1):
        fence = line.startswith('```')
        yield _Line(number, line, inside or fence)
        inside ^= fence


def links(text: str) -> list[tuple[int, str]]:
    """Return line number and target of the links to files of the repository and to headings."""
    return [
        (line.number, target)
        for line in _lines(text)
        if not line.is_code
        for target in LINK.findall(line.text)
        if not _OTHER_SITE.match(target)
    ]


def anchors(text: str) -> set[str]:
    """Return the anchors of the headings as GitHub names them."""
    found: set[str] = set()
    for line in _lines(text):
        if not line.is_code and (heading := _HEADING.match(line.text)):
            name = re.sub(r'[^\w\- ]', '', heading[1].strip().lower()).replace(' ', '-')
            count = 1
            unique = name
            while unique in found:
                unique, count = f'{name}-{count}', count + 1
            found.add(unique)
    return found


def resolve(page: str, target: str) -> str:
    """Return the path in the repository that a link means, without its anchor.

    Args:
        page: Path of the document in the repository.
        target: Target of the link.

    """
    path = target.partition('#')[0]
    parts: list[str] = []
    for part in (PurePosixPath(page).parent / path).parts if path else PurePosixPath(page).parts:
        if part == '..' and parts and parts[-1] != '..':
            parts.pop()
        else:
            parts.append(part)
    return '/'.join(parts)


def rewrite(text: str, new: dict[str, str]) -> str:
    """Return a document with the targets of its links replaced; code stays as it is."""
    lines = (
        line.text if line.is_code else LINK.sub(lambda match: new.get(match[0], match[0]), line.text)
        for line in _lines(text)
    )
    return ''.join(f'{line}\n' for line in lines)

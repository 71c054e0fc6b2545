# SPDX-License-Identifier: Apache-2.0
"""Sentences of the documents are short, and both changelogs have the same entries."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from tools.documents import ROOT

if TYPE_CHECKING:
    from pathlib import Path

LIMIT = 30  # words
PAGES = (ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md')))
# Pages with sentences still to be shortened, and how many.
LONG = {
    'README.md': 1,
    'algorithms.md': 2,
    'client_reference.md': 4,
    'controller.md': 3,
    'controller_evidence.md': 6,
    'diagnostics.md': 3,
    'effects.md': 1,
    'explain.md': 4,
    'faults_evidence.md': 8,
    'fleet.md': 3,
    'mapping.md': 2,
    'monitor.md': 4,
    'nodes.md': 3,
    'parameters.md': 1,
    'replay.md': 6,
    'status.md': 6,
    'status_evidence.md': 3,
    'tables.md': 1,
    'train_file.md': 2,
}


def sentences(text: str) -> list[str]:
    """Return the sentences of a document without code, tables and headings; list items are paragraphs."""
    prose = re.sub(r'^```.*?^```$', '', text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r'^(\||#|    |!).*$', '', prose, flags=re.MULTILINE)
    prose = re.sub(r'\]\([^)]*\)', ']', prose)
    paragraphs = re.split(r'\n\s*\n|\n(?=\s*[-*] )', prose)
    return [one for paragraph in paragraphs for one in re.split(r'(?<=[.!?:])\**\s+', paragraph.strip()) if one]


def too_long(text: str) -> list[str]:
    return [one for one in sentences(text) if len(re.findall(r'\S*\w\S*', one)) > LIMIT]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    found = too_long(page.read_text(encoding='utf-8'))
    assert len(found) == LONG.get(page.name, 0), '\n\n'.join(found)


def test_a_long_sentence_is_found() -> None:
    assert too_long('word ' * (LIMIT + 1) + 'end.')
    assert not too_long('word ' * (LIMIT - 1) + 'end. ' + 'word ' * LIMIT)
    assert not too_long('| ' + 'word ' * 50 + '|\n\n```sh\n' + 'word ' * 50 + '\n```\n')


def test_both_changelogs_have_the_same_entries() -> None:
    entries = re.findall(r'^- (.*)$', (ROOT / 'CHANGELOG.md').read_text(encoding='utf-8'), re.MULTILINE)
    assert entries
    assert entries == re.findall(r'^\* (.*)$', (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8'), re.MULTILINE)

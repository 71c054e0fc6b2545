# SPDX-License-Identifier: Apache-2.0
"""Sentences of the documents are short, also in lists and tables; both changelogs have the same entries."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.documents import ROOT, documents

LIMIT = 30  # words
WHOLE = 40  # words of a sentence with what follows its colons
PAGES = (*documents(), ROOT / 'bags' / 'README.md', *sorted((ROOT / 'research').glob('*.md')))


def sentences(text: str, ends: str) -> list[str]:
    """Return the sentences of a document without its code blocks.

    Headings, list items and cells of tables are paragraphs; code in a line is one word.
    """
    prose = re.sub(r'^ *```.*?^ *```$|<!--.*?-->', '', text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r'^(!|\|[-:| ]+\|$).*$', '', prose, flags=re.MULTILINE)
    prose = re.sub(r'`[^`]*`', 'code', re.sub(r'\]\([^)]*\)', ']', prose))
    prose = re.sub(r'^\|.*\|$', lambda row: '\n\n'.join(['', *row[0].split('|'), '']), prose, flags=re.MULTILINE)
    paragraphs = re.split(r'\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )|^#+ ', prose, flags=re.MULTILINE)
    return [one for paragraph in paragraphs for one in re.split(rf'(?<=[{ends}])[*)]*\s+', paragraph.strip()) if one]


def too_long(text: str) -> list[str]:
    limits = {'.!?:': LIMIT, '.!?': WHOLE}
    found = ((one, limit) for ends, limit in limits.items() for one in sentences(text, ends))
    return [one for one, limit in found if len(re.findall(r'\S*\w\S*', one)) > limit]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    assert too_long(page.read_text(encoding='utf-8')) == []


@pytest.mark.parametrize(
    'text',
    [
        '{}',
        '- a\n- {}',
        '    1. {}',
        'Before: {}',
        f'{"word " * 11}end: {"word " * 29}',
        '# {}',
        '| a | {} |',
        '(A. {})',
        '`a. b` {}',
        '> {}',
    ],
)
def test_a_long_sentence_is_found(text: str) -> None:
    assert too_long(text.format('word ' * LIMIT + 'end'))


def test_what_is_no_long_sentence_is_not_found() -> None:
    assert not too_long('word ' * (LIMIT - 1) + 'end. ' + 'word ' * LIMIT)
    assert not too_long('word ' * 20 + 'end: ' + 'word ' * 19)
    assert not too_long('```sh\n' + 'word ' * 50 + '\n```\n`' + 'word ' * 50 + '`')
    assert not too_long('| a |\n|---|\n' + '| ' + 'word ' * 20 + '| ' + 'word ' * 20 + '|\n')


def test_both_changelogs_have_the_same_entries() -> None:
    markdown, rst = ((ROOT / f'CHANGELOG.{kind}').read_text(encoding='utf-8') for kind in ('md', 'rst'))
    entries = re.split(r'^- ', markdown, flags=re.MULTILINE)[1:]
    assert entries
    others = re.split(r'^\* ', rst, flags=re.MULTILINE)[1:]
    assert [' '.join(one.split()) for one in entries] == [' '.join(one.split()).replace('``', '`') for one in others]

# SPDX-License-Identifier: Apache-2.0
"""Links between the documents lead to files and headings that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.documents import ROOT, anchors, documents, links, resolve, rewrite

PAGES = (*documents(), ROOT / 'bags' / 'README.md')


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page: Path) -> None:
    name = page.relative_to(ROOT).as_posix()
    for line, link in links(page.read_text(encoding='utf-8')):
        target = ROOT / resolve(name, link)
        assert target.is_file(), f'{name}:{line}: {link}'
        if (anchor := link.partition('#')[2]) and target.suffix == '.md':
            assert anchor in anchors(target.read_text(encoding='utf-8')), f'{name}:{line}: {link}'


def test_every_page_is_in_the_navigation_and_linked_from_the_readme() -> None:
    navigation = (ROOT / 'mkdocs.yml').read_text(encoding='utf-8')
    readme = {resolve('README.md', link) for _, link in links((ROOT / 'README.md').read_text(encoding='utf-8'))}
    for page in sorted((ROOT / 'docs').glob('*.md')):
        assert f': {page.name}\n' in navigation
        assert page.name == 'index.md' or f'docs/{page.name}' in readme


def test_the_readme_fits_on_a_page() -> None:
    assert len((ROOT / 'README.md').read_text(encoding='utf-8').splitlines()) <= 100


FOLDERS = ('trainid_ros', 'research', 'benchmarks', 'config', 'examples', 'test', 'tools')


def test_files_and_names_of_the_code_exist() -> None:
    sources = [*ROOT.glob('*.py'), *(path for folder in FOLDERS for path in (ROOT / folder).rglob('*.py'))]
    modules = {path.as_posix() for path in sources}
    for page in PAGES:
        text = page.read_text(encoding='utf-8')
        for name in re.findall(r'`([\w/]+\.py)`', text):  # from the root of the repository, or the end of a path
            assert any(path.endswith(f'/{name}') for path in modules), f'{page.name}: {name}'
        for name in re.findall(r'`((?:trainid_ros|test|benchmarks|research|config|msg_defs|bags|docs)/[\w/.]+)`', text):
            assert (ROOT / name).exists(), f'{page.name}: {name}'
        for names, name in re.findall(r'((?:`\w+`(?: and )?)+) in `(trainid_ros/[\w/]+\.py)`', text):
            source = (ROOT / name).read_text(encoding='utf-8')
            for one in re.findall(r'`(\w+)`', names):
                assert re.search(rf'\b{one}\b', source), f'{page.name}: {one} in {name}'


def test_modules_named_in_docstrings_exist() -> None:
    sources = [
        path for folder in ('trainid_ros', 'research', 'benchmarks', 'tools') for path in (ROOT / folder).rglob('*.py')
    ]
    modules = {path.stem for path in sources} | {path.parent.name for path in sources}
    for path in sources:
        named = re.findall(r':mod:`~?([\w.]+)`', path.read_text(encoding='utf-8'))
        assert {name.rpartition('.')[2] for name in named} <= modules, path


def test_links_in_code_are_no_links() -> None:
    text = 'See [a](b.md#c) and [d](https://e.f).\n```python\ng = [h](i)\n```\n'
    assert links(text) == [(1, 'b.md#c')]
    assert rewrite(text, {'b.md#c': 'x', 'i': 'y'}) == text.replace('b.md#c', 'x')


def test_paths_of_links_are_those_of_the_repository() -> None:
    assert resolve('docs/fit.md', '../bags/README.md#ride') == 'bags/README.md'
    assert resolve('docs/fit.md', '#here') == 'docs/fit.md'
    assert resolve('README.md', 'docs/fit.md') == 'docs/fit.md'


def test_anchors_are_those_of_github() -> None:
    assert anchors("# A new effect\n## c, d: what's (new)\n## A new effect\n```sh\n# no heading\n```\n") == {
        'a-new-effect',
        'c-d-whats-new',
        'a-new-effect-1',
    }

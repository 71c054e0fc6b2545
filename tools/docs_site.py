# SPDX-License-Identifier: Apache-2.0
"""Hooks of mkdocs.yml: the API reference, and files of the repository that the pages link to, are part of the site.

On GitHub a page links to ``../bags/README.md``; in the site that file lies at ``repository/bags/README.md``. So the
strict build finds every broken link, and the site needs no other server.
"""

from __future__ import annotations

import posixpath
from typing import TYPE_CHECKING, Final

from tools.api_reference import PAGES, api_page
from tools.documents import DOCS, ROOT, links, resolve, rewrite

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

_OTHERS: Final = 'repository'


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the files of the repository that pages link to, those that these link to, and the API reference."""
    from mkdocs.structure.files import File  # noqa: PLC0415 (its own environment)

    waiting = [f'{DOCS}/{file.src_uri}' for file in files.documentation_pages()]
    while waiting:
        page = waiting.pop()
        for _, target in links((ROOT / page).read_text(encoding='utf-8')):
            name = resolve(page, target)
            place = _place(name)
            if (ROOT / name).is_file() and files.get_file_from_path(place) is None:
                files.append(File.generated(config, place, abs_src_path=str(ROOT / name)))
                if name.endswith('.md'):
                    waiting.append(name)
    for name in PAGES:
        files.append(File.generated(config, f'api/{name}.md', content=api_page(name)))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """Change the links of a page from places in the repository to places in the site."""
    here = page.file.src_uri
    source = _source(here)
    folder = posixpath.dirname(here)
    new: dict[str, str] = {}
    for _line, target in links(markdown):
        path, mark, anchor = target.partition('#')
        if not path:
            continue
        new[target] = posixpath.relpath(_place(resolve(source, target)), folder or '.') + mark + anchor
    return rewrite(markdown, new)


def _place(name: str) -> str:
    """Return the place in the site of a path in the repository."""
    return name.removeprefix(f'{DOCS}/') if name.startswith(f'{DOCS}/') else f'{_OTHERS}/{name}'


def _source(place: str) -> str:
    """Return the path in the repository of a place in the site."""
    return place.removeprefix(f'{_OTHERS}/') if place.startswith(f'{_OTHERS}/') else f'{DOCS}/{place}'

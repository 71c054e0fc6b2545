# SPDX-License-Identifier: Apache-2.0
"""The API reference holds the docstrings and the comments beside fields, of public names only."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import pytest

from tools.api_reference import PAGES, api_page, module_text
from tools.docs_site import on_files
from tools.documents import ROOT, links

MODULE = '''
"""Head, see :mod:`other`.

    w = a + b v

Tail.
"""
LIMIT: Final = 2.0  # Upper limit [m]
_HIDDEN: Final = 1.0

class Row(NamedTuple):
    """One row."""

    speed: float  # Speed | measured [m/s]
    # Force [N],
    # at the rim
    force: float = 0.0
    mass: float = setting(1.0, 'mass', 'kg', 0.0, 9.0)
    _hidden: int = 0

    @property
    def energy(self) -> float:
        """Kinetic energy [J]."""

    def _private(self) -> None: ...

def scale(row: Row, *, by: float = 1.0) -> Row:
    """Return a scaled row.

    Args:
        row: The row.
        by: Factor [1], of
            all fields.

    Raises:
        InputError: It is negative.

    """
'''


@pytest.mark.parametrize(
    ('page', 'parts'),
    [
        ('client', ['w(v) = a + b v + c v^2 + x(v) [N/kN]', '- `NoAnswerError`: The train may not stop at all.']),
        ('bag', ['### BagReader']),
        ('stream', ['| `dt` | `float` |  | Time since the previous sample [s]; NaN for the first and after a gap |']),
        ('estimators', ['[4]      S = P_vv + r', '(17)', 'innovation length p, 1 to 50 observations', 'shape (n, n)']),
    ],
)
def test_a_page_has_units_shapes_errors_and_equations(page: str, parts: list[str]) -> None:
    text = api_page(page)  # raises where a public function has no docstring
    assert [part for part in parts if part not in text] == []
    assert not re.search(r'^#+ (.*\.)?_', text, re.MULTILINE)
    assert not re.search(r'^\| `_', text, re.MULTILINE)
    assert links(text) == []
    assert f'api/{page}.md\n' in (ROOT / 'mkdocs.yml').read_text(encoding='utf-8')


def test_comments_sections_and_signatures_are_shown(tmp_path: Path) -> None:
    (tmp_path / 'rows.py').write_text(MODULE, encoding='utf-8')
    text = module_text(tmp_path / 'rows.py', 'rows')
    assert 'Head, see `other`.\n\n    w = a + b v\n' in text
    assert '| `LIMIT` | `Final` | `2.0` | Upper limit [m] |' in text
    assert '| `speed` | `float` |  | Speed \\| measured [m/s] |' in text
    assert '| `force` | `float` | `0.0` | Force [N], at the rim |' in text
    assert '| `mass` | `float` | `1.0` | mass, 0.0 to 9.0 kg |' in text
    assert '#### Row.energy\n\n```python\nenergy -> float\n```\n\nKinetic energy [J].' in text
    assert 'scale(row: Row, *, by: float=1.0) -> Row' in text
    assert '- `by`: Factor [1], of\n        all fields.' in text
    assert '**Raises**\n\n- `InputError`: It is negative.' in text
    assert 'idden' not in text
    assert '_private' not in text


def test_a_public_function_without_docstring_is_an_error(tmp_path: Path) -> None:
    (tmp_path / 'bare.py').write_text('class Bare:\n    """A class."""\n    def go(self): ...\n', encoding='utf-8')
    with pytest.raises(ValueError, match=r'bare\.py: Bare\.go has no docstring'):
        module_text(tmp_path / 'bare.py', 'bare')


def test_the_site_holds_the_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    pages: dict[str, str] = {}  # mkdocs is not in this environment
    module = ModuleType('mkdocs.structure.files')
    monkeypatch.setattr(module, 'File', Mock(generated=lambda _, name, content: (name, content)), raising=False)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    files = Mock(documentation_pages=list, append=lambda item: pages.update([item]))
    on_files(files, config=Mock())
    assert pages == {f'api/{name}.md': api_page(name) for name in PAGES}


def test_the_generator_imports_the_standard_library_only() -> None:
    tree = ast.parse((ROOT / 'tools' / 'api_reference.py').read_text(encoding='utf-8'))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or '' for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name for name in names if name not in sys.stdlib_module_names} == {'tools.documents'}
    assert len(PAGES) == 4

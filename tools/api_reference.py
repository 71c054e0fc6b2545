# SPDX-License-Identifier: Apache-2.0
"""Pages of the API reference, from docstrings and from the comments beside fields; read with ast, nothing is imported.

A public function, class or method without a docstring is an error.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Final

from tools.documents import ROOT

PAGES: Final = {
    'client': ('client',),
    'bag': ('bag',),
    'stream': ('stream',),
    'estimators': ('estimators', 'resistance', 'speed_model', 'brake_rate'),
}
"""Packages of ``trainid_ros`` on each page."""


def api_page(name: str) -> str:
    """Return the Markdown text of one page."""
    paths = (path for package in PAGES[name] for path in sorted((ROOT / 'trainid_ros' / package).glob('*.py')))
    modules = (module_text(path, '.'.join(path.relative_to(ROOT).with_suffix('').parts)) for path in paths)
    return f'# API of {name}\n\n' + '\n'.join(modules)


def module_text(path: Path, name: str) -> str:
    """Return the section of one module.

    Raises:
        ValueError: A public name has no docstring.

    """
    source = path.read_text(encoding='utf-8')
    tree, lines = ast.parse(source), source.splitlines()
    head = f'## {name.removesuffix(".__init__")}\n\n{_prose(ast.get_docstring(tree) or "")}\n'
    return head + _members(tree, lines, str(path), '')


def _members(owner: ast.Module | ast.ClassDef, lines: list[str], path: str, inside: str) -> str:
    """Return the public constants or fields of a module or class, then its classes and functions."""
    text = _table(owner, lines)
    for node in owner.body:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)) or node.name.startswith('_'):
            continue
        if 'overload' in map(ast.unparse, node.decorator_list):  # what follows has all that they say
            continue
        if not (docstring := ast.get_docstring(node)):
            raise ValueError(f'{path}: {inside}{node.name} has no docstring')
        level = '####' if inside else '###'
        text += f'\n{level} {inside}{node.name}\n\n```python\n{_signature(node)}\n```\n\n{_prose(docstring)}\n'
        if isinstance(node, ast.ClassDef):
            text += _members(node, lines, path, f'{node.name}.')
    return text


def _signature(node: ast.FunctionDef | ast.ClassDef) -> str:
    if isinstance(node, ast.ClassDef):
        functions = [one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == '__init__']
        arguments = ast.unparse(functions[0].args) if functions else ', '.join(map(ast.unparse, node.bases))
        return f'class {node.name}({arguments})'.replace('(self, ', '(').replace('(self)', '()')
    arguments = ast.unparse(node.args).removeprefix('self').removeprefix(', ')
    is_property = 'property' in map(ast.unparse, node.decorator_list)
    returns = f' -> {ast.unparse(node.returns)}' if node.returns else ''
    return f'{node.name}{"" if is_property else f"({arguments})"}{returns}'


def _table(owner: ast.Module | ast.ClassDef, lines: list[str]) -> str:
    """Return the table of public constants or fields; empty without any. Those in the docstring are left out."""
    rows, docstring = '', ast.get_docstring(owner) or ''
    for node, after in zip(owner.body, [*owner.body[1:], None], strict=True):
        if isinstance(node, ast.Assign) and isinstance(owner, ast.ClassDef):  # a member of an enumeration
            target, kind = node.targets[0], ''
        elif isinstance(node, ast.AnnAssign):
            target, kind = node.target, f'`{ast.unparse(node.annotation)}`'
        else:
            continue
        name, value = ast.unparse(target), ast.unparse(node.value) if node.value else ''
        if name.startswith('_') or kind.startswith('`ClassVar') or f'    {name}: ' in docstring:
            continue
        told = _comment(node, after, lines)
        if isinstance(node.value, ast.Call) and value.startswith('setting('):  # default, text, unit, lowest, highest
            value, text, unit, low, high = (ast.unparse(one).strip('\'"') for one in node.value.args)
            told = f'{text}, {low} to {high} {unit}'.removesuffix(' 1').strip()
        shown = f'`{value}`' if 0 < len(value) <= 60 else ''  # long values stand in the source
        rows += '| ' + ' | '.join(cell.replace('|', '\\|') for cell in (f'`{name}`', kind, shown, told)) + ' |\n'
    return f'\n| name | type | value | meaning |\n|---|---|---|---|\n{rows}' if rows else ''


def _comment(node: ast.stmt, after: ast.stmt | None, lines: list[str]) -> str:
    """Return the comment behind a statement, else the text below it, else the comment above it."""
    last = lines[(node.end_lineno or 1) - 1].encode()[node.end_col_offset :].decode()
    if behind := last.partition('#')[2].partition('noqa')[0].strip(' #'):
        return behind
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
        return ' '.join(str(after.value.value).split())
    above: list[str] = []
    while (line := lines[node.lineno - 2 - len(above)].strip()).startswith('#'):
        above.insert(0, line.strip(' #'))
    return ' '.join(above)


def _prose(docstring: str) -> str:
    """Return a docstring as Markdown: the entries of its sections become lists, other indented lines stay code."""
    text = re.sub(r':\w+:`~?([^`]*)`', r'`\1`', docstring)
    section = r'^(Args|Attributes|Returns|Yields|Raises):\n((?: {4}.*\n?)+)'
    listed = re.sub(section, lambda m: f'**{m[1]}**\n\n{re.sub(r"(?m)^ {4}(?! )", "- ", m[2])}', text, flags=re.M)
    return re.sub(r'(?m)^- (\w+): ', r'- `\1`: ', listed)

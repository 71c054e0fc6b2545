# SPDX-License-Identifier: Apache-2.0
"""The steps at the head of each algorithm stand at lines of its code and of its plain numpy reference."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Head, modules with the code lines, and the reference, each without its suffix.
ALGORITHMS = (
    (
        'resistance/filter_bank',
        ('resistance/hypotheses',),
        'resistance/reference_filter_bank',
    ),
    (
        'resistance/vmils',
        ('resistance/window_learner', 'resistance/change_points'),
        'resistance/reference_vmils',
    ),
    ('speed_model/am_vff_rls', (), 'speed_model/reference_am_vff_rls'),
    ('brake_rate/gsma', ('brake_rate/m_algorithm',), 'brake_rate/reference_gsma'),
)


def numbers(text: str) -> set[int]:
    """Return the numbers of steps [n], with those inside ranges like [2]-[5]."""
    found = {int(n) for n in re.findall(r'\[(\d+)\]', text)}
    for first, last in re.findall(r'\[(\d+)\]-\[(\d+)\]', text):
        found |= set(range(int(first), int(last)))
    return found


def comments(path: Path) -> str:
    return '\n'.join(re.findall(r'#.*', path.read_text(encoding='utf-8')))


@pytest.mark.parametrize(('head', 'modules', 'reference'), ALGORITHMS)
def test_each_step_is_marked_in_the_code(head: str, modules: tuple[str, ...], reference: str) -> None:
    paths = [ROOT / 'trainid_ros' / f'{name}.py' for name in (head, *modules)]
    text = ast.get_docstring(ast.parse(paths[0].read_text(encoding='utf-8'))) or ''
    steps = {int(n) for n in re.findall(r'^ +\[(\d+)\]', text, re.MULTILINE)}
    assert steps == set(range(1, max(steps) + 1))
    assert len(steps) >= 15
    assert set().union(*(numbers(comments(path)) for path in paths)) == steps
    oracle = ROOT / 'test' / f'{reference}.py'
    assert numbers(comments(oracle)) <= steps
    assert oracle.relative_to(ROOT).as_posix() in text
    assert oracle.relative_to(ROOT).as_posix() in (ROOT / 'docs/algorithms.md').read_text(encoding='utf-8')

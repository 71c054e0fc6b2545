# SPDX-License-Identifier: Apache-2.0
"""Which changes are made to a source, and which tests see them first."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks import mutation
from benchmarks.mutation import (
    FOLDERS,
    REPOSITORY,
    Called,
    failure_of,
    function_at,
    mutants_of,
    order_of,
    read_calls,
    sample,
)

SOURCE = b'''"""Doc."""
from __future__ import annotations

LIMIT: Final = 2.0


def f(x: int = 1) -> int:
    """Doc 7."""
    if not x or x < 3:
        raise ValueError(f'no {x + 1}')
    x += 1
    g(x)
    return x * LIMIT


@dataclass(frozen=True)
class Point:
    x: float = 3.0
'''


def test_each_kind_of_change_is_made_once_and_texts_and_types_are_left_alone() -> None:
    found = mutants_of('f.py', SOURCE)
    assert [(one.line, one.before, one.after) for one in found] == [
        (4, '2.0', '(4.0)'),
        (7, '1', '(2)'),
        (9, 'not x', '(x)'),
        (9, 'not x or x < 3', '(not x and x < 3)'),
        (9, 'x < 3', '(x <= 3)'),
        (9, '3', '(4)'),
        (11, 'x += 1', 'x -= 1'),
        (11, '1', '(2)'),
        (12, 'g(x)', 'pass'),
        (13, 'return x * LIMIT', 'return None'),
        (13, 'x * LIMIT', '(x / LIMIT)'),
        (18, '3.0', '(6.0)'),
    ]


def test_a_sample_is_reproducible_and_of_each_folder() -> None:
    chosen = sample(20, 5)
    assert chosen == sample(20, 5)
    assert chosen != sample(20, 6)
    assert {name: len(some) for name, some in chosen.items()} == dict.fromkeys(FOLDERS, 4)
    for mutant in (mutant for some in chosen.values() for mutant in some):
        source = (REPOSITORY / mutant.path).read_bytes()
        ast.parse(source[: mutant.begin] + mutant.after.encode() + source[mutant.end :])


def test_the_tests_that_call_the_changed_function_are_chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(mutation, 'REPOSITORY', tmp_path)
    (tmp_path / 'm.py').write_bytes(SOURCE)
    mutant = next(mutant for mutant in mutants_of('m.py', SOURCE) if mutant.line == 13)
    assert function_at('m.py', 13) == 7
    assert function_at('m.py', 4) == 0
    slow, fast = (
        Called('a.py::slow', 2.0, frozenset({('m.py', 7)})),
        Called('b.py::fast', 1.0, frozenset({('m.py', 7)})),
    )
    beside, other = Called('a.py::beside', 0.1, frozenset()), Called('c.py::other', 0.1, frozenset({('m.py', 16)}))
    assert order_of(mutant, [beside, slow, fast, other]) == [fast, slow]
    assert order_of(mutant, [beside]) == [beside]


def test_calls_of_a_test_are_those_of_the_package(tmp_path: Path) -> None:
    for path in ('tools', 'benchmarks', 'pyproject.toml'):
        (tmp_path / path).symlink_to(REPOSITORY / path)
    (tmp_path / 'trainid_ros').mkdir()
    (tmp_path / 'trainid_ros' / '__init__.py').write_bytes(b'')
    (tmp_path / 'trainid_ros' / 'm.py').write_text('\n\ndef f(): pass\n\ndef g(): pass\n', encoding='utf-8')
    (tmp_path / 'test_m.py').write_text(
        'import pytest\nfrom trainid_ros.m import f, g\n\n@pytest.fixture(scope="module")\ndef x(): g()\n\n'
        'def test_a(): f()\n\ndef test_b(x): len("")\n',
        encoding='utf-8',
    )
    out = tmp_path / 'out'
    assert failure_of(['-p', 'benchmarks.mutation', '--called', str(out), 'test_m.py'], tmp_path) == ''
    assert [(one.name, one.functions) for one in read_calls(out)] == [
        ('test_m.py::test_a', frozenset({('trainid_ros/m.py', 3), ('trainid_ros/m.py', 5)})),
        ('test_m.py::test_b', frozenset({('trainid_ros/m.py', 5)})),
    ]


def test_what_stops_the_tests_is_not_taken_for_a_failure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / 'tools').symlink_to(REPOSITORY / 'tools')
    (tmp_path / 'test_a.py').write_text('def test_a(): pass\n\ndef test_b(): assert not 7\n', encoding='utf-8')
    (tmp_path / 'test_b.py').write_text('import nothing_of_this_name\n', encoding='utf-8')
    (tmp_path / 'c').mkdir()
    (tmp_path / 'c' / 'conftest.py').write_text('import nothing_of_this_name\n', encoding='utf-8')
    assert failure_of(['test_a.py::test_a'], tmp_path) == ''
    assert 'assert not 7' in failure_of(['test_a.py'], tmp_path)
    for broken in ('test_b.py', 'c'):
        assert 'nothing_of_this_name' in failure_of([broken], tmp_path)
    (tmp_path / 'test_c.py').write_text('def test_c():\n    while True: pass\n', encoding='utf-8')
    monkeypatch.setattr(mutation, '_IMPORT_S', 3)
    assert 'CPU time' in failure_of(['test_c.py'], tmp_path, 0.0)
    assert 'not found' in failure_of(['test_a.py::test_gone'], tmp_path)
    with pytest.raises(RuntimeError, match='exit code 4'):
        failure_of(['--unknown'], tmp_path)

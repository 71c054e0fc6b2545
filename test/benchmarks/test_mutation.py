# SPDX-License-Identifier: Apache-2.0
"""Which changes are made to a source, and which tests see them first."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks.days import REPOSITORY
from benchmarks.mutation import FOLDERS, failure_of, mutants_of, sample, targets_of

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


def test_the_tests_that_mirror_a_module_run_first() -> None:
    first, golden, rest = targets_of('trainid_ros/stream/alignment.py', REPOSITORY)
    assert first == ['test/stream/alignment']
    assert golden == ['test/golden']
    assert rest == ['test/stream', '--ignore=test/stream/alignment']


def test_what_stops_the_tests_is_not_taken_for_a_failure(tmp_path: Path) -> None:
    (tmp_path / 'tools').symlink_to(REPOSITORY / 'tools')
    (tmp_path / 'test_a.py').write_text('def test_a(): pass\n\ndef test_b(): assert not 7\n', encoding='utf-8')
    (tmp_path / 'test_b.py').write_text('import nothing_of_this_name\n', encoding='utf-8')
    (tmp_path / 'c').mkdir()
    (tmp_path / 'c' / 'conftest.py').write_text('import nothing_of_this_name\n', encoding='utf-8')
    assert failure_of(['test_a.py::test_a'], tmp_path) == ''
    assert 'assert not 7' in failure_of(['test_a.py'], tmp_path)
    for broken in ('test_b.py', 'c'):
        assert 'nothing_of_this_name' in failure_of([broken], tmp_path)
    with pytest.raises(RuntimeError, match='exit code 4'):
        failure_of(['missing.py'], tmp_path)

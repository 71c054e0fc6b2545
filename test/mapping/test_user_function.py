# SPDX-License-Identifier: Apache-2.0
"""Functions beside a mapping: what they get and return, and errors that name them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.units import find_unit
from trainid_ros.mapping.user_function import UserFunction, user_function

CODE = """
import numpy as np
def double(x, y): return 2.0 * x + y
def short(x): return x[1:]
def words(x): return ['a'] * len(x)
def broken(x): raise RuntimeError('no\\nway')
def gone(x): raise SystemExit(0)
number = 3
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / 'code.py').write_text(CODE, encoding='utf-8')
    (tmp_path / 'bad.py').write_text('1 +', encoding='utf-8')
    (tmp_path / 'sub').mkdir()
    (tmp_path / 'sub' / 'other.py').write_text(CODE, encoding='utf-8')
    return tmp_path


def function(folder: Path, text: str, unit: str = 'kN') -> UserFunction:
    return user_function(folder, text, find_unit(unit, 'force'))


def test_columns_and_single_numbers_give_the_same_in_the_unit_of_the_interface(folder: Path) -> None:
    double = function(folder, 'code.py:double')
    assert double.of_columns([np.array([1.0, np.nan]), np.array([3.0, 4.0])]).tolist() == pytest.approx(
        [5000.0, np.nan], nan_ok=True
    )
    assert double.of_numbers([1.0, 3.0]) == 5000.0
    assert not (folder / '__pycache__').exists()


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('code.py', 'must be a Python file and a function in it'),
        ('code.txt:double', 'must be a Python file and a function in it'),
        ('code.py:a.b', 'must be a Python file and a function in it'),
        ('none.py:double', 'is not there'),
        ('sub/other.py:double', 'must lie in the folder'),
        ('../code.py:double', 'must lie in the folder'),
        ('/tmp/code.py:double', 'must lie in the folder'),
    ],
)
def test_only_files_of_the_folder_are_taken(folder: Path, text: str, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        function(folder, text)


def test_a_link_out_of_the_folder_is_refused(folder: Path) -> None:
    (folder / 'link.py').symlink_to(folder / 'sub' / 'other.py')
    with pytest.raises(ValueError, match='must lie in the folder'):
        function(folder, 'link.py:double')


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('bad.py:double', r'bad\.py: cannot be run: SyntaxError'),
        ('code.py:none', r'code\.py: has no function none'),
        ('code.py:number', r'code\.py: has no function number'),
        ('code.py:gone', r'code\.py:gone failed in line 7: SystemExit: 0'),
        ('code.py:broken', r'code\.py:broken failed in line 6: RuntimeError: no'),
        ('code.py:words', r'code\.py:words failed: ValueError'),
        ('code.py:short', r'code\.py:short returned shape \(2,\), \(3,\) expected'),
        ('code.py:double', r'code\.py:double failed: TypeError'),
    ],
)
def test_what_a_function_does_wrong_is_said(folder: Path, text: str, error: str) -> None:
    with pytest.raises(InputError, match=error):
        function(folder, text).of_columns([np.zeros(3)])

# SPDX-License-Identifier: Apache-2.0
"""Units, dates and functions of a mapping."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trainid_ros.inputs.mapping import UserFunction, date_time_ns, find_unit, time_of_day_ns, user_function
from trainid_ros.interface.errors import InputError


@pytest.mark.parametrize(
    ('text', 'quantity', 'value', 'expected'),
    [
        ('m/s', 'speed', 20.0, 20.0),
        ('km/h', 'speed', 72.0, 20.0),
        ('mph', 'speed', 10.0, 4.4704),
        ('kN', 'force', -1.5, -1500.0),
        ('lbf', 'force', 1.0, 4.4482216152605),
        ('percent', 'gradient', 1.2, 12.0),
        ('deg', 'gradient', 1.0, 17.4524064),
        ('rad', 'gradient', 0.01, 9.99983333),
        ('t', 'mass', 194.0, 194e3),
        ('lb', 'mass', 1.0, 0.45359237),
        ('km', 'length', 1.5, 1500.0),
        ('percent_of 300 kN', 'force', 50.0, 150e3),
        ('percent_of 1.2 m/s^2', 'acceleration', -100.0, -1.2),
    ],
)
def test_a_value_is_converted(text: str, quantity: str, value: float, expected: float) -> None:
    assert find_unit(text, quantity).convert(value) == pytest.approx(expected)


@pytest.mark.parametrize(
    ('text', 'quantity', 'hint'),
    [
        ('kmh', 'speed', "did you mean 'km/h'"),
        ('kN', 'speed', 'known: '),
        ('deg', 'speed', 'known: '),
        ('', 'mass', 'known: '),
        ('percent_of', 'force', 'must be like'),
        ('percent_of x kN', 'force', 'must be like'),
        ('percent_of 0 kN', 'force', 'must be like'),
        ('percent_of nan kN', 'force', 'must be like'),
        ('percent_of 300 km/h', 'force', 'must be like'),
    ],
)
def test_an_unknown_unit_is_rejected_with_a_hint(text: str, quantity: str, hint: str) -> None:
    with pytest.raises(ValueError, match=hint.replace('.', r'\.')):
        find_unit(text, quantity)


NOON_NS = 1_709_899_200 * 10**9


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('2024-03-08T12:00:00Z', NOON_NS),
        ('2024-03-08 12:00:00', NOON_NS),
        ('2024-03-08T13:00:00+01:00', NOON_NS),
        ('2024-03-08T12:00:00.123456789Z', NOON_NS + 123_456_789),
        ('2024-03-08T13:00:00,5+01:00', NOON_NS + 500_000_000),
        ('2024-03-08', NOON_NS - 12 * 3600 * 10**9),
        ('8.3.2024 12:00:00,25', NOON_NS + 250_000_000),
        ('08.03.2024', NOON_NS - 12 * 3600 * 10**9),
        ('2024-03-08 12:00:00:900', NOON_NS + 900_000_000),
        ('08.03.2024 12:00:00:009', NOON_NS + 9_000_000),
        ('2024-03-08T13:00:00:900+01:00', NOON_NS + 900_000_000),
        ('2024-03-08T120000.5Z', NOON_NS + 500_000_000),
        ('2024-03-08 12', NOON_NS),
        # Only a part of these would be used, or not as what it is.
        ('2024-03-08 12:00:00:9', None),
        ('2024-03-08 12:00:00:900:1', None),
        ('2024-03-08 12:00:00.123.456', None),
        ('2024-03-08 12:00:00.123:456', None),
        ('2024-03-08 12:00.5', None),
        ('2024-03-08 12:00:00+01:00:30.5', None),
        ('08/03/2024 12:00:00', None),
        ('12,5', None),
        ('1.5', None),
        ('20240308', None),
        ('2024-13-08T12:00:00', None),
        ('a-b-c', None),
    ],
)
def test_dates_are_read_to_the_nanosecond(text: str, expected: int | None) -> None:
    assert date_time_ns(text) == expected


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


@pytest.mark.parametrize(
    ('text', 'expected_ns'),
    [
        ('12:00:00:900', 43_200_900_000_000),
        ('12:00:00,9', 43_200_900_000_000),
        ('12:00:00:9', None),
        ('12:00:00.9:1', None),
    ],
)
def test_a_time_of_day_is_read_whole_or_not_at_all(text: str, expected_ns: int | None) -> None:
    assert time_of_day_ns(text) == expected_ns

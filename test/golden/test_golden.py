# SPDX-License-Identifier: Apache-2.0
"""The estimates of two simulated runs equal those of the last reviewed version.

Numbers may differ by a relative 1e-6: sums and matrix products of other numpy or BLAS builds, and the
exponentials of other C libraries, round their last bits differently, and a filter propagates this over
2000 samples. A change of an algorithm, a default or the simulator is larger by orders of magnitude.
"""

from __future__ import annotations

import csv
import importlib.util
import math
from pathlib import Path
from types import ModuleType

import pytest

HERE = Path(__file__).parent
RELATIVE = 1e-6
# Innovations and errors pass through zero, where a relative tolerance does not work.
ABSOLUTE = 1e-9
NAMES = ('resistance', 'resistance_vmils', 'speed_model', 'brake_rate')
Rows = list[dict[str, str]]


def load_maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location('make_golden', HERE / 'make_golden.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def found() -> dict[str, Rows]:
    rows: dict[str, Rows] = load_maker().outputs()
    return rows


def expected(name: str) -> Rows:
    with (HERE / f'{name}.csv').open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))


def error(old: str, new: str) -> float:
    """Return the difference in units of the tolerance; infinite for different text."""
    if old == new:
        return 0.0
    try:
        a, b = float(old), float(new)
    except ValueError:
        return math.inf
    if math.isnan(a) or math.isnan(b):
        return math.inf
    return abs(a - b) / (RELATIVE * max(abs(a), abs(b)) + ABSOLUTE)


def differences(name: str, old: Rows, new: Rows) -> str:
    """Return a readable summary, empty if there are no differences."""
    if [*old[0]] != [*new[0]]:
        return f'{name}.csv: columns were {[*old[0]]}, are {[*new[0]]}'
    lines = [] if len(old) == len(new) else [f'{name}.csv: {len(old)} rows before, {len(new)} now']
    for column in old[0]:
        errors = [error(a[column], b[column]) for a, b in zip(old, new, strict=False)]
        wrong = [i for i, e in enumerate(errors) if e > 1.0]
        if wrong:
            worst = max(wrong, key=lambda i: errors[i])
            at = f'worst in row {worst + 2}: {old[worst][column]} -> {new[worst][column]}'
            lines.append(f'{name}.csv: {column}: {len(wrong)} of {len(errors)} rows from row {wrong[0] + 2} on, {at}')
    if lines:
        lines.append("If this is intended, run 'make golden', review the difference and commit it.")
    return '\n'.join(lines)


@pytest.mark.parametrize('name', NAMES)
def test_the_estimates_equal_the_reviewed_ones(name: str, found: dict[str, Rows]) -> None:
    summary = differences(name, expected(name), found[name])
    assert not summary, summary


@pytest.mark.parametrize('name', NAMES)
def test_the_expected_rows_cover_a_stop_and_all_statuses(name: str) -> None:
    """They cover two runs with a stop and an estimate that becomes valid during them."""
    rows = expected(name)
    assert len(rows) > 50
    assert {'CONVERGING', 'VALID', 'HOLDING'} == {row['status'] for row in rows}


def test_a_difference_is_reported_by_column_row_and_size() -> None:
    old = [{'a': '1.0', 'b': '2.0'}, {'a': '1.0', 'b': '2.0'}]
    new = [{'a': '1.0', 'b': '2.000001'}, {'a': '1.0000001', 'b': '2.5'}]
    summary = differences('x', old, new)
    assert 'x.csv: b: 1 of 2 rows from row 3 on, worst in row 3: 2.0 -> 2.5' in summary
    assert 'make golden' in summary
    assert 'x.csv: a' not in summary
    assert not differences('x', old, old)
    assert '2 rows before, 1 now' in differences('x', old, new[:1])
    assert 'columns' in differences('x', old, [{'a': '1.0'}])
    assert 'VALID -> HOLDING' in differences('x', [{'s': 'VALID'}], [{'s': 'HOLDING'}])

# SPDX-License-Identifier: Apache-2.0
"""The estimates of two simulated runs are those of the last reviewed version.

Numbers may differ by 1e-6 of themselves: sums and matrix products of other numpy or BLAS builds, and the
exponentials of other C libraries, round their last bits differently; a filter carries that along for
2000 samples. A change of an algorithm, a default or the simulator is larger by orders.
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
# Innovations and errors pass through zero, where nothing is relative.
ABSOLUTE = 1e-9
NAMES = ('resistance', 'speed_model', 'brake_rate')
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
    """Return the difference in units of what is allowed; infinite for other text."""
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
    """Return a summary for people, empty if all is well."""
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
        lines.append("If this is meant, run 'make golden', look at the difference and commit it.")
    return '\n'.join(lines)


@pytest.mark.parametrize('name', NAMES)
def test_the_estimates_are_those_that_were_reviewed(name: str, found: dict[str, Rows]) -> None:
    summary = differences(name, expected(name), found[name])
    assert not summary, summary


@pytest.mark.parametrize('name', NAMES)
def test_the_expectation_is_worth_comparing(name: str) -> None:
    """Two runs with a stop, and an estimate that became valid on the way."""
    rows = expected(name)
    assert len(rows) > 50
    assert {'CONVERGING', 'VALID', 'HOLDING'} == {row['status'] for row in rows}


def test_a_difference_is_told_by_column_row_and_size() -> None:
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

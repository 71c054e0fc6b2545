# SPDX-License-Identifier: Apache-2.0
"""The checks of the inputs on many drives: what is counted, and that a gross fault is found."""

from __future__ import annotations

import math

import pytest

from benchmarks import healthy
from benchmarks.healthy import Case, Moment, faulty_rows, moments_of, outcome_of, rows_of

S_NS = 10**9


def test_motion_under_findings_is_counted() -> None:
    """Ten minutes at 5 Hz from 1200 s on with a fault that is found after a minute, and cleared ten seconds late."""
    finding = 'ato/force is in kN'
    moments = [Moment(S_NS + k * S_NS // 5, 0.2, finding if 6300 <= k < 9050 else '') for k in range(12_000)]
    outcome = outcome_of(moments, Case('metro', 1, fault='force in kN'))
    assert outcome.found_s == pytest.approx(60.2)
    assert outcome.cleared_s == pytest.approx(10.2)
    assert outcome.found == pytest.approx(550.0 / 2400.0)
    assert outcome.is_right
    assert len(outcome.findings) == 1
    wrong = outcome_of(moments, Case('metro', 1, fault='speed half'))
    assert not wrong.is_right


@pytest.mark.slow
def test_a_gross_fault_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    train_file, rows = rows_of('metro', 5000, -1, 400.0)
    monkeypatch.setattr(healthy, '_BEGIN_S', 100.0)
    monkeypatch.setattr(healthy, '_END_S', 250.0)
    case = Case('metro', 5000, fault='force in kN')
    faulty = faulty_rows(rows, healthy.FAULTS['force in kN'], from_start=False)
    outcome = outcome_of(moments_of(train_file, faulty), case)
    assert outcome.is_right
    assert math.isfinite(outcome.found_s)

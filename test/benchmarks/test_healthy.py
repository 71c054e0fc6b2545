# SPDX-License-Identifier: Apache-2.0
"""The check of the inputs on many drives: what is counted, and that a gross fault is found."""

from __future__ import annotations

import math

import pytest

from benchmarks import healthy
from benchmarks.healthy import Case, Moment, faulty_rows, moments_of, outcome_of, rows_of, samples_of
from benchmarks.unusual import UNUSUAL
from trainid_ros.stream.samples import coasting_sample

S_NS = 10**9


def test_motion_under_findings_is_counted() -> None:
    """Ten minutes at 5 Hz from 1200 s on with a fault that is found after a minute, and cleared ten seconds late."""
    samples = [coasting_sample(S_NS + k * S_NS // 5, 0.2, 10.0) for k in range(12_000)]
    moments = [Moment('ato/force is in kN' if 1260.0 <= 0.2 * k < 1810.0 else '', False, True) for k in range(12_000)]
    outcome = outcome_of(moments, samples, Case('metro', 1, fault='force in kN'))
    assert outcome.found_s == pytest.approx(60.2)
    assert outcome.cleared_s == pytest.approx(10.2)
    assert outcome.found == pytest.approx(550.0 / 2400.0)
    assert outcome.is_right
    assert len(outcome.findings) == 1
    wrong = outcome_of(moments, samples, Case('metro', 1, fault='speed half'))
    assert not wrong.is_right


@pytest.mark.slow
def test_a_gross_fault_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    train_file, rows = rows_of('metro', 5000, -1, 400.0)
    monkeypatch.setattr(healthy, '_BEGIN_S', 100.0)
    monkeypatch.setattr(healthy, '_END_S', 250.0)
    case = Case('metro', 5000, fault='force in kN')
    samples = samples_of(train_file, faulty_rows(rows, healthy.FAULTS['force in kN'], from_start=False))
    outcome = outcome_of(moments_of(train_file, samples), samples, case)
    assert outcome.is_right
    assert math.isfinite(outcome.found_s)


@pytest.mark.slow
@pytest.mark.parametrize('place', range(len(UNUSUAL)), ids=lambda k: UNUSUAL[k].name)
def test_each_unusual_drive_can_be_made(place: int) -> None:
    train_file, rows = rows_of(UNUSUAL[place].world, 5000, place, 120.0)
    assert samples_of(train_file, rows)

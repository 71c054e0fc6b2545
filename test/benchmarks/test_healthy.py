# SPDX-License-Identifier: Apache-2.0
"""What is counted of what the checks of the inputs say on a drive."""

from __future__ import annotations

import pytest

from benchmarks.healthy import Moment, outcome_of

S_NS = 10**9


def test_motion_under_findings_is_counted() -> None:
    """Forty minutes at 5 Hz, the first tenth at a stand, with a finding for ten and a suspicion for twenty minutes."""
    moments = [
        Moment(
            S_NS + k * S_NS // 5,
            0.2 if k >= 1200 else 0.0,
            'ato/force is in kN' if 3000 <= k < 6000 else '',
            'ato/speed' if 3000 <= k < 9000 else '',
            holds_resistance=k < 6000,
        )
        for k in range(12_000)
    ]
    outcome = outcome_of(moments)
    assert outcome.findings == ('ato/force is in kN',)
    assert outcome.moved_s == pytest.approx(2160.0)
    assert (outcome.found, outcome.suspected) == pytest.approx((600.0 / 2160.0, 600.0 / 2160.0))
    assert outcome.held == pytest.approx(960.0 / 2160.0)
    assert outcome.suspicions == ('ato/speed (600 s)',)
    assert outcome_of(moments[:100]).found == 0.0

# SPDX-License-Identifier: Apache-2.0
"""One fault through real processes: the benchmark has a dozen and a half."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import faults_live
from benchmarks.faults import BY_NAME
from benchmarks.faults_live import CASES, HEALTHY, NODES, Case, Trial, score
from benchmarks.graph import private_domain


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.name)
def test_cases_are_complete(case: Case) -> None:
    re.compile(case.expected)
    assert set(case.faults) <= BY_NAME.keys()
    processes = {sender.name for sender in (*HEALTHY, *case.senders)} | {NODES}
    assert {action.process for action in case.actions} <= processes
    assert all(0.0 <= action.at_s <= case.duration_s for action in case.actions)


@pytest.mark.ros
def test_messages_that_are_no_numbers_are_named_and_nothing_wrong_is_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = next(case for case in CASES if case.name == 'speed not a number')
    for slow in (1.0, 4.0, 16.0):  # a slow machine has the processes ready later than the case begins
        folder = tmp_path / f'{slow:g}'
        folder.mkdir()
        monkeypatch.setattr(faults_live, '_SET_UP_S', 5.0 * slow)
        monkeypatch.setattr(faults_live, '_TAIL_S', 0.5 * slow)
        with private_domain(folder):
            outcome = score(case, Trial(replace(case, duration_s=6.0), folder).run())
        if outcome.resumed and math.isfinite(outcome.named_s) and math.isfinite(outcome.withdrawn_s):
            break
    assert outcome.resumed
    assert 'messages not used: NOT_FINITE' in outcome.text
    assert math.isfinite(outcome.named_s) and math.isfinite(outcome.withdrawn_s)
    assert (outcome.wrong_s, outcome.non_finite) == (0.0, 0)
    assert outcome.rejected['NOT_FINITE'] > 0

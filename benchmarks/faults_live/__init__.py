# SPDX-License-Identifier: Apache-2.0
"""Faults of messages, publishers and processes, in real time: the three nodes in one process, and their publishers.

Each case has processes and a ROS domain of its own; some run at the same time.
"""

from __future__ import annotations

import math
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks.faults_live.cases import CASES, FAULT_S
from benchmarks.faults_live.score import score
from benchmarks.faults_live.trial import Trial
from benchmarks.live import private_domain
from benchmarks.tables import Table
from trainid_ros.cli.processes import free_domain

if TYPE_CHECKING:
    from benchmarks.faults_live.cases import Case
    from benchmarks.faults_live.score import Outcome

_AT_A_TIME: Final = 3
_DOMAINS_APART: Final = 7
_HEADER: Final = (
    'fault',
    'not fit after, s',
    'named after, s',
    'VALID > 3 std, s',
    'worst, std',
    'fit again, s',
    'rejected',
    'what names it',
)
_NOTE: Final = (
    f'One trial each, at 5 Hz; the fault lasts {FAULT_S:g} s, or as long as it says. Not fit: the resistance is '
    'neither VALID nor HOLDING. Named: by `/diagnostics`, once a second, or by an event of the middleware. VALID '
    'beyond 3 std: of resistance or brake rate, since the start of the fault. Fit again: after the end of the fault. '
    'Rejected: records and samples of the resistance, by the most frequent reason.'
)


def measure() -> tuple[Table, ...]:
    """Run all cases; return their table."""
    with ProcessPoolExecutor(_AT_A_TIME, mp_context=get_context('spawn')) as pool:
        rows = tuple(_row(case, outcome) for case, outcome in zip(CASES, pool.map(run, CASES), strict=True))
    return (Table('Faults through real processes', _HEADER, rows, _NOTE),)


def run(case: Case) -> Outcome:
    """Return the outcome of a case."""
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)):
        # Cases that start at the same time must not find the same domain free.
        os.environ['ROS_DOMAIN_ID'] = str(free_domain(_DOMAINS_APART * os.getpid()))
        return score(case, Trial(case, Path(name)).run())


def _row(case: Case, outcome: Outcome) -> tuple[str, ...]:
    name = case.name
    if outcome.non_finite:
        name += ' (NOT FINITE)'
    if not outcome.resumed:
        name += ' (NOT RESUMED)'
    if not outcome.ready:
        name += ' (NOT READY)'
    ((reason, count),) = outcome.rejected.most_common(1) or (('', 0),)
    return (
        name,
        _seconds(outcome.withdrawn_s),
        _seconds(outcome.named_s),
        f'{outcome.wrong_s:.1f}',
        f'{outcome.worst:.1f}',
        _seconds(outcome.back_s),
        f'{count} {reason}' if count else '-',
        outcome.text,
    )


def _seconds(value: float) -> str:
    return f'{value:.1f}' if math.isfinite(value) else '-'

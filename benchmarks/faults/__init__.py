# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the inputs of simulated drives: when they are named, and what is published meanwhile.

Each fault is injected from the first message on, and for a minute in mid-drive, on days of several seeds.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.faults.injection import FAULTS
from benchmarks.faults.trial import Injection, run
from benchmarks.papers.seeds import over_seeds
from benchmarks.tables import Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.faults.trial import Outcome

_FIRST_SEED = 4001
_MOST_SEEDS = 12
_HEADER = ('fault', 'named', 'after, s', 'VALID > 3 std, s', 'worst, std', 'w left, N/kN', 'rate left', 'what names it')
_NOTE = (
    'Medians and worst cases over days of {count} seeds. Named: share of the days on which a finding, a reason of '
    'rejection or a status that the healthy drive does not have shows up; after: median motion until then. VALID '
    'beyond 3 std: longest over the days, of resistance or brake rate, since the start of the fault. Left: median of '
    'the absolute error a minute of motion after the fault less that of the same drive without it.'
)


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables for faults from the first message on and in mid-drive."""
    return tuple(_table(from_start, min(seeds, _MOST_SEEDS)) for from_start in (True, False))


def _table(from_start: bool, seeds: int) -> Table:
    trials = [Injection((place,), _FIRST_SEED + k, from_start) for place in range(len(FAULTS)) for k in range(seeds)]
    outcomes = over_seeds(run, trials, 'faults')
    rows = tuple(
        _row(FAULTS[place].name, outcomes[place * seeds : (place + 1) * seeds]) for place in range(len(FAULTS))
    )
    when = 'from the first message on' if from_start else 'for a minute in mid-drive'
    return Table(f'Faults {when}', _HEADER, rows, _NOTE.format(count=seeds))


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    named = [outcome.named_s for outcome in outcomes if math.isfinite(outcome.named_s)]
    texts = Counter(outcome.name.partition(':')[0] for outcome in outcomes if math.isfinite(outcome.named_s))
    if any(outcome.non_finite for outcome in outcomes):
        name += ' (NOT FINITE)'
    return (
        name,
        f'{len(named) / len(outcomes):.0%}',
        f'{np.median(named):.0f}' if named else '-',
        f'{max(outcome.wrong_s for outcome in outcomes):.1f}',
        f'{max(outcome.worst for outcome in outcomes):.1f}',
        _median([outcome.resistance_left for outcome in outcomes], '+.3f'),
        _median([outcome.brake_left for outcome in outcomes], '+.3f'),
        texts.most_common(1)[0][0] if texts else '-',
    )


def _median(values: Sequence[float], form: str) -> str:
    known = [value for value in values if math.isfinite(value)]
    return format(float(np.median(known)), form) if known else '-'

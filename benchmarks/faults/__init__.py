# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the inputs of simulated drives: when they are named, and what is published meanwhile.

Each fault is injected from the first message on, and for a minute in mid-drive; pairs of them in mid-drive. Days of
several seeds.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.faults.catalogue import FAULTS, NOTHING, PAIRS
from benchmarks.faults.trial import Injection, run
from benchmarks.rides import DAY
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.worlds import WORLDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.faults.trial import Outcome

_FIRST_SEED = 4001
_MAX_SEEDS = 12
_MAX_WORLD_SEEDS = 2
_HEADER = (
    'fault',
    'seen',
    'after, s',
    'named',
    'after, s',
    'used > 3 std, s',
    'by the fault, s',
    'worst, std',
    'w left, N/kN',
    'rate left',
    'rejected',
    'what names it',
)
_NOTE = (
    'Medians and worst cases over days of {count} seeds. Seen: share of the days on which a finding, a reason of '
    'rejection or a status that the healthy drive does not have shows up; after: median motion until then. Named: the '
    'same without OUTLIER, CONTRADICTION and BRAKE_UNCERTAIN, which do not say what is wrong. Used beyond 3 std: '
    'time that the resistance or the brake rate was VALID or HOLDING and that far off since the fault began, at most; '
    'by the fault: the same, but not at times at which it was so without the fault, too. The row "nothing" has what '
    'the drives have by themselves. Left: median of the absolute error a minute of motion after the fault less that of '
    'the same drive without it. Rejected: the most frequent reason, and its mean count beyond that without the fault.'
)


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables for faults from the first message on and in mid-drive, of each train, and in pairs."""
    count, single = min(seeds, _MAX_SEEDS), [(fault.name,) for fault in (NOTHING, *FAULTS)]
    kinds = ((DAY, count), *((world, min(seeds, _MAX_WORLD_SEEDS)) for world in WORLDS))
    return (
        *(_table(f'Faults from the first message on: {kind}', single, n, kind, from_start=True) for kind, n in kinds),
        *(_table(f'Faults for a minute in mid-drive: {kind}', single, n, kind) for kind, n in kinds),
        _table('Pairs of faults for a minute in mid-drive', [(NOTHING.name,), *PAIRS], count, DAY),
    )


def _table(title: str, faults: Sequence[tuple[str, ...]], seeds: int, train: str, *, from_start: bool = False) -> Table:
    trials = [Injection(names, _FIRST_SEED + k, from_start, train) for names in faults for k in range(seeds)]
    outcomes = over_seeds(run, trials, 'faults')
    rows = tuple(_row(' + '.join(names), outcomes[k * seeds : (k + 1) * seeds]) for k, names in enumerate(faults))
    return Table(title, _HEADER, rows, _NOTE.format(count=seeds))


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    texts = Counter(outcome.name.partition(':')[0] for outcome in outcomes if math.isfinite(outcome.named_s))
    if any(outcome.non_finite for outcome in outcomes):
        name += ' (NOT FINITE)'
    return (
        name,
        *_when([outcome.seen_s for outcome in outcomes]),
        *_when([outcome.named_s for outcome in outcomes]),
        f'{max(outcome.wrong_s for outcome in outcomes):.1f}',
        f'{max(outcome.added_s for outcome in outcomes):.1f}',
        f'{max(outcome.worst for outcome in outcomes):.1f}',
        _median([outcome.resistance_left for outcome in outcomes], '+.3f'),
        _median([outcome.brake_left for outcome in outcomes], '+.3f'),
        _rejected(outcomes),
        texts.most_common(1)[0][0] if texts else '-',
    )


def _when(times: Sequence[float]) -> tuple[str, str]:
    """Return how often a time is known, and the median of those that are [s]."""
    known = [time for time in times if math.isfinite(time)]
    return f'{len(known) / len(times):.0%}', f'{np.median(known):.0f}' if known else '-'


def _rejected(outcomes: Sequence[Outcome]) -> str:
    total = sum((Counter(outcome.rejected) for outcome in outcomes), Counter())
    ((reason, count),) = total.most_common(1) or ((None, 0),)
    return '-' if reason is None or count <= 0 else f'{count / len(outcomes):.0f} {reason.name}'


def _median(values: Sequence[float], form: str) -> str:
    known = [value for value in values if math.isfinite(value)]
    return format(float(np.median(known)), form) if known else '-'

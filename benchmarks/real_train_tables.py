# SPDX-License-Identifier: Apache-2.0
"""Tables of the scores of the resistance algorithms on drives of five worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.real_train_scores import Score
from benchmarks.real_train_trials import ALL, EVERY_TOPIC_5_HZ, INFORMED, PAIRS, Trial
from benchmarks.tables import Table
from benchmarks.worlds import CLEAN, FIELD, UNKNOWNS, WORLDS, Rates

Array = NDArray[np.float64]
Results: TypeAlias = Mapping[Trial, Mapping[str, Score]]

SOON_MIN: Final = 15.0
MIXED: Final = Rates(speed=10.0, force=1.0, gradient=1.0, brake=50.0)
RATES: Final = {
    **{f'{hz:g} Hz': Rates(hz, hz, hz, hz) for hz in (1.0, 2.0, 5.0, 10.0, 50.0)},
    'speed 10, force and gradient 1, brake 50 Hz': MIXED,
}
ALONE: Final = tuple(name for name in UNKNOWNS if name not in CLEAN)
_SETTLED: Final = 'settled |error of w|, N/kN'


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity that one table shows for each algorithm in each world."""

    name: str
    cell: Callable[[Sequence[Score]], str]
    note: str = ''


def spread(values: Array, unit: float = 1.0, digits: int = 3, sign: str = '') -> str:
    """Return the mean and its standard error; values that are not finite are left out."""
    finite = unit * values[np.isfinite(values)]
    if not finite.size:
        return '-'
    if finite.size == 1:
        return f'{finite[0]:{sign}.{digits}f}'
    return f'{finite.mean():{sign}.{digits}f} ± {finite.std(ddof=1) / math.sqrt(finite.size):.{digits}f}'


def error_cell(scores: Sequence[Score]) -> str:
    """Return the settled error [N/kN] as text."""
    return spread(np.array([score.error for score in scores]))


def _percent(values: Sequence[float], digits: int) -> str:
    text = spread(np.array(values), 100.0, digits)
    return text if text == '-' else f'{text} %'


def _cover_cell(scores: Sequence[Score]) -> str:
    return _percent([score.cover for score in scores], 1)


def valid_cell(scores: Sequence[Score]) -> str:
    """Return the share of the time in motion with status VALID as text."""
    return _percent([score.valid for score in scores], 1)


def _wrong_cell(scores: Sequence[Score]) -> str:
    return _percent([score.wrong for score in scores], 2)


def first_cell(scores: Sequence[Score]) -> str:
    """Return the median time to the first VALID [min] and the share of drives that reach it within ``SOON_MIN``."""
    first = np.array([score.first_valid_min for score in scores])
    median, soon = float(np.median(first)), float(np.mean(first <= SOON_MIN))
    return f'{median:.1f}, {soon:.0%}' if math.isfinite(median) else f'never, {soon:.0%}'


_ERROR: Final = Quantity(_SETTLED, error_cell)
_COVER: Final = Quantity('coverage of the 95 % band', _cover_cell)
_FIELD_ONLY: Final = (
    Quantity('VALID, share of the time in motion', valid_cell),
    Quantity(f'first VALID: median, min in motion; share within {SOON_MIN:g} min', first_cell),
    Quantity('VALID with an error above 3 std, share of samples used', _wrong_cell),
)
_NOTE: Final = (
    '{seeds} drives per world, mean ± standard error over drives. Settled: the train moves (1 m/s or more), and has '
    'moved for 300 s since the start and since the last change of resistance; w at the true speed. VALID: the sample '
    'was used and the estimate is fit to use; rejected samples (as in braking) count as HOLDING. The band is '
    '± 1.96 standard deviations, over the same samples as the error. '
)
_INFORMED_NOTE: Final = (
    f'The {INFORMED} is a single filter of filter-bank that is given the sizes of gusts and map errors and the times '
    'of the changes; it must estimate force scale and delay, so it is not a bound.'
)


def world_tables(results: Results, seeds: Sequence[int]) -> tuple[Table, ...]:
    """Return one table per quantity, algorithms by worlds, in the field and clean."""
    field = [_world_table(results, seeds, FIELD, quantity) for quantity in (_ERROR, _COVER, *_FIELD_ONLY)]
    clean = [_world_table(results, seeds, CLEAN, quantity) for quantity in (_ERROR, _COVER)]
    return *field, *clean


def _world_table(results: Results, seeds: Sequence[int], unknowns: frozenset[str], quantity: Quantity) -> Table:
    condition = 'field' if unknowns == FIELD else 'clean'
    rows = tuple(
        (name, *(quantity.cell(_picked(results, name, world, seeds, unknowns)) for world in WORLDS)) for name in ALL
    )
    title = f'Resistance on real trains, {condition}: {quantity.name}'
    note = _NOTE.format(seeds=len(seeds)) + _INFORMED_NOTE if quantity is _ERROR else ''
    return Table(title, ('algorithm', *WORLDS), rows, note)


def _picked(
    results: Results, name: str, world: str, seeds: Sequence[int], unknowns: frozenset[str], rates: Rates | None = None
) -> list[Score]:
    return [results[Trial(world, seed, unknowns, rates or EVERY_TOPIC_5_HZ)][name] for seed in seeds]


def errors_of(scores: Sequence[Score]) -> Array:
    """Return the settled errors [N/kN]."""
    return np.array([score.error for score in scores])


def paired_table(
    results: Results, seeds: Sequence[int], pair: tuple[str, str], days: Sequence[Mapping[str, float]]
) -> Table:
    """Return the second algorithm of a pair against the first on the same drives.

    Args:
        results: Scores of all trials.
        seeds: Seeds of the drives.
        pair: Names of two algorithms.
        days: Error of each algorithm on the Yizhuang days [N/kN].

    """
    rows = []
    for condition, unknowns in (('field', FIELD), ('clean', CLEAN)):
        for world in WORLDS:
            one, other = (errors_of(_picked(results, name, world, seeds, unknowns)) for name in pair)
            rows.append((f'{world}, {condition}', *_paired(one, other)))
    one, other = (np.array([day[name] for day in days]) for name in pair)
    rows.append(('Yizhuang days', *_paired(one, other)))
    note = (
        f'{len(seeds)} drives per world and {len(days)} Yizhuang days, mean ± standard error. Yizhuang days: the '
        'simulated day on the Yizhuang line, whose train file is exact except for the resistance, scored as in the '
        'part accuracy: five minutes after each change, mean over 10 m/s, 15 m/s and the last speed in motion.'
    )
    first, second = pair
    header = ('|error of w|, N/kN', *pair, f'{second} minus {first}', f'{second} is better')
    return Table(f'Resistance on real trains: {first} and {second} on the same drives', header, tuple(rows), note)


def _paired(first: Array, second: Array) -> tuple[str, ...]:
    less = second - first
    finite = less[np.isfinite(less)]
    better = f'{np.mean(finite < 0.0):.0%}' if finite.size else '-'
    return spread(first), spread(second), spread(less, sign='+'), better


def costs() -> dict[str, tuple[frozenset[str], frozenset[str]]]:
    """Return each set of unknowns and the set it is compared with, by row name."""
    alone = {f'clean + {name}': (CLEAN | {name}, CLEAN) for name in ALONE}
    without = {f'field - {name}': (FIELD - {name}, FIELD) for name in UNKNOWNS}
    return {'clean': (CLEAN, CLEAN), **alone, 'field': (FIELD, FIELD), **without}


def cost_tables(results: Results, seeds: Sequence[int]) -> tuple[Table, ...]:
    """Return the error that each unknown adds, one table per algorithm."""
    note = (
        f'{len(seeds)} drives per world, the same trains and drivers in all rows: mean settled error of w [N/kN], and '
        'in brackets its difference to the reference row (clean or field), mean ± standard error of the paired '
        'differences. Clean: changes of resistance are the only unknown.'
    )
    return tuple(
        Table(
            f'Error added by each unknown: {_SETTLED}, {name}',
            ('unknowns', *WORLDS),
            tuple(
                (row, *(_cost_cell(results, name, world, seeds, *pair) for world in WORLDS))
                for row, pair in costs().items()
            ),
            note,
        )
        for name in PAIRS[0]
    )


def _cost_cell(
    results: Results, name: str, world: str, seeds: Sequence[int], unknowns: frozenset[str], reference: frozenset[str]
) -> str:
    with_it = errors_of(_picked(results, name, world, seeds, unknowns))
    if unknowns == reference:
        return spread(with_it)
    added = with_it - errors_of(_picked(results, name, world, seeds, reference))
    return f'{np.nanmean(with_it):.3f} ({spread(added, sign="+")})' if np.isfinite(with_it).any() else '-'


def rate_tables(results: Results, seeds: Sequence[int]) -> tuple[Table, ...]:
    """Return the effect of the topic rates on a metro."""
    note = f'{len(seeds)} drives, the same motion in all rows. Samples are 0.2 s apart, or further if the speeds are.'
    return tuple(
        Table(
            f'Rates of the topics, metro in the field: {name}',
            ('rate', *ALL),
            tuple(
                (row, *(cell(_picked(results, name, 'metro', seeds, FIELD, rates)) for name in ALL))
                for row, rates in RATES.items()
            ),
            note if cell is error_cell else '',
        )
        for name, cell in (
            (_SETTLED, error_cell),
            (_COVER.name, _COVER.cell),
            ('VALID, share of the time in motion', valid_cell),
        )
    )

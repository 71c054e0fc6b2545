# SPDX-License-Identifier: Apache-2.0
"""Parts that score algorithms on drives: each is a list of scenarios and the tables of its claims.

- accuracy: all algorithms, on days whose train file is right about mass and force.
- real_trains, brake_worlds: resistance and brake rate in five worlds, with the unknowns of real operation.
- unknowns, rates: what each unknown, and each rate of the topics, costs.
- integrity: how often a default estimate is VALID and wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenarios import DAY, DEFAULTS, INFORMED, Method, Results, Scenario, Score, methods_of, results_of
from benchmarks.tables import Table, spread
from benchmarks.worlds import CLEAN, FIELD, UNKNOWNS, WORLDS, Rates

Array = NDArray[np.float64]

# Seeds from here on were not used during development of the estimators.
FIRST_SEED: Final = 1001
_FIRST_DAY: Final = 101
_FIRST_INTEGRITY: Final = 7001
# Days take a third of the time of worlds.
_DAYS_PER_DRIVE: Final = 4
CONDITIONS: Final = {'field': FIELD, 'clean': CLEAN}
COMPARED: Final = methods_of('resistance', ('V-MILS', 'filter-bank', 'two-window'))
PAIRS: Final = (COMPARED[:2], (COMPARED[0], COMPARED[2]))
RESISTANCES: Final = (*COMPARED, *methods_of('resistance', ('speed-EKF', INFORMED)))
BRAKES: Final = methods_of('brake_rate', ('GSMA', 'IMM', 'KF'))
SOON_MIN: Final = 15.0
RATES: Final = {
    **{f'{hz:g} Hz': Rates(hz, hz, hz, hz) for hz in (1.0, 2.0, 5.0, 10.0, 50.0)},
    'speed 10, force and gradient 1, brake 50 Hz': Rates(speed=10.0, force=1.0, gradient=1.0, brake=50.0),
}


class Quantity(NamedTuple):
    """What a column or a table shows of some scores."""

    name: str
    cell: Callable[[Sequence[Score]], str]


def values_of(scores: Sequence[Score], name: str) -> Array:
    return np.array([getattr(score, name) for score in scores])


def shown(name: str, digits: int = 3) -> Callable[[Sequence[Score]], str]:
    """Return what shows mean and standard error of a field."""
    return lambda scores: spread(values_of(scores, name), 1.0, digits)


def share(name: str, digits: int = 1) -> Callable[[Sequence[Score]], str]:
    """Return what shows mean and standard error of a share in per cent."""

    def cell(scores: Sequence[Score]) -> str:
        text = spread(values_of(scores, name), 100.0, digits)
        return text if text == '-' else f'{text} %'

    return cell


def first_cell(scores: Sequence[Score]) -> str:
    """Return the median time to the first VALID [min] and the share of drives that reach it within ``SOON_MIN``."""
    first = values_of(scores, 'first_valid_min')
    median, soon = float(np.median(first)), float(np.mean(first <= SOON_MIN))
    return f'{median:.1f}, {soon:.0%}' if math.isfinite(median) else f'never, {soon:.0%}'


_ERROR: Final = Quantity('|error of w|, N/kN', shown('error'))
_COVER: Final = Quantity('95 % band', share('cover'))
_VALID: Final = Quantity('VALID, share of motion', share('valid'))
_FIRST: Final = Quantity(f'first VALID: median, min in motion; within {SOON_MIN:g} min', first_cell)
_WRONG: Final = Quantity('VALID > 3 std', share('wrong', 2))
_BRAKE_ERROR: Final = Quantity('|error of the brake rate|', shown('error', 4))
_LONGEST: Final = (
    Quantity('longest, mean s', lambda scores: f'{values_of(scores, "longest_s").mean():.1f}'),
    Quantity('longest, s', lambda scores: f'{values_of(scores, "longest_s").max():.1f}'),
    Quantity('with HOLDING > 3 std', share('held', 2)),
)
_STATUS: Final = (_COVER, _VALID, _FIRST, _WRONG)
_STRETCHES: Final = (
    'Longest: longest stretch of VALID outputs beyond three standard deviations of each drive. Steps are '
    'abrupt: on the Yizhuang days a grows by 0.5 N/kN and later c by 20 %. '
)
_NOTE: Final = (
    '{drives} per train, mean ± standard error over drives. Errors of the resistance count where the train moves and '
    'has moved for 300 s since the start and since the last change of resistance, for w at the true speed; those of '
    'the brake rate while the brake acts, from 7 s after the first braking on. Band: share of these errors within '
    '1.96 standard deviations. VALID > 3 std: share of the VALID outputs in motion beyond three standard deviations.'
)
_INFORMED_NOTE: Final = (
    f' The {INFORMED} is a single filter of filter-bank that is given the sizes of gusts and map errors and the times '
    'of the changes; it must estimate force scale and delay, so it is not a bound.'
)


def _of(results: Results, method: Method, train: str, seeds: Sequence[int], *which: object) -> list[Score]:
    """Return the scores of an algorithm on a train; ``which``: unknowns, then rates."""
    return [results[Scenario(train, seed, *which)][method] for seed in seeds]  # type: ignore[arg-type]


def _score_table(
    title: str, corner: str, rows: Mapping[str, Sequence[Score]], columns: Sequence[Quantity], drives: str
) -> Table:
    """Return a table of quantities, with a row for some scores."""
    cells = tuple((name, *(column.cell(scores) for column in columns)) for name, scores in rows.items())
    return Table(title, (corner, *(column.name for column in columns)), cells, _NOTE.format(drives=drives))


def accuracy(seeds: int) -> tuple[Table, ...]:
    """Score every registered algorithm on days."""
    chosen = range(_FIRST_DAY, _FIRST_DAY + seeds)
    jobs = {job: methods_of(job) for job in ('resistance', 'speed_model', 'brake_rate')}
    methods = tuple(method for some in jobs.values() for method in some)
    results = results_of([Scenario(DAY, seed, methods=methods) for seed in chosen], 'accuracy')
    tables = []
    for job, some in jobs.items():
        rows = {method.name: _of(results, method, DAY, chosen) for method in some}
        title = f'On days with an exact train file: {job.replace("_", " ")}'
        columns = (_BRAKE_ERROR if job == 'brake_rate' else _ERROR, *_STATUS)
        tables.append(_score_table(title, 'algorithm', rows, columns, f'{seeds} days'))
    return tuple(tables)


def real_trains(seeds: int) -> tuple[Table, ...]:
    """Score resistance algorithms in the field (all unknowns) and clean (changes only), and in pairs."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    results = results_of(real_trains_scenarios(chosen), 'real_trains')
    return *world_tables(results, chosen), *(paired_table(results, chosen, pair) for pair in PAIRS)


def real_trains_scenarios(seeds: Sequence[int]) -> list[Scenario]:
    """Return the drives of all worlds, in the field and clean, and days."""
    drives = [
        Scenario(world, seed, unknowns, methods=RESISTANCES)
        for unknowns in CONDITIONS.values()
        for seed in seeds
        for world in WORLDS
    ]
    return [*drives, *(Scenario(DAY, seed, methods=COMPARED) for seed in seeds)]


def world_tables(results: Results, seeds: Sequence[int]) -> tuple[Table, ...]:
    """Return one table per quantity, algorithms by worlds, in the field and clean."""
    note = _NOTE.format(drives=f'{len(seeds)} drives') + _INFORMED_NOTE
    chosen = {'field': (_ERROR, *_STATUS), 'clean': (_ERROR, _COVER)}
    tables = []
    for condition, quantities in chosen.items():
        for quantity in quantities:
            rows = tuple(
                (one.name, *(quantity.cell(_of(results, one, w, seeds, CONDITIONS[condition])) for w in WORLDS))
                for one in RESISTANCES
            )
            title = f'Resistance on real trains, {condition}: {quantity.name}'
            tables.append(Table(title, ('algorithm', *WORLDS), rows, note if quantity is _ERROR else ''))
    return tuple(tables)


def paired_table(results: Results, seeds: Sequence[int], pair: Sequence[Method]) -> Table:
    """Return the second algorithm of a pair against the first on the same drives."""
    places = [(world, condition) for condition in CONDITIONS for world in WORLDS]
    rows = []
    for train, condition in (*places, (DAY, 'field')):
        one, other = (values_of(_of(results, method, train, seeds, CONDITIONS[condition]), 'error') for method in pair)
        less = other - one
        known = less[np.isfinite(less)]
        better = f'{np.mean(known < 0.0):.0%}' if known.size else '-'
        name = train if train == DAY else f'{train}, {condition}'
        rows.append((name, spread(one), spread(other), spread(less, sign='+'), better))
    first, second = (method.name for method in pair)
    header = ('|error of w|, N/kN', first, second, f'{second} minus {first}', f'{second} is better')
    note = f'{len(seeds)} drives per train, mean ± standard error. The train file of the days is exact but for w.'
    return Table(f'Resistance on real trains: {first} and {second} on the same drives', header, tuple(rows), note)


def brake_worlds(seeds: int) -> tuple[Table, ...]:
    """Score brake rate algorithms in all worlds, clean and in the field."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    places = [(unknowns, world) for unknowns in CONDITIONS.values() for world in WORLDS]
    scenarios = [Scenario(w, seed, unknowns, methods=BRAKES) for seed in chosen for unknowns, w in places]
    results = results_of(scenarios, 'brake_worlds')
    tables = []
    for condition, unknowns in CONDITIONS.items():
        pairs = [(world, method) for world in WORLDS for method in BRAKES]
        rows = {f'{world}, {one.name}': _of(results, one, world, chosen, unknowns) for world, one in pairs}
        title = f'Brake rate in five worlds: {condition}'
        tables.append(_score_table(title, 'algorithm', rows, (_BRAKE_ERROR, *_STATUS), f'{seeds} drives'))
    return tuple(tables)


def unknowns(seeds: int) -> tuple[Table, ...]:
    """Score V-MILS and filter-bank with each unknown alone and with all but one."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    results = results_of(unknowns_scenarios(chosen), 'unknowns')
    return tuple(cost_table(results, chosen, method) for method in PAIRS[0])


def unknowns_scenarios(seeds: Sequence[int]) -> list[Scenario]:
    sets = [unknown for unknown, _ in costs().values()]
    return [Scenario(world, seed, unknown, methods=PAIRS[0]) for seed in seeds for unknown in sets for world in WORLDS]


def costs() -> dict[str, tuple[frozenset[str], frozenset[str]]]:
    """Return each set of unknowns and the set it is compared with, by row name."""
    alone = {f'clean + {name}': (CLEAN | {name}, CLEAN) for name in UNKNOWNS if name not in CLEAN}
    without = {f'field - {name}': (FIELD - {name}, FIELD) for name in UNKNOWNS}
    return {'clean': (CLEAN, CLEAN), **alone, 'field': (FIELD, FIELD), **without}


def cost_table(results: Results, seeds: Sequence[int], method: Method) -> Table:
    def cell(world: str, unknown: frozenset[str], reference: frozenset[str]) -> str:
        error = values_of(_of(results, method, world, seeds, unknown), 'error')
        if unknown == reference:
            return spread(error)
        added = error - values_of(_of(results, method, world, seeds, reference), 'error')
        return f'{np.nanmean(error):.3f} ({spread(added, sign="+")})' if np.isfinite(error).any() else '-'

    rows = tuple((row, *(cell(world, *pair) for world in WORLDS)) for row, pair in costs().items())
    note = (
        f'{len(seeds)} drives per world, the same trains and drivers in all rows: mean settled error of w, and in '
        'brackets its difference to the reference row (clean or field), mean ± standard error of the paired '
        'differences. Clean: changes of resistance are the only unknown.'
    )
    return Table(f'Error added by each unknown: {_ERROR.name}, {method.name}', ('unknowns', *WORLDS), rows, note)


def rates(seeds: int) -> tuple[Table, ...]:
    """Score all resistance algorithms on a metro with topics at 1 to 50 Hz, and at mixed rates."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    return rate_tables(results_of(rates_scenarios(chosen), 'rates'), chosen)


def rates_scenarios(seeds: Sequence[int]) -> list[Scenario]:
    return [Scenario('metro', seed, FIELD, rate, methods=RESISTANCES) for seed in seeds for rate in RATES.values()]


def rate_tables(results: Results, seeds: Sequence[int]) -> tuple[Table, ...]:
    header = ('rate', *(method.name for method in RESISTANCES))
    note = f'{len(seeds)} drives, the same motion in all rows. Samples are 0.2 s apart, or further if the speeds are.'
    tables = []
    for quantity in (_ERROR, _COVER, _VALID):
        rows = tuple(
            (name, *(quantity.cell(_of(results, method, 'metro', seeds, FIELD, rate)) for method in RESISTANCES))
            for name, rate in RATES.items()
        )
        title = f'Rates of the topics, metro in the field: {quantity.name}'
        tables.append(Table(title, header, rows, note if quantity is _ERROR else ''))
    return tuple(tables)


def integrity(seeds: int) -> tuple[Table, ...]:
    """Return how often the default resistance and brake rate are VALID and wrong, on days and in the worlds."""
    counts = {DAY: _DAYS_PER_DRIVE * seeds, **dict.fromkeys(WORLDS, seeds)}
    chosen = {train: range(_FIRST_INTEGRITY, _FIRST_INTEGRITY + count) for train, count in counts.items()}
    methods = (DEFAULTS[0], DEFAULTS[2])
    scenarios = [Scenario(train, seed, methods=methods) for train, some in chosen.items() for seed in some]
    results = results_of(scenarios, 'integrity')
    tables = []
    for method, error in zip(methods, (_ERROR, _BRAKE_ERROR), strict=True):
        columns = (_VALID, _WRONG, *_LONGEST, error, _COVER)
        rows = {f'{train}, {len(some)}': _of(results, method, train, some) for train, some in chosen.items()}
        title = f'VALID and wrong: {method.job.replace("_", " ")}'
        table = _score_table(title, 'train, drives', rows, columns, 'As many')
        tables.append(replace(table, note=_STRETCHES + table.note))
    return tuple(tables)

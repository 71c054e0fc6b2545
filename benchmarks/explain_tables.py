# SPDX-License-Identifier: Apache-2.0
"""Tables of the discrepancy workflow on hidden cases."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.explain_score import (
    VISIBLE,
    Rate,
    acceptable,
    alarmed,
    both,
    exact,
    found_of_truth,
    generic,
    named,
    over_floor,
    parameter_errors,
    rate,
    rms,
    seconds_for_eight,
    truth_names,
    visible,
    within_std,
    within_two,
)
from benchmarks.explain_trial import CRASHED
from benchmarks.tables import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from benchmarks.explain_trial import Outcome

    Outcomes = Sequence[Outcome]

_SLACK: Final = 1.1


def tables_of(outcomes: Outcomes, title: str) -> list[Table]:
    """Return all tables of the cases of one generator."""
    makers = (singles, nothing_hidden, pairs, outsiders, circumstances, confusions, parameters)
    return [table for maker in makers if (table := maker(outcomes, title)).rows]


def targets(outcomes: Outcomes, title: str) -> Table:
    """Return targets, reached values and whether each target is met."""
    shown = [one for one in outcomes if visible(one)]
    single, pair, outside = (_kind(shown, kind) for kind in ('single', 'pair', 'outside'))
    errors = [error for one in outcomes for _, error in parameter_errors(one)]
    ratios = _finite([over_floor(one) for one in single if exact(one)])
    times = [seconds_for_eight(one) for one in outcomes]
    rows = [
        _target('false alarms on no-effect cases', rate(_kind(outcomes, 'none'), alarmed), 0.02, most=True),
        _target('exact name, single effects', rate(single, exact), 0.85),
        _target('truth in a reported set of at most two, single effects', rate(single, within_two), 0.95),
        _target('both of two', rate(pair, both), 0.75),
        _target('outside the library: unexplained or an acceptable name', rate(outside, acceptable), 0.80),
        _target('parameters within 2 of their std', within_std(errors), 0.90),
        _limit('gap after / noise floor, correctly named single effects: median', _quantile(ratios, 0.5), _SLACK, ''),
        _limit('CPU time for 8 runs: 90th percentile', _quantile(times, 0.9), 3.0, ' s'),
        _limit('crashes', float(sum(one.verdict == CRASHED for one in outcomes)), 0.0, ''),
    ]
    note = (
        f'In brackets the number of cases and the 95 % interval. Single effects, pairs and effects outside the library '
        f'count if each raises the gap by >= {VISIBLE:.0f} %. Naming wheel slip is correct if slip contaminates the '
        f'data. Gap after / floor: {_within_slack(ratios)} of these cases are within 10 %.'
    )
    return Table(f'Targets, {title}', ('quantity', 'target', 'reached', 'met?'), tuple(rows), note)


def singles(outcomes: Outcomes, title: str) -> Table:
    """Return a table with a row per effect of the library."""
    cases = _kind(outcomes, 'single')
    header = (
        'effect',
        'cases',
        'visible',
        'exact',
        'in set of two',
        'exact, all cases',
        'within 2 std',
        'error rms [std]',
        'before',
        'after',
        'floor [mm/s]',
        'time p50',
        'p90 [s]',
    )
    rows = [_single_row(name, _of(cases, name)) for name in sorted({truth_names(one)[0] for one in cases})]
    rows += [_single_row('all', cases)] if cases else []
    note = (
        f'Visible: raises the gap by >= {VISIBLE:.0f} %; exact and set: visible cases. Parameter errors: all cases '
        'in which the effect was named. Gaps: medians over visible cases, on held-out runs. Time: CPU, not scaled.'
    )
    return Table(f'Single effects, {title}', header, tuple(rows), note)


def _single_row(name: str, cases: Outcomes) -> tuple[str, ...]:
    shown = [one for one in cases if visible(one)]
    errors = [error for one in cases for _, error in parameter_errors(one)]
    gaps = [one.gap for one in shown if one.gap is not None]
    medians = [f'{1e3 * _quantile([gap[k] for gap in gaps], 0.5):.0f}' if gaps else '-' for k in range(3)]
    times = [one.explain_s for one in cases]
    return (
        name,
        str(len(cases)),
        str(len(shown)),
        _short(rate(shown, exact)),
        _short(rate(shown, within_two)),
        _short(rate(cases, exact)),
        _short(within_std(errors)),
        _number(rms(errors), '.2f'),
        *medians,
        _number(_quantile(times, 0.5), '.1f'),
        _number(_quantile(times, 0.9), '.1f'),
    )


def nothing_hidden(outcomes: Outcomes, title: str) -> Table:
    """Return a table with a row per verdict on cases without hidden effect."""
    cases = _kind(outcomes, 'none')
    counts = Counter(f'{one.verdict}: {_formatted(one)}' if named(one) else one.verdict for one in cases)
    rows = [('false alarms', _long(rate(cases, alarmed)))] if cases else []
    rows += [(text, str(count)) for text, count in counts.most_common()]
    return Table(f'Nothing hidden, {title}', ('outcome', 'cases'), tuple(rows))


def pairs(outcomes: Outcomes, title: str) -> Table:
    """Return the table of pairs of effects."""
    cases = _kind(outcomes, 'pair')
    shown = [one for one in cases if visible(one)]
    rows = [
        (
            text,
            str(len(chosen)),
            _long(rate(chosen, both)),
            _short(rate(chosen, exact)),
            _short(rate(chosen, lambda one: found_of_truth(one) == 1)),
            _short(rate(chosen, lambda one: found_of_truth(one) == 0)),
        )
        for text, chosen in (('both visible', shown), ('all', cases))
        if cases
    ]
    header = ('pairs', 'cases', 'both found', 'exactly both', 'one found', 'none found')
    return Table(f'Two effects, {title}', header, tuple(rows))


def outsiders(outcomes: Outcomes, title: str) -> Table:
    """Return a table with a row per effect outside the library."""
    cases = [one for one in _kind(outcomes, 'outside') if visible(one)]
    names = sorted({truth_names(one)[0] for one in cases})
    rows = [_outside_row(name, _of(cases, name)) for name in names]
    rows += [_outside_row('all', cases)] if cases else []
    header = (
        'effect',
        'visible cases',
        'acceptable',
        'unexplained',
        'unexplained or generic name',
        'no gap',
        'reported',
    )
    note = (
        'Acceptable: unexplained, or only names that imply no mechanism (local_drag, resistance_step) or that the '
        'generator lists as near to the hidden effect. Generic: without the near names.'
    )
    return Table(f'Outside the library, {title}', header, tuple(rows), note)


def _outside_row(name: str, cases: Outcomes) -> tuple[str, ...]:
    return (
        name,
        str(len(cases)),
        _short(rate(cases, acceptable)),
        _short(rate(cases, lambda one: one.verdict == 'unexplained')),
        _short(rate(cases, generic)),
        _short(rate(cases, lambda one: one.verdict == 'no_gap')),
        _counted(cases) if name != 'all' else '',
    )


def circumstances(outcomes: Outcomes, title: str) -> Table:
    """Return the results by circumstance: contaminated data, one direction of travel and so on."""
    words = sorted({flag for one in outcomes for flag in one.answer.flags})
    picks: list[tuple[str, Callable[[Outcome], bool]]] = [
        ('clean data', lambda one: not one.answer.contamination),
        *((word, lambda one, word=word: word in one.answer.contamination) for word in ('outliers', 'dropouts', 'slip')),
        ('one way', lambda one: one.answer.one_way),
        ('both ways', lambda one: not one.answer.one_way),
        *((word, lambda one, word=word: word in one.answer.flags) for word in words),
    ]
    rows = [_circumstance_row(text, [one for one in outcomes if pick(one)]) for text, pick in picks]
    header = ('circumstance', 'cases', 'alarms', 'exact, single', 'in set of two', 'both of two', 'acceptable outside')
    return Table(f'By circumstance, {title}', header, tuple(row for row in rows if row[1] != '0'))


def _circumstance_row(text: str, cases: Outcomes) -> tuple[str, ...]:
    shown = [one for one in cases if visible(one)]
    single, pair, outside = (_kind(shown, kind) for kind in ('single', 'pair', 'outside'))
    return (
        text,
        str(len(cases)),
        _short(rate(_kind(cases, 'none'), alarmed)),
        _short(rate(single, exact)),
        _short(rate(single, within_two)),
        _short(rate(pair, both)),
        _short(rate(outside, acceptable)),
    )


def confusions(outcomes: Outcomes, title: str) -> Table:
    """Return the reported effects for each visible single effect."""
    cases = [one for one in _kind(outcomes, 'single') if visible(one)]
    rows = tuple((name, _counted(_of(cases, name))) for name in sorted({truth_names(one)[0] for one in cases}))
    note = 'Visible single effects. After ~ the twins reported with the name.'
    return Table(f'Reported effects, {title}', ('hidden', 'reported: cases'), rows, note)


def parameters(outcomes: Outcomes, title: str) -> Table:
    """Return a table with a row per parameter."""
    errors: dict[str, list[float]] = {}
    for one in outcomes:
        for name, error in parameter_errors(one):
            errors.setdefault(name, []).append(error)
    rows = tuple(_parameter_row(name, values) for name, values in sorted(errors.items()))
    header = ('parameter', 'within 2 std', 'error rms [std]', 'median error [std]', 'without std')
    return Table(f'Parameters, {title}', header, rows)


def _parameter_row(name: str, errors: Sequence[float]) -> tuple[str, ...]:
    finite = _finite(errors)
    middle = _number(_quantile(finite, 0.5), '+.2f')
    return name, _long(within_std(errors)), _number(rms(errors), '.2f'), middle, str(len(errors) - len(finite))


def _kind(outcomes: Outcomes, kind: str) -> list[Outcome]:
    return [one for one in outcomes if one.answer.kind == kind]


def _of(outcomes: Outcomes, name: str) -> list[Outcome]:
    return [one for one in outcomes if name in truth_names(one)]


def _formatted(outcome: Outcome) -> str:
    names = (effect.name + (f'~{"~".join(effect.twins)}' if effect.twins else '') for effect in named(outcome))
    return ' + '.join(names) or outcome.verdict


def _counted(outcomes: Outcomes) -> str:
    counts = Counter(_formatted(one) for one in outcomes)
    return '; '.join(f'{text}: {count}' for text, count in counts.most_common())


def _target(text: str, reached: Rate, goal: float, *, most: bool = False) -> tuple[str, ...]:
    met = reached.share <= goal if most else reached.share >= goal
    verdict = '-' if not reached.cases else 'yes' if met else 'no'
    return text, f'{"<=" if most else ">="} {100.0 * goal:.0f} %', _long(reached), verdict


def _limit(text: str, reached: float, goal: float, unit: str) -> tuple[str, ...]:
    verdict = '-' if math.isnan(reached) else 'yes' if reached <= goal else 'no'
    return text, f'<= {goal:g}{unit}', f'{reached:.3g}{unit}', verdict


def _long(reached: Rate) -> str:
    if not reached.cases:
        return '-'
    low, high = reached.interval()
    return f'{100.0 * reached.share:.1f} % ({reached.hits}/{reached.cases}; {100.0 * low:.0f} .. {100.0 * high:.0f} %)'


def _short(reached: Rate) -> str:
    return f'{reached.hits}/{reached.cases}' if reached.cases else '-'


def _number(value: float, form: str) -> str:
    return '-' if math.isnan(value) else format(value, form)


def _within_slack(ratios: Sequence[float]) -> str:
    return _short(Rate(sum(ratio <= _SLACK for ratio in ratios), len(ratios)))


def _finite(values: Sequence[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _quantile(values: Sequence[float], share: float) -> float:
    return float(np.quantile(values, share)) if values else math.nan

# SPDX-License-Identifier: Apache-2.0
"""The discrepancy workflow on hidden cases of three generators: which effects are found, and how often it is wrong.

The workflow gets the bags and the assumed train file; only the scoring reads the truth.
"""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Final, Literal

import numpy as np
from matplotlib.figure import Figure

from benchmarks import hidden_cases, hidden_cases_b, hidden_cases_c
from benchmarks.hidden_case import Answer, Case
from benchmarks.seeds import over_seeds
from benchmarks.tables import Plot, Table, columns
from trainid_ros.explain.dataset import Run, RunCollector, numbered
from trainid_ros.explain.proof import NEAR
from trainid_ros.explain.result import NONE, OTHER, Learned
from trainid_ros.explain.workflow import explain
from trainid_ros.interface.records import Record
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import NamedValues, TrainFile, parse_train_file

Outcomes = Sequence['Outcome']
Generator = Literal['A', 'B', 'C']
GENERATORS: Final[Mapping[Generator, ModuleType]] = {'A': hidden_cases, 'B': hidden_cases_b, 'C': hidden_cases_c}
CRASHED: Final = 'crashed'
"""Verdict of a case on which the workflow raised an exception."""
VISIBLE: Final = 20.0
"""Least rise of the gap over the noise floor at which an effect counts [%]."""
GENERIC: Final = frozenset({'local_drag', 'resistance_step'})
"""Names that imply no mechanism, so acceptable for effects outside the library."""
_Z95: Final = 1.959964
DEPENDS: Final[Mapping[str, str]] = {
    'wavy_drag': 'place', 'resistance_wave': 'place', 'growing_drag': 'time', 'day_creep': 'time', 'storm_hour': 'time',
    'thinner_air': 'time', 'speed_band_drag': 'speed', 'brake_speed_rate': 'brake-speed', 'iron_blocks': 'brake-speed',
    'brake_falls_with_speed': 'brake-speed', 'wet_brake': 'brake-time', 'slow_release': 'release',
    'field_weakening': 'traction-speed', 'traction_saturation': 'traction-speed', 'traction_creep': 'traction-speed',
    'sagging_voltage': 'traction-place', 'weak_feeder': 'traction-place', 'weak_wire': 'traction-place',
    'pull_drag_one_way': 'traction-rising traction-falling', 'oneway_traction_drag': 'traction-rising',
    'gear_loss': 'traction', 'rotary_mass': 'inertia', 'rotary_mass_error': 'inertia', 'jerked_drag': 'inertia',
    'acceleration_drag': 'inertia', 'cold_departure': 'start', 'long_stand': 'start', 'one_way_drag': 'direction',
    'lateral_drag': 'curve curve-speed', 'tight_flanges': 'curve curve-speed', 'uphill_drag': 'gradient',
    'random_runs': 'run', 'resistance_per_run': 'run', 'crowded_drag': 'run', 'crowd_drag': 'run', 'wet_legs': 'run',
    'axle_load': 'run',
}  # fmt: skip
"""Variables that effects outside the library depend on, as a learned curve names them; loads differ by run."""
_IN_LIBRARY: Final[Mapping[str, str]] = dict.fromkeys(
    ('brake_falls_with_speed', 'brake_speed_rate', 'iron_blocks'), 'brake_slope'
)
"""Effects outside the library when the generators were written, which has the same equation by now."""
_WITHOUT_NAME: Final = frozenset({'no_gap', 'unexplained', CRASHED})
_SLIP: Final = 'wheel_slip'
_SEED: Final = 7001
_CASES_PER_SEED: Final[Mapping[Generator, float]] = {'A': 5.0, 'B': 2.5, 'C': 2.5}
_JOBS: Final = 2
_SLACK: Final = 1.1
_EDGES: Final = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, float('inf'))
_TICKS: Final = (0.5, 1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True)
class Spec:
    """Identification of a case; generator, name and seed reproduce it."""

    generator: Generator
    name: str
    seed: int


def draw_specs(generator: Generator, seed: int, count: int) -> tuple[Spec, ...]:
    drawn = GENERATORS[generator].draw_cases(seed, count)
    return tuple(Spec(generator, name, of_case) for name, of_case in drawn)


def open_case(spec: Spec) -> Case:
    case: Case = GENERATORS[spec.generator].make_case(spec.name, spec.seed)
    return case


@dataclass(frozen=True, slots=True)
class Named:
    """An effect that the workflow added."""

    name: str
    parameters: NamedValues
    std: NamedValues
    evidence: float
    twins: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the workflow on one case, with the truth."""

    spec: Spec  # The case
    answer: Answer  # The truth
    verdict: str  # Of the workflow, or ``CRASHED``
    found: tuple[Named, ...]  # Effects, strongest first
    probabilities: NamedValues  # Cause and probability
    gap: tuple[float, float, float] | None  # RMS gap before, after, floor [m/s]; None if no run was held out
    remaining: str  # What the remaining gap depends on, or the error message of a crash
    runs: int  # Number of runs
    explain_s: float  # CPU time of the workflow [s]
    learned: Learned | None = None  # Curve of what is missing


def try_case(spec: Spec) -> Outcome:
    """Generate a case and explain it; a crash of the workflow is an outcome too."""
    return explain_case(spec, open_case(spec))


def explain_case(spec: Spec, case: Case) -> Outcome:
    assumed = parse_train_file(case.train_yaml, 'assumed train file')
    runs = runs_of(case.bags, assumed)
    start = time.process_time()
    verdict, found, gap = CRASHED, list[Named](), None
    probabilities: NamedValues = ()
    learned: Learned | None = None
    try:
        explanation = explain(runs, assumed)
    except Exception as error:  # A benchmark of hundreds of cases must report failures, not stop at one.
        frame = traceback.extract_tb(error.__traceback__)[-1]
        remaining = f'{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})'
    else:
        verdict, remaining = explanation.verdict.value, explanation.remaining
        probabilities, learned = explanation.probabilities, explanation.learned
        for one in explanation.effects:
            twins = tuple(twin.name for twin in one.twins)
            found.append(Named(one.name, one.parameters, one.std, one.evidence, twins))
        if explanation.gap is not None:
            gap = explanation.gap.before, explanation.gap.after, explanation.gap.noise_floor
    explain_s = time.process_time() - start
    return Outcome(
        spec, case.answer, verdict, tuple(found), probabilities, gap, remaining, len(runs), explain_s, learned
    )


def runs_of(bags: Sequence[Sequence[Record]], assumed: TrainFile) -> tuple[Run, ...]:
    """Return the runs of all bags, with the aligner and collector of the command."""
    runs: list[Run] = []
    origin = 0
    for number, records in enumerate(bags):
        aligner, collector = Aligner(AlignmentConfig()), RunCollector(assumed, number, origin)
        for record in records:
            for event in aligner.push(record):
                if isinstance(event, Sample):
                    collector.add(event)
                elif isinstance(event, TimeJump):
                    collector.end_run()
        collector.end_run()
        origin = origin or collector.origin_ns
        runs += collector.runs
    return tuple(numbered(runs))


@dataclass(frozen=True, slots=True)
class Rate:
    """A number of hits among a number of cases."""

    hits: int
    cases: int

    @property
    def share(self) -> float:
        return self.hits / self.cases if self.cases else math.nan

    def interval(self) -> tuple[float, float]:
        """Return Wilson's 95 % interval of the share."""
        n, p = self.cases, self.share
        if not n:
            return 0.0, 1.0
        middle = p + _Z95**2 / (2 * n)
        half = _Z95 * math.sqrt(p * (1.0 - p) / n + _Z95**2 / (4 * n * n))
        scale = 1.0 + _Z95**2 / n
        return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def rate(outcomes: Iterable[Outcome], holds: Callable[[Outcome], bool]) -> Rate:
    """Return the rate of outcomes for which a predicate holds."""
    answers = [holds(outcome) for outcome in outcomes]
    return Rate(sum(answers), len(answers))


def truth_names(outcome: Outcome) -> tuple[str, ...]:
    return tuple(effect.name for effect in outcome.answer.effects)


def visible(outcome: Outcome) -> bool:
    """True if all effects together and each alone raise the gap by at least ``VISIBLE``."""
    return outcome.answer.visible >= VISIBLE and all(one.visible >= VISIBLE for one in outcome.answer.effects)


def slip_excused(outcome: Outcome) -> bool:
    """True if slip is reported that contaminates the data without being a hidden effect: this is correct."""
    spoiled = 'slip' in outcome.answer.contamination and _SLIP not in truth_names(outcome)
    return spoiled and any(effect.name == _SLIP for effect in outcome.found)


def named(outcome: Outcome) -> tuple[Named, ...]:
    """Return the effects named, without correctly reported slip contamination."""
    excused = slip_excused(outcome)
    return tuple(effect for effect in outcome.found if not (excused and effect.name == _SLIP))


def reported(outcome: Outcome) -> tuple[str, ...]:
    """Return all names and twins that were reported, each once."""
    effects = named(outcome)
    names = [*(effect.name for effect in effects), *(twin for effect in effects for twin in effect.twins)]
    return tuple(dict.fromkeys(names))


def alarmed(outcome: Outcome) -> bool:
    """True if the outcome is a false alarm on a case without effect: anything but "no gap"."""
    if named(outcome) or outcome.verdict in {'unexplained', CRASHED}:
        return True
    return outcome.verdict != 'no_gap' and not slip_excused(outcome)


def exact(outcome: Outcome) -> bool:
    """True if exactly the hidden effects were named."""
    names = {effect.name for effect in named(outcome)}
    return outcome.verdict not in _WITHOUT_NAME and names == set(truth_names(outcome))


def within_two(outcome: Outcome) -> bool:
    """True if at most two names were reported and the truth is among them."""
    names = reported(outcome)
    return outcome.verdict not in _WITHOUT_NAME and len(names) <= 2 and set(truth_names(outcome)) <= set(names)


def found_of_truth(outcome: Outcome) -> int:
    """Return how many of the hidden effects were named."""
    return len({effect.name for effect in named(outcome)} & set(truth_names(outcome)))


def both(outcome: Outcome) -> bool:
    return found_of_truth(outcome) == len(outcome.answer.effects)


def generic(outcome: Outcome) -> bool:
    """True if unexplained, or only names that imply no mechanism."""
    return _only_names(outcome, frozenset())


def acceptable(outcome: Outcome) -> bool:
    """True if unexplained, or only names that imply no mechanism or are near to the hidden effect."""
    return _only_names(outcome, frozenset(name for effect in outcome.answer.effects for name in effect.near))


def _only_names(outcome: Outcome, near: frozenset[str]) -> bool:
    if outcome.verdict == 'unexplained':
        return True
    names = {effect.name for effect in named(outcome)}
    return outcome.verdict not in _WITHOUT_NAME and bool(names) and names <= GENERIC | near


def variable_named(outcome: Outcome) -> bool:
    """True if the curve is over the variable that the hidden effect depends on."""
    return outcome.learned is not None and outcome.learned.name in DEPENDS[truth_names(outcome)[0]].split()


def confirmed(outcome: Outcome) -> bool:
    return outcome.learned is not None and outcome.learned.is_confirmed


def near_floor(outcome: Outcome) -> bool:
    """True if the gap of runs held out is within 20 % of the floor, unexplained ones with a curve that they confirm."""
    if outcome.verdict != 'unexplained':
        return over_floor(outcome) <= NEAR
    gap = outcome.learned.gap if outcome.learned is not None and confirmed(outcome) else None
    return gap is not None and gap.after <= NEAR * gap.noise_floor


def parameter_errors(outcome: Outcome) -> tuple[tuple[str, float], ...]:
    """Return (effect.parameter, error in its own std) of all named effects that are in the data.

    Of a name reported more than once only the strongest counts. A parameter without a usable std has an infinite error.
    """
    truth = {effect.name: dict(effect.parameters) for effect in outcome.answer.effects}
    strongest = {effect.name: effect for effect in reversed(named(outcome))}
    errors: list[tuple[str, float]] = []
    for effect in strongest.values():
        std = dict(effect.std)
        for name, value in effect.parameters:
            if name in truth.get(effect.name, {}):
                spread, error = std.get(name, math.nan), value - truth[effect.name][name]
                usable = math.isfinite(spread) and spread > 0.0
                errors.append((f'{effect.name}.{name}', error / spread if usable else math.inf))
    return tuple(errors)


def within_std(errors: Sequence[float]) -> Rate:
    """Return how many errors are within two of their own std."""
    return Rate(sum(abs(error) <= 2.0 for error in errors), len(errors))


def rms(errors: Sequence[float]) -> float:
    """Return the rms of the finite errors, NaN if there are none."""
    finite = [error for error in errors if math.isfinite(error)]
    return math.sqrt(sum(error * error for error in finite) / len(finite)) if finite else math.nan


def over_floor(outcome: Outcome) -> float:
    """Return the ratio of the gap after to the noise floor, NaN if no run was held out."""
    return math.nan if outcome.gap is None else outcome.gap[1] / outcome.gap[2]


def seconds_for_eight(outcome: Outcome) -> float:
    """Return the CPU time from aligned records to the explanation, scaled to eight runs [s]."""
    return outcome.explain_s * 8.0 / max(outcome.runs, 1)


def measure(seeds: int) -> list[Table | Plot]:
    """Score five cases of generator A and 2.5 of each other one per seed."""
    by_generator = {generator: _scored(generator, round(each * seeds)) for generator, each in _CASES_PER_SEED.items()}
    everything = [outcome for of_one in by_generator.values() for outcome in of_one]
    tables: list[Table | Plot] = [targets(everything, 'all generators'), reliability(everything)]
    for generator, of_one in by_generator.items():
        title = f'generator {generator}'
        tables += [targets(of_one, title), *tables_of(of_one, title)]
    return [*tables, visibility_plot(everything), gap_plot(everything)]


def _scored(generator: Generator, count: int) -> list[Outcome]:
    found = over_seeds(try_case, draw_specs(generator, _SEED, count), f'generator {generator}: cases', _JOBS)
    return sorted(found, key=lambda outcome: (outcome.spec.name, outcome.spec.seed))


def tables_of(outcomes: Outcomes, title: str) -> list[Table]:
    makers = (singles, nothing_hidden, pairs, outsiders, curves, circumstances, confusions, parameters)
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
        _target('outside the library: variable named by a curve', rate(outside, variable_named), 0.80),
        _target('outside the library: gap after within 20 % of the floor', rate(outside, near_floor), 0.80),
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


def causes(outcome: Outcome) -> frozenset[str]:
    """Return the true causes as probabilities name them; contaminating slip is one."""
    answer = outcome.answer
    slip = {_SLIP} if 'slip' in answer.contamination else set()
    if answer.kind == 'outside':
        return frozenset({_IN_LIBRARY.get(name, OTHER) for name in truth_names(outcome)} | slip)
    return frozenset({*truth_names(outcome)} | slip or {NONE})


def given_to_truth(outcome: Outcome) -> float:
    """Return the probability given to the true causes."""
    true = causes(outcome)
    return sum(p for name, p in outcome.probabilities if name in true)


def reliability(outcomes: Outcomes) -> Table:
    """Return a table of stated probabilities against the share of them that were true; true causes share one."""
    true = [causes(one) for one in outcomes]
    stated = [
        (p, (name in some) / len(some))
        for one, some in zip(outcomes, true, strict=True)
        for name, p in one.probabilities
    ]
    rows = []
    for low in range(10):
        if inside := [pair for pair in stated if min(int(10.0 * pair[0]), 9) == low]:
            mean, share = np.mean(inside, axis=0).tolist()
            rows.append((f'{low / 10:.1f} to {low / 10 + 0.1:.1f}', f'{len(inside)}', f'{mean:.3f}', f'{share:.3f}'))
    given = [given_to_truth(one) for one in outcomes]
    seen = [p for p, one in zip(given, outcomes, strict=True) if visible(one) or one.answer.kind == 'none']
    note = (
        f'Of two causes that act together, each counts as half true. Mean probability given to the true causes: '
        f'{np.mean(given):.2f} in all '
        f'{len(outcomes)} cases, {np.mean(seen):.2f} in those without an effect or with visible ones.'
    )
    return Table('Probabilities of causes', ('stated', 'number', 'mean', 'true'), tuple(rows), note)


def singles(outcomes: Outcomes, title: str) -> Table:
    """Return a table with a row per effect of the library."""
    cases = _kind(outcomes, 'single')
    header = columns(
        'effect | cases | visible | exact | in set of two | exact, all cases | within 2 std | error rms [std] | '
        'before | after | floor [mm/s] | time p50 | p90 [s]'
    )
    rows = _by_effect(cases, _single_row)
    note = (
        f'Visible: raises the gap by >= {VISIBLE:.0f} %; exact and set: visible cases. Parameter errors: all cases '
        'in which the effect was named. Gaps: medians over visible cases, on held-out runs. Time: CPU, not scaled.'
    )
    return Table(f'Single effects, {title}', header, rows, note)


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
    rows = _by_effect(cases, _outside_row)
    header = columns(
        'effect | visible cases | acceptable | unexplained | unexplained or generic name | no gap | reported'
    )
    note = (
        'Acceptable: unexplained, or only names that imply no mechanism (local_drag, resistance_step) or that the '
        'generator lists as near to the hidden effect. Generic: without the near names.'
    )
    return Table(f'Outside the library, {title}', header, rows, note)


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


def curves(outcomes: Outcomes, title: str) -> Table:
    """Return a table of what was learned, with a row per effect outside the library."""
    cases = [one for one in _kind(outcomes, 'outside') if visible(one)]
    header = columns(
        'effect | visible cases | unexplained | variable named | confirmed | gap near the floor | curves over'
    )
    note = (
        'Variable named: the curve is over the variable of the effect. Confirmed: by runs left out of the fit. '
        'Gap near the floor: within 20 % of it; that of the curve where unexplained.'
    )
    return Table(f'Learned curves, {title}', header, _by_effect(cases, _curve_row), note)


def _curve_row(name: str, cases: Outcomes) -> tuple[str, ...]:
    names = Counter(one.learned.name for one in cases if one.learned is not None)
    return (
        name,
        str(len(cases)),
        _short(rate(cases, lambda one: one.verdict == 'unexplained')),
        _short(rate(cases, variable_named)),
        _short(rate(cases, confirmed)),
        _short(rate(cases, near_floor)),
        '; '.join(f'{text}: {count}' for text, count in names.most_common()) if name != 'all' else '',
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
    rows = _by_effect(cases, lambda name, some: (name, _counted(some)))[:-1]
    note = 'Visible single effects. After ~ the twins reported with the name.'
    return Table(f'Reported effects, {title}', ('hidden', 'reported: cases'), rows, note)


def parameters(outcomes: Outcomes, title: str) -> Table:
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


def _by_effect(cases: Outcomes, row: Callable[[str, Outcomes], tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Return a row for each hidden effect, and one for all cases; none without cases."""
    groups = {name: [one for one in cases if name in truth_names(one)] for name in sorted(set(map(_first, cases)))}
    return tuple(row(name, some) for name, some in (groups | {'all': cases}).items()) if cases else ()


def _first(outcome: Outcome) -> str:
    return truth_names(outcome)[0]


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


def visibility_plot(outcomes: Sequence[Outcome]) -> Plot:
    """Return the share of single effects identified, over their visibility."""
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    single = [one for one in outcomes if one.answer.kind == 'single']
    bins = [[one for one in single if low <= one.answer.visible < high] for low, high in pairwise(_EDGES)]
    filled = [(k, chosen) for k, chosen in enumerate(bins) if chosen]
    for text, holds, aside in (('exact name', exact, -0.1), ('in a set of at most two', within_two, 0.1)):
        rates = [rate(chosen, holds) for _, chosen in filled]
        share = np.array([100.0 * one.share for one in rates])
        ends = 100.0 * np.array([one.interval() for one in rates]).reshape(-1, 2).T
        spread = np.clip([share - ends[0], ends[1] - share], 0.0, None)
        axes.errorbar([k + aside for k, _ in filled], share, yerr=spread, fmt='o', capsize=3.0, label=text)
    axes.axvline(_EDGES.index(VISIBLE) - 0.5, color='0.5', linestyle=':')
    axes.set_xticks(range(len(bins)), [f'{low:.0f} .. {high:.0f}' for low, high in pairwise(_EDGES)])
    axes.set_xlabel('rise of the gap over the noise floor, %')
    axes.set_ylim(0.0, 105.0)
    axes.set_ylabel('of the cases, %')
    axes.legend()
    note = 'Single effects of all generators, 95 % intervals. The targets count cases to the right of the dotted line.'
    return Plot('explain_visibility', 'Correctly named effects by visibility', figure, note)


def gap_plot(outcomes: Sequence[Outcome]) -> Plot:
    """Return the gap before and after over the noise floor, for correctly named single effects."""
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    right = [one for one in outcomes if one.answer.kind == 'single' and exact(one)]
    gaps = np.array([one.gap for one in right if one.gap is not None]).reshape(-1, 3)
    before, after = np.sort(gaps[:, 0] / gaps[:, 2]), np.sort(gaps[:, 1] / gaps[:, 2])
    share = 100.0 * (np.arange(len(gaps)) + 0.5) / max(len(gaps), 1)
    axes.plot(before, share, label='before')
    axes.plot(after, share, label='after')
    axes.axvline(1.1, color='0.5', linestyle=':')
    axes.set_xscale('log')
    axes.set_xticks(_TICKS, [f'{tick:g}' for tick in _TICKS])
    axes.minorticks_off()
    axes.set_xlabel('held-out gap / noise floor')
    axes.set_ylabel('of the cases below, %')
    axes.legend()
    note = 'Correctly named single effects of all generators. Dotted: 10 % above the floor.'
    return Plot('explain_gap', 'Held-out gap before and after the effect is added', figure, note)

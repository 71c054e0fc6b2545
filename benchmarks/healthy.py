# SPDX-License-Identifier: Apache-2.0
"""What the checks of the inputs say on healthy drives, on unusual ones, and with faults."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

from benchmarks.faults import BY_NAME, NOTHING, Fault, injected, late, scaled, value_fault
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.unusual import UNUSUAL, unusual_drive
from benchmarks.worlds import FIELD, WORLDS, drive
from trainid_ros.interface.records import NS_PER_S, Row
from trainid_ros.stream.input_check import MIN_SPEED
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

FIRST_SEED: Final = 8200
"""Seeds from here on to 8999 were not used while the checks were written; smaller ones, and 9000, were."""
HEALTHY_S: Final = 3600.0
FAULTY_S: Final = 2400.0
# A fault in mid-drive [s].
_BEGIN_S, _END_S = 1200.0, 1800.0
_FAULTY_WORLDS: Final = ('metro', 'emu', 'freight')

_EXTRA: Final = (
    scaled('x .5', 'force', 0.5),
    scaled('x 1.5', 'force', 1.5),
    scaled('x 1.05', 'force', 1.05),
    scaled('zero', 'force', 0.0),
    scaled('+10 kN per 100 t', 'force', 1.0, 2e4),
    late('force', 2.0),
    late('speed', 2.0),
    late('command', 2.0),
    scaled('x 3', 'command', 3.0),
    scaled('5 per mille high', 'gradient', 1.0, 5.0),
    scaled('zero', 'gradient', 0.0),
    scaled('3 % low', 'speed', 0.97),
    value_fault('drift 10 % in 300 s', 'speed', lambda t, x, y, flag: (x * (1.0 + min(t, 600.0) / 3000.0), y, flag)),
)
_OF_MATRIX: Final = (
    'speed in km/h', 'speed in mph', 'speed half', 'speed 3 % high', 'speed 5 % high', 'speed frozen', 'speed +1 s',
    'speed position 5 % high', 'speed position double', 'speed position frozen', 'force in kN', 'force in lbf',
    'force sign', 'force 20 % high', 'force frozen', 'force +0.5 s', 'force +1 s', 'force clock -1 s', 'gradient sign',
    'gradient in per cent', 'gradient 2 per mille high', 'gradient frozen', 'command half', 'command in g',
    'command frozen',
)  # fmt: skip
FAULTS: Final = {fault.name: fault for fault in (*(BY_NAME[name] for name in _OF_MATRIX), *_EXTRA)}
# What a finding must name, by the first word of a fault; a speed clock is also one of all others.
_NAMES: Final = {
    'speed': 'ato/speed', 'position': 'position', 'force': 'ato/force', 'gradient': 'ato/gradient',
    'command': 'ato/brake_command',
}  # fmt: skip


class Moment(NamedTuple):
    """What the checks say after a sample."""

    stamp_ns: int
    moved_s: float  # Time in motion since the sample before [s]
    finding: str = ''
    suspicion: str = ''  # Of something that an estimator uses
    holds_resistance: bool = False


@dataclass(frozen=True, slots=True)
class Case:
    """A drive: ``place`` in the unusual ones, -1 for none; ``fault`` by name, from the start or in mid-drive."""

    world: str
    seed: int
    place: int = -1
    fault: str = NOTHING.name
    from_start: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the check said on a drive.

    Attributes:
        findings: Texts of the findings, one for each time that one began.
        found: Share of the motion under a finding.
        suspected: Share of the motion under a suspicion alone.
        held: Share of the motion in which the resistance is held back.
        moved_s: Time in motion [s].
        found_s: Motion from the start of the fault to the first finding [s], infinite without one.
        cleared_s: Motion from its end to the end of the finding [s], NaN where it does not apply.
        is_right: Whether most of the time under a finding during the fault names the right input.
        was_suspected: Whether anything was suspected during the fault.
        suspicions: Texts of the suspicions, most frequent first.
    """

    findings: tuple[str, ...]
    found: float
    suspected: float
    held: float
    moved_s: float
    found_s: float
    cleared_s: float
    is_right: bool
    was_suspected: bool
    suspicions: tuple[str, ...] = ()


def moments_of(train_file: TrainFile, rows: Iterable[Row]) -> list[Moment]:
    """Return what the checks say after each sample of a drive."""
    stream, moments = SampleStream(StreamConfig(train_file)), list[Moment]()
    for row in rows:
        for event in stream.push_row(*row):
            if isinstance(event, Sample):
                faults = stream.faults
                moved_s = event.dt if event.speed >= MIN_SPEED and event.dt > 0.0 else 0.0
                suspicion, is_held = faults.brake_rate.suspicion, faults.resistance.finding != ''
                moments.append(Moment(event.stamp_ns, moved_s, faults.finding, suspicion, is_held))
    return moments


def outcome_of(moments: Sequence[Moment], case: Case) -> Outcome:
    """Summarise what the checks said."""
    findings, suspicions, before, start_ns = list[str](), Counter[str](), '', moments[0].stamp_ns
    begin_s, end_s = (0.0, math.inf) if case.from_start else (_BEGIN_S, _END_S)
    moved = found = suspected = held = right = 0.0
    found_s, cleared_s, since, after, under, was_suspected = math.inf, math.nan, 0.0, 0.0, 0.0, False
    name = _NAMES.get(case.fault.split(' ')['position' in case.fault], '')
    for moment in moments:
        if moment.finding and not before:
            findings.append(moment.finding)
        before = moment.finding
        time_s, dt = (moment.stamp_ns - start_ns) / NS_PER_S, moment.moved_s
        is_suspected = moment.suspicion != '' and not moment.finding
        moved += dt
        found += dt * (moment.finding != '')
        suspected += dt * is_suspected
        held += dt * moment.holds_resistance
        if is_suspected:
            suspicions[moment.suspicion] += 1
        if begin_s <= time_s < end_s:
            since += dt
            if moment.finding:
                found_s = min(found_s, since)
                under += dt
                right += dt * (name in moment.finding)
            was_suspected = was_suspected or is_suspected
        elif time_s >= end_s:
            after += dt
            if moment.finding and math.isnan(cleared_s) and found_s < math.inf:
                cleared_s = math.inf
            if not moment.finding and cleared_s == math.inf:
                cleared_s = after
    whole = moved or math.inf  # a speed that is stuck from the start never moves
    return Outcome(
        tuple(findings), found / whole, suspected / whole, held / whole, moved, found_s, cleared_s,
        under > 0.0 and right > 0.5 * under, was_suspected,
        tuple(f'{text} ({count / 5.0:.0f} s)' for text, count in suspicions.most_common(3)),
    )  # fmt: skip


@lru_cache(maxsize=2)
def rows_of(world: str, seed: int, place: int, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of a healthy drive."""
    if place >= 0:
        return unusual_drive(UNUSUAL[place], seed, duration)
    found = drive(world, seed, FIELD, duration=duration)
    return found.train_file, [record.row() for record in found.records]


def faulty_rows(rows: Sequence[Row], fault: Fault, *, from_start: bool) -> list[Row]:
    """Return the rows of a drive with a fault."""
    start_ns, end_ns = rows[0][1], rows[-1][1] + 1
    if not from_start:
        start_ns, end_ns = (start_ns + round(s * NS_PER_S) for s in (_BEGIN_S, _END_S))
    return injected(rows, (fault,), start_ns, end_ns)


def run(case: Case) -> Outcome:
    """Return what the check says on a drive."""
    is_faulty = case.fault != NOTHING.name
    train_file, rows = rows_of(case.world, case.seed, case.place, FAULTY_S if is_faulty else HEALTHY_S)
    if is_faulty:
        rows = faulty_rows(rows, FAULTS[case.fault], from_start=case.from_start)
    return outcome_of(moments_of(train_file, rows), case)


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables of healthy, unusual and faulty drives."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    healthy = [Case(world, seed) for world in WORLDS for seed in chosen]
    unusual = [Case(case.world, FIRST_SEED, place) for place, case in enumerate(UNUSUAL)]
    faulty = [
        Case(world, FIRST_SEED, fault=name, from_start=from_start)
        for world in _FAULTY_WORLDS for from_start in (False, True) for name in FAULTS
    ]  # fmt: skip
    cases = [*healthy, *unusual, *faulty]
    outcomes = dict(zip(cases, over_seeds(run, cases, 'healthy: drives'), strict=True))
    by_world = [[outcomes[Case(world, seed)] for seed in chosen] for world in WORLDS]
    names = [f'{case.name}, {case.world}' for case in UNUSUAL]
    return (
        healthy_table('Healthy drives', WORLDS, by_world),
        healthy_table('Unusual healthy drives', names, [[outcomes[case]] for case in unusual]),
        fault_table(outcomes),
        summary_table(outcomes),
    )


_HEALTHY_HEADER: Final = (
    '', 'hours', 'findings', 'drives with one', 'found, %', 'suspected, %', 'resistance held, %', 'what is found',
)  # fmt: skip
_NOTE: Final = (
    'Shares of the time in motion. Suspected: of something that an estimator uses, without a finding. Found in s of '
    'motion / cleared in s after the end of the fault; (s): only suspected; !: another input is named most of the time.'
)


def healthy_table(title: str, names: Sequence[str], outcomes: Sequence[Sequence[Outcome]]) -> Table:
    """Return the table of drives without faults."""
    rows = []
    for name, ones in zip(names, outcomes, strict=True):
        moved = sum(one.moved_s for one in ones)
        shares = [
            f'{100 * sum(getattr(one, what) * one.moved_s for one in ones) / moved:.1f}'
            for what in ('found', 'suspected', 'held')
        ]
        texts = Counter(text for one in ones for text in one.findings)
        counts = (str(sum(len(one.findings) for one in ones)), str(sum(bool(one.findings) for one in ones)))
        rows.append((name, f'{moved / 3600:.1f}', *counts, *shares, '; '.join(texts) or '-'))
    return Table(title, _HEALTHY_HEADER, tuple(rows), _NOTE)


def _cell(one: Outcome) -> str:
    if not math.isfinite(one.found_s):
        return 'suspected' if one.was_suspected else '-'
    cleared = '' if math.isnan(one.cleared_s) else f'/{one.cleared_s:.0f}' if one.cleared_s < math.inf else '/never'
    return f'{one.found_s:.0f}{cleared}{"" if one.is_right else " !"}'


def fault_table(outcomes: dict[Case, Outcome]) -> Table:
    """Return the table of faults by worlds."""
    rows = [
        (name, 'start' if from_start else 'mid',
         *(_cell(outcomes[Case(w, FIRST_SEED, fault=name, from_start=from_start)]) for w in _FAULTY_WORLDS))
        for name in FAULTS for from_start in (False, True)
    ]  # fmt: skip
    return Table(
        'Faults, seconds of motion until found / cleared', ('fault', 'from', *_FAULTY_WORLDS), tuple(rows), _NOTE
    )


def summary_table(outcomes: dict[Case, Outcome]) -> Table:
    """Return how many faults are found, by the right input, or at least suspected."""
    rows = []
    for from_start in (False, True):
        some = [one for case, one in outcomes.items() if case.fault != NOTHING.name and case.from_start == from_start]
        found = sum(math.isfinite(one.found_s) for one in some)
        right, seen = (
            sum(one.is_right for one in some),
            sum(one.was_suspected or one.found_s < math.inf for one in some),
        )
        name = f'{"from the start" if from_start else "in mid-drive"} ({len(some)})'
        rows.append((name, str(found), str(right), str(seen)))
    return Table('Faults', ('', 'found', 'right input named', 'at least suspected'), tuple(rows))

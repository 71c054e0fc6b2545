# SPDX-License-Identifier: Apache-2.0
"""What the check of the inputs says on healthy drives, ordinary and unusual; faults are in ``fault_matrix``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.unusual import UNUSUAL, unusual_drive
from benchmarks.worlds import FIELD, WORLDS, drive
from trainid_ros.interface.records import Row
from trainid_ros.stream.input_blocks import MIN_SPEED
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

FIRST_SEED: Final = 8400
"""Seeds from here on to 8999 were not used while the checks were written; smaller ones, and 9000, were."""
HEALTHY_S: Final = 3600.0


class Moment(NamedTuple):
    """What the checks say after a sample."""

    stamp_ns: int
    moved_s: float  # Time in motion since the sample before [s]
    finding: str = ''
    suspicion: str = ''  # Of something that an estimator uses
    holds_resistance: bool = False


@dataclass(frozen=True, slots=True)
class Case:
    """A healthy drive: ``place`` in the unusual ones, -1 for an ordinary one."""

    world: str
    seed: int
    place: int = -1


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the check said on a drive.

    Attributes:
        findings: Texts of the findings, one for each time that one began.
        found: Share of the motion under a finding.
        suspected: Share of the motion under a suspicion alone.
        held: Share of the motion in which the resistance is held back.
        moved_s: Time in motion [s].
        suspicions: Texts of the suspicions, most frequent first.
    """

    findings: tuple[str, ...]
    found: float
    suspected: float
    held: float
    moved_s: float
    suspicions: tuple[str, ...]


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


def outcome_of(moments: Sequence[Moment]) -> Outcome:
    """Summarise what the checks said."""
    findings, suspicions, before = list[str](), Counter[str](), ''
    moved = found = suspected = held = 0.0
    for moment in moments:
        if moment.finding and not before:
            findings.append(moment.finding)
        before = moment.finding
        dt, is_suspected = moment.moved_s, moment.suspicion != '' and not moment.finding
        moved += dt
        found += dt * (moment.finding != '')
        suspected += dt * is_suspected
        held += dt * moment.holds_resistance
        if is_suspected:
            suspicions[moment.suspicion] += 1
    whole = moved or math.inf  # a speed that is stuck from the start never moves
    texts = tuple(f'{text} ({count / 5.0:.0f} s)' for text, count in suspicions.most_common(3))
    return Outcome(tuple(findings), found / whole, suspected / whole, held / whole, moved, texts)


def rows_of(world: str, seed: int, place: int, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of a healthy drive."""
    if place >= 0:
        return unusual_drive(UNUSUAL[place], seed, duration)
    found = drive(world, seed, FIELD, duration=duration)
    return found.train_file, [record.row() for record in found.records]


def run(case: Case) -> Outcome:
    """Return what the check says on a drive."""
    return outcome_of(moments_of(*rows_of(case.world, case.seed, case.place, HEALTHY_S)))


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables of ordinary and unusual healthy drives."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    ordinary = [Case(world, seed) for world in WORLDS for seed in chosen]
    unusual = [Case(case.world, FIRST_SEED, place) for place, case in enumerate(UNUSUAL)]
    outcomes = over_seeds(run, [*ordinary, *unusual], 'healthy: drives')
    by_world = [outcomes[k * seeds : (k + 1) * seeds] for k in range(len(WORLDS))]
    names = [f'{case.name}, {case.world}' for case in UNUSUAL]
    return (
        healthy_table('Healthy drives', WORLDS, by_world),
        healthy_table('Unusual healthy drives', names, [[one] for one in outcomes[len(ordinary) :]]),
    )


_HEALTHY_HEADER: Final = (
    '', 'hours', 'findings', 'drives with one', 'found, %', 'suspected, %', 'resistance held, %', 'what is found',
)  # fmt: skip
_NOTE: Final = 'Shares of the time in motion. Suspected: of something that an estimator uses, without a finding.'


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

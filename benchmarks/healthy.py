# SPDX-License-Identifier: Apache-2.0
"""What the check of the inputs says on healthy drives, ordinary and unusual; faults are in ``fault_matrix``.

An unusual drive is one of a world whose motion, plan or records differ as stated: a check must not take it for a fault.
Those of ``trainid simulate`` have tunnels in the train file, and maps of their own behind ``ato/gradient``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.worlds import FIELD, WORLDS, drive
from benchmarks.worlds.motion import HOLD, Motion, Plan
from benchmarks.worlds.unknowns import Coefficients, random_of
from trainid_ros.interface.records import FORCE, SPEED, Row
from trainid_ros.sim.scenario import simulate
from trainid_ros.sim.worlds import REALISMS, find_world, make_case, usual_duration, world_train
from trainid_ros.stream.input_blocks import MIN_SPEED
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Rows = Callable[[Sequence[Row], TrainFile, int], list[Row]]


@dataclass(frozen=True, slots=True)
class Unusual:
    """An unusual healthy drive: the world, and what differs from it."""

    name: str
    world: str
    motion: type[Motion] = Motion
    change: Callable[[Plan], Plan] | None = None
    rows: Rows | None = None


class _PowerBraking(Motion):
    """The driver pulls against the brake for the first seconds of each braking."""

    since = math.inf

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        self.since = 0.0 if command == 0.0 else self.since + 0.2
        if 0.0 < self.since < 4.0 and self.speed > 3.0:
            effort = 0.25 * self.plan.vehicle.max_force
        return effort, command


class _DynamicBraking(Motion):
    """The drives brake without a command, but to hold the train at stops."""

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        if command > 0.0 and self.speed > 1.0:
            rotary = 1.0 + self.plan.vehicle.kind.rotary_mass
            return -command * self.plan.masses[self.leg] * rotary, 0.0
        return effort, command


class _HalfDynamicBraking(_DynamicBraking):
    """Every other time."""

    count, was = 0, 0.0

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        self.count += command > 0.0 and self.was == 0.0
        self.was = command
        return super().acts(effort, command) if self.count % 2 else (effort, command)


class _Wind(Motion):
    """Head wind on the way out, tail wind on the way back."""

    wind = 11.0

    def davis(self) -> Coefficients:
        a, b, c = super().davis()
        wind = self.wind * self.line.sign
        # c (v + W)^2, which acts against the train where the wind is slower than it.
        return a + c * wind * abs(wind), b + 2.0 * c * wind, c


class _Storm(_Wind):
    wind = 15.0


class _Tunnels(Motion):
    """Short tunnels with 2.5 times the aerodynamic drag."""

    factor = 2.5

    def davis(self) -> Coefficients:
        a, b, c = super().davis()
        here = self.line.origin + self.line.sign * self.way
        return a, b, self.factor * c if here % 1500.0 < 400.0 else c


class _WideTunnels(_Tunnels):
    """Those of two tracks, on a line for fast trains."""

    factor = 1.6


class _TwiceTheDrag(Motion):
    """Snow, or the train file of another front."""

    def davis(self) -> Coefficients:
        a, b, c = super().davis()
        return a, b, 2.0 * c


class _Coupling(Motion):
    """A second train is coupled after 20 min, and not weighed."""

    def mass(self) -> float:
        return super().mass() * (2.0 if self.time > 1200.0 else 1.0)


class _NeutralSections(Motion):
    """No traction for some seconds of every minute."""

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        return 0.0 if self.time % 60.0 < 4.0 else effort, command


class _HillStarts(Motion):
    """The driver pulls before the brake is released."""

    pulled = 0.0

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        if self.speed == 0.0 and command == 0.0 and self.pulled < 3.0:
            self.pulled += 0.2
            return 0.4 * self.plan.vehicle.max_force, 2.0 * HOLD
        if self.speed > 1.0:
            self.pulled = 0.0
        return effort, command


class _LeafSeason(Motion):
    """Wheels slide: in bursts the brake has only a part of its force, and the measured speed is too low."""

    def rate_at(self, base: float, speed: float, nominal: float, acted: float) -> float:
        rate = super().rate_at(base, speed, nominal, acted)
        return rate * (0.65 if nominal > 0.4 and slides(self.time) > 0.0 else 1.0)


def slides(time_s: float) -> float:
    """Return by which share sliding wheels are too slow at a time of the day [s]: bursts of one to three seconds."""
    burst = math.floor(time_s / 4.0)
    kind = (burst * 2654435761) % 97
    return (0.08 + 0.002 * kind) if kind < 45 and time_s % 4.0 < 1.0 + 0.04 * kind else 0.0


def _shunting(plan: Plan) -> Plan:
    ways = tuple(replace(way, limits=((way.limits[0][0], 3.1),)) for way in plan.ways)
    return replace(plan, ways=(ways[0], ways[1]))


def _of_odometer(change: Callable[[float, float], tuple[float, float]]) -> Rows:
    """Return what changes speed and position of each row of the odometer."""

    def changed(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
        return [(*row[:2], *change(*row[2:4]), row[4]) if row[0] == SPEED else row for row in rows]

    return changed


_whole_kmh = _of_odometer(lambda speed, position: (round(speed * 3.6) / 3.6, position))
_in_steps = _of_odometer(lambda speed, position: (speed, 10.0 * math.floor(position / 10.0)))


def _noisy(rows: Sequence[Row], _: TrainFile, seed: int) -> list[Row]:
    """Return rows whose speed has white noise of 0.1 m/s, but at a stand."""
    rng = np.random.default_rng(seed)
    noise = 0.1 * rng.standard_normal(len(rows))
    return [
        (*row[:2], max(row[2] + float(e), 0.0), *row[3:]) if row[0] == SPEED and row[2] > 0.0 else row
        for row, e in zip(rows, noise, strict=True)
    ]


_dead_zone = _of_odometer(lambda speed, position: (speed if speed > 0.8 else 0.0, position))


def _worn(rows: Sequence[Row], file: TrainFile, seed: int) -> list[Row]:
    """Speed and distance from the start are 1.5 % high."""
    start = next(row[3] for row in rows if row[0] == SPEED)
    high = _of_odometer(lambda speed, position: (1.015 * speed, start + 1.015 * (position - start)))
    return high(rows, file, seed)


def _filtered(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    """The speed, but not the position, has passed a low-pass of 0.3 s."""
    speed, last_ns, sent = 0.0, rows[0][1], list[Row]()
    for row in rows:
        if row[0] == SPEED:
            speed += (1.0 - math.exp((last_ns - row[1]) / 0.3e9)) * (row[2] - speed)
            last_ns = row[1]
        stands = row[0] == SPEED and row[2] == 0.0 and speed < 0.05
        sent.append((*row[:2], 0.0 if stands else speed, *row[3:]) if row[0] == SPEED else row)
    return sent


@_of_odometer
def _balises(speed: float, position: float) -> tuple[float, float]:
    """The position is 2 % off from balise to balise, which stand every 700 m."""
    balise = 700.0 * math.floor(position / 700.0)
    return speed, balise + 1.02 * (position - balise)


def _slipping(share: float, most: float) -> Rows:
    def change(rows: Sequence[Row], file: TrainFile, seed: int) -> list[Row]:
        rng = random_of('any', seed, 'slip')
        weight, force, left_s, size, last_ns = file.train.mass * 9.80665e-3, 0.0, 0.0, 0.0, 0
        sent = list[Row]()
        for row in rows:
            if row[0] == FORCE:
                force = row[2] / weight
            if row[0] == SPEED:
                left_s -= (row[1] - last_ns) * 1e-9
                last_ns = row[1]
                if left_s <= 0.0 or force * size <= 0.0:
                    size = left_s = 0.0
                    if abs(force) > 10.0 and row[2] > 1.0 and rng.uniform() < share * 0.2 / 1.3 / 0.5:
                        left_s = float(rng.uniform(0.6, 2.0))
                        size = math.copysign(most * float(rng.uniform(0.15, 1.0)), force)
            sent.append((*row[:2], max(row[2] + size, 0.0), *row[3:]) if row[0] == SPEED else row)
        return sent

    return change


def _then(first: Rows, second: Rows) -> Rows:
    return lambda rows, file, seed: second(first(rows, file, seed), file, seed)


def _sliding(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    start_ns, braked, sent = rows[0][1], False, list[Row]()
    for row in rows:
        if row[0] == FORCE:
            braked = row[2] < 0.0
        slide = slides((row[1] - start_ns) * 1e-9) if row[0] == SPEED and braked else 0.0
        sent.append((*row[:2], row[2] * (1.0 - slide), *row[3:]) if slide > 0.0 else row)
    return sent


UNUSUAL: Final = (
    Unusual('power braking', 'metro', _PowerBraking),
    Unusual('power braking', 'freight', _PowerBraking),
    Unusual('dynamic braking without command', 'metro', _DynamicBraking),
    Unusual('dynamic braking, every other one', 'emu', _HalfDynamicBraking),
    Unusual('wind of 11 m/s', 'metro', _Wind),
    Unusual('wind of 15 m/s', 'emu', _Storm),
    Unusual('speed in whole km/h', 'metro', rows=_whole_kmh),
    Unusual('speed in whole km/h', 'high_speed', rows=_whole_kmh),
    Unusual('speed in whole km/h', 'freight', rows=_whole_kmh),
    Unusual('slip in 4 %', 'metro', rows=_slipping(0.04, 2.0)),
    Unusual('slip in 12 %', 'metro', rows=_slipping(0.12, 3.0)),
    Unusual('slip in 4 %', 'tram', rows=_slipping(0.04, 2.0)),
    *(
        Unusual('slip in 12 %, whole km/h', world, rows=_then(_slipping(0.12, 2.0), _whole_kmh))
        for world in ('metro', 'emu', 'high_speed', 'tram')
    ),
    Unusual('leaf season', 'tram', _LeafSeason, rows=_sliding),
    Unusual('leaf season', 'emu', _LeafSeason, rows=_sliding),
    Unusual('hill starts', 'metro', _HillStarts),
    Unusual('hill starts', 'freight', _HillStarts),
    Unusual('shunting', 'metro', change=_shunting),
    Unusual('shunting', 'tram', change=_shunting),
    Unusual('tunnels, not stated', 'metro', _Tunnels),
    Unusual('tunnels of the line', 'metro', _Tunnels),
    Unusual('tunnels, not stated', 'high_speed', _WideTunnels),
    Unusual('twice the drag', 'metro', _TwiceTheDrag),
    Unusual('twice the drag', 'high_speed', _TwiceTheDrag),
    Unusual('coupling, not weighed', 'emu', _Coupling),
    Unusual('neutral sections', 'emu', _NeutralSections),
    Unusual('neutral sections', 'high_speed', _NeutralSections),
    Unusual('position 2 % off between balises', 'metro', rows=_balises),
    Unusual('position 2 % off between balises', 'high_speed', rows=_balises),
    Unusual('position in steps of 10 m', 'metro', rows=_in_steps),
    Unusual('position in steps of 10 m', 'high_speed', rows=_in_steps),
    Unusual('noise of the speed of .1 m/s', 'metro', rows=_noisy),
    Unusual('noise of the speed of .1 m/s', 'freight', rows=_noisy),
    Unusual('speed 0 below .8 m/s', 'metro', rows=_dead_zone),
    Unusual('speed 0 below .8 m/s', 'tram', rows=_dead_zone),
    Unusual('speed behind a low-pass of .3 s', 'metro', rows=_filtered),
    Unusual('speed behind a low-pass of .3 s', 'high_speed', rows=_filtered),
    Unusual('speed behind a low-pass of .3 s', 'tram', rows=_filtered),
    Unusual('odometer 1.5 % high', 'freight', rows=_worn),
)


def simulated_drive(case: Case, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of a drive of ``trainid simulate``, at least as long as asked for [s]."""
    world, rng = find_world(case.world), np.random.default_rng(case.seed)
    file = world_train(world)
    runs = math.ceil(duration / usual_duration(world, file.line.stops, 1))
    made = make_case(world, file, REALISMS[case.realism], runs, rng)
    return made.stated, [record.row() for record in simulate(made.scenario, rng).records]


def unusual_drive(case: Unusual, seed: int, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of an unusual healthy drive."""
    found = drive(case.world, seed, FIELD, 5.0, duration, case.motion, case.change)
    rows, file = [record.row() for record in found.records], found.train_file
    if case.name == 'tunnels of the line':
        ends = [x for x, _ in file.line.gradient]
        starts = np.arange(math.ceil(min(ends) / 1500.0) * 1500.0, max(ends), 1500.0).tolist()
        file = replace(file, line=replace(file.line, tunnel=tuple((x, x + 400.0) for x in starts)))
    return file, rows if case.rows is None else case.rows(rows, file, seed)


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
    """A healthy drive: ``place`` in the unusual ones, -1 for an ordinary one; or one of ``trainid simulate``."""

    world: str
    seed: int
    place: int = -1
    realism: str = ''


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the check said on a drive."""

    findings: tuple[str, ...]  # Texts of the findings, one for each time that one began
    found: float  # Share of the motion under a finding
    suspected: float  # Share of the motion under a suspicion alone
    held: float  # Share of the motion in which the resistance is held back
    moved_s: float  # Time in motion [s]
    suspicions: tuple[str, ...]  # Texts of the suspicions, most frequent first


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


def rows_of(case: Case, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of a healthy drive."""
    if case.realism:
        return simulated_drive(case, duration)
    if case.place >= 0:
        return unusual_drive(UNUSUAL[case.place], case.seed, duration)
    found = drive(case.world, case.seed, FIELD, duration=duration)
    return found.train_file, [record.row() for record in found.records]


def run(case: Case) -> Outcome:
    """Return what the check says on a drive."""
    return outcome_of(moments_of(*rows_of(case, HEALTHY_S)))


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables of ordinary, simulated and unusual healthy drives."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    ordinary = [Case(world, seed) for world in WORLDS for seed in chosen]
    kinds = [(world, realism) for realism in REALISMS for world in WORLDS]
    simulated = [Case(world, seed, realism=realism) for world, realism in kinds for seed in chosen]
    unusual = [Case(case.world, FIRST_SEED, place) for place, case in enumerate(UNUSUAL)]
    outcomes = over_seeds(run, [*ordinary, *simulated, *unusual], 'healthy: drives')
    by_kind = [outcomes[k * seeds : (k + 1) * seeds] for k in range(len(WORLDS) + len(kinds))]
    simulations = [f'{world}, {realism}' for world, realism in kinds]
    names = [f'{case.name}, {case.world}' for case in UNUSUAL]
    return (
        healthy_table('Healthy drives', WORLDS, by_kind[: len(WORLDS)]),
        healthy_table('Healthy drives of trainid simulate', simulations, by_kind[len(WORLDS) :]),
        healthy_table('Unusual healthy drives', names, [[one] for one in outcomes[len(ordinary) + len(simulated) :]]),
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

# SPDX-License-Identifier: Apache-2.0
"""Fit of the brake on simulated brakes with laws other than that of the model, and on data that others made.

The laws are written here and share no code with the package: two lags, a limited jerk, valves that act in steps, a
changeover between brakes, loads that nobody weighs, and releases that act later. Trains brake to stops at the same few
places and are released on the way; map, resistance and traction are wrong by what the train file states.
"""

from __future__ import annotations

import math
import sys
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.days import REPOSITORY
from benchmarks.measured_car import FOLDER, Trip, load_trip, stated_car, trip_names
from benchmarks.measured_car import records as car_records
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, as_text, columns
from trainid_ros.bag.reader import BagReader
from trainid_ros.brake_rate.brake_fit import CHANGEOVER, DEAD_TIME, LAG, RELEASE, RESPONSE, BrakeFit, fit_brake
from trainid_ros.brake_rate.braking import Braking, BrakingCollector
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile, load_train_file

Array = NDArray[np.float64]

# Seeds from here on were not used during development.
FIRST_SEED: Final = 5001
LAWS: Final = ('one lag', 'two lags', 'jerk limit', 'steps', 'changeover', 'load', 'late release')
RATES: Final = (10.0, 5.0, 1.0)
# Quanta of the speed [m/s]: 0.01 m/s, 0.1 km/h, 1 km/h.
_QUANTA: Final = (0.01, 0.1 / 3.6, 1.0 / 3.6)
_STEP_S: Final = 0.02
_TICK_S: Final = 0.2
_SLEW: Final = 0.3  # Change of the command in a tick [m/s^2]
# Speeds at which rates are scored [m/s].
SPEEDS: Final = (4.0, 9.0, 14.0)
_MASS, _GAMMA = 200e3, 0.08
_INERTIA: Final = 1000.0 * (1.0 + _GAMMA) / 9.80665
_COVER_STD: Final = 1.96
_LEAST_COMMAND: Final = 0.1  # Weaker torques of a car are no braking [m/s^2]


@dataclass(frozen=True, slots=True)
class Law:
    """A brake."""

    name: str
    delay: float  # Dead time [s]
    lags: tuple[float, ...]  # Time constants [s]
    jerk: float = math.inf  # Largest change of the brake [m/s^3]
    quantum: float = 0.0  # Step of its valves [m/s^2]
    late: float = 0.0  # By how much later it releases [s]
    changeover: float = math.nan  # Speed below which another brake acts [m/s]
    below: float = 0.0  # By how much its rate differs there [1]
    rate: float = 1.0  # Mean rate at medium speed [1]
    slope: float = 0.0  # Change of the rate from 0 to 20 m/s [1]
    load: float = 0.0  # Largest load that is not weighed, as a share of the mass [1]
    scatter: float = 0.02  # Scatter of the rate from braking to braking [1]

    @property
    def loaded(self) -> float:
        """Mean factor of the rate by the load [1]."""
        return math.log1p(self.load) / self.load if self.load else 1.0

    def rate_at(self, v: float) -> float:
        """Return the mean rate over loads at a speed [m/s]."""
        step = 0.0
        if math.isfinite(self.changeover):
            step = self.below * min(1.0, max(0.0, 0.5 - (v - self.changeover) / 1.5))
        return (self.rate + self.slope * (v / 20.0 - 0.5) + step) * self.loaded


@dataclass
class Actuator:
    """State of a brake in steps of ``_STEP_S``; the output is that of a brake of rate 1 [m/s^2]."""

    law: Law
    stages: list[float] = field(default_factory=list)
    output: float = 0.0
    pending: deque[tuple[float, float]] = field(default_factory=deque)
    target: float = 0.0
    last: float = 0.0

    def command(self, now: float, value: float) -> None:
        """Command a level [m/s^2] at a time [s]; a later one replaces what has not acted yet."""
        if value == self.last:
            return
        at = now + self.law.delay + (self.law.late if value > self.last else 0.0)
        self.last = value
        while self.pending and self.pending[-1][0] >= at:
            self.pending.pop()
        self.pending.append((at, value))

    def step(self, now: float) -> float:
        """Advance to a time [s]; return the output."""
        while self.pending and self.pending[0][0] <= now:
            self.target = self.pending.popleft()[1]
        law, most = self.law, self.law.jerk * _STEP_S
        self.stages = self.stages or [0.0] * len(law.lags)
        value = self.target
        for j, lag in enumerate(law.lags):
            self.stages[j] += (value - self.stages[j]) * -math.expm1(-_STEP_S / lag)
            value = self.stages[j]
        self.output += min(most, max(-most, value - self.output))
        return round(self.output / law.quantum) * law.quantum if law.quantum else self.output


def moments(law: Law, level: float) -> tuple[float, float]:
    """Return mean and spread [s] of the response to a command that goes to a level [m/s^2] as a driver's does.

    Those of the command itself are taken off; the steps of the valves are left out.
    """
    brake, now, command = Actuator(replace(law, quantum=0.0)), 0.0, 0.0
    late = np.zeros((2, 2))  # Mean and mean square of what is missing, times two, of command and brake
    for i in range(round(40.0 / _STEP_S)):
        if i % round(_TICK_S / _STEP_S) == 0:
            command = max(level, command - _SLEW)
            brake.command(now, command)
        now += _STEP_S
        missing = 1.0 - np.array([command, brake.step(now)]) / level
        late += missing * np.array([[1.0], [2.0 * (now - 0.5 * _STEP_S)]]) * _STEP_S
    variance = late[1] - np.square(late[0])
    return late[0, 1] - late[0, 0], math.sqrt(max(0.0, variance[1] - variance[0]))


def draw_law(name: str, rng: np.random.Generator) -> Law:
    """Return a brake of a kind, with times as metros and multiple units have them."""

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    lag = draw(0.25, 1.2)
    base = Law(
        name, draw(0.2, 1.0), (lag,),
        rate=draw(0.8, 1.2), slope=float(rng.normal(0.0, 0.08)), scatter=draw(0.005, 0.04),
    )  # fmt: skip
    kinds = {
        'one lag': base,
        'two lags': replace(base, lags=(lag, draw(0.3, 1.0) * lag)),
        'jerk limit': replace(base, lags=(0.1,), jerk=draw(0.4, 1.0)),
        'steps': replace(base, quantum=draw(0.03, 0.1)),
        'changeover': replace(base, changeover=draw(4.0, 9.0), below=float(rng.choice([-1.0, 1.0])) * draw(0.06, 0.2)),
        'load': replace(base, load=draw(0.1, 0.3)),
        'late release': replace(base, late=draw(0.3, 1.5)),
    }
    return kinds[name]


@dataclass(frozen=True, slots=True)
class Trial:
    """A simulated brake."""

    seed: int

    @property
    def law(self) -> str:
        return LAWS[self.seed % len(LAWS)]

    @property
    def hz(self) -> float:
        return RATES[self.seed % len(RATES)]


@dataclass(frozen=True, slots=True)
class Score:
    """True value, estimate, standard deviation, and whether the data tell it."""

    quantity: str
    true: float
    value: float
    std: float
    told: bool

    @property
    def z(self) -> float:
        return (self.value - self.true) / self.std


STATED: Final = TrainFile(
    Train(mass=_MASS, rotary_mass=_GAMMA, mass_std=0.05, force_std=0.02),
    Davis(1.6, 0.03, 0.0008),
    brake=Brake(rate=1.0, time_constant=0.4, delay=0.6, timing_std=0.3),
    line=Line(gradient_std=0.3),
)


def drive(law: Law, hz: float, rng: np.random.Generator) -> tuple[list[Record], list[float]]:
    """Return the records of some brakings, and the changes of their commands [m/s^2]."""
    records, changes, start = list[Record](), list[float](), 10.0
    line = _Line(rng)
    for _ in range(int(rng.integers(6, 14))):
        start += brake_once(law, hz, line, rng, start, records, changes) + 60.0
    return records, changes


class _Line:
    """What is wrong with the train file and the sensors on all brakings."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.quantum = float(rng.choice(_QUANTA))
        w = STATED.resistance
        self.w = Davis(*(x * float(rng.uniform(0.75, 1.25)) for x in (w.a, w.b, w.c)))
        self.traction_gain = float(rng.normal(1.0, 0.04))
        self.places = rng.uniform(1e3, 2e4, 4)
        # Errors of the map [per mille], correlated over 200 m.
        self.knots, rho = np.arange(0.0, 2.2e4, 50.0), math.exp(-50.0 / 200.0)
        self.map = np.zeros(self.knots.size)
        for i in range(1, self.map.size):
            self.map[i] = rho * self.map[i - 1] + 0.3 * math.sqrt(1.0 - rho * rho) * rng.standard_normal()

    def resistance(self, v: float, x: float) -> float:
        """Return the true resistance [N/kN]."""
        return self.w.a + v * (self.w.b + v * self.w.c) + float(np.interp(x, self.knots, self.map))


def brake_once(
    law: Law,
    hz: float,
    line: _Line,
    rng: np.random.Generator,
    start: float,
    records: list[Record],
    changes: list[float],
) -> float:
    """Add the records of one braking and the changes of its command; return its duration [s]."""
    brake, load = Actuator(law), float(rng.uniform(0.0, law.load)) if law.load else 0.0
    factor = (1.0 + law.scatter * float(rng.standard_normal())) / (1.0 + load) / law.loaded
    v, x = float(rng.uniform(10.0, 20.0)), float(rng.choice(line.places)) - 150.0
    level, traction = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.0, 0.3))
    apply_s, change_s, end_s = float(rng.uniform(12.0, 14.0)), 0.0, 80.0
    release_s = apply_s + (float(rng.uniform(5.0, 9.0)) if rng.random() < 0.5 else math.inf)
    now = gust = command = wanted = 0.0
    i, every, tick = 0, round(1.0 / hz / _STEP_S), round(_TICK_S / _STEP_S)
    while now < end_s and v > 0.05:
        at_ns = round((start + now) * NS_PER_S)
        pull = traction * max(0.0, min(1.0, (apply_s - now) / 0.7))
        if i % tick == 0:
            if now >= apply_s and now - change_s > 4.0:
                level, change_s = min(1.1, max(0.3, level + float(rng.normal(0.0, 0.15)))), now
            before, wanted = wanted, -level if apply_s <= now < release_s else 0.0
            end_s = min(end_s, release_s + 14.0)
            changes += [wanted - before] if wanted != before else []
            command = round(command + min(_SLEW, max(-_SLEW, wanted - command)), 2)
            brake.command(now, command)
            records.append(BrakeRecord(at_ns, min(0.0, command), emergency=False))
        if i % every == 0:
            noisy = max(0.0, v + 0.015 * float(rng.standard_normal()))
            records.append(SpeedRecord(at_ns, round(noisy / line.quantum) * line.quantum, x))
            records.append(ForceRecord(at_ns, _MASS * (1.0 + _GAMMA) * (pull + min(0.0, brake.output))))
            records.append(GradientRecord(at_ns, 0.0, 0.0, tunnel=False))
        now, i = now + _STEP_S, i + 1
        gust += -gust * _STEP_S / 5.0 + 0.1 * math.sqrt(2.0 * _STEP_S / 5.0) * float(rng.standard_normal())
        braked = law.rate_at(v) * factor * brake.step(now)
        v += (line.traction_gain * pull + braked - (line.resistance(v, x) + gust) / _INERTIA) * _STEP_S
        x += max(0.0, v) * _STEP_S
    return now


def brakings_of(records: Iterable[Record], train_file: TrainFile) -> list[Braking]:
    """Return the brakings in records."""
    stream, collector = SampleStream(StreamConfig(train_file)), BrakingCollector(train_file)
    for record in records:
        for event in stream.push(record):
            if isinstance(event, Sample):
                collector.add(event, Counter())
    collector.end_piece()
    return collector.brakings


def run(trial: Trial) -> list[Score]:
    """Return the scores of one simulated brake."""
    rng = np.random.default_rng(trial.seed)
    law = draw_law(trial.law, rng)
    records, changes = drive(law, trial.hz, rng)
    return scores(fit_brake(brakings_of(records, STATED), STATED), law, changes)


def scores(fit: BrakeFit, law: Law, changes: list[float]) -> list[Score]:
    """Compare a fit with a law and the changes of its command [m/s^2]."""
    # The response to large changes counts more: the squares are its information.
    levels = np.quantile(np.abs(changes), np.linspace(0.05, 0.95, 10)) if math.isfinite(law.jerk) else np.ones(1)
    mean, spread = np.average([moments(law, -level) for level in levels], axis=0, weights=np.square(levels)).tolist()
    true = {RESPONSE: mean, DEAD_TIME: mean - spread, LAG: spread, RELEASE: law.late}
    if math.isfinite(law.changeover):
        true[CHANGEOVER] = law.changeover
    out = [
        Score(one.name, true[one.name], one.value, one.std, one.is_told) for one in fit.quantities if one.name in true
    ]
    seen = [one for one in fit.quantities if one.name == CHANGEOVER and not math.isfinite(law.changeover)]
    out += [Score(FALSE_CHANGEOVER, one.value, one.value, one.std, told=True) for one in seen]
    slow, fast = fit.speed_range
    for v in SPEEDS:
        if not slow <= v <= fast:
            continue
        row = np.array([np.interp(v, fit.knots, unit) for unit in np.eye(len(fit.knots))])
        std = math.sqrt(float(row @ fit.covariance @ row))
        out.append(Score(f'rate at {v:g} m/s', law.rate_at(v), float(row @ fit.rates), std, std < 0.05))
    return out


def measure(seeds: int) -> tuple[Table, ...]:
    """Return tables over as many simulated brakes, and of the freight run of another simulator."""
    trials = [Trial(seed) for seed in range(FIRST_SEED, FIRST_SEED + seeds)]
    found = list(zip(trials, over_seeds(run, trials, 'brake_fit'), strict=True))
    everything = [score for _, scores_of in found for score in scores_of]
    names = [name for name in dict.fromkeys(score.quantity for score in everything) if name != FALSE_CHANGEOVER]
    rows = [(name, *_row([score for score in everything if score.quantity == name])) for name in names]
    header = columns('quantity | fits | rms error | median std | bias | cover of 95 % | beyond 3 std | told')
    note = (
        f'{seeds} brakes with seven laws, 6 to 13 brakings each, speeds at 10, 5 and 1 Hz in steps of 0.01 m/s, '
        '0.1 km/h and 1 km/h; times in s, rates in 1. Told: the standard deviation is below that of the train file, '
        'of rates below 0.05. Changeover: where one is found.'
    )
    tables = [Table('Fit of simulated brakes', header, tuple(rows), note)]
    for title, keys, key in (
        ('By law of the brake', LAWS, 'law'), ('By rate of the speeds', RATES, 'hz'),
    ):  # fmt: skip
        cells = []
        for value in keys:
            chosen = [score for trial, scores_of in found if getattr(trial, key) == value for score in scores_of]
            groups = [[s for s in chosen if s.quantity.startswith(name)] for name in _GROUPS]
            cells.append((str(value) if key == 'law' else f'{value:g} Hz', *(_short(group) for group in groups)))
        note = 'Rms error, and in brackets the cover of 95 %.'
        tables.append(Table(title, ('brakes', *(name.strip() for name in _GROUPS)), tuple(cells), note))
    seen = [score for trial, scores_of in found if trial.law == 'changeover' for score in scores_of]
    shown = sum(score.quantity == CHANGEOVER for score in seen)
    false = sum(score.quantity == FALSE_CHANGEOVER for score in everything)
    of = sum(trial.law == 'changeover' for trial in trials)
    rows = [('brakes that have one', str(of), str(shown)), ('all others', str(seeds - of), str(false))]
    tables.append(Table('Changeovers', ('brakes', 'fits', 'seen'), tuple(rows)))
    return (*tables, altrios())


_GROUPS: Final = (RESPONSE, DEAD_TIME, LAG, 'rate at ', RELEASE)
FALSE_CHANGEOVER: Final = 'changeover where there is none'


def _row(scores_of: Sequence[Score]) -> tuple[str, ...]:
    error = np.array([score.value - score.true for score in scores_of])
    z = np.abs([score.z for score in scores_of])
    std, told = np.median([score.std for score in scores_of]), np.mean([score.told for score in scores_of])
    shares = (f'{np.mean(z < _COVER_STD):.0%}', f'{np.mean(z > 3.0):.1%}', f'{told:.0%}')
    return (str(z.size), f'{np.sqrt(np.mean(error**2)):.3f}', f'{std:.3f}', f'{error.mean():+.3f}', *shares)


def _short(scores_of: Sequence[Score]) -> str:
    if not scores_of:
        return '-'
    _, rms, _, _, cover, *_ = _row(scores_of)
    return f'{rms} ({cover})'


def altrios() -> Table:
    """Return the fit to the freight run of another simulator, whose brake acts at once and with rate 1."""
    folder = REPOSITORY / 'bags' / 'altrios_manifest'
    train_file = load_train_file(folder / 'train.yaml')
    with BagReader(folder) as reader:
        fit = fit_brake(brakings_of(reader.records(), train_file), train_file)
    true = {DEAD_TIME: 0.0, LAG: 0.0, RESPONSE: 0.0, RELEASE: 0.0}
    rows = tuple(
        (one.name, f'{true.get(one.name, 1.0):.0f}', f'{one.value:.3f} ± {one.std:.3f}')
        for one in fit.quantities
        if one.name in true or one.name.startswith('rate at')
    )
    return Table(f'Freight run of another simulator, {fit.brakings} brakings', ('quantity', 'true', 'fitted'), rows)


def measured(folder: Path | str = FOLDER) -> Table:
    """Return the fit to measured trips of an electric car, see :mod:`benchmarks.measured_car`, by season.

    The brake is the motor: its reported torque with the pedal released is the command. What the foot adds with the
    friction brake is not recorded, so the rate scatters and is above 1.
    """
    car, rows = stated_car(), []
    for season, letter in (('summer', 'A'), ('winter', 'B')):
        brakings = list[Braking]()
        for name in trip_names(Path(folder), letter):
            brakings += brakings_of(_regenerated(load_trip(Path(folder), name), car), car)
        fit = fit_brake(brakings, car)
        rates = ', '.join(
            f'{one.value:.2f} ± {one.std:.2f}' for one in fit.quantities if one.name.startswith('rate at')
        )
        times = (f'{one.value:.2f} ± {one.std:.2f}' for one in map(fit.find, (RESPONSE, DEAD_TIME, LAG)))
        rows.append((season, str(fit.brakings), *times, rates, f'{fit.scatter:.2f}'))
    header = columns('season | brakings | response time, s | dead time, s | time constant, s | rate | scatter')
    return Table('Regenerative braking of a car', header, tuple(rows))


def _regenerated(trip: Trip, car: TrainFile) -> Iterator[Record]:
    """Yield the records of a trip with the torque of the motor, if the pedal is released, as the brake command."""
    inertia = car.train.mass * (1.0 + car.train.rotary_mass)
    command = np.where(trip.pedal, 0.0, np.minimum(0.0, np.round(trip.force / inertia, 2)))
    command[command > -_LEAST_COMMAND] = 0.0
    changes = iter(command.tolist())
    for record in car_records(trip):
        yield (
            BrakeRecord(record.stamp_ns, next(changes), emergency=False) if isinstance(record, BrakeRecord) else record
        )


if __name__ == '__main__':
    print(as_text(measured(*sys.argv[1:2])))

# SPDX-License-Identifier: Apache-2.0
"""The train file: the engineer's prior values for train, resistance, brake and line.

One YAML file is read by the node parameters, the simulator and the workflow. Units are SI, specific
resistance is in N/kN with v in m/s, gradients are in per mille in the direction of increasing position.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import MISSING, dataclass, field, fields, replace
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from trainid_ros.interface.errors import setting, setting_info
from trainid_ros.train.fields import Section, as_section, parse_yaml, read_text, shown

Pairs = tuple[tuple[float, float], ...]
NamedValues = tuple[tuple[str, float], ...]

MIN_RATE, MAX_RATE = 0.01, 10.0
"""A brake rate outside this range is a unit error [1]."""
_CARS = 6  # Number of cars of a train without a stated number, as that of Yizhuang Line
_MAX_ROWS = 100
"""Maximum number of rows of the brake rate: the time of an answer of the client grows with them."""
_MAX_CARS = 1000
_ROUNDING = 1e-3
"""Rounded values of cars may add up to this much more or less than the stated value of the train [1]."""
_MAX_SPEED, _MAX_POSITION = 1000.0, 1e8
"""Values beyond are unit errors: speed [m/s], position [m]."""


@dataclass(frozen=True, slots=True)
class Train:
    """Parameters of the vehicle; only the mass has no default."""

    mass: float = setting(MISSING, 'train mass at its usual load', 'kg', 1.0, 1e9)
    rotary_mass: float = setting(0.08, 'rotating mass as a fraction of the train mass', '1', 0.0, 1.0)
    length: float = setting(118.0, 'length of the train', 'm', 0.1, 1e4)
    cars: int = _CARS  # Number of cars
    max_traction_force: float = setting(310e3, 'maximum tractive force at the wheel rim', 'N', 1.0, 1e9)
    max_traction_power: float = setting(3.1e6, 'maximum tractive power at the wheel rim', 'W', 1.0, 1e12)
    max_speed: float = setting(80.0 / 3.6, 'maximum speed of the train', 'm/s', 0.1, _MAX_SPEED)
    # Of the mass, weighed or not, and of the force as it is reported.
    mass_std: float = setting(0.03, 'std of the relative error of the mass', '1', 0.0, 0.5)
    force_std: float = setting(0.02, 'std of the relative error of the force', '1', 0.0, 0.5)
    # Air drag depends on the body, not on the load: 1 if all of c is air drag.
    c_by_weight: float = setting(0.0, 'share of Davis c that goes by 1/weight, from the mass above', '1', 0.0, 1.0)
    # Mass [kg] and length [m] of each car, first that at the end which leads while positions increase; empty: even
    consist: Pairs = ()

    def traction_limit(self, speed: float) -> float:
        """Return the largest traction [N] at a speed [m/s]; below 0.1 m/s, the power limits it as at 0.1 m/s."""
        return min(self.max_traction_force, self.max_traction_power / max(speed, 0.1))


@dataclass(frozen=True, slots=True)
class Davis:
    """Running resistance ``w(v) = a + b v + c v^2`` [N/kN], v in m/s."""

    a: float = setting(MISSING, 'prior Davis a', 'N/kN', 0.0, 100.0)
    # Only b may be negative: published fits of real rolling stock have such values, and w(v) stays positive.
    b: float = setting(MISSING, 'prior Davis b', 'N/kN per m/s', -10.0, 10.0)
    c: float = setting(MISSING, 'prior Davis c', 'N/kN per (m/s)^2', 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Brake:
    """Brake actuator: a gain (actual over commanded acceleration) with a dead time and a first-order lag."""

    # With a table, the factor on it.
    rate: float = setting(1.0, 'prior brake rate, 1 = nominal', '1', MIN_RATE, MAX_RATE)
    time_constant: float = setting(0.4, 'time constant of the brake', 's', 0.0, 60.0)
    delay: float = setting(0.6, 'dead time of the brake', 's', 0.0, 60.0)
    rate_table: Pairs = ()  # Speed [m/s], increasing, and brake rate [1]; empty if the rate does not depend on speed
    timing_std: float = setting(0.12, 'std of the relative error of both times', '1', 0.0, 1.0)
    # What no estimate can know before the next braking, such as rain or a brake unit that fails.
    loss_per_hour: float = setting(0.0, 'rate of sudden drops of the brake rate', '1/h', 0.0, 100.0)
    loss: float = setting(0.0, 'size of such a drop as a share of the brake rate', '1', 0.0, 0.9)
    loss_confidence: float = setting(0.0, 'least share of the first stops after a drop within a bound', '1', 0.0, 0.99)

    def shape_at(self, speed: float) -> float:
        """Return the table's value [1] at a speed [m/s]: linear between rows, constant beyond; 1 without a table."""
        table = self.rate_table
        if not table:
            return 1.0
        above = bisect_right(table, speed, key=itemgetter(0))
        if above == 0:
            return table[0][1]
        if above == len(table):
            return table[-1][1]
        (low, before), (high, after) = table[above - 1], table[above]
        return before + (after - before) * (speed - low) / (high - low)

    def rate_at(self, speed: float) -> float:
        """Return the brake rate [1] at a speed [m/s]."""
        return self.rate * self.shape_at(speed)

    @property
    def timing_stds(self) -> tuple[float, float]:
        """Standard deviations of the errors of dead time and lag [s]; relative errors of short times are larger."""
        return self.timing_std * math.hypot(self.delay, 0.67), self.timing_std * math.hypot(self.time_constant, 0.25)


@dataclass(frozen=True, slots=True)
class Line:
    """The line by position [m]; each pair applies from its position on, positions increase."""

    stops: tuple[float, ...] = ()  # Stopping points of the train's front [m], in increasing order
    gradient: Pairs = ()  # Position [m] and gradient [per mille, + uphill in increasing position]
    curve: Pairs = ()  # Position [m] and radius [m], 0 = straight
    tunnel: Pairs = ()  # Start and end of each tunnel [m]
    speed_limit: Pairs = ()  # Position [m] and limit [m/s]
    gradient_std: float = setting(0.2, 'std of the error of the gradients', 'per mille', 0.0, 50.0)


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect added by the workflow: its parameters, their standard deviations and their provenance."""

    name: str
    parameters: NamedValues = ()
    std: NamedValues = ()
    provenance: str = ''
    runs: tuple[int, ...] = ()  # Runs of the record, counted by departures from 1, on which it acts; empty: on all


@dataclass(frozen=True, slots=True)
class TrainFile:
    """Content of a train file."""

    train: Train
    resistance: Davis
    brake: Brake = field(default_factory=Brake)
    line: Line = field(default_factory=Line)
    effects: tuple[Effect, ...] = ()

    @property
    def c_of_load(self) -> float:
        """Part of Davis c that goes by 1/weight [N/kN per (m/s)^2]."""
        return self.train.c_by_weight * self.resistance.c


def load_train_file(path: str | Path) -> TrainFile:
    """Read a train file; raise InputError, which names file and field in one line, if it cannot be used."""
    return parse_train_file(read_text(path), str(path))


def parse_train_file(text: str, source: str) -> TrainFile:
    """Read a train file from its text; ``source`` is the name shown in the InputError of an invalid field."""
    top = parse_yaml(text, source).only(_names(TrainFile))
    return TrainFile(
        train=_train(top.section('train', required=True)),
        resistance=_davis(top.section('resistance', required=True)),
        brake=_brake(top.section('brake')),
        line=_line(top.section('line')),
        effects=tuple(_effect(as_section(source, f'effects[{i}]', x)) for i, x in enumerate(top.items('effects'))),
    )


_SHOWN: Final = {'train': ('length', 'cars', 'max_speed', 'rotary_mass'), 'brake': ('rate', 'delay', 'time_constant')}


def assumed_fields(text: str, source: str) -> list[str]:
    """Return the names of fields of train and brake that a train file does not state; InputError as above."""
    top = parse_yaml(text, source)
    known = {name: set(top.section(name).data) for name in _SHOWN}
    if isinstance(top.section('train').data.get('cars'), list):  # which have lengths
        known['train'].add('length')
    return [f'{name}.{key}' for name, keys in _SHOWN.items() for key in keys if key not in known[name]]


def dump_train_file(train_file: TrainFile) -> str:
    """Return a train file as YAML text that reads back as exactly the same values."""
    document: dict[str, Any] = {
        name: _plain(getattr(train_file, name)) for name in ('train', 'resistance', 'brake', 'line')
    }
    if document['brake'].pop('rate_table'):
        document['brake']['rate'] = [[float(v), train_file.brake.rate * x] for v, x in train_file.brake.rate_table]
    if document['train'].pop('consist'):
        document['train']['cars'] = [dict(zip(_OF_CAR, car, strict=True)) for car in train_file.train.consist]
    document['effects'] = [
        {
            'name': effect.name, 'parameters': plain_numbers(effect.parameters), 'std': plain_numbers(effect.std),
            'provenance': effect.provenance, **({'runs': [*effect.runs]} if effect.runs else {}),
        }
        for effect in train_file.effects
    ]  # fmt: skip
    import yaml  # noqa: PLC0415 (slow to load)

    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True)


def _numbers(section: Section, kind: type[Any], *others: str) -> dict[str, Any]:
    """Return the numbers of a section whose ranges are stated on the fields of a class, but for some others."""
    numbers = {}
    for item in fields(kind):
        if (info := setting_info(item)) and item.name not in others:
            unit, default = '' if info.unit == '1' else info.unit, None if item.default is MISSING else item.default
            numbers[item.name] = section.number(item.name, unit, default, low=info.low, high=info.high)
    return numbers


_OF_CAR = {'mass': 'kg', 'length': 'm'}


def _train(section: Section) -> Train:
    section.only(name for name in _names(Train) if name != 'consist')
    if not isinstance(section.data.get('cars'), list):
        return Train(**_numbers(section, Train), cars=section.integer('cars', _CARS, low=1, high=_MAX_CARS))
    consist = tuple(_car(section, i, item) for i, item in enumerate(section.items('cars')))
    if not 1 <= len(consist) <= _MAX_CARS:
        section.fail('cars', f'has {len(consist)} cars; it must have 1 to {_MAX_CARS}')
    sums = {key: math.fsum(values) for key, values in zip(_OF_CAR, zip(*consist, strict=True), strict=True)}
    numbers = _numbers(replace(section, data={**sums, **section.data}), Train)
    for key, unit in _OF_CAR.items():
        if abs(numbers[key] - sums[key]) > _ROUNDING * sums[key]:
            section.fail(key, f'= {numbers[key]:g} {unit} contradicts cars, which add up to {sums[key]:g} {unit}')
    return Train(**numbers, cars=len(consist), consist=consist)


def _car(section: Section, number: int, item: object) -> tuple[float, float]:
    car = as_section(section.source, f'{section.name("cars")}[{number}]', item).only(_OF_CAR)
    return car.number('mass', 'kg', low=1.0, high=1e9), car.number('length', 'm', low=0.1, high=1e4)


def _davis(section: Section) -> Davis:
    if key := next((key for key in section.data if key in _names(Train)), ''):
        section.fail(key, f'is not a known field; did you mean train.{key}?')
    return Davis(**_numbers(section.only(_names(Davis)), Davis))


def _brake(section: Section) -> Brake:
    section.only(name for name in _names(Brake) if name != 'rate_table')
    given = section.data.get('rate', 1.0)
    if isinstance(given, bool) or not isinstance(given, (int, float, list)):
        section.fail('rate', f'= {shown(given)} must be a number or a table [[speed m/s, rate], ...]')
    if isinstance(given, list):
        return Brake(rate_table=_rate_table(section), **_numbers(section, Brake, 'rate'))
    return Brake(**_numbers(section, Brake))


def _rate_table(section: Section) -> Pairs:
    rows = section.pairs('rate', ('speed m/s', 'rate'))
    if not rows:
        section.fail('rate', '= [] must be a number or have at least one row')
    if len(rows) > _MAX_ROWS:
        section.fail('rate', f'has {len(rows)} rows; it may have at most {_MAX_ROWS}')
    for i, (speed, rate) in enumerate(rows):
        section.check(f'rate[{i}][0]', speed, 'm/s', low=0.0, high=_MAX_SPEED)
        if not MIN_RATE <= rate <= MAX_RATE:
            section.fail(f'rate[{i}][1]', f'= {rate:g} is outside [{MIN_RATE:g}, {MAX_RATE:g}]')
    section.check_rising('rate[{}][0]', (speed for speed, _ in rows), 'm/s', what='speeds')
    return rows


def _line(section: Section) -> Line:
    section.only(_names(Line))
    stops = section.numbers('stops', 'm')
    _check_positions(section, 'stops', stops)
    gradient = _profile(section, 'gradient', 'per mille', low=-500.0, high=500.0)
    curve = _profile(section, 'curve', 'm radius', low=0.0, high=1e9)
    for i, (_, radius) in enumerate(curve):
        if radius:
            section.check(f'curve[{i}][1]', radius, 'm radius', low=1.0)
    return Line(
        stops=stops,
        gradient=gradient,
        curve=curve,
        tunnel=_tunnels(section),
        speed_limit=_profile(section, 'speed_limit', 'm/s', above=0.0, high=_MAX_SPEED),
        **_numbers(section, Line),
    )


def _profile(section: Section, key: str, unit: str, *, low: float = -math.inf, **limits: float) -> Pairs:
    rows = section.pairs(key, ('m', unit))
    _check_positions(section, key, tuple(row[0] for row in rows))
    for i, (_, value) in enumerate(rows):
        section.check(f'{key}[{i}][1]', value, unit, low=low, **limits)
    return rows


def _tunnels(section: Section) -> Pairs:
    rows = section.pairs('tunnel', ('start m', 'end m'))
    for i, (start, end) in enumerate(rows):
        section.check(f'tunnel[{i}][0]', start, 'm', low=-_MAX_POSITION)
        section.check(f'tunnel[{i}][1]', end, 'm', high=_MAX_POSITION)
        if end <= start:
            section.fail(f'tunnel[{i}]', f'= [{start:g}, {end:g}] m must end beyond its start')
    for i, ((_, end), (start, _)) in enumerate(pairwise(rows)):
        if start < end:
            section.fail(f'tunnel[{i + 1}][0]', f'= {start:g} m is before the end of the previous tunnel, {end:g} m')
    return rows


def _check_positions(section: Section, key: str, positions: tuple[float, ...]) -> None:
    for i, position in enumerate(positions):
        section.check(f'{key}[{i}]', position, 'm', low=-_MAX_POSITION, high=_MAX_POSITION)
    section.check_rising(f'{key}[{{}}]', positions, 'm', what='positions')


def _effect(section: Section) -> Effect:
    section.only(_names(Effect))
    name = section.text('name')
    if not name:
        section.fail('name', f'= {shown(name)} must not be empty')
    std = section.named_numbers('std')
    parameters = section.named_numbers('parameters')
    for key, value in std:
        if value < 0.0:
            section.fail(f'std.{key}', f'= {value:g} must be >= 0')
        if key not in dict(parameters):
            section.fail(f'std.{key}', 'has no parameter of that name')
    return Effect(name, parameters, std, section.text('provenance', ''), section.counts('runs'))


def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(item.name for item in fields(kind))


def _plain(section: Train | Davis | Brake | Line) -> dict[str, object]:
    return {item.name: _lists(getattr(section, item.name)) for item in fields(section)}


def _lists(value: Any) -> object:
    """Return a number as one of Python, and nested tuples of numbers as lists."""
    if isinstance(value, tuple):
        return [_lists(item) for item in value]
    return value if isinstance(value, int) else float(value)


def plain_numbers(values: NamedValues) -> dict[str, float]:
    """Return named values as a mapping of numbers of Python."""
    return {key: float(value) for key, value in values}

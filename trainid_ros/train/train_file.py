# SPDX-License-Identifier: Apache-2.0
"""The train file: the engineer's prior values for train, resistance, brake and line.

One YAML file is read by the node parameters, the simulator and the workflow. Units are SI, specific
resistance is in N/kN with v in m/s, gradients are in per mille in the direction of increasing position.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

from trainid_ros.train.fields import Section, as_section, finite_number, parse_yaml, read_text, shown

Pairs = tuple[tuple[float, float], ...]
NamedValues = tuple[tuple[str, float], ...]

# Below this speed, the power limits the traction as at it [m/s].
_SLOWEST = 0.1
# A brake rate outside this range is a unit error.
LEAST_RATE, MOST_RATE = 0.01, 10.0
# The time of an answer of the client grows with the rows of the brake rate.
_MOST_ROWS = 100
# Added in quadrature to dead time and lag, because the relative error of short ones is larger [s].
_LEAST_DELAY, _LEAST_LAG = 0.67, 0.25
# Beyond these, too: speed [m/s], gradient [per mille], radius of a curve [m], position [m].
_MOST_SPEED, _STEEPEST, _TIGHTEST, _FARTHEST = 1000.0, 500.0, 1.0, 1e8


@dataclass(frozen=True, slots=True)
class Train:
    """Parameters of the vehicle; only the mass has no default."""

    mass: float  # Mass with the usual load [kg]
    rotary_mass: float = 0.08  # Rotating mass as a share of the mass, gamma [1]
    length: float = 118.0  # Length over couplers [m]
    cars: int = 6  # Number of cars
    max_traction_force: float = 310e3  # Maximum tractive force at the wheel rim [N]
    max_traction_power: float = 3.1e6  # Maximum tractive power at the wheel rim [W]
    max_speed: float = 80.0 / 3.6  # Maximum speed of the train [m/s]
    mass_std: float = 0.03  # Standard deviation of the relative error of the mass, weighed or not [1]
    force_std: float = 0.02  # Standard deviation of the relative error of the reported force [1]

    def traction_limit(self, speed: float) -> float:
        """Return the largest traction [N] at a speed [m/s]."""
        return min(self.max_traction_force, self.max_traction_power / max(speed, _SLOWEST))


@dataclass(frozen=True, slots=True)
class Davis:
    """Running resistance ``w(v) = a + b v + c v^2`` [N/kN], v in m/s."""

    a: float  # Constant term [N/kN]
    b: float  # Linear term [N/kN/(m/s)]
    c: float  # Quadratic term [N/kN/(m/s)^2]


@dataclass(frozen=True, slots=True)
class Brake:
    """Brake actuator: a gain (actual over commanded acceleration) with a dead time and a first-order lag."""

    rate: float = 1.0  # Brake rate (1 = nominal) [1]; with a table, the factor on it
    time_constant: float = 0.4  # Time constant of the lag [s]
    delay: float = 0.6  # Dead time [s]
    rate_table: Pairs = ()  # Speed [m/s], increasing, and brake rate [1]; empty if the rate does not depend on speed
    timing_std: float = 0.12  # Standard deviation of the relative error of dead time and lag [1]

    def shape_at(self, speed: float) -> float:
        """Return the table's value [1] at a speed [m/s]: linear between rows, constant beyond; 1 without a table."""
        table = self.rate_table
        if not table:
            return 1.0
        above = bisect_right(table, speed, key=_first)
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
        """Standard deviations of the errors of dead time and lag [s]."""
        return (
            self.timing_std * math.hypot(self.delay, _LEAST_DELAY),
            self.timing_std * math.hypot(self.time_constant, _LEAST_LAG),
        )


@dataclass(frozen=True, slots=True)
class Line:
    """The line by position [m]; each pair applies from its position on, positions increase."""

    stops: tuple[float, ...] = ()  # Stopping points of the train's front [m], in increasing order
    gradient: Pairs = ()  # Position [m] and gradient [per mille, + uphill in increasing position]
    curve: Pairs = ()  # Position [m] and radius [m], 0 = straight
    tunnel: Pairs = ()  # Start and end of each tunnel [m]
    speed_limit: Pairs = ()  # Position [m] and limit [m/s]
    gradient_std: float = 0.2  # Standard deviation of the error of the gradients [per mille]


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect added by the workflow: its parameters, their standard deviations and their provenance."""

    name: str
    parameters: NamedValues = ()
    std: NamedValues = ()
    provenance: str = ''


@dataclass(frozen=True, slots=True)
class TrainFile:
    """Content of a train file."""

    train: Train
    resistance: Davis
    brake: Brake = field(default_factory=Brake)
    line: Line = field(default_factory=Line)
    effects: tuple[Effect, ...] = ()


def load_train_file(path: str | Path) -> TrainFile:
    """Read a train file.

    Raises:
        InputError: The file cannot be read or a field is invalid; one line names both.
    """
    return parse_train_file(read_text(path), str(path))


def parse_train_file(text: str, source: str) -> TrainFile:
    """Read a train file from its text; ``source`` is the name shown in errors.

    Raises:
        InputError: A field is invalid.
    """
    top = parse_yaml(text, source).only(_names(TrainFile))
    return TrainFile(
        train=_train(top.section('train', required=True)),
        resistance=_davis(top.section('resistance', required=True)),
        brake=_brake(top.section('brake')),
        line=_line(top.section('line')),
        effects=_effects(top),
    )


def dump_train_file(train_file: TrainFile) -> str:
    """Return a train file as YAML text that reads back as exactly the same values."""
    line = train_file.line
    document = {
        'train': _plain(train_file.train),
        'resistance': _plain(train_file.resistance),
        'brake': _plain_brake(train_file.brake),
        'line': {
            'stops': [float(stop) for stop in line.stops],
            'gradient': _lists(line.gradient),
            'curve': _lists(line.curve),
            'tunnel': _lists(line.tunnel),
            'speed_limit': _lists(line.speed_limit),
            'gradient_std': float(line.gradient_std),
        },
        'effects': [_plain_effect(effect) for effect in train_file.effects],
    }
    import yaml  # noqa: PLC0415 (slow to load)

    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True)


def _train(section: Section) -> Train:
    section.only(_names(Train))
    default = Train(mass=1.0)
    return Train(
        mass=section.number('mass', 'kg', above=0.0, low=1.0, high=1e9),
        rotary_mass=section.number('rotary_mass', '', default.rotary_mass, low=0.0, high=1.0),
        length=section.number('length', 'm', default.length, above=0.0, low=0.1, high=1e4),
        cars=section.integer('cars', default.cars, low=1, high=1000),
        max_traction_force=section.number('max_traction_force', 'N', default.max_traction_force, low=1.0, high=1e9),
        max_traction_power=section.number('max_traction_power', 'W', default.max_traction_power, low=1.0, high=1e12),
        max_speed=section.number('max_speed', 'm/s', default.max_speed, low=0.1, high=_MOST_SPEED),
        mass_std=section.number('mass_std', '', default.mass_std, low=0.0, high=0.5),
        force_std=section.number('force_std', '', default.force_std, low=0.0, high=0.5),
    )


def _davis(section: Section) -> Davis:
    # Only b may be negative: published fits of real rolling stock have such values, and w(v) stays positive.
    section.only(_names(Davis))
    return Davis(
        a=section.number('a', 'N/kN', low=0.0, high=100.0),
        b=section.number('b', 'N/kN/(m/s)', low=-10.0, high=10.0),
        c=section.number('c', 'N/kN/(m/s)^2', low=0.0, high=1.0),
    )


def _brake(section: Section) -> Brake:
    section.only(('rate', 'time_constant', 'delay', 'timing_std'))
    default = Brake()
    given = section.data.get('rate', default.rate)
    if isinstance(given, bool) or not isinstance(given, (int, float, list)):
        section.fail('rate', f'= {shown(given)} must be a number or a table [[speed m/s, rate], ...]')
    table = _rate_table(section) if isinstance(given, list) else ()
    return Brake(
        rate=default.rate if table else section.number('rate', '', default.rate, low=LEAST_RATE, high=MOST_RATE),
        time_constant=section.number('time_constant', 's', default.time_constant, low=0.0, high=60.0),
        delay=section.number('delay', 's', default.delay, low=0.0, high=60.0),
        rate_table=table,
        timing_std=section.number('timing_std', '', default.timing_std, low=0.0, high=1.0),
    )


def _rate_table(section: Section) -> Pairs:
    rows = section.rows('rate', ('speed m/s', 'rate'))
    if not rows:
        section.fail('rate', '= [] must be a number or have at least one row')
    if len(rows) > _MOST_ROWS:
        section.fail('rate', f'has {len(rows)} rows; it may have at most {_MOST_ROWS}')
    for i, (speed, rate) in enumerate(rows):
        section.check(f'rate[{i}][0]', speed, 'm/s', low=0.0, high=_MOST_SPEED)
        if not LEAST_RATE <= rate <= MOST_RATE:
            section.fail(f'rate[{i}][1]', f'= {rate:g} is outside [{LEAST_RATE:g}, {MOST_RATE:g}]')
    for i, ((before, _), (after, _)) in enumerate(pairwise(rows)):
        if after <= before:
            section.fail(f'rate[{i + 1}][0]', f'= {after:g} m/s must be above {before:g} m/s: speeds must increase')
    return tuple((speed, rate) for speed, rate in rows)


def _line(section: Section) -> Line:
    section.only(_names(Line))
    stops = section.numbers('stops', 'm')
    _check_rising(section, 'stops', stops)
    return Line(
        stops=stops,
        gradient=_profile(section, 'gradient', 'per mille', low=-_STEEPEST, high=_STEEPEST),
        curve=_curves(section),
        tunnel=_tunnels(section),
        speed_limit=_profile(section, 'speed_limit', 'm/s', above=0.0, high=_MOST_SPEED),
        gradient_std=section.number('gradient_std', 'per mille', Line().gradient_std, low=0.0, high=50.0),
    )


def _profile(section: Section, key: str, unit: str, *, low: float = -math.inf, **limits: float) -> Pairs:
    rows = section.rows(key, ('m', unit))
    _check_rising(section, key, tuple(row[0] for row in rows))
    for i, (_, value) in enumerate(rows):
        section.check(f'{key}[{i}][1]', value, unit, low=low, **limits)
    return tuple((position, value) for position, value in rows)


def _curves(section: Section) -> Pairs:
    curves = _profile(section, 'curve', 'm radius', low=0.0, high=1e9)
    for i, (_, radius) in enumerate(curves):
        if radius:
            section.check(f'curve[{i}][1]', radius, 'm radius', low=_TIGHTEST)
    return curves


def _tunnels(section: Section) -> Pairs:
    rows = section.rows('tunnel', ('start m', 'end m'))
    for i, (start, end) in enumerate(rows):
        section.check(f'tunnel[{i}][0]', start, 'm', low=-_FARTHEST)
        section.check(f'tunnel[{i}][1]', end, 'm', high=_FARTHEST)
        if end <= start:
            section.fail(f'tunnel[{i}]', f'= [{start:g}, {end:g}] m must end beyond its start')
    for i, ((_, end), (start, _)) in enumerate(pairwise(rows)):
        if start < end:
            section.fail(f'tunnel[{i + 1}][0]', f'= {start:g} m is before the end of the previous tunnel, {end:g} m')
    return tuple((start, end) for start, end in rows)


def _check_rising(section: Section, key: str, positions: tuple[float, ...]) -> None:
    for i, position in enumerate(positions):
        section.check(f'{key}[{i}]', position, 'm', low=-_FARTHEST, high=_FARTHEST)
    for i, (before, after) in enumerate(pairwise(positions)):
        if after <= before:
            problem = f'= {after:g} m must be above {before:g} m: positions must increase'
            section.fail(f'{key}[{i + 1}]', problem)


def _effects(top: Section) -> tuple[Effect, ...]:
    items = enumerate(top.items('effects'))
    return tuple(_effect(as_section(top.source, f'effects[{i}]', item)) for i, item in items)


def _effect(section: Section) -> Effect:
    section.only(_names(Effect))
    name = section.text('name')
    if not name:
        section.fail('name', f'= {shown(name)} must not be empty')
    std = _named_values(section, 'std')
    parameters = _named_values(section, 'parameters')
    for key, value in std:
        if value < 0.0:
            section.fail(f'std.{key}', f'= {value:g} must be >= 0')
        if key not in dict(parameters):
            section.fail(f'std.{key}', 'has no parameter of that name')
    return Effect(name, parameters, std, section.text('provenance', ''))


def _named_values(section: Section, key: str) -> NamedValues:
    inner = section.section(key)
    return tuple((k, finite_number(inner.source, inner.name(k), v, '')) for k, v in inner.data.items())


def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(item.name for item in fields(kind))


def _plain_brake(brake: Brake) -> dict[str, object]:
    rate = [[float(speed), brake.rate * rate] for speed, rate in brake.rate_table] or float(brake.rate)
    times = {'time_constant': float(brake.time_constant), 'delay': float(brake.delay)}
    return {'rate': rate, **times, 'timing_std': float(brake.timing_std)}


def _first(row: tuple[float, float]) -> float:
    return row[0]


def _plain(value: Train | Davis) -> dict[str, float]:
    out: dict[str, float] = {}
    for item in fields(value):
        number = getattr(value, item.name)
        out[item.name] = number if isinstance(number, int) else float(number)
    return out


def _plain_effect(effect: Effect) -> dict[str, object]:
    return {
        'name': effect.name,
        'parameters': {key: float(value) for key, value in effect.parameters},
        'std': {key: float(value) for key, value in effect.std},
        'provenance': effect.provenance,
    }


def _lists(pairs: Pairs) -> list[list[float]]:
    return [[float(first), float(second)] for first, second in pairs]

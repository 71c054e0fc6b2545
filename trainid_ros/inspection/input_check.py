# SPDX-License-Identifier: Apache-2.0
"""Check that the inputs of a bag fit together, by the samples that a replay makes of them.

With a train file the checks are those of a replay. Without one the mass is not known, so that units of forces cannot be
checked, but forces must still go with the acceleration, and gradients slow the train as such in per mille do.

Unit and sign of the gradient show in how it slows the train. While no brake acts, the mean acceleration over some
seconds is

    (1 + gamma) dv/dt = p F - g k i / 1000 - (a + b v + c v^2)

The regression leaves gain p of the force and resistance free, so that neither mass nor train file is needed. The slope
k is about 1 if the gradient i is in per mille, and 10 if it is in per cent. Nothing is said unless the gradient
explains a good part of what force and speed leave: on a flat line, or with much noise, its unit does not show.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.estimators.pipeline import Contradiction
from trainid_ros.inspection.suggestion import USUAL_ROTARY, Slope, is_near, partial_slope
from trainid_ros.interface.records import (
    BRAKE,
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    NS_PER_S,
    SPEED_TOPIC,
)
from trainid_ros.interface.results import Reason
from trainid_ros.interface.scalars import find_fault
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import G
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Davis, Train, TrainFile

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from trainid_ros.bag.record_table import RecordTable
    from trainid_ros.interface.records import Row
    from trainid_ros.stream.alignment import AlignmentConfig

# Slower trains may stand or shunt [m/s].
_MIN_SPEED: Final = 1.0
# A share of the samples in motion [1]: beyond it what goes wrong is the rule.
_MAJORITY: Final = 0.5
# Correlation of a force whose sign is wrong [1], from so many samples on.
_OPPOSITE: Final = -0.5
_FEWEST: Final = 50
# Accelerations are means over at least this time [s], so that noise of the speed matters little.
_BLOCK_S: Final = 2.0
# Time after which a brake that was released does not act [s].
_RELEASED_S: Final = 4.0
_MIN_BLOCKS: Final = 15
# Multiple of its standard deviation that a slope has at least, share of the variance that the gradient explains at
# least [1], and least standard deviation of the gradient in its right unit [per mille].
_SIGMAS: Final = 8.0
_SHARE: Final = 0.2
_MIN_STD: Final = 1.0
# Slope beyond which a gradient is certainly too small [1]: a speed in km/h gives 3.6. It exceeds that by so many
# standard deviations.
_TOO_SMALL: Final = 5.0
_BEYOND: Final = 3.0
# Slope of a gradient that is ten times too large [1]. Noise makes slopes small too, but no noise has this standard
# deviation [per mille].
_TOO_LARGE: Final = 0.1
_LARGE_STD: Final = 30.0
# Per mille in each unit.
_UNITS: Final = {'per cent': 10.0, 'degrees': 1000.0 * math.pi / 180.0, 'a ratio or radians': 1000.0}
# Any train: only what the train file does not change is then checked.
_ANY_TRAIN: Final = TrainFile(Train(mass=1e9), Davis(0.0, 0.0, 0.0))


class Findings(NamedTuple):
    """What is wrong with the inputs of a bag."""

    problems: tuple[str, ...]  # Why it cannot be used
    warnings: tuple[str, ...]  # What the estimators leave out


def check_inputs(rows: Iterable[Row], alignment: AlignmentConfig, train_file: TrainFile | None) -> Findings:
    """Return what is wrong with inputs as rows of numbers; names of topics are our own.

    Args:
        rows: The inputs, by log time.
        alignment: Settings of the alignment.
        train_file: The train, None if it is not known.
    """
    check = _Check(alignment, train_file)
    for row in rows:
        check.take(row)
    problems = [*check.signs(), *check.unusable(), *filter(None, [check.gradient.finding()])]
    warnings = [*check.faults(), *check.off_the_line()]
    if (last := check.contradiction).finding:
        (problems if check.is_most(Reason.CONTRADICTION) else warnings).append(last.text)
    return Findings(tuple(problems), tuple(warnings))


def brake_sign(tables: Iterable[RecordTable]) -> str:
    """Say so if brake commands have the wrong sign, '' if they have not."""
    above = below = 0
    for table in tables:
        commands = table.x[table.topic == BRAKE]
        above, below = above + int(np.count_nonzero(commands > 0.0)), below + int(np.count_nonzero(commands < 0.0))
    return _wrong_brake(above) if above and not below else ''


def _wrong_brake(above: int) -> str:
    return (
        f'{BRAKE_TOPIC.name} looks as if it had the wrong sign: all {above} messages that are not 0 are above it, and '
        'target accelerations of a brake are not'
    )


class _Block(NamedTuple):
    """Means over some seconds without brake."""

    seconds: float  # How long
    acceleration: float  # In m/s^2
    gradient: float  # In per mille, as it is reported
    force: float  # Force by weight [N/kN]
    speed: float  # In m/s
    square: float  # Of the speed [m^2/s^2]


class _GradientCheck:
    """What the samples of a drive say about the unit of the gradient."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._released_s = 0.0
        self._sums = [0.0] * len(_Block._fields)

    def add(self, sample: Sample, before: float, traction: float) -> None:
        """Add a sample in motion that an estimator could use.

        Args:
            sample: The sample.
            before: The speed before [m/s].
            traction: Its force by its weight [N/kN].
        """
        dt, speed = sample.dt, 0.5 * (before + sample.speed)
        self._released_s = 0.0 if sample.brake_command < 0.0 else self._released_s + dt
        values = (1.0, (sample.speed - before) / dt, sample.gradient_mean, traction, speed, speed * speed)
        if self._released_s < _RELEASED_S or not math.isfinite(sum(values)):
            self._begin()
            return
        self._sums = [total + dt * value for total, value in zip(self._sums, values, strict=True)]
        if (seconds := self._sums[0]) >= _BLOCK_S:
            self._blocks.append(_Block(seconds, *(total / seconds for total in self._sums[1:])))
            self._begin()

    def interrupt(self) -> None:
        """Take note that samples are missing: a brake may have acted meanwhile."""
        self._released_s = 0.0
        self._begin()

    def _begin(self) -> None:
        self._sums = [0.0] * len(_Block._fields)

    def finding(self) -> str:
        """Return what is wrong with the gradient, '' if nothing is, or if it does not show."""
        if len(self._blocks) < _MIN_BLOCKS or (slope := _slope(np.array(self._blocks))) is None:
            return ''
        size = abs(slope.value)
        if size < _SIGMAS * slope.std or slope.share < _SHARE or size * slope.spread < _MIN_STD:
            return ''
        how = f'the train is slowed {slope.value:.2g} times as much as by so many per mille'
        sign = ', with the wrong sign' if slope.value < 0.0 else ''
        if size - _BEYOND * slope.std > _TOO_SMALL:
            unit = min(_UNITS, key=lambda name: abs(math.log(size / _UNITS[name])))
            what = f'like {unit}' if is_near(size, _UNITS[unit]) else 'too small'
            return f'{GRADIENT_TOPIC.name} looks {what}{sign}: {how}'
        if is_near(size, _TOO_LARGE) and slope.spread > _LARGE_STD:
            return f'{GRADIENT_TOPIC.name} looks ten times too large{sign}: {how}'
        if sign and is_near(size, 1.0):
            return f'{GRADIENT_TOPIC.name} looks as if it had the wrong sign: the train gains speed uphill'
        return ''


def _slope(blocks: NDArray[np.float64]) -> Slope | None:
    """Return how the gradient slows the train [1], from blocks as rows; None if the other columns explain it."""
    seconds, acceleration, gradient, *others = blocks.T
    slope = partial_slope(acceleration, gradient, others, np.cumsum(seconds))
    scale = -1000.0 * (1.0 + USUAL_ROTARY) / G
    return slope and slope._replace(value=scale * slope.value, std=abs(scale) * slope.std)


class _Check:
    """What a stream of samples says about its inputs."""

    def __init__(self, alignment: AlignmentConfig, train_file: TrainFile | None) -> None:
        self._known = KnownForce(train_file or _ANY_TRAIN)
        config = StreamConfig(train_file or _ANY_TRAIN, alignment, rejects_faults=train_file is not None)
        self._stream = SampleStream(config)
        self._line = None if train_file is None else LineProfile(train_file.line, train_file.train.length)
        self._off_line = 0
        self.contradiction = Contradiction()
        self.gradient = _GradientCheck()
        self._out_of_range: Counter[int] = Counter()
        self._first_out: dict[int, float] = {}
        self._applied = 0
        self._reasons: Counter[Reason] = Counter()
        self._moving = 0
        self._first_ns, self._speed = 0, math.nan
        # Force and acceleration without brake, force and command while braking; one row each.
        self._released: list[tuple[float, float]] = []
        self._braked: list[tuple[float, float]] = []

    def take(self, row: Row) -> None:
        topic, stamp_ns, x, y, _ = row
        fault = find_fault(topic, stamp_ns, x, y)
        if fault is not None and fault.reason is Reason.OUT_OF_RANGE:
            self._out_of_range[topic] += 1
            self._first_out.setdefault(topic, fault.value)
        elif topic == BRAKE and x < 0.0:
            self._applied += 1
        for event in self._stream.push_row(*row):
            if isinstance(event, Sample):
                self._follow(event)

    def _follow(self, sample: Sample) -> None:
        self._first_ns = self._first_ns or sample.stamp_ns
        self.contradiction.follow(self._stream.finding, (sample.stamp_ns - self._first_ns) / NS_PER_S)
        before, self._speed = self._speed, sample.speed
        if sample.speed < _MIN_SPEED:
            self.gradient.interrupt()
            return
        self._moving += 1
        if self._line is not None and (sample.position < self._line.first or sample.position > self._line.last):
            self._off_line += 1
        self._reasons[reason := self._reason(sample)] += 1
        if reason not in {Reason.NONE, Reason.CONTRADICTION} or not math.isfinite(sample.dt + sample.force_mean):
            self.gradient.interrupt()
            return
        self.gradient.add(sample, before, self._known.traction(sample.force_mean, sample))
        if sample.brake_command < 0.0:
            self._braked.append((sample.force_mean, sample.brake_command))
        else:
            acceleration = (sample.speed - before) / sample.dt + G * sample.gradient_mean / 1000.0
            self._released.append((sample.force_mean, acceleration))

    def _reason(self, sample: Sample) -> Reason:
        """Return why no estimator can use a sample, NONE if one can."""
        if sample.rejection is not None:
            return sample.rejection.reason
        if math.isnan(sample.dt):
            return Reason.GAP
        if (rejection := self._known.reject(sample)) is not None:
            return rejection.reason
        return Reason.NONE if math.isfinite(sample.brake_command) else Reason.BRAKE_COMMAND_MISSING

    def is_most(self, reason: Reason) -> bool:
        """Return whether most samples in motion are rejected for a reason."""
        return self._reasons[reason] > _MAJORITY * self._moving

    def signs(self) -> list[str]:
        """Return which inputs have the wrong sign, by all that was seen."""
        found = []
        if self._first_out.get(BRAKE, 0.0) > 0.0 and not self._applied:
            found.append(_wrong_brake(self._out_of_range[BRAKE]))
        if self.is_most(Reason.CONTRADICTION):
            return found
        if _correlation(self._released) < _OPPOSITE:
            found.append(f'{FORCE_TOPIC.name} looks as if it had the wrong sign: it is against the acceleration')
        elif _correlation(self._braked, about_zero=True) < _OPPOSITE:
            found.append(f'{FORCE_TOPIC.name} drives while {BRAKE_TOPIC.name} brakes: its sign is missing or wrong')
        return found

    def unusable(self) -> list[str]:
        """Say so if hardly any sample in motion can be used."""
        left_out = Counter({reason: count for reason, count in self._reasons.items() if reason is not Reason.NONE})
        del left_out[Reason.CONTRADICTION]  # named by what contradicts what
        if not left_out or self._reasons[Reason.NONE] >= (1.0 - _MAJORITY) * self._moving:
            return []
        reason, count = left_out.most_common(1)[0]
        return [f'{count} of {self._moving} samples in motion cannot be used: {reason.name}']

    def faults(self) -> list[str]:
        """Say which messages are out of range."""
        return [
            f'{INPUT_TOPICS[topic].name}: {count} messages out of range, the first with {self._first_out[topic]:.4g}'
            for topic, count in sorted(self._out_of_range.items())
        ]

    def off_the_line(self) -> list[str]:
        """Say so if most positions are not on the line of the train file."""
        if self._line is None or self._off_line <= _MAJORITY * self._moving:
            return []
        return [
            f'{SPEED_TOPIC.name} has a position off the line of the train file, {self._line.first:.0f} to '
            f'{self._line.last:.0f} m, in {self._off_line} of {self._moving} samples in motion: check origin and unit'
        ]


def _correlation(pairs: list[tuple[float, float]], *, about_zero: bool = False) -> float:
    """Return the correlation of pairs about their means or 0 [1]; 0 where there are few, or one does not change."""
    if len(pairs) < _FEWEST:
        return 0.0
    x, y = (column if about_zero else column - column.mean() for column in np.array(pairs).T)
    scale = math.sqrt(float(x @ x) * float(y @ y))
    return float(x @ y) / scale if scale > 0.0 else 0.0

# SPDX-License-Identifier: Apache-2.0
"""Check that the inputs of a bag fit together, by the samples that a replay makes of them.

With a train file the checks are those of a replay. Without one the mass is not known, so that units of forces cannot be
checked, but forces must still go with the acceleration, and gradients slow the train as such in per mille do.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.bag.gradient_check import GradientCheck
from trainid_ros.estimators.contradiction import Contradiction
from trainid_ros.interface.records import BRAKE, BRAKE_TOPIC, FORCE_TOPIC, INPUT_TOPICS, NS_PER_S, SPEED_TOPIC
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

    from trainid_ros.bag.record_table import RecordTable
    from trainid_ros.interface.records import Row
    from trainid_ros.stream.alignment import AlignmentConfig

# Slower trains may stand or shunt [m/s].
_MIN_SPEED: Final = 1.0
# A share of the samples in motion [1]: beyond it what goes wrong is the rule.
_MOST: Final = 0.5
# Correlation of a force whose sign is wrong [1], from so many samples on.
_OPPOSITE: Final = -0.5
_FEWEST: Final = 50
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


class _Check:
    """What a stream of samples says about its inputs."""

    def __init__(self, alignment: AlignmentConfig, train_file: TrainFile | None) -> None:
        self._known = KnownForce(train_file or _ANY_TRAIN)
        config = StreamConfig(train_file or _ANY_TRAIN, alignment, rejects_faults=train_file is not None)
        self._stream = SampleStream(config)
        self._line = None if train_file is None else LineProfile(train_file.line, train_file.train.length)
        self._off_line = 0
        self.contradiction = Contradiction()
        self.gradient = GradientCheck()
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
        return self._reasons[reason] > _MOST * self._moving

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
        if not left_out or self._reasons[Reason.NONE] >= (1.0 - _MOST) * self._moving:
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
        if self._line is None or self._off_line <= _MOST * self._moving:
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

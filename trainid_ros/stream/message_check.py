# SPDX-License-Identifier: Apache-2.0
"""Messages that cannot come from one healthy source: a brake command of two publishers, spikes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.stream.samples import BrakeCommandChange

# A large change of the brake command [m/s^2]. Two publishers that disagree change it to and fro with every message, ten
# times a second; a controller that toggles it by itself does so up to twice a second, a brake could not follow more.
_REVERSAL: Final = 0.15
# Most reversals within the memory [s], and the number at which they are over.
_REVERSALS: Final = 6.0
_REVERSAL_MEMORY_S: Final = 1.0
_QUIET: Final = 2.0


@dataclass(slots=True)
class CommandCheck:
    """Brake command, and whether it alternates.

    Attributes:
        finding: What is wrong, empty if nothing is.
        command: Last brake command [m/s^2, <= 0].
        direction: Sign of its last large change.
        reversals: Number of large changes to and fro, with forgetting.

    """

    finding: str = ''
    command: float = 0.0
    direction: float = 0.0
    reversals: float = 0.0

    @property
    def limit(self) -> float:
        """Most reversals of one publisher, with forgetting."""
        return _REVERSALS

    def add(self, changes: tuple[BrakeCommandChange, ...], dt: float) -> None:
        """Add the changes of the brake command in the time since the last sample [s]."""
        self.reversals *= math.exp(-dt / _REVERSAL_MEMORY_S)
        for change in changes:
            step = change.target_acceleration - self.command
            self.command = change.target_acceleration
            if abs(step) > _REVERSAL:
                sign = math.copysign(1.0, step)
                self.reversals += 1.0 if sign * self.direction < 0.0 else 0.0
                self.direction = sign
        if self.reversals > _REVERSALS:
            self.finding = 'ato/brake_command alternates between values: two publishers?'
        elif self.reversals < _QUIET:
            self.finding = ''


# Most spikes within the memory [s], and the number at which they are over.
_SPIKES: Final = 2.5
_SPIKE_MEMORY_S: Final = 30.0
_NO_SPIKES: Final = 1.0
# Spikes after which more are suspected.
_SUSPECTED: Final = 1.5
# Longest spike [s], and difference of the values before and after it as a share of its height [1].
_LONGEST_S: Final = 0.65
_SAME: Final = 0.3


@dataclass(slots=True)
class ExcursionCheck:
    """Values that leave their level for a moment and return to it, too fast for what they measure.

    Attributes:
        topic: Topic of the values.
        height: Least height of a spike, in the unit of the values.
        calm_s: Time for which the level must have held before [s]: what alternates has no spikes.
        finding: What is wrong, empty if nothing is.
        level: The last value outside a spike.
        held_s: Time for which it has held [s].
        peak: Largest distance from the level since it was left, 0 if it was not.
        left_s: Time since it was left [s].
        spikes: Number of spikes, with forgetting.

    """

    topic: str
    height: float
    calm_s: float = 0.0
    finding: str = ''
    level: float = 0.0
    held_s: float = 0.0
    peak: float = 0.0
    left_s: float = 0.0
    spikes: float = 0.0

    @property
    def limit(self) -> float:
        """Most spikes, with forgetting."""
        return _SPIKES

    @property
    def is_suspected(self) -> bool:
        """True while more spikes are to be expected."""
        return self.spikes > _SUSPECTED

    def add(self, value: float, dt: float) -> None:
        """Add a value and the time since the last one [s]; a NaN changes nothing but the time."""
        self.spikes *= math.exp(-dt / _SPIKE_MEMORY_S)
        if self.peak > 0.0:
            self.left_s += dt
        else:
            self.held_s += dt
        if not math.isnan(value):
            self._follow(value)
        if self.spikes > _SPIKES:
            self.finding = f'{self.topic} has spikes'
        elif self.spikes < _NO_SPIKES:
            self.finding = ''

    def _follow(self, value: float) -> None:
        distance = abs(value - self.level)
        returns = distance < _SAME * self.peak and self.left_s <= _LONGEST_S
        if self.peak > 0.0 and not returns and self.left_s <= _LONGEST_S:
            self.peak = max(self.peak, distance)
        elif self.peak == 0.0 and distance > self.height and self.held_s >= self.calm_s:
            self.peak, self.left_s = distance, 0.0
        else:  # back from a spike, or on a new level
            self.spikes += 1.0 if returns else 0.0
            if distance > self.height:
                self.held_s = 0.0
            self.level, self.peak = value, 0.0


# A single report of the force stands out by this [N/kN]; its neighbours, and those before, agree to this share of its
# height [1].
_SPIKE: Final = 15.0
_SPIKE_BASE: Final = 0.3
# Log-likelihood that the force was wrong rather than traction cut for a moment, as slip protection does: limit of the
# sum (e^4 = 55 to 1), most of one spike. A cut is towards zero, and the speed answers to it.
_EVIDENCE: Final = 4.0
_MOST_EVIDENCE: Final = 2.0


@dataclass(slots=True)
class SpikeCheck:
    """Single reports of the force that stand out, and are no short cuts of traction.

    Attributes:
        finding: What is wrong, empty if nothing is.
        last: Last specific force [N/kN].
        before: The one before.
        earlier: The one before that.
        area: Integral of the force over the last interval [N/kN s].
        answer: Integral of the force by the change of the speed over it [N/kN s], NaN if that is not known.
        dt: Its length [s].
        spikes: Number of spikes, with forgetting.
        evidence: Log-likelihood of spikes against cuts of traction, with forgetting.

    """

    finding: str = ''
    last: float = 0.0
    before: float = 0.0
    earlier: float = 0.0
    area: float = 0.0
    answer: float = math.nan
    dt: float = 0.0
    spikes: float = 0.0
    evidence: float = 0.0

    @property
    def limit(self) -> float:
        """Most spikes, with forgetting."""
        return _SPIKES

    @property
    def is_suspected(self) -> bool:
        """True while more spikes are to be expected."""
        return self.spikes > _SUSPECTED and self.evidence > 0.0

    def add(self, force: float, mean: float, answer: float, std: float, dt: float) -> None:
        """Add a sample.

        Args:
            force: Specific force at its stamp [N/kN], NaN if it is missing.
            mean: Mean since the last one [N/kN].
            answer: Integral of the force by the change of the speed since then [N/kN s], NaN if a brake may act.
            std: Standard deviation of two such integrals [N/kN s].
            dt: Time since the last sample [s].

        """
        force = self.last if math.isnan(force) else force
        keep = math.exp(-dt / _SPIKE_MEMORY_S)
        self.spikes *= keep
        self.evidence *= keep
        rise, fall = self.last - self.before, self.last - force
        uneven = max(abs(force - self.before), abs(self.before - self.earlier))
        if min(abs(rise), abs(fall)) > _SPIKE and uneven < _SPIKE_BASE * abs(fall):
            base, both_s = 0.5 * (self.before + force), self.dt + dt
            if min(self.last * base, (base - self.last) * base) < 0.0:  # beyond its neighbours, or on the other side
                self._count(_MOST_EVIDENCE)
            else:
                self._judge(self.area + mean * dt - base * both_s, self.answer + answer - base * both_s, std)
        self.earlier, self.before, self.last = self.before, self.last, force
        self.area, self.answer, self.dt = mean * dt, answer, dt
        if self.spikes > _SPIKES and self.evidence > _EVIDENCE:
            self.finding = 'ato/force has spikes'
        elif self.spikes < _NO_SPIKES:
            self.finding = ''

    def _judge(self, area: float, answer: float, std: float) -> None:
        """Count a cut by its area and the answer of the speed [N/kN s]: 0, or all of the area, with the same std."""
        if not math.isnan(area + answer):
            evidence = area * (0.5 * area - answer) / (std * std)
            self._count(min(max(evidence, -_MOST_EVIDENCE), _MOST_EVIDENCE))

    def _count(self, evidence: float) -> None:
        self.spikes += 1.0
        self.evidence += evidence

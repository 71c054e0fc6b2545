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
# Difference of the values before and after a spike as a share of its height [1].
_SAME: Final = 0.3


@dataclass(slots=True)
class ExcursionCheck:
    """Values that leave their level for a moment and return to it, too fast for what they measure.

    Attributes:
        topic: Topic of the values.
        height: Least height of a spike, in the unit of the values.
        longest_s: Longest time of a spike [s].
        calm_s: Time for which the level must have held before [s]: what alternates has no spikes.
        direction: -1 if spikes are below the level only, 0 if on both sides.
        finding: What is wrong, empty if nothing is.
        level: The last value outside a spike.
        held_s: Time for which it has held [s].
        peak: Largest distance from the level since it was left, 0 if it was not.
        left_s: Time since it was left [s].
        spikes: Number of spikes, with forgetting.

    """

    topic: str
    height: float
    longest_s: float
    calm_s: float = 0.0
    direction: float = 0.0
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
        returns = distance < _SAME * self.peak and self.left_s <= self.longest_s
        if self.peak > 0.0 and not returns and self.left_s <= self.longest_s:
            self.peak = max(self.peak, distance)
        elif self.peak == 0.0 and self._is_left(value):
            self.peak, self.left_s = distance, 0.0
        else:  # back from a spike, or on a new level
            self.spikes += 1.0 if returns else 0.0
            if distance > self.height:
                self.held_s = 0.0
            self.level, self.peak = value, 0.0

    def _is_left(self, value: float) -> bool:
        """Return whether a value may be the first one of a spike."""
        excess = value - self.level
        return abs(excess) > self.height and self.held_s >= self.calm_s and excess * self.direction >= 0.0


# A report of the force stands out by this [N/kN]; those before and after it agree to this share of its height [1].
_SPIKE: Final = 12.0
_SPIKE_BASE: Final = 0.3
# Log-likelihood that the force was wrong rather than traction cut for a moment, as slip protection does: limit of the
# sum (e^4 = 55 to 1), most of one spike by the speed, memory [s]. A cut is towards zero, and the speed answers to it;
# traction hardly rises for a moment, but may where a controller knows two steps only.
_EVIDENCE: Final = 4.0
_MOST_EVIDENCE: Final = 2.0
_NO_CUT: Final = 1.0
_EVIDENCE_MEMORY_S: Final = 120.0
# Samples after which a spike is out of those that are compared.
_SAMPLES: Final = 3


@dataclass(slots=True)
class SpikeCheck:
    """Single reports of the force that stand out, and are no short cuts of traction.

    Brought to the stamps of the speed, a report shows in up to two samples; those before and after them are compared.

    Attributes:
        finding: What is wrong, empty if nothing is.
        last: Last specific force [N/kN].
        before: The one before.
        earlier: The one before that.
        first: The one before that.
        area: Integral of the force over the last interval [N/kN s].
        area_before: That over the one before.
        answer: Integral of the force by the change of the speed over the last interval [N/kN s], NaN if not known.
        answer_before: That over the one before.
        dt: Length of the last interval [s].
        dt_before: That of the one before.
        passed: Number of samples since the last spike, up to those that may still hold it.
        spikes: Number of spikes, with forgetting.
        evidence: Log-likelihood of spikes against cuts of traction, with forgetting.

    """

    finding: str = ''
    last: float = 0.0
    before: float = 0.0
    earlier: float = 0.0
    first: float = 0.0
    area: float = 0.0
    area_before: float = 0.0
    answer: float = math.nan
    answer_before: float = math.nan
    dt: float = 0.0
    dt_before: float = 0.0
    passed: int = 0
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
        earlier, before, last = self.earlier, self.before, self.last
        force = last if math.isnan(force) else force
        self.spikes *= math.exp(-dt / _SPIKE_MEMORY_S)
        self.evidence *= math.exp(-dt / _EVIDENCE_MEMORY_S)
        self.passed = min(self.passed + 1, _SAMPLES)
        peak = before if abs(before - earlier) > abs(last - earlier) else last
        height = abs(peak - earlier)
        uneven = max(abs(force - earlier), abs(earlier - self.first))
        if height > _SPIKE and uneven < _SPIKE_BASE * height and self.passed == _SAMPLES:
            base = 0.5 * (earlier + force)
            rest = base * (self.dt_before + self.dt + dt)
            area = self.area_before + self.area + mean * dt - rest
            self._judge(peak, base, area, self.answer_before + self.answer + answer - rest, std)
            self.passed = 0
        self.first, self.earlier, self.before, self.last = earlier, before, last, force
        self.area_before, self.area = self.area, mean * dt
        self.answer_before, self.answer = self.answer, answer
        self.dt_before, self.dt = self.dt, dt
        if self.spikes > _SPIKES and self.evidence > _EVIDENCE:
            self.finding = 'ato/force has spikes'
        elif self.spikes < _NO_SPIKES:
            self.finding = ''

    def _judge(self, peak: float, base: float, area: float, answer: float, std: float) -> None:
        """Count a peak on a base [N/kN] by its area and the answer of the speed: 0, or all of the area."""
        evidence = 0.0
        if min(peak * base, (base - peak) * base) < 0.0:  # beyond its neighbours, or on the other side: no cut
            evidence = _NO_CUT
        if not math.isnan(area + answer):
            by_speed = area * (0.5 * area - answer) / (std * std)
            evidence += min(max(by_speed, -_MOST_EVIDENCE), _MOST_EVIDENCE)
        elif evidence == 0.0:
            return
        self._count(evidence)

    def _count(self, evidence: float) -> None:
        self.spikes += 1.0
        self.evidence = max(self.evidence + evidence, -_EVIDENCE)

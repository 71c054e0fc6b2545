# SPDX-License-Identifier: Apache-2.0
"""When the brake acts, against dead time and time constant of the train file.

A brake rate is learned from the retardation while the brake should act; where the dead time is wrong by much, the rate
is wrong too. So the specific force y of each braking is compared with the lagged command z, which acts after the dead
time T of the train file and a shift d,

    y(t) = f r(v) z(t - T - d),

with the brake rate r(v) of the train file and a factor f for each braking. The sum of squared residuals over a grid of
shifts has its minimum at the shift of this braking, and its curvature gives the standard deviation. The mean over the
last brakings is the error of the dead time (that of the time constant adds to it).

The blocks during which the command holds, so that no such error matters, show whether r(v) is right; see
``brake_shape_check``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.state import several
from trainid_ros.stream.brake_shape_check import BrakeShapeCheck, ShapeSums
from trainid_ros.stream.lagged_command import LaggedCommand
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import effect_value
from trainid_ros.train.train_file import TrainFile

# Step of the grid [s], and its largest shifts in steps: a train may brake like a freight train, but hardly before a
# command. A largest shift to later times stands for all beyond.
_STEP_S: Final = 0.5
_SOONER: Final = 7
_LATER: Final = 20
_SHIFTS: Final = _SOONER + 1 + _LATER
_FARTHEST_S: Final = (_LATER - 1) * _STEP_S
# Forces are compared over blocks, so that the noise of the speed matters little [s].
_BLOCK_S: Final = 0.6
# Rounding of the length of a block [s].
_ROUNDING_S: Final = 1e-3
# Factors that a brake may have [1].
_LEAST_FACTOR: Final = 0.3
_MOST_FACTOR: Final = 2.0
# Fewest blocks of a braking that show a shift, and least standard deviation of their residuals [N/kN].
_FEWEST: Final = 8
_RESIDUAL: Final = 2.0
# The command holds where shifts by so many steps change it by no more than this share.
_NEAR: Final = 2
_HOLDS: Final = 0.2
# A brake has followed a command after its dead time and this many time constants.
_FOLLOWED: Final = 2.0
# Error of the shift of one braking by the shape of the response, rates and gradients [s]. A braking that leaves the
# shift less certain than this tells nothing [s].
_SHAPE_S: Final = 0.15
_CERTAIN_S: Final = 0.8
# Least impulse of a braking that says something about the command [N/kN s]: .6 m/s.
_LEAST_IMPULSE: Final = 60.0
# Share of the weight that is kept at each further braking: about ten of them count.
_KEPT: Final = 0.9
# Standard deviations by which a shift must stand out; those added to one that is to be known as small; and what a shift
# must gain in likelihood while a braking lasts.
_KNOWN: Final = 4.0
_NEAR_STDS: Final = 2.0
_GAIN: Final = 25.0
# Errors of dead time and time constant that are no fault: in standard deviations of the train file, and at least [s].
_STATED: Final = 2.0
_LEAST_ERROR_S: Final = 0.8


class BrakeTiming:
    """What the train file says of the brake.

    Attributes:
        delay: Dead time, with the effect ``brake_delay`` [s].
        time_constant: Time constant of the lag [s].
        followed_s: Time after which a brake has followed its command [s].
        tolerance: Error of both together that estimators learn by themselves [s].
        max_speed: Maximum speed of the train [m/s].
        lead_s: Time by which the largest negative shift comes before the command [s].
        rest_s: Time after which no earlier braking acts, unless it acts very late [s].
        history_s: Time for which a command may act, whatever the shift [s].

    """

    def __init__(self, train_file: TrainFile) -> None:
        brake = train_file.brake
        self.delay = brake.delay + effect_value(train_file.effects, 'brake_delay', 'extra', 0.0)
        self.time_constant = brake.time_constant
        self.followed_s = self.delay + _FOLLOWED * brake.time_constant
        self.tolerance = max(_LEAST_ERROR_S, _STATED * brake.timing_std * math.hypot(brake.delay, brake.time_constant))
        self.max_speed = train_file.train.max_speed
        self.lead_s = max(0.0, _SOONER * _STEP_S - self.delay)
        self.rest_s = self.delay + _SOONER * _STEP_S
        self.history_s = self.delay + _LATER * _STEP_S + self.lead_s + 2.0 * _BLOCK_S


@dataclass(slots=True)
class BrakeBlock:
    """Forces over a block of samples.

    Attributes:
        end_s: Its end, by the time of the lagged command [s].
        seconds: Its length [s].
        y: Integral of y over it [N/kN s].
        rate: Integral of the specific force per command [N/kN s per m/s^2].
        force: Integral of the reported force, as far as it brakes [N/kN s].
        speed: Integral of the speed as a share of its maximum, at most 1 [s].

    """

    end_s: float = 0.0
    seconds: float = 0.0
    y: float = 0.0
    rate: float = 0.0
    force: float = 0.0
    speed: float = 0.0


@dataclass(slots=True)
class Braking:
    """Sums over the blocks of one braking.

    Attributes:
        began: Integrals of the shifted commands when the next block begins [m/s]; empty before the first.
        count: Number of blocks.
        yy: Sum of y^2 [(N/kN)^2].
        yx: Sums of products of y and the force x = r z, for each shift [(N/kN)^2].
        xx: Sums of x^2, for each shift [(N/kN)^2].
        commanded: Integral of the lagged command [m/s].
        by_command: Impulse of the brake by the train file [N/kN s].
        by_force: Impulse of the reported force, as far as it brakes [N/kN s].
        by_speed: Impulse that the speed shows [N/kN s].
        shape: Sums for the rate over speed.

    """

    began: tuple[float, ...] = ()
    count: float = 0.0
    yy: float = 0.0
    yx: tuple[float, ...] = (0.0,) * _SHIFTS
    xx: tuple[float, ...] = (0.0,) * _SHIFTS
    commanded: float = 0.0
    by_command: float = 0.0
    by_force: float = 0.0
    by_speed: float = 0.0
    shape: ShapeSums = field(default_factory=ShapeSums)

    @property
    def is_comparable(self) -> bool:
        """True if the impulses are large enough to compare; they hardly depend on dead time and lag."""
        return self.by_command < -_LEAST_IMPULSE

    @property
    def is_valid(self) -> bool:
        """True if the sums have possible lengths."""
        sums = len(self.yx) == len(self.xx) == _SHIFTS and self.shape.is_valid
        return sums and len(self.began) in (0, _SHIFTS)

    def add(self, block: BrakeBlock, lag: LaggedCommand, delay: float) -> None:
        """Add a block; ``delay`` is the dead time [s]."""
        if not self.began:
            self.began = _shifted(lag, block.end_s - block.seconds - delay)
        now = _shifted(lag, block.end_s - delay)
        y, scale = block.y / block.seconds, block.rate / (block.seconds * block.seconds)
        yx, xx = list(self.yx), list(self.xx)
        for k in range(_SHIFTS):
            x = scale * (now[k] - self.began[k])
            yx[k] += y * x
            xx[k] += x * x
        self.yx, self.xx, self.yy, self.count = tuple(yx), tuple(xx), self.yy + y * y, self.count + 1.0
        self.commanded += now[_SOONER] - self.began[_SOONER]
        self.by_command += block.rate / block.seconds * (now[_SOONER] - self.began[_SOONER])
        self.by_force += block.force
        self.by_speed += block.y
        sooner, later = (now[k] - self.began[k] for k in (_SOONER - _NEAR, _SOONER + _NEAR))
        if abs(sooner - later) < -_HOLDS * max(sooner, later):
            x = scale * (now[_SOONER] - self.began[_SOONER])
            self.shape.add(y, x, block.speed / block.seconds - 0.5)
        self.began = now

    def residuals(self, shift: int) -> float:
        """Return the sum of squared residuals of a shift [(N/kN)^2]."""
        xx, yx = self.xx[shift], self.yx[shift]
        factor = min(max(yx / xx, _LEAST_FACTOR), _MOST_FACTOR) if xx > 0.0 else 0.0
        return self.yy - factor * (2.0 * yx - factor * xx)

    def judge(self) -> tuple[float, float, float]:
        """Return the shift [s], its standard deviation [s], and how much more likely it is than none [1]."""
        sums = [self.residuals(k) for k in range(_SHIFTS)]
        best = 0
        for k in range(_SHIFTS):
            if sums[k] < sums[best]:
                best = k
        variance = max(sums[best] / (self.count - 2.0), _RESIDUAL * _RESIDUAL)
        middle = min(max(best, 1), _SHIFTS - 2)
        curvature = sums[middle - 1] - 2.0 * sums[middle] + sums[middle + 1]
        if not curvature > 0.0:
            return 0.0, math.inf, 0.0
        shift = float(best - _SOONER)
        if best == middle:
            shift -= 0.5 * (sums[best + 1] - sums[best - 1]) / curvature
        std = _STEP_S * math.sqrt(2.0 * variance / curvature)
        return _STEP_S * shift, std, (sums[_SOONER] - sums[best]) / variance


def _shifted(lag: LaggedCommand, time_s: float) -> tuple[float, ...]:
    """Return the integrals of the command at a time [s], for each shift [m/s]."""
    return tuple([lag.integral_at(time_s - (k - _SOONER) * _STEP_S) for k in range(_SHIFTS)])


@dataclass(slots=True)
class BrakeDelayCheck:
    """How much later the brake acts than the train file says.

    Attributes:
        lag: The brake command after the lag.
        block: The block that is being filled.
        waiting: Blocks to be compared once the command is known for all shifts, oldest first.
        braking: The braking that is observed.
        is_observing: Whether one is.
        weight: Sum of the weights of the brakings [1/s^2].
        mean: Weighted mean of their shifts [s].
        spread: Weighted sum of the squared deviations from it [1].
        count: Number of brakings, with forgetting.
        braked_s: Time for which a moving train was braked, until the brake has acted [s].
        has_braked: Whether it has, and the first braking shows no large error, if that is possible.
        is_wrong: Whether the mean contradicts the dead time.
        is_odd: Whether the braking that is observed does.
        is_near: Whether it certainly does not.
        shape: Check of the rate over speed.
        max_speed: Maximum speed of the train [m/s].

    """

    lag: LaggedCommand = field(default_factory=LaggedCommand)
    block: BrakeBlock = field(default_factory=BrakeBlock)
    waiting: tuple[BrakeBlock, ...] = several(BrakeBlock)
    braking: Braking = field(default_factory=Braking)
    is_observing: bool = False
    weight: float = 0.0
    mean: float = 0.0
    spread: float = 0.0
    count: float = 0.0
    braked_s: float = 0.0
    has_braked: bool = False
    is_wrong: bool = False
    is_odd: bool = False
    is_near: bool = False
    shape: BrakeShapeCheck = field(default_factory=BrakeShapeCheck)
    max_speed: float = 0.0

    @property
    def is_valid(self) -> bool:
        """True if sums and history have possible lengths."""
        history = len(self.lag.history)
        return self.braking.is_valid and history % 2 == 0 and (history > 0 or not self.is_observing)

    @property
    def is_trusted(self) -> bool:
        """True once the train was braked, and neither the brakings before nor the present one contradict the file."""
        return self.has_braked and not self.is_wrong and not self.is_odd and self.shape.is_trusted

    @property
    def warning(self) -> str:
        """What is wrong with the dead time, or else with the rate over speed; empty if nothing is."""
        if not self.is_wrong:
            return self.shape.warning(self.max_speed)
        later = 'later' if self.mean > 0.0 else 'sooner'
        beyond = 'at least ' if self.mean > _FARTHEST_S else ''
        return f'the brake acts {beyond}{abs(self.mean):.1f} s {later} than brake.delay of the train file says'

    @property
    def std(self) -> float:
        """Standard deviation of the mean [s], infinite before the first braking."""
        if self.weight == 0.0:
            return math.inf
        return math.sqrt(max(1.0, self.spread / self.count) / self.weight)

    def follow(self, sample: Sample, y: float, force: float, rate: float, timing: BrakeTiming) -> Braking | None:
        """Take in a sample.

        Args:
            sample: The sample.
            y: Integral of the specific force besides traction and resistance [N/kN s], NaN if not known.
            force: Mean of the reported force [N/kN], NaN if not known.
            rate: Specific force per command [N/kN per m/s^2].
            timing: What the train file says.

        Returns:
            The braking that has ended, None if none has.

        """
        if not self.has_braked:
            self.braked_s += sample.dt if sample.brake_command < 0.0 and sample.dt > 0.0 and not math.isnan(y) else 0.0
            judged = not self.is_observing or self.is_near
            self.has_braked = judged and self.braked_s > timing.followed_s
        lag = self.lag
        if not sample.dt > 0.0 or sample.brake_gap or sample.emergency or math.isnan(sample.brake_command):
            # What acts is not known until the brake has been released for some time.
            self._end(timing)
            self.lag = LaggedCommand(command=0.0 if math.isnan(sample.brake_command) else sample.brake_command)
            return None
        was_at_rest = lag.rest_s > timing.rest_s
        if was_at_rest and not self.is_observing and lag.command == 0.0 and not sample.brake_changes:
            lag.time_s += sample.dt
        else:
            self._follow_command(sample, timing)
        if math.isnan(y) or (self.is_observing and lag.rest_s > timing.rest_s):
            return self._end(timing)
        if was_at_rest and not self.is_observing and lag.command < 0.0:
            self.is_observing, self.braking, self.max_speed = True, Braking(), timing.max_speed
        self._add(sample, y, min(force, 0.0), rate)
        self._compare(timing.lead_s, timing)
        return None

    def _follow_command(self, sample: Sample, timing: BrakeTiming) -> None:
        """Go on to a sample; where a braking begins, its time begins, too."""
        lag = self.lag
        if lag.rest_s > timing.rest_s and not self.is_observing:
            for block in self.waiting:
                block.end_s -= lag.time_s
            lag.begin()
        lag.follow(sample, timing.time_constant, timing.history_s)

    def _add(self, sample: Sample, y: float, force: float, rate: float) -> None:
        """Add a sample to its block; see :meth:`follow`."""
        block, dt = self.block, sample.dt
        block.seconds += dt
        block.speed += min(sample.speed / self.max_speed, 1.0) * dt if self.max_speed > 0.0 else 0.0
        block.y += y
        block.rate += rate * dt
        block.force += force * dt
        if block.seconds > _BLOCK_S - _ROUNDING_S:
            block.end_s = self.lag.time_s
            self.waiting, self.block = (*self.waiting, block), BrakeBlock()

    def _compare(self, lead_s: float, timing: BrakeTiming) -> None:
        """Compare the blocks that ended a time ago [s], or drop them where no braking is observed."""
        waiting, braking, done = self.waiting, self.braking, 0
        while done < len(waiting) and waiting[done].end_s <= self.lag.time_s - lead_s:
            if self.is_observing:
                braking.add(waiting[done], self.lag, timing.delay)
            done += 1
        if not done:
            return
        self.waiting = waiting[done:]
        if self.is_observing and braking.count >= _FEWEST:
            shift, std, gain = braking.judge()
            self.is_odd = gain > _GAIN and abs(shift) > max(timing.tolerance, _KNOWN * std)
            self.is_near = abs(shift) + _NEAR_STDS * std < timing.tolerance
            self.shape.observe(braking.shape)

    def _end(self, timing: BrakeTiming) -> Braking | None:
        """End the braking, learn from it and return it; None if there is none."""
        was_observing = self.is_observing
        if was_observing:
            self._compare(0.0, timing)
        self.block, self.waiting, self.is_observing = BrakeBlock(), (), False
        self.is_odd = self.is_near = self.shape.is_odd = False
        if not was_observing:
            return None
        if self.braking.count >= _FEWEST:
            self._learn(timing)
        return self.braking

    def _learn(self, timing: BrakeTiming) -> None:
        """Learn from a whole braking."""
        shift, std, _ = self.braking.judge()
        if abs(shift) < _NEAR * _STEP_S:
            self.shape.learn(self.braking.shape)
        if std > _CERTAIN_S:
            return
        weight, off = 1.0 / (std * std + _SHAPE_S * _SHAPE_S), shift - self.mean
        before = _KEPT * self.weight
        self.weight = before + weight
        self.mean += weight / self.weight * off
        self.spread = _KEPT * self.spread + before * weight / self.weight * off * off
        self.count = _KEPT * self.count + 1.0
        self.is_wrong = abs(self.mean) > max(timing.tolerance, _KNOWN * self.std)

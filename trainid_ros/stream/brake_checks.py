# SPDX-License-Identifier: Apache-2.0
"""Checks of the brake against the train file: its rate over speed, and its dead time and lag.

Rate over speed: while a brake holds its level, its specific force is, with the rate r(v) of the train file and the
lagged command z,

    y = x (f + e p + h q),    x = r(v) z,    p = min(v / v_max, 1) - 1/2,    q = p^2 - 1/12.

f differs from braking to braking; e and h are zero where the train file is right. They follow from each braking by
least squares, with f eliminated, and from all brakings by their weighted mean, which forgets. What is judged is the
largest change of e p + h q between two speeds of the last braking.

Estimators learn small changes by themselves, but take large ones for changes of the brake from one moment to the next.

Dead time: a brake rate is learned from the retardation while the brake should act; where the dead time is wrong by
much, the rate is wrong too. So the specific force y of each braking is compared with the lagged command z, which acts
after the dead time T of the train file and a shift d,

    y(t) = f r(v) z(t - T - d),

with the brake rate r(v) of the train file and a factor f for each braking. The sum of squared residuals over a grid of
shifts has its minimum at the shift of this braking, and its curvature gives the standard deviation. The mean over the
last brakings is the error of the dead time (that of the time constant adds to it).

The blocks during which the command holds, so that no such error matters, show whether r(v) is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.state import stored
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import lag_integral, lag_response
from trainid_ros.train.train_file import TrainFile

# A lagged command that does not brake [m/s^2].
_RELEASED: Final = 1e-3


@dataclass(slots=True)
class LaggedCommand:
    """The brake command after the lag, without dead time."""

    command: float = 0.0  # Brake command [m/s^2]
    lagged: float = 0.0  # The command after the lag [m/s^2]
    integral: float = 0.0  # Its integral since the braking began [m/s]
    time_s: float = 0.0  # Time since then [s]
    rest_s: float = 0.0  # Time for which nothing has been commanded [s]
    history: tuple[float, ...] = ()  # Times [s] and integrals [m/s] in turn, oldest first

    def follow(self, sample: Sample, time_constant: float, longest_s: float) -> None:
        """Go on to a sample; a history older than ``longest_s`` [s] is forgotten."""
        left = sample.dt
        for change in sample.brake_changes:
            after = min(max((sample.stamp_ns - change.stamp_ns) / NS_PER_S, 0.0), left)
            self._hold(left - after, time_constant)
            left, self.command = after, change.target_acceleration
        self._hold(left, time_constant)
        self.time_s += sample.dt
        released = self.command == 0.0 and self.lagged > -_RELEASED
        self.rest_s = self.rest_s + sample.dt if released else 0.0
        history, first = (*self.history, self.time_s, self.integral), 0
        while first + 4 <= len(history) and history[first + 2] < self.time_s - longest_s:
            first += 2
        self.history = history[first:]

    def _hold(self, duration: float, time_constant: float) -> None:
        self.integral += lag_integral(self.lagged, self.command, time_constant, duration)
        self.lagged = lag_response(self.lagged, self.command, time_constant, duration)

    def begin(self) -> None:
        """Count time and integral from now on."""
        self.time_s = self.integral = 0.0
        self.history = (0.0, 0.0)

    def integral_at(self, time_s: float) -> float:
        """Return the integral at a time [s]; nothing acts before the braking, and it goes on as it is at the end."""
        history = self.history
        last = len(history) - 2
        if time_s >= history[last]:
            return history[last + 1] + self.lagged * (time_s - history[last])
        while last >= 2 and history[last - 2] > time_s:
            last -= 2
        if last < 2:
            return history[1]
        before_s, before = history[last - 2], history[last - 1]
        return before + (history[last + 1] - before) * (time_s - before_s) / (history[last] - before_s)


# Smallest change that contradicts the train file [1].
_MIN_CHANGE: Final = 0.3
# The same in standard deviations [1].
_KNOWN: Final = 4.0
# Share of that limit at which a contradiction ends [1].
_ENDS: Final = 0.75
# A braking over a smaller range of p says nothing of a change over speed [1].
_NARROW: Final = 0.2
# Smallest number of blocks of a braking that are compared.
_MIN_BLOCKS: Final = 8
# Smallest standard deviation of their residuals [N/kN].
_RESIDUAL: Final = 2.0
# Standard deviation from braking to braking of e, and of h, by fade, changes of the brake and gradients [1].
_SCATTER_E: Final = 0.1
_SCATTER_H: Final = 0.3
# Standard deviations of e and h before the first braking: they may be anything [1].
_PRIOR_E: Final = 2.0
_PRIOR_H: Final = 6.0
# Share of the information that is kept at each further braking: about ten of them count.
_KEPT: Final = 0.9
_MEAN_Q: Final = 1.0 / 12.0


@dataclass(slots=True)
class ShapeSums:
    """Sums over the blocks of one braking during which the brake held its level."""

    count: float = 0.0  # Number of blocks
    yy: float = 0.0  # Sum of y^2 [(N/kN)^2]
    products: tuple[float, ...] = (0.0,) * 3  # Sums of y x, y x p and y x q [(N/kN)^2]
    moments: tuple[float, ...] = (0.0,) * 6  # Sums of x^2 times 1, p, q, p^2, p q and q^2 [(N/kN)^2]
    slowest: float = 0.5  # Smallest p
    fastest: float = -0.5  # Largest p

    def add(self, y: float, x: float, p: float) -> None:
        """Add a block with force and nominal force [N/kN]."""
        q = p * p - _MEAN_Q
        yx, xx, x2 = self.products, self.moments, x * x
        self.count += 1.0
        self.yy += y * y
        self.products = (yx[0] + y * x, yx[1] + y * x * p, yx[2] + y * x * q)
        self.moments = (
            xx[0] + x2, xx[1] + x2 * p, xx[2] + x2 * q, xx[3] + x2 * p * p, xx[4] + x2 * p * q, xx[5] + x2 * q * q
        )  # fmt: skip
        self.slowest, self.fastest = min(self.slowest, p), max(self.fastest, p)

    def information(self) -> ShapeInformation:
        """Return what this braking says of e and h, scatter from braking to braking included; nothing if too short."""
        if self.count < _MIN_BLOCKS or not self.moments[0] > 0.0:
            return ShapeInformation()
        (y0, y1, y2), (x0, x1, x2, x11, x12, x22) = self.products, self.moments
        # Without f (Schur complement): M (e, h)' = r
        m11, m12, m22 = x11 - x1 * x1 / x0, x12 - x1 * x2 / x0, x22 - x2 * x2 / x0
        r1, r2 = y1 - x1 * y0 / x0, y2 - x2 * y0 / x0
        det = m11 * m22 - m12 * m12
        explained = (m22 * r1 * r1 - 2.0 * m12 * r1 * r2 + m11 * r2 * r2) / det if det > 0.0 else 0.0
        variance = max((self.yy - y0 * y0 / x0 - explained) / (self.count - 3.0), _RESIDUAL * _RESIDUAL)
        m11, m12, m22, r1, r2 = m11 / variance, m12 / variance, m22 / variance, r1 / variance, r2 / variance
        # I = (M^-1 + S)^-1 = (1 + M S)^-1 M with the scatter S; its vector is (1 + M S)^-1 r.
        s1, s2 = _SCATTER_E * _SCATTER_E, _SCATTER_H * _SCATTER_H
        k11, k12, k21, k22 = 1.0 + m11 * s1, m12 * s2, m12 * s1, 1.0 + m22 * s2
        scale = k11 * k22 - k12 * k21
        return ShapeInformation(
            (k22 * m11 - k12 * m12) / scale,
            (k22 * m12 - k12 * m22) / scale,
            (k11 * m22 - k21 * m12) / scale,
            (k22 * r1 - k12 * r2) / scale,
            (k11 * r2 - k21 * r1) / scale,
        )


@dataclass(slots=True)
class ShapeInformation:
    """Information matrix of (e, h), and its product with them [1]; none by default."""

    ee: float = 0.0
    eh: float = 0.0
    hh: float = 0.0
    e: float = 0.0
    h: float = 0.0

    def add(self, other: ShapeInformation, kept: float) -> None:
        """Add the information of a further braking, after forgetting a share of that of the brakings before."""
        self.ee = kept * self.ee + other.ee
        self.eh = kept * self.eh + other.eh
        self.hh = kept * self.hh + other.hh
        self.e = kept * self.e + other.e
        self.h = kept * self.h + other.h

    def change(self, slowest: float, fastest: float) -> ShapeChange:
        """Return the largest change of e p + h q between two values of p in a range."""
        ee, hh = self.ee + 1.0 / (_PRIOR_E * _PRIOR_E), self.hh + 1.0 / (_PRIOR_H * _PRIOR_H)
        det = ee * hh - self.eh * self.eh
        e, h = (hh * self.e - self.eh * self.h) / det, (ee * self.h - self.eh * self.e) / det
        least = most = slowest
        places = [slowest, fastest]
        if h != 0.0 and slowest < -0.5 * e / h < fastest:
            places.append(-0.5 * e / h)
        for p in places:
            if (e + h * p) * p < (e + h * least) * least:
                least = p
            if (e + h * p) * p > (e + h * most) * most:
                most = p
        dp, dq = most - least, most * most - least * least
        variance = (hh * dp * dp - 2.0 * self.eh * dp * dq + ee * dq * dq) / det
        return ShapeChange(least, most, e * dp + h * dq, math.sqrt(max(0.0, variance)))


@dataclass(slots=True)
class ShapeChange:
    """Largest change of the brake rate against the train file."""

    least: float = 0.0  # p where the rate is lowest against the train file
    most: float = 0.0  # p where it is highest
    size: float = 0.0  # The change [1]
    std: float = 0.0  # Its standard deviation [1]

    @property
    def contradicts(self) -> bool:
        """True if the change is larger than errors of train files are."""
        return self.size > max(_MIN_CHANGE, _KNOWN * self.std)


@dataclass(slots=True)
class BrakeShapeCheck:
    """Change of the brake rate over speed against the train file."""

    known: ShapeInformation = field(default_factory=ShapeInformation)  # What all brakings say
    slowest: float = 0.0  # Smallest p of the last braking over a range of speeds
    fastest: float = 0.0  # Largest p of it
    found: ShapeChange = field(default_factory=ShapeChange)  # The last change that contradicts the train file
    is_wrong: bool = False  # Whether the brakings contradict it
    is_odd: bool = False  # Whether the braking that is observed does

    @property
    def is_trusted(self) -> bool:
        """True if neither the brakings before nor the present one contradict the train file."""
        return not self.is_wrong and not self.is_odd

    def warning(self, max_speed: float) -> str:
        """Return what is wrong with the brake rate over speed, empty if nothing is."""
        if not self.is_wrong:
            return ''
        change = self.found
        low, high = (max_speed * (0.5 + p) for p in sorted((change.least, change.most)))
        sense = 'rises' if change.most > change.least else 'falls'
        return (
            f'from {low:.0f} to {high:.0f} m/s the brake rate {sense} by about {change.size:.2f} against brake.rate of '
            'the train file: it needs another table over speed'
        )

    def observe(self, sums: ShapeSums) -> None:
        """Judge a braking that has not ended."""
        self.is_odd = sums.count >= _MIN_BLOCKS and sums.information().change(sums.slowest, sums.fastest).contradicts

    def learn(self, sums: ShapeSums) -> None:
        """Learn from a whole braking."""
        self.is_odd = False
        if sums.count < _MIN_BLOCKS:
            return
        self.known.add(sums.information(), _KEPT)
        if sums.fastest - sums.slowest > _NARROW:
            self.slowest, self.fastest = sums.slowest, sums.fastest
        change = self.known.change(self.slowest, self.fastest)
        if change.contradicts:
            self.found = change
        self.is_wrong = change.contradicts or (self.is_wrong and change.size > _ENDS * _MIN_CHANGE)


# Step of the grid of shifts [s].
_STEP_S: Final = 0.5
# Largest shift to earlier times, in steps: a train hardly brakes before a command.
_SOONER: Final = 7
# Largest shift to later times, in steps: a train may brake like a freight train. It stands for all larger ones.
_LATER: Final = 20
_SHIFTS: Final = _SOONER + 1 + _LATER
_MAX_DELAY_S: Final = (_LATER - 1) * _STEP_S
# Forces are compared over blocks, so that the noise of the speed matters little [s].
_BLOCK_S: Final = 0.6
# Rounding of the length of a block [s].
_ROUNDING_S: Final = 1e-3
# Smallest and largest plausible ratio of actual to nominal braking [1].
_MIN_FACTOR: Final = 0.3
_MAX_FACTOR: Final = 2.0
# The command holds where shifts by up to this number of steps
_NEAR: Final = 2
# change it by no more than this share [1].
_HOLDS: Final = 0.2
# A brake has followed a command after its dead time and this many time constants.
_FOLLOWED: Final = 2.0
# Error of the shift of one braking by the shape of the response, rates and gradients [s].
_SHAPE_S: Final = 0.15
# Largest standard deviation of the shift of a braking that is used [s].
_CERTAIN_S: Final = 0.8
# Smallest impulse of a braking that says something about the command [N/kN s]: 0.6 m/s.
_MIN_IMPULSE: Final = 60.0
_NEAR_STDS: Final = 2.0
_GAIN: Final = 25.0
# Largest error of dead time and time constant that is no fault, in standard deviations of the train file [1].
_STATED: Final = 2.0
# Smallest value of that limit [s].
_MIN_ERROR_S: Final = 0.8


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
        self.tolerance = max(_MIN_ERROR_S, _STATED * brake.timing_std * math.hypot(brake.delay, brake.time_constant))
        self.max_speed = train_file.train.max_speed
        self.lead_s = max(0.0, _SOONER * _STEP_S - self.delay)
        self.rest_s = self.delay + _SOONER * _STEP_S
        self.history_s = self.delay + _LATER * _STEP_S + self.lead_s + 2.0 * _BLOCK_S


@dataclass(slots=True)
class BrakeBlock:
    """Forces over a block of samples."""

    end_s: float = 0.0  # Its end, by the time of the lagged command [s]
    seconds: float = 0.0  # Its length [s]
    y: float = 0.0  # Integral of y over it [N/kN s]
    rate: float = 0.0  # Integral of the specific force per command [N/kN s per m/s^2]
    force: float = 0.0  # Integral of the reported force, as far as it brakes [N/kN s]
    speed: float = 0.0  # Integral of the speed as a share of its maximum, at most 1 [s]


@dataclass(slots=True)
class Braking:
    """Sums over the blocks of one braking."""

    # Integrals of the shifted commands when the next block begins [m/s]; empty before the first
    began: tuple[float, ...] = ()
    count: float = 0.0  # Number of blocks
    yy: float = 0.0  # Sum of y^2 [(N/kN)^2]
    yx: tuple[float, ...] = (0.0,) * _SHIFTS  # Sums of products of y and the force x = r z, for each shift [(N/kN)^2]
    xx: tuple[float, ...] = (0.0,) * _SHIFTS  # Sums of x^2, for each shift [(N/kN)^2]
    commanded: float = 0.0  # Integral of the lagged command [m/s]
    by_command: float = 0.0  # Impulse of the brake by the train file [N/kN s]
    by_force: float = 0.0  # Impulse of the reported force, as far as it brakes [N/kN s]
    by_speed: float = 0.0  # Impulse that the speed shows [N/kN s]
    shape: ShapeSums = field(default_factory=ShapeSums)  # Sums for the rate over speed

    @property
    def is_comparable(self) -> bool:
        """True if the impulses are large enough to compare; they hardly depend on dead time and lag."""
        return self.by_command < -_MIN_IMPULSE

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
        factor = min(max(yx / xx, _MIN_FACTOR), _MAX_FACTOR) if xx > 0.0 else 0.0
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
    """How much later the brake acts than the train file says."""

    lag: LaggedCommand = field(default_factory=LaggedCommand)  # The brake command after the lag
    block: BrakeBlock = field(default_factory=BrakeBlock)  # The block that is being filled
    # Blocks to be compared once the command is known for all shifts, oldest first
    waiting: tuple[BrakeBlock, ...] = stored((), kind=BrakeBlock)
    braking: Braking = field(default_factory=Braking)  # The braking that is observed
    is_observing: bool = False  # Whether one is
    weight: float = 0.0  # Sum of the weights of the brakings [1/s^2]
    mean: float = 0.0  # Weighted mean of their shifts [s]
    spread: float = 0.0  # Weighted sum of the squared deviations from it [1]
    count: float = 0.0  # Number of brakings, with forgetting
    braked_s: float = 0.0  # Time for which a moving train was braked, until the brake has acted [s]
    has_braked: bool = False  # Whether it has, and the first braking shows no large error, if that is possible
    is_wrong: bool = False  # Whether the mean contradicts the dead time
    is_odd: bool = False  # Whether the braking that is observed does
    is_near: bool = False  # Whether it certainly does not
    shape: BrakeShapeCheck = field(default_factory=BrakeShapeCheck)  # Check of the rate over speed
    max_speed: float = 0.0  # Maximum speed of the train [m/s]

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
        beyond = 'at least ' if self.mean > _MAX_DELAY_S else ''
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
        if self.is_observing and braking.count >= _MIN_BLOCKS:
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
        if self.braking.count >= _MIN_BLOCKS:
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

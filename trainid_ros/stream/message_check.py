# SPDX-License-Identifier: Apache-2.0
"""Messages that no healthy source sends: a stuck speed, a mass of another train, two publishers, spikes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import stored
from trainid_ros.stream.known_force import SpeedNoise
from trainid_ros.train.forces import STANDING, BrakeCommandChange

# Density of the difference of two equal measurements at zero, times sigma: 1 / (2 sqrt(pi)), rounded.
_DENSITY: Final = 0.2821
# Probability of a repeat above which coarse steps hide the noise, so that repeats say nothing [1].
_MAX_REPEAT_PROBABILITY: Final = 0.4
_MIN_PROBABILITY: Final = 1e-9  # probability of chance repeats below which the sensor is stuck: once in 6 years at 5 Hz
_MIN_REPEATS: Final = 5  # smallest number of repeats that is judged
_MIN_CHANGES: Final = 100  # number of changes of the speed that show its noise first


@dataclass(slots=True)
class RepeatCheck:
    """A speed that stays the same to the last bit for longer than noisy measurements do.

    Two of them with noise sigma, in steps of q, are equal with probability q / (2 sqrt(pi) sigma). The balance of
    forces shows a stuck speed too, but some seconds later.
    """

    speed: float = math.nan  # Last measured speed [m/s], NaN before the first
    repeats: int = 0  # Number of times that it has come again
    most: int = 0  # Limit for a noisy speed, as known when it changed last; 0 if repeats say nothing
    changes: int = 0  # Number of changes in motion, up to those that show the noise

    @property
    def is_stuck(self) -> bool:
        """True while the last speed has come again too often."""
        return 0 < self.most < self.repeats

    def add(self, speed: float, noise: SpeedNoise) -> None:
        """Add a speed [m/s]; ``noise`` is that until then."""
        if speed == self.speed and speed >= STANDING:
            self.repeats += 1
            return
        if speed >= STANDING:
            self.changes = min(self.changes + 1, _MIN_CHANGES)
            self.most = max_repeats(noise) if self.changes == _MIN_CHANGES else 0
        self.speed, self.repeats = speed, 0


def max_repeats(noise: SpeedNoise) -> int:
    """Return how often in a row a noisy speed may come again, 0 if any number is possible."""
    repeated = max(_DENSITY * noise.quantum / noise.std, 1.0 - noise.changed)
    if repeated >= _MAX_REPEAT_PROBABILITY or not noise.is_seen:
        return 0
    if repeated == 0.0:
        return _MIN_REPEATS
    return max(_MIN_REPEATS, math.ceil(math.log(_MIN_PROBABILITY) / math.log(repeated)))


# A large change of the brake command [m/s^2]. Two publishers that disagree change it to and fro with every message, ten
# times a second; a controller that toggles it by itself does so up to twice a second, a brake could not follow more.
_REVERSAL: Final = 0.15
_REVERSALS: Final = 6.0  # largest number of reversals of one publisher within the memory
_REVERSAL_MEMORY_S: Final = 1.0  # s: memory of reversals
_QUIET: Final = 2.0  # number of reversals below which a finding is over


@dataclass(slots=True)
class MessageCheck:
    """What is wrong with the messages of one input."""

    finding: str = ''  # What is wrong, empty if nothing is

    @property
    def suspicion(self) -> str:
        """What may be wrong, empty if nothing is suspected."""
        return ''


@dataclass(slots=True)
class CommandCheck(MessageCheck):
    """Brake command, and whether it alternates."""

    command: float = 0.0  # Last brake command [m/s^2, <= 0]
    direction: float = 0.0  # Sign of its last large change
    reversals: float = 0.0  # Number of large changes to and fro, with forgetting

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


# Specific force that pulls, beyond errors of a report [N/kN], and the longest time until traction is cut [s].
_PULLS: Final = 3.0
_CUT_S: Final = 5.0


@dataclass(slots=True)
class EmergencyCheck(MessageCheck):
    """Traction under an emergency brake command: every train cuts it within a second or two."""

    pulled_s: float = 0.0  # Time of it since the command [s]

    def add(self, force: float, dt: float, *, emergency: bool) -> None:
        """Add a reported force [N/kN], NaN if it is missing, and the time since the last one [s]."""
        self.pulled_s = self.pulled_s + dt * (force > _PULLS) if emergency else 0.0
        self.finding = 'ato/brake_command says emergency while the train pulls' if self.pulled_s > _CUT_S else ''


MAX_MASS: Final = 5.0
"""Largest plausible ratio of weighed to stated mass (full over empty wagon); the smallest is its reciprocal [1]."""
_TONNE: Final = 1000.0
_OVERDUE: Final = 'ato/mass is missing since the last stop: the load may have changed'


@dataclass(slots=True)
class MassCheck(MessageCheck):
    """Weighed mass against that of the train file, and whether the present load was weighed."""

    @property
    def misread(self) -> str:
        """What is wrong with the mass that was weighed, empty if nothing is."""
        return '' if self.finding == _OVERDUE else self.finding

    def add(self, mass: float, stated: float, *, is_overdue: bool) -> None:
        """Compare the weighed mass, NaN if there is none, with that of the train file [kg]."""
        ratio = mass / stated if is_finite(mass) else 1.0
        if 1.0 / MAX_MASS <= ratio <= MAX_MASS:
            self.finding = _OVERDUE if is_overdue else ''
            return
        in_tonnes = 1.0 / MAX_MASS < ratio * _TONNE < MAX_MASS
        unit = ': it looks like tonnes' if in_tonnes else ''
        self.finding = f'ato/mass is {mass:.6g}, the train file says {stated:.6g} kg{unit}'


_SPIKES: Final = 2.5  # largest number of spikes within the memory
_SPIKE_MEMORY_S: Final = 30.0  # s: memory of spikes
_NO_SPIKES: Final = 1.0  # number of spikes below which a finding is over
_SUSPECTED: Final = 1.5  # number of spikes above which more are suspected
_BACK: Final = 0.3  # difference of the values before and after a spike as a share of its height


@dataclass(slots=True)
class SpikeCount(MessageCheck):
    """Number of spikes, with forgetting."""

    topic: str = ''  # Topic of the values
    spikes: float = 0.0  # Number of spikes

    @property
    def suspicion(self) -> str:
        """What may be wrong while more spikes are to be expected."""
        return f'{self.topic} has spikes' if self.spikes > _SUSPECTED else ''

    def forget(self, dt: float) -> None:
        """Forget spikes over a time [s]."""
        self.spikes *= math.exp(-dt / _SPIKE_MEMORY_S)

    def judge(self, *, certain: bool = True) -> None:
        """Begin a finding where there are too many spikes, if that is certain, or end it where there are few."""
        if self.spikes > _SPIKES and certain:
            self.finding = f'{self.topic} has spikes'
        elif self.spikes < _NO_SPIKES:
            self.finding = ''


@dataclass(slots=True)
class ExcursionCheck(SpikeCount):
    """Values that leave their level for a moment and return to it, too fast for what they measure."""

    height: float = 0.0  # Smallest height of a spike, in the unit of the values
    longest_s: float = 0.0  # Longest time of a spike [s]
    calm_s: float = 0.0  # Time for which the level must have held before [s]: what alternates has no spikes
    direction: float = 0.0  # -1 if spikes are below the level only, 0 if on both sides
    level: float = 0.0  # The last value outside a spike
    held_s: float = 0.0  # Time for which it has held [s]
    peak: float = 0.0  # Largest distance from the level since it was left, 0 if it was not
    left_s: float = 0.0  # Time since it was left [s]

    def add(self, value: float, dt: float) -> None:
        """Add a value and the time since the last one [s]; a NaN changes nothing but the time."""
        self.forget(dt)
        if self.peak > 0.0:
            self.left_s += dt
        else:
            self.held_s += dt
        if not math.isnan(value):
            self._follow(value)
        self.judge()

    def _follow(self, value: float) -> None:
        distance = abs(value - self.level)
        returns = distance < _BACK * self.peak and self.left_s <= self.longest_s
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


_BRAKING: Final = -0.15  # m/s^2: weakest command that brakes
_EFFORT: Final = -10.0  # N/kN: weakest force that brakes
_EQUAL: Final = 0.1  # largest difference of equal commands, as a share of them
_LATE_S: Final = 0.6  # s: time by which healthy brakes and their reports may be later than stated
_FOLLOWED: Final = 0.7  # share of a release above which the force has followed it
_IGNORED: Final = 0.3  # share below which the force has ignored it
_FORCE_ERROR: Final = 0.03  # variation of the force without a change of the command, as a share of it
_MAX_ERROR: Final = 0.4  # largest error by it of the share that was followed


@dataclass(slots=True)
class ReleaseCheck(SpikeCount):
    """Brake commands that are released for a moment, which the reported force does not follow.

    A controller that knows two steps only sends the same, but then the force of a nominal brake falls for as long.
    """

    level: float = 0.0  # Brake command before the last change [m/s^2]
    held_s: float = 0.0  # Time for which it has held [s]
    force: float = 0.0  # Reported force meanwhile [N/kN]
    since_s: float = 0.0  # Time since a release [s], 0 if there is none
    released: float = 0.0  # Integral of the change of the command since then, as a share of the level [s]
    followed: float = 0.0  # Integral of the change of the force, as a share of that before [s]

    def add(self, command: float, force: float, followed_s: float, dt: float) -> None:
        """Add a sample.

        Args:
            command: Brake command [m/s^2], NaN if it is missing or the train stands.
            force: Reported force [N/kN], NaN if it is missing.
            followed_s: Time after which a brake has followed a command [s].
            dt: Time since the last sample [s].
        """
        self.forget(dt)
        self.judge()
        same = abs(command - self.level) <= _EQUAL * abs(self.level)
        braked = self.level < _BRAKING and self.force < _EFFORT
        if self.since_s == 0.0 and command == 0.0 and braked and self.held_s > followed_s:
            self.released = self.followed = 0.0
        elif self.since_s == 0.0 or math.isnan(force) or not (same or command == 0.0):
            self._hold(command, force, dt, same=same)
            return
        self.since_s += dt
        self.released += dt * (1.0 - command / self.level)
        self.followed += dt * (1.0 - force / self.force)
        if self.since_s > followed_s + _LATE_S:
            self._count(same=same)

    def _hold(self, command: float, force: float, dt: float, *, same: bool) -> None:
        """Follow a command that holds, or begin with another one."""
        self.held_s = self.held_s + dt if same and self.since_s == 0.0 else 0.0
        self.level, self.since_s = 0.0 if math.isnan(command) else command, 0.0
        self.force = 0.0 if math.isnan(force) else force

    def _count(self, *, same: bool) -> None:
        """Count a release that is over, as a spike if the force has not followed it."""
        if same and self.released * _MAX_ERROR > _FORCE_ERROR * self.since_s:
            share = self.followed / self.released
            self.spikes = max(self.spikes + (1.0 if share < _IGNORED else -1.0 if share > _FOLLOWED else 0.0), 0.0)
        self.since_s = 0.0


_SPIKE: Final = 12.0  # N/kN: smallest height of a spike of the force
# Log-likelihood above which spikes are wrong forces rather than short cuts of traction, as by slip protection: e^4 = 55
# to 1. A cut is towards zero, and the speed answers to it.
_EVIDENCE: Final = 4.0
_MAX_EVIDENCE: Final = 2.0  # largest contribution of one spike by the speed
# Contribution of a spike that is no cut by its sign: traction rarely rises for a moment, except by a controller
# with two steps only.
_NO_CUT: Final = 1.0
_EVIDENCE_MEMORY_S: Final = 120.0  # s: memory of the log-likelihood
_CALM: Final = 3  # number of samples without a large step before a spike: a controller that hunts has fewer


@dataclass(slots=True)
class SpikeCheck(SpikeCount):
    """Single reports of the force that stand out, and are no short cuts of traction.

    Brought to the stamps of the speed, a report shows in up to two samples; those before and after them are compared.
    """

    last: float = 0.0  # Last specific force [N/kN]
    before: float = 0.0  # The one before
    earlier: float = 0.0  # The one before that
    first: float = 0.0  # The one before that
    area: float = stored(0.0, may_be_nan=True)  # Integral of the force over the last interval [N/kN s]
    area_before: float = stored(0.0, may_be_nan=True)  # That over the one before
    # Integral of the force by the change of the speed over the last interval [N/kN s], NaN if not known
    specific_impulse: float = math.nan
    specific_impulse_before: float = math.nan  # That over the one before
    dt: float = stored(0.0, may_be_nan=True)  # Length of the last interval [s]
    dt_before: float = stored(0.0, may_be_nan=True)  # That of the one before
    calm: int = 0  # Number of samples without a large step before those that may hold a spike
    evidence: float = 0.0  # Log-likelihood of spikes against cuts of traction, with forgetting

    @property
    def suspicion(self) -> str:
        """What may be wrong while more spikes are to be expected."""
        return f'{self.topic} has spikes' if self.spikes > _SUSPECTED and self.evidence > 0.0 else ''

    def add(self, force: float, mean: float, specific_impulse: float, std: float, dt: float) -> None:
        """Add a sample.

        Args:
            force: Specific force at its stamp [N/kN], NaN if it is missing.
            mean: Mean since the last one [N/kN].
            specific_impulse: Integral of the force by the change of speed since then [N/kN s], NaN if a brake may act.
            std: Standard deviation of two such integrals [N/kN s].
            dt: Time since the last sample [s].
        """
        self.forget(dt)
        self.evidence *= math.exp(-dt / _EVIDENCE_MEMORY_S)
        force = self.last if math.isnan(force) else force
        area = mean * dt
        self.calm = self.calm + 1 if abs(self.earlier - self.first) <= _SPIKE else 0
        self._find(force, area, specific_impulse, std, dt)
        self.first, self.earlier, self.before, self.last = self.earlier, self.before, self.last, force
        self.area_before, self.area = self.area, area
        self.specific_impulse_before, self.specific_impulse = self.specific_impulse, specific_impulse
        self.dt_before, self.dt = self.dt, dt
        self.judge(certain=self.evidence > _EVIDENCE)

    def _find(self, force: float, area: float, specific_impulse: float, std: float, dt: float) -> None:
        """Look for a spike in the two samples before this one."""
        earlier, before, last = self.earlier, self.before, self.last
        peak = before if abs(before - earlier) > abs(last - earlier) else last
        height = abs(peak - earlier)
        if height <= _SPIKE or self.calm < _CALM or abs(force - earlier) + abs(earlier - self.first) >= _BACK * height:
            return
        self.calm = 0
        base = 0.5 * (earlier + force)
        rest = base * (self.dt_before + self.dt + dt)
        area = self.area_before + self.area + area - rest
        by_speed = self.specific_impulse_before + self.specific_impulse + specific_impulse - rest
        self._weigh(peak, base, area, by_speed, std)

    def _weigh(self, peak: float, base: float, area: float, specific_impulse: float, std: float) -> None:
        """Count a peak on a base [N/kN] by its area and the impulse by the speed: 0, or all of the area."""
        evidence = 0.0
        if not math.isnan(area + specific_impulse):
            by_speed = area * (0.5 * area - specific_impulse) / (std * std)
            evidence = min(max(by_speed, -_MAX_EVIDENCE), _MAX_EVIDENCE)
        # Beyond its neighbours, or on the other side, and the speed does not answer: no cut.
        if min(peak * base, (base - peak) * base) < 0.0 and evidence >= 0.0:
            evidence += _NO_CUT
        elif evidence == 0.0:
            return
        self.spikes += 1.0
        self.evidence = max(self.evidence + evidence, -_EVIDENCE)

# SPDX-License-Identifier: Apache-2.0
"""The train as it is today: answers for an autopilot from live estimates, else from the train file.

Without a node nothing is subscribed: estimates are handed to :meth:`TrainModel.take`, and time is that of ``clock``.

The estimators remove the effects of the train file from their estimates; the client adds them again. Place, time and
history are not known there. So effects are evaluated on level, open, straight track, long after the last brake release,
with warm bearings and at the start of the record: what depends on anything else adds nothing. The exception is a hot
brake, which is the worst case of a bound.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from numbers import Real
from operator import sub
from threading import Lock
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.brake_rate.motion_model import MotionModel
from trainid_ros.client.adhesion import LiveAdhesion
from trainid_ros.client.live_estimate import MAX_AGE_S, USABLE, LiveEstimate, Normal, Parameter
from trainid_ros.client.stopping import EXTRA_STEP, MAX_SPEED, NO_BRAKE, RateShape, StoppingBounds, StopPosterior
from trainid_ros.estimators.settings import FilterBankConfig, GsmaConfig, prior_variances
from trainid_ros.interface.errors import InputError, NoAnswerError, SettingInfo, check_settings, check_value
from trainid_ros.interface.records import ADHESION_TOPIC, BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, output_topic
from trainid_ros.interface.scalars import seconds
from trainid_ros.train.effects import TrackPoint, resistance_terms
from trainid_ros.train.fields import shown
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import MAX_RATE, MIN_RATE, TrainFile, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from trainid_ros.bag.bag_replay import Replay
    from trainid_ros.estimators.settings import BrakeRateConfig, PriorSettings
    from trainid_ros.interface.records import OutputTopic
    from trainid_ros.interface.results import Output, Status


@dataclass(frozen=True, slots=True)
class Argument:
    """A number, its unit and its closed range."""

    name: str  # as in error messages
    unit: str  # empty if there is none
    low: float  # lowest value [unit]
    high: float  # highest value [unit]

    def checked(self, value: object) -> float:
        """Return a number, which may be one of numpy, as a float; raise InputError if it is none or out of range."""
        if not isinstance(value, (float, Real)):  # float first, because an abstract class takes long
            raise InputError(f'{self.name} = {shown(value)} must be a number in {self.unit or "1"}')
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not self.low <= number <= self.high:
            check_value(self.name, number, SettingInfo('', self.unit, self.low, self.high))
        return number


SPEED: Final = Argument('speed', 'm/s', 0.0, MAX_SPEED)  # accepted speeds
GRADIENT: Final = Argument('gradient', 'per mille', -500.0, 500.0)  # accepted gradients, > 0 uphill
ACCELERATION: Final = Argument('acceleration', 'm/s^2', -20.0, 20.0)  # accepted accelerations
MASS: Final = Argument('mass', 'kg', 1.0, 1e9)  # accepted masses of the train
COMMAND: Final = Argument('command', 'm/s^2', -20.0, -1e-3)  # accepted brake commands
APPLIED: Final = Argument('applied', 'm/s^2', -20.0, 0.0)  # accepted brake commands that act now, 0 without
CONFIDENCE: Final = Argument('confidence', '', 0.5, 1.0 - 1e-6)  # accepted probabilities that a bound holds [1]
MAX_AGE: Final = Argument('max_age', 's', 0.01, 1e12)  # accepted limits of the age of the last estimate
MAX_STAMP_AGE: Final = Argument('max_stamp_age', 's', 0.1, 1e12)  # accepted differences between stamp and clock
DISTANCE: Final = Argument('distance', 'm', 0.0, 1e5)  # accepted distances to go
STOP: Final = Argument('stop', 'm', -1e9, 1e9)  # accepted positions of the stop
_POSITION: Final = Argument('position', 'm', -1e9, 1e9)


def checked_direction(direction: int) -> int:
    """Return a direction; InputError unless it is 1 or -1."""
    if direction not in (1, -1):
        raise InputError(f'direction = {direction!r} must be 1 or -1')
    return int(direction)


def distance_to(stop: float, position: float, direction: int) -> float:
    """Return the distance [m] from a position to a stop in the direction of travel, 0 beyond it."""
    return DISTANCE.checked(max(0.0, direction * (stop - _POSITION.checked(position))))


_TIME: Final = Argument('clock()', 's', -1e12, 1e12)


STOPPED_S: Final = 2.0
"""Time after which a clock that stands still is taken to have stopped [s]; ``/clock`` comes several times a second."""


class ForwardClock:
    """The time of a clock [s] plus all that it has gone back: it goes on from where the clock jumped.

    A clock that returns no finite number stands still. One that has stood still for ``STOPPED_S`` of a ``steady``
    clock, if there is one, goes on with that, so that silence is noticed. A clock that is not callable, or returns no
    number at first, raises InputError.
    """

    def __init__(self, clock: Callable[[], float], steady: Callable[[], float] | None = None) -> None:
        if not callable(clock):
            raise InputError(f'clock = {clock!r} must be a function that returns the time in s')
        self._clock, self._offset_s, self._last_s = clock, 0.0, _TIME.checked(clock())
        self._steady, self._moved_s, self._stood_s = steady, steady() if steady else 0.0, 0.0

    def now(self) -> float:
        """Return the time [s], which is not before that of the last call."""
        read_s, steady_s = self._clock(), self._steady() if self._steady else 0.0
        if math.isfinite(read_s) and read_s != self._last_s:
            self._offset_s += self._stood_s + max(0.0, self._last_s - read_s)
            self._last_s, self._moved_s, self._stood_s = read_s, steady_s, 0.0
        elif steady_s - self._moved_s > STOPPED_S:
            self._stood_s = steady_s - self._moved_s
        return self._last_s + self._offset_s + self._stood_s


# Traction or braking force for which shares are calculated: effects are (nearly) linear in it [N/kN].
_REFERENCE: Final = 100.0


class StatedEffects:
    """The effects of a train file that act at a speed; InputError for one not known or that cannot be evaluated.

    ``brake_scale`` and ``brake_delay`` are part of the brake, see ``brake_rate.motion_model.true_brake``.
    """

    def __init__(self, train_file: TrainFile) -> None:
        effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
        self._terms, self._davis = resistance_terms(effects), train_file.resistance
        self._names = ', '.join(effect.name for effect in effects)
        self._length = train_file.train.length

    def resistance(self, speed: float, direction: int) -> float:
        """Return what they add to the running resistance [N/kN] at a speed [m/s]."""
        return math.fsum(self._values(speed, direction))

    def traction_share(self, speed: float, direction: int) -> float:
        """Return the share of the reported traction that they leave [1]."""
        before, after = self._values(speed, direction), self._values(speed, direction, traction=_REFERENCE)
        return 1.0 - math.fsum(map(sub, after, before)) / _REFERENCE

    def brake_share(self, speed: float, *, hot: bool = False) -> float:
        """Return the share of the brake force that they leave [1], of a hot brake if less; InputError if nothing."""
        shares = []
        for heat in (0.0, 1e6) if hot else (0.0,):  # J/kg: with the latter any brake fades fully
            before, after = self._values(speed, 1, heat=heat), self._values(speed, 1, brake=-_REFERENCE, heat=heat)
            shares.append(1.0 + math.fsum(map(sub, after, before)) / _REFERENCE)
        share = min(shares)
        if share <= 0.0:
            raise InputError(
                f'effects ({self._names}) of the train file leave no brake force at {speed:g} m/s: share {share:.2f}'
            )
        return share

    def _values(
        self, speed: float, direction: int, *, traction: float = 0.0, brake: float = 0.0, heat: float = 0.0
    ) -> list[float]:
        """Return the resistance of each effect with a traction and a braking force [N/kN]."""
        if not self._terms:
            return []
        point = TrackPoint(
            0.0, math.nan, direction, speed, length=self._length,
            distance_run=1e12,  # any bearing is warm
            traction=traction, brake=brake, heat=heat,
            # As in the live estimators, which shift the dead time instead.
            brake_before=lambda _: brake, traction_before=lambda _: traction,
        )  # fmt: skip
        return [term(self._davis, point) for term in self._terms]


DAVIS: Final = 'a, b, c'  # name of the running resistance among the parameters [N/kN, v in m/s]
FORCE_SCALE: Final = 'force scale'  # name of the actual over the reported force [1]
BRAKE_RATE: Final = 'brake rate'  # name of the brake rate, or of the factor on its table [1]
MIN_SCALE: Final = 0.1  # least actual over reported force, whichever reads wrong [1]
# Speeds at which moves of the resistance are measured, and changes of the brake by effects, as shares of the highest.
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


class FileValues:
    """Values and standard deviations of a train file, as the estimators start with them.

    Attributes:
        k: Deceleration by a resistance of 1 N/kN, g0 / (1000 (1 + gamma)) [m/s^2].
        brake: Brake with the effects ``brake_scale`` and ``brake_delay`` of the train file applied.
        effects: Its other effects.
        timing_stds: Standard deviations of dead time and time constant [s].
    """

    def __init__(self, train_file: TrainFile, prior: PriorSettings, config: BrakeRateConfig) -> None:
        self.train_file, self.config, self._prior = train_file, config, prior
        model = MotionModel(train_file, config)
        self.brake, self.timing_stds = model.brake, model.timing_stds
        self.k = G / (1000.0 * (1.0 + train_file.train.rotary_mass))
        self.effects = StatedEffects(train_file)
        self._speeds = tuple(share * train_file.train.max_speed for share in _SHARES)
        self._shape = self._rate_shape([], hot=False)
        self._worst, speeds = {}, [EXTRA_STEP * k for k in range(math.ceil(MAX_SPEED / EXTRA_STEP) + 1)]
        for direction in (1, -1):
            extra = [self.effects.resistance(speed, direction) for speed in speeds]
            self._worst[direction] = self._rate_shape(extra if any(extra) else [], hot=True)

    def _rate_shape(self, extra: list[float], *, hot: bool) -> RateShape:
        """Return the brake rate over speed, with a cold or a hot brake, and an extra resistance [N/kN]."""
        table = self.brake.rate_table or tuple((speed, 1.0) for speed in self._speeds)
        speeds, rates = [v for v, _ in table], [rate * self.effects.brake_share(v, hot=hot) for v, rate in table]
        if not self.brake.rate_table and len(set(rates)) == 1:
            # Does not depend on speed: one row, or none if there is nothing to state.
            speeds, rates = ([], []) if rates[0] == 1.0 else ([0.0], rates[:1])
        return RateShape(speeds, rates, self.train_file.train.max_speed, self.config.blend_speed, self.k, extra)

    def stop_shape(self, direction: int) -> RateShape:
        """Return the brake rate and the extra resistance over speed that bounds assume: those of a hot brake."""
        return self._worst[direction]

    def resistance(self) -> dict[str, Parameter]:
        """Return (a, b, c) and the force scale."""
        w, train = self.train_file.resistance, self.train_file.train
        a, b, c = prior_variances((w.a, w.b, w.c), self._prior)
        davis = Normal((w.a, w.b, w.c), (a, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c))
        scale = Normal((1.0,), (math.hypot(train.mass_std, train.force_std) ** 2,))
        probes = tuple((1.0, v, v * v) for v in self._speeds)
        # No a, b or c of a train is outside -20 to 200 [N/kN and per m/s, (m/s)^2], nor is its resistance [N/kN].
        return {
            DAVIS: Parameter(davis, probes, -20.0, 200.0, max_std=200.0),
            FORCE_SCALE: Parameter(scale, ((1.0,),), MIN_SCALE, 10.0),
        }

    def brake_rate(self) -> dict[str, Parameter]:
        """Return the brake rate, or the factor on its table."""
        rate = Normal((self.brake.rate,), (self.config.prior_std**2,))
        return {BRAKE_RATE: Parameter(rate, ((1.0,),), MIN_RATE, MAX_RATE)}

    def rate_direction(self, speed: float | None) -> tuple[float, float]:
        """Return s(v), and the standard deviation of e p(v) + h m(v) [1]; see ``stopping``.

        Without a speed, s is 1 but for the effects of the train file at medium speed.
        """
        if speed is None:
            return self.effects.brake_share(self._speeds[len(_SHARES) // 2]), 0.0
        shape, config = self._shape, self.config
        over_speed = math.hypot(config.slope_std * shape.slope(speed), config.blend_std * shape.changeover(speed))
        return shape.table(speed), over_speed


def _resistance_values(estimate: Any) -> dict[str, Normal]:
    values = {DAVIS: Normal((estimate.a, estimate.b, estimate.c), tuple(map(float, estimate.covariance)))}
    if not math.isnan(estimate.force_scale):
        values[FORCE_SCALE] = _factor(estimate.force_scale, estimate.force_scale_std)
    return values


def _factor(value: float, std: float) -> Normal:
    """Return a factor; a negative standard deviation gives a negative variance, which is not possible."""
    return Normal((value,), (math.copysign(std * std, std),))


MAX_STAMP_AGE_S: Final = 60.0
"""Difference between stamps and the clock of the node that is allowed unless another is given [s].

Clocks of two computers on board that are not synchronised differ by some seconds; a forgotten bag is of another day.
"""
FULL_SERVICE: Final = -1.0
"""Brake command of a stop unless another is given [m/s^2]."""
# What the nodes start with unless they are set otherwise.
_PRIOR: Final = FilterBankConfig()
_BRAKE: Final = GsmaConfig()


@dataclass(frozen=True, slots=True)
class Value:
    """An answer."""

    value: float  # in the unit of the method that gave it
    std: float  # its standard deviation, in the same unit
    live: bool  # whether it is from live estimates; False: from the train file
    reason: str  # status of the estimates, or why they are not used


class TrainModel:
    """Typed answers about one train.

    Args:
        node: A node of rclpy, which somebody spins; its namespace is that of the estimates. None: no ROS.
        train_file: Train file, or its path.
        max_age: Time without a new estimate after which the train file applies [s]. Estimates come as often as the
            speed; with speeds slower than 2 Hz it must be longer.
        max_stamp_age: Difference between stamp and clock of the node beyond which an estimate is that of another time
            [s], such as of a bag that somebody plays. With ``use_sim_time`` that clock is the one of the bag.
        clock: Present time [s]. If it goes back, time goes on from there.
        prior: How well the train file's resistance is known, as set in the node ``resistance_estimator``.
        brake: The same of the brake rate and its change over speed, as set in the node ``brake_rate_estimator``.

    Raises:
        InputError: The train file cannot be used, or an argument, also of a method, is not finite or out of range.
    """

    def __init__(
        self, node: Any, train_file: TrainFile | str | Path, *, max_age: float = MAX_AGE_S,
        max_stamp_age: float = MAX_STAMP_AGE_S,
        clock: Callable[[], float] = time.monotonic, prior: PriorSettings = _PRIOR, brake: BrakeRateConfig = _BRAKE,
    ) -> None:  # fmt: skip
        max_age, self._max_stamp_age = MAX_AGE.checked(max_age), MAX_STAMP_AGE.checked(max_stamp_age)
        check_settings(prior)
        check_settings(brake)
        known = train_file if isinstance(train_file, TrainFile) else load_train_file(train_file)
        self._file, self._lock = FileValues(known, prior, brake), Lock()
        self._clock = ForwardClock(clock, None if node is None else time.monotonic)
        self._resistance = LiveEstimate(self._file.resistance(), max_age)
        self._brake_rate = LiveEstimate(self._file.brake_rate(), max_age)
        self._adhesion = LiveAdhesion(max_age)
        self._estimates: dict[OutputTopic, LiveEstimate | LiveAdhesion] = {
            RESISTANCE_TOPIC: self._resistance, BRAKE_RATE_TOPIC: self._brake_rate, ADHESION_TOPIC: self._adhesion,
        }  # fmt: skip
        self._learned_speeds = (0.0, math.inf)
        self.subscriptions: tuple[Any, ...] = ()
        self._node = node
        if node is not None:
            from trainid_ros.ros.topics import subscribe_estimates  # noqa: PLC0415 (needs ROS)

            made = (subscribe_estimates(node, topic, self.take_message, self.mark_lost) for topic in self._estimates)
            self.subscriptions = tuple(item for pair in made for item in pair)

    @classmethod
    def from_replay(cls, result: Replay, train_file: TrainFile | str | Path) -> TrainModel:
        """Return the train by the last outputs of a replay; nothing moves or ages any more.

        Where the last one is CONVERGING, the train file applies. A client that has received all outputs, see
        :meth:`take`, keeps the last valid values then. A train file that cannot be used raises InputError.
        """
        now = 0.0
        model = cls(None, train_file, max_age=MAX_AGE.high, clock=lambda: now)
        for output in (result.resistance.output, result.brake_rate.output, result.adhesion):
            model.take(output)
        now = 1e9  # all moves are done
        return model

    def take(self, output: Output[Any]) -> None:
        """Take in an output of an estimator that has just arrived; those of the speed model are not needed."""
        self.take_message(output_topic(output.estimate), output.status, output.estimate, output.stamp_ns)

    def take_message(
        self,
        topic: OutputTopic,
        status: Status,
        estimate: Any,
        stamp_ns: int,
        *,
        latched: bool = False,
        doubt: str = '',
    ) -> None:
        """Take in status, fields and stamp [ns] of an estimate or message; a latched copy is of the last valid one.

        ``doubt`` says why no message of the topic is to be believed now; empty if they are.
        """
        live = self._estimates.get(topic)
        if live is None:
            return
        if isinstance(live, LiveAdhesion):
            self._take_adhesion(status, estimate, stamp_ns, doubt)
            return
        if is_resistance := topic is RESISTANCE_TOPIC:
            values = _resistance_values(estimate)
        else:
            values = {BRAKE_RATE: _factor(estimate.brake_rate, estimate.brake_rate_std)}
        with self._lock:
            now = self._clock.now()
            if doubt := doubt or ('' if latched else self._age_doubt(stamp_ns)):
                live.refuse(doubt, now)
                return
            if latched and not live.take_latched(status, values, now):
                return
            if not latched:
                live.take_new(status, values, now, stamp_ns)
            if is_resistance and status in USABLE and estimate.speed_min <= estimate.speed_max:
                self._learned_speeds = (estimate.speed_min, estimate.speed_max)

    def _take_adhesion(self, status: Status, estimate: Any, stamp_ns: int, doubt: str) -> None:
        with self._lock:
            now = self._clock.now()
            if doubt := doubt or self._age_doubt(stamp_ns):
                self._adhesion.refuse(doubt, now)
            else:
                self._adhesion.take_new(status, estimate, now, stamp_ns)

    def _age_doubt(self, stamp_ns: int) -> str:
        """Return how far a stamp [ns] is from the clock of the node if that is too far, else nothing."""
        age_s = 0.0 if self._node is None else seconds(self._node.get_clock().now().nanoseconds - stamp_ns)
        if abs(age_s) <= self._max_stamp_age:
            return ''
        side = 'behind' if age_s > 0.0 else 'ahead of'
        return f'the estimate is {abs(age_s):.0f} s {side} the clock; is a bag played without use_sim_time?'

    def mark_lost(self, topic: OutputTopic, reason: str) -> None:
        """Say why an estimate does not come any more: the train file applies, at once or when the next is overdue."""
        with self._lock:
            self._estimates[topic].mark_lost(reason, self._clock.now())

    def resistance(self, speed: float, *, direction: int = 1) -> Value:
        """Return the running resistance w(v) = a + b v + c v^2 + x(v) [N/kN] at a speed [m/s].

        x is that of the train file's effects. In all methods, ``direction`` is 1 where positions increase on the way,
        -1 where they decrease; of the effects built in, only ``headwind`` depends on it.
        """
        v, direction = SPEED.checked(speed), checked_direction(direction)
        with self._lock:
            self._go_on()
            return self._resistance_at(v, direction)

    def brake_rate(self, speed: float | None = None) -> Value:
        """Return the brake rate [1] (1 = nominal) at a speed [m/s]; without one, the factor on the table over speed."""
        v = None if speed is None else SPEED.checked(speed)
        with self._lock:
            self._go_on()
            return self._brake_rate_at(v)

    def adhesion(self) -> Value:
        """Return the adhesion between wheel and rail, over the weight of the train [1]; if not live, of a usual rail.

        While the axle slides and over the next kilometre, bounds do not rely on more, and ``reason`` says so.
        """
        with self._lock:
            self._go_on()
            return Value(*self._adhesion.value())

    def feed_forward(
        self, speed: float, gradient: float, acceleration: float, mass: float | None = None, *, direction: int = 1
    ) -> Value:
        """Return the force [N] at the wheel rim that gives an acceleration.

        ``F = M / s ((1 + gamma) dv/dt + g (w(v) + i) / 1000)``, where s is the force scale: the estimated ratio of
        actual to reported force, which also absorbs errors in mass, with the effects of the train file on traction.
        Braking forces (F < 0) are not scaled but for a wrong mass that the train file states, because the brake rate
        covers the brake.

        Args:
            speed: v [m/s].
            gradient: i [per mille], + uphill in the direction of travel, and other resistance [N/kN] that is known.
            acceleration: dv/dt [m/s^2].
            mass: M [kg], as weighed; without it that of the train file.
            direction: As of :meth:`resistance`.
        """
        v, i, wanted = _motion(speed, gradient, acceleration)
        direction, train = checked_direction(direction), self._file.train_file.train
        M = train.mass if mass is None else MASS.checked(mass)
        with self._lock:
            self._go_on()
            w = self._resistance_at(v, direction)
            scale, variance = self._resistance.normal(FORCE_SCALE).along((1.0,))
        force = M * ((1.0 + train.rotary_mass) * wanted + 0.001 * G * (w.value + i))
        if force > 0.0:
            # As the estimators do: they subtract what effects take from the reported force, which they scale.
            s = max(scale + (self._file.effects.traction_share(v, direction) - 1.0), MIN_SCALE)
            share = math.sqrt(variance) / s
        else:
            s, share = max(self._file.effects.brake_share(v), MIN_SCALE), train.mass_std
        force, by_w = force / s, M * 0.001 * G / s
        map_std = self._file.train_file.line.gradient_std
        std = math.hypot(by_w * w.std, by_w * map_std, force * share)
        return Value(force, std, w.live, w.reason)

    def brake_command(self, speed: float, gradient: float, acceleration: float, *, direction: int = 1) -> Value:
        """Return the brake command [m/s^2, <= 0] that gives an acceleration once the brake is built up.

        ``u = (dv/dt + k (w(v) + i)) / r(v)`` with ``k = g0 / (1000 (1 + gamma))``; 0 where no brake is needed. The
        arguments are those of :meth:`feed_forward`.
        """
        v, i, wanted = _motion(speed, gradient, acceleration)
        direction = checked_direction(direction)
        with self._lock:
            self._go_on()
            w, rate = self._resistance_at(v, direction), self._brake_rate_at(v)
        k, r = self._file.k, max(rate.value, NO_BRAKE)
        command = min(0.0, (wanted + k * (w.value + i)) / r)
        std = math.hypot(k * w.std, k * self._file.train_file.line.gradient_std, command * rate.std) / r
        return Value(command, std, *_both((w.live, w.reason), (rate.live, rate.reason)))

    def stopping_distance(
        self, speed: float, gradient: float = 0.0, command: float = FULL_SERVICE, confidence: float = 0.95,
        *, applied: float = 0.0, direction: int = 1,
    ) -> Value:  # fmt: skip
        """Return the distance [m] within which the train stops at a confidence; its median at 0.5.

        If the train file states ``brake_fade``, the brake is taken to have faded fully.

        ``std`` is the standard deviation of the distance, not of the bound. For the equations see ``stopping``.

        Args:
            speed: Speed now [m/s].
            gradient: Mean gradient on the way to the stop [per mille], + uphill in the direction of travel.
            command: Brake command from now on [m/s^2, < 0].
            confidence: Probability that the train stops within the distance, 0.5 to 0.999999.
            applied: Brake command that acts until the dead time is over [m/s^2, <= 0]; 0: the brake is released.
            direction: As of :meth:`resistance`.

        Raises:
            NoAnswerError: The train may not stop at all.
        """
        v = SPEED.checked(speed)
        bounds, live, reason = self._bounds(gradient, command, confidence, applied, direction)
        found = bounds.at(v)
        if math.isinf(found.distance):
            raise NoAnswerError(bounds.no_answer())
        return Value(found.distance, found.std, live, reason)

    def braking_speed(
        self, distance: float, gradient: float = 0.0, command: float = FULL_SERVICE, confidence: float = 0.95,
        *, applied: float = 0.0, direction: int = 1,
    ) -> Value:  # fmt: skip
        """Return the speed [m/s] from which the train stops within a distance [m] at a confidence.

        It is the inverse of :meth:`stopping_distance`, whose other arguments it takes, and at most 150 m/s.

        Raises:
            NoAnswerError: The train may not stop from any speed.
        """
        away = DISTANCE.checked(distance)
        bounds, live, reason = self._bounds(gradient, command, confidence, applied, direction)
        return Value(*bounds.speed(away), live, reason)

    def braking_curve(
        self, stop: float, positions: Iterable[float], gradient: float = 0.0, command: float = FULL_SERVICE,
        confidence: float = 0.95, *, applied: float = 0.0, direction: int = 1,
    ) -> tuple[Value, ...]:  # fmt: skip
        """Return the :meth:`braking_speed` [m/s] at positions [m] before a stopping point [m]; 0 at it and beyond."""
        end, direction = STOP.checked(stop), checked_direction(direction)
        distances = [distance_to(end, position, direction) for position in positions]
        bounds, live, reason = self._bounds(gradient, command, confidence, applied, direction)
        return tuple(Value(*bounds.speed(distance), live, reason) for distance in distances)

    def _bounds(
        self, gradient: float, command: float, confidence: float, applied: float, direction: int
    ) -> tuple[StoppingBounds, bool, str]:
        i, u1 = GRADIENT.checked(gradient), -COMMAND.checked(command)
        u0, P = -APPLIED.checked(applied), CONFIDENCE.checked(confidence)
        shape = self._file.stop_shape(checked_direction(direction))
        with self._lock:
            self._go_on()
            posterior = self._posterior(i)
            live, reason = _both(self._resistance.state(), self._brake_rate.state())
            most, why = self._adhesion.limit(P)
        if why:
            # As a command of the brake that is known to act: its rate, at the speed where that is largest.
            force = most * 1000.0 * self._file.k / (posterior.mean[0] * max(shape.rates, default=1.0))
            u1, u0, reason = min(u1, force), min(u0, force), f'{reason}; {why}'
        return StoppingBounds(shape, posterior, u1, u0, P), live, reason

    def _posterior(self, gradient: float) -> StopPosterior:
        file, davis, rate = self._file, self._resistance.normal(DAVIS), self._brake_rate.normal(BRAKE_RATE)
        config, (delay_std, lag_std) = file.config, file.timing_stds
        map_std = file.train_file.line.gradient_std
        mean = (rate.mean[0], 0.0, 0.0, *davis.mean, gradient, file.brake.delay, file.brake.time_constant)
        over_speed = (config.slope_std**2, config.blend_std**2)
        rest = (map_std**2, delay_std**2, lag_std**2)
        return StopPosterior(mean, (rate.covariance[0], *over_speed, 0.0, 0.0, 0.0, *rest), davis.covariance)

    def _resistance_at(self, speed: float, direction: int) -> Value:
        w, variance = self._resistance.normal(DAVIS).along((1.0, speed, speed * speed))
        extra = self._file.effects.resistance(speed, direction)
        live, reason = self._resistance.state()
        low, high = self._learned_speeds
        if live and not low <= speed <= high:
            reason = f'{reason}; outside the speeds learned from, {low:.1f} to {high:.1f} m/s'
        return Value(w + extra, math.sqrt(variance), live, reason)

    def _brake_rate_at(self, speed: float | None) -> Value:
        table, over_speed = self._file.rate_direction(speed)
        factor, variance = self._brake_rate.normal(BRAKE_RATE).along((1.0,))
        std = table * math.hypot(math.sqrt(variance), over_speed)
        return Value(table * factor, std, *self._brake_rate.state())

    def _go_on(self) -> None:
        now = self._clock.now()
        self._resistance.go_on(now)
        self._brake_rate.go_on(now)
        self._adhesion.go_on(now)


def _motion(speed: float, gradient: float, acceleration: float) -> tuple[float, float, float]:
    wanted = ACCELERATION.checked(acceleration)
    return SPEED.checked(speed), GRADIENT.checked(gradient), wanted


def _both(resistance: tuple[bool, str], rate: tuple[bool, str]) -> tuple[bool, str]:
    """Return whether resistance and brake rate are both live, and the reason."""
    live = resistance[0] and rate[0]
    same = resistance[1] == rate[1]
    return live, rate[1] if same else f'resistance {resistance[1]}; brake rate {rate[1]}'

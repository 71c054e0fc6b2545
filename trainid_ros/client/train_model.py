# SPDX-License-Identifier: Apache-2.0
"""The train as it is today: answers for an autopilot from live estimates, else from the train file.

Without a node nothing is subscribed: either the model learns from records itself, see :meth:`TrainModel.offline`, or
estimates are handed to :meth:`TrainModel.take`, and time is that of ``clock``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, get_args, overload

from trainid_ros.client.arguments import (
    ACCELERATION,
    APPLIED,
    COMMAND,
    CONFIDENCE,
    DISTANCE,
    FORCE,
    GRADIENT,
    HORIZON,
    MASS,
    MAX_AGE,
    MAX_STAMP_AGE,
    PLANNED,
    POSITION,
    SPEED,
    STOP,
    TARGET,
    ForwardClock,
    checked_direction,
    distance_to,
    rows_of,
    steps_of,
)
from trainid_ros.client.file_values import BRAKE_RATE, DAVIS, FORCE_SCALE, MIN_SCALE, FileValues
from trainid_ros.client.live_adhesion import LiveAdhesion, Rail
from trainid_ros.client.live_estimate import MAX_AGE_S, LiveEstimate, Normal
from trainid_ros.client.prediction import Plan, predicted_speeds
from trainid_ros.client.stopping import NO_BRAKE, NORMAL, StoppingBounds, StopPosterior
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.estimators.settings import BrakeRateConfig, FilterBankConfig, GsmaConfig, PriorSettings
from trainid_ros.interface.errors import InputError, NoAnswerError, check_settings
from trainid_ros.interface.records import ADHESION_TOPIC, BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, Record, output_topic
from trainid_ros.interface.results import Status
from trainid_ros.interface.scalars import seconds
from trainid_ros.train.fields import shown
from trainid_ros.train.forces import G, load_drag
from trainid_ros.train.train_file import TrainFile, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from trainid_ros.bag.bag_replay import Replay
    from trainid_ros.client.prediction import Steps
    from trainid_ros.client.stopping import RateShape
    from trainid_ros.interface.records import OutputTopic
    from trainid_ros.interface.results import Output
    from trainid_ros.setup.pipelines import EstimatorSettings


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
_UNSEEN_S: Final = 3600.0
"""Time since the brake was last observed where that is not known [s]."""
_TINY: Final = 1e-9  # keeps divisors above zero
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


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Bounds of stops with where they come from."""

    stopping: StoppingBounds
    live: bool
    reason: str
    of_rail: float  # Standard deviation of the braking force by that of an adhesion, relative [1]

    def speed(self, distance: float, more: str = '') -> Value:
        """Return the speed from which the train stops within a distance [m]; ``more`` is added to the reason."""
        speed, std = self.stopping.speed(distance)
        # The speed is nearly the root of the force.
        return Value(speed, math.hypot(std, 0.5 * self.of_rail * speed), self.live, self.reason + more)


class TrainModel:
    """Typed answers about one train.

    Args:
        node: A node of rclpy, which somebody spins; its namespace is that of the estimates. None: no ROS.
        train_file: Train file, or its path.
        max_age: Time without a new estimate after which the train file applies [s]. Estimates come as often as the
            speed; with speeds slower than 2 Hz it must be longer.
        max_stamp_age: Difference between stamp and clock of the node beyond which an estimate is that of another time
            [s], such as of a bag that somebody plays. With ``use_sim_time`` that clock is the one of the bag.
        clock: Present time [s]. If it goes back, time goes on from there. It may be replaced, see :meth:`set_clock`.
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
        self._clock = ForwardClock(clock, runs=node is not None)
        self._resistance = LiveEstimate(self._file.resistance(), max_age)
        self._brake_rate = LiveEstimate(self._file.brake_rate(), max_age)
        self._adhesion = LiveAdhesion(max_age)
        self._estimates: dict[OutputTopic, LiveEstimate | LiveAdhesion] = {
            RESISTANCE_TOPIC: self._resistance, BRAKE_RATE_TOPIC: self._brake_rate, ADHESION_TOPIC: self._adhesion,
        }  # fmt: skip
        self._learned_speeds = (0.0, math.inf)
        self._observed_s = -math.inf  # Time at which a sample last updated the brake rate
        self.subscriptions: tuple[Any, ...] = ()
        self._group: PipelineGroup | None = None
        self._node = node
        if node is not None:
            from trainid_ros.ros.topics import subscribe_estimates  # noqa: PLC0415 (needs ROS)

            made = (subscribe_estimates(node, topic, self.take_message, self.mark_lost) for topic in self._estimates)
            self.subscriptions = tuple(item for pair in made for item in pair)

    @classmethod
    def offline(
        cls, train_file: TrainFile | str | Path, settings: EstimatorSettings | None = None, *,
        max_age: float = MAX_AGE_S,
    ) -> TrainModel:  # fmt: skip
        """Return a train that learns from the records handed to :meth:`push`, as the nodes do; time is that of these.

        ``max_age`` is that of the class: longer for speeds slower than 2 Hz.
        A train file that cannot be used raises InputError.
        """
        from trainid_ros.setup.pipelines import (  # noqa: PLC0415 (estimators are not needed elsewhere)
            EstimatorSettings,
            brake_rate_pipeline,
            resistance_pipeline,
        )

        settings = settings or EstimatorSettings()
        known = train_file if isinstance(train_file, TrainFile) else load_train_file(train_file)
        pipelines = resistance_pipeline(known, settings), brake_rate_pipeline(known, settings)
        prior, brake = settings.resistance.config, settings.brake_rate.config
        model = cls(
            None, known, max_age=max_age, clock=lambda: seconds(pipelines[0].newest_ns),
            prior=prior if isinstance(prior, PriorSettings) else _PRIOR,
            brake=brake if isinstance(brake, BrakeRateConfig) else _BRAKE,
        )  # fmt: skip
        model._group = PipelineGroup(pipelines)
        return model

    def push(self, record: Record) -> list[Output[Any]]:
        """Take in a record of an input, in the order of arrival; return the outputs that it completes, now taken in.

        InputError unless the model is one of :meth:`offline`, and for what is no record of numbers.
        """
        if self._group is None:
            raise InputError('push: only a TrainModel.offline(train_file) learns from records')
        outputs: list[Output[Any]] = []
        if not isinstance(record, get_args(Record)):
            raise InputError(f'push: {shown(record)} is no record of an input, see interface.records')
        topic, stamp_ns, x, y, flag = record.row()
        try:  # simulations give numbers of numpy, which no state can hold
            row = topic, int(stamp_ns), float(x), float(y), bool(flag)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f'push: {shown(record)} has a value that is no number') from None
        self._group.push_rows((row,), outputs.append)
        for output in outputs:
            self.take(output)
        return outputs

    def set_clock(self, clock: Callable[[], float]) -> None:
        """Take the time from another clock [s] from now on, such as one that is there later; time goes on from now."""
        with self._lock:
            self._clock.follow(clock)

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
        model._observed_s += now  # so that it stays as long ago
        return model

    def take(self, output: Output[Any]) -> None:
        """Take in an output of an estimator that has just arrived; those of the speed model are not needed.

        InputError if its status or its stamp [ns] is none.
        """
        status: Any = output.status
        stamp_ns: Any = output.stamp_ns
        if not (isinstance(status, Status) and isinstance(stamp_ns, Integral)):
            raise InputError(f'take: status {shown(status)} with stamp_ns {shown(stamp_ns)} is no output')
        self.take_message(output_topic(output.estimate), status, output.estimate, output.stamp_ns)

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
        with self._lock:
            now = self._clock.now()
            if doubt := doubt or ('' if latched else self._age_doubt(stamp_ns)):
                live.refuse(doubt, now)
                return
            if isinstance(live, LiveAdhesion):
                live.take_new(status, estimate, now, stamp_ns)
                return
            if is_resistance := topic is RESISTANCE_TOPIC:
                values = _resistance_values(estimate)
            else:
                values = {BRAKE_RATE: _factor(estimate.brake_rate, estimate.brake_rate_std)}
            if latched and not live.take_latched(status, values, now):
                return
            if not latched and live.take_new(status, values, now, stamp_ns) and not is_resistance:
                self._observed_s = now if estimate.observable else self._observed_s
            if is_resistance and status.is_usable and estimate.speed_min <= estimate.speed_max:
                self._learned_speeds = (estimate.speed_min, estimate.speed_max)

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

        After a slide, bounds rely on no more and say so, until a usable estimate has no slip in the last km.
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
        wanted, v, i = ACCELERATION.checked(acceleration), SPEED.checked(speed), GRADIENT.checked(gradient)
        direction, train = checked_direction(direction), self._file.train_file.train
        M = train.mass if mass is None else MASS.checked(mass)
        with self._lock:
            self._go_on()
            w, scale, rail = (
                self._resistance_at(v, direction),
                self._traction_scale(v, direction),
                self._adhesion.limit(),
            )
        load = load_drag(self._file.train_file.c_of_load, train.mass, M, v)
        force = M * ((1.0 + train.rotary_mass) * wanted + 0.001 * G * (w.value + load + i))
        if force > 0.0:
            s, share = scale[0], scale[1] / scale[0]
        else:
            s, share = max(self._file.effects.brake_share(v), MIN_SCALE), train.mass_std
        force, by_w = force / s, M * 0.001 * G / s
        map_std = self._file.train_file.line.gradient_std
        std = math.hypot(by_w * w.std, by_w * map_std, force * share)
        return Value(force, std, w.live, w.reason + _beyond_rail(-force * s / (G * M), rail))

    def brake_command(self, speed: float, gradient: float, acceleration: float, *, direction: int = 1) -> Value:
        """Return the brake command [m/s^2, <= 0] that gives an acceleration once the brake is built up.

        ``u = (dv/dt + k (w(v) + i)) / r(v)`` with ``k = g0 / (1000 (1 + gamma))``; 0 where no brake is needed. The
        arguments are those of :meth:`feed_forward`.
        """
        wanted, v, i = ACCELERATION.checked(acceleration), SPEED.checked(speed), GRADIENT.checked(gradient)
        direction = checked_direction(direction)
        with self._lock:
            self._go_on()
            w, rate, rail = self._resistance_at(v, direction), self._brake_rate_at(v), self._adhesion.limit()
        k, r = self._file.k, max(rate.value, NO_BRAKE)
        command = min(0.0, (wanted + k * (w.value + i)) / r)
        std = math.hypot(k * w.std, k * self._file.train_file.line.gradient_std, command * rate.std) / r
        live, reason = _of_brake((w.live, w.reason), (rate.live, rate.reason))
        return Value(command, std, live, reason + _beyond_rail(-command * r / (1000.0 * k), rail))

    @overload
    def predict(
        self, horizon: float, *, speed: float, force: float | Steps = ..., command: float | Steps = ...,
        applied: float = ..., gradient: float = ..., mass: float | None = ..., direction: int = ...,
        position: float | None = ...,
    ) -> Value: ...  # fmt: skip

    @overload
    def predict(
        self, horizon: Sequence[float], *, speed: float, force: float | Steps = ..., command: float | Steps = ...,
        applied: float = ..., gradient: float = ..., mass: float | None = ..., direction: int = ...,
        position: float | None = ...,
    ) -> tuple[Value, ...]: ...  # fmt: skip

    def predict(
        self, horizon: float | Sequence[float], *, speed: float, force: float | Steps = 0.0,
        command: float | Steps = 0.0, applied: float = 0.0, gradient: float = 0.0, mass: float | None = None,
        direction: int = 1, position: float | None = None,
    ) -> Value | tuple[Value, ...]:  # fmt: skip
        """Return the speed [m/s] at one or several times from now on [s, up to 600]; see ``prediction``.

        ``force`` and ``command`` are constant, or values that hold from a time on: ((0.0, 90e3), (12.0, 0.0)).

        Args:
            horizon: The time, or several in any order: then there is an answer for each.
            speed: Speed now [m/s].
            force: At the wheel rim, as the drive reports it [N]; without braking, which is that of ``command``.
            command: Brake commands [m/s^2, <= 0]; those given before now may still be in their dead time.
            applied: Brake command that acts now, lag included, until that of ``command`` acts [m/s^2, <= 0].
            gradient: As of :meth:`stopping_distance`.
            mass: M [kg], as of :meth:`feed_forward`.
            direction: As of :meth:`stopping_distance`.
            position: As of :meth:`stopping_distance`.
        """
        v, i, train = SPEED.checked(speed), GRADIENT.checked(gradient), self._file.train_file.train
        times = [HORIZON.checked(time) for time in rows_of(horizon, HORIZON)]
        M, u0 = train.mass if mass is None else MASS.checked(mass), -APPLIED.checked(applied)
        load = load_drag(self._file.train_file.c_of_load, train.mass, M, v)  # as at the start
        forces = [(t, F / ((1.0 + train.rotary_mass) * M)) for t, F in steps_of(force, FORCE)]
        plan = Plan(forces, [(t, -u) for t, u in steps_of(command, PLANNED)], u0)
        place = None if position is None else POSITION.checked(position)
        shape = self._file.motion_shape(checked_direction(direction), place)
        with self._lock:
            self._go_on()
            posterior, of_rate = self._posterior(i + load), self._brake_rate.state()
            live, reason = self._resistance.state()
            scale, rail = self._traction_scale(v, direction), self._adhesion.limit()
        if u0 or any(u for _, u in plan.command):
            live, reason = live and of_rate[0], _of_brake((live, reason), of_rate)[1]
        if rail is not None:
            plan, posterior, why = self._limited_plan(plan, posterior, shape, rail)
            reason += why
        found = predicted_speeds(v, times, plan, shape, posterior, scale, self._file.config)
        answers = tuple(
            Value(mean, std, live, reason + self._file.beyond_line(run, direction, place)) for mean, std, run in found
        )
        return answers[0] if isinstance(horizon, (float, Real)) else answers

    def stopping_distance(
        self, speed: float, gradient: float = 0.0, command: float = FULL_SERVICE, confidence: float = 0.95,
        *, applied: float = 0.0, direction: int = 1, position: float | None = None,
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
            position: Of the train's front [m]. With it, gradients and effects over the line of the train file act along
                the way, and ``gradient`` is added to them; ``reason`` says so if the way leads off that line.

        Raises:
            NoAnswerError: The train may not stop at all.
        """
        v = SPEED.checked(speed)
        bounds = self._bounds(gradient, command, confidence, applied, direction, position)
        found = bounds.stopping.at(v)
        if math.isinf(found.distance):
            raise NoAnswerError(bounds.stopping.no_answer())
        reason = bounds.reason + self._file.beyond_line(found.distance, direction, position)
        # The distance is nearly inverse to the force.
        return Value(found.distance, math.hypot(found.std, bounds.of_rail * found.distance), bounds.live, reason)

    def braking_speed(
        self, distance: float | None = None, gradient: float = 0.0, command: float = FULL_SERVICE,
        confidence: float = 0.95, *, applied: float = 0.0, direction: int = 1,
        target_position: float | None = None, position: float | None = None,
    ) -> Value:  # fmt: skip
        """Return the speed [m/s] from which the train stops within a distance [m] at a confidence.

        It is the inverse of :meth:`stopping_distance`, whose other arguments it takes, and at most 150 m/s. Where the
        train must stop and where it is may be given instead, as ``target_position`` and ``position`` [m], both on the
        line of the train file.

        Raises:
            NoAnswerError: The train may not stop from any speed.
        """
        if (distance is None) == (target_position is None) or (target_position is None) != (position is None):
            raise InputError('give either distance, or target_position and position')
        passed = ''
        if distance is None:
            target = TARGET.checked(target_position)
            self._file.check_place('target_position', target)
            distance = distance_to(target, position, checked_direction(direction))
            passed = '' if distance > 0.0 else '; the target is not ahead in this direction'
        away = DISTANCE.checked(distance)
        return self._bounds(gradient, command, confidence, applied, direction, position).speed(away, passed)

    def braking_curve(
        self, stop: float, positions: Iterable[float], gradient: float = 0.0, command: float = FULL_SERVICE,
        confidence: float = 0.95, *, applied: float = 0.0, direction: int = 1,
    ) -> tuple[Value, ...]:  # fmt: skip
        """Return the :meth:`braking_speed` [m/s] at positions [m] before a stopping point [m]; 0 at it and beyond."""
        end, direction = STOP.checked(stop), checked_direction(direction)
        try:
            places = tuple(positions)
        except TypeError:
            raise InputError(f'positions = {shown(positions)} must be numbers in m') from None
        distances = [distance_to(end, place, direction) for place in places]
        bounds = self._bounds(gradient, command, confidence, applied, direction)
        return tuple(bounds.speed(distance) for distance in distances)

    def _bounds(
        self, gradient: float, command: float, confidence: float, applied: float, direction: int,
        position: float | None = None,
    ) -> _Bounds:  # fmt: skip
        i, u1 = GRADIENT.checked(gradient), -COMMAND.checked(command)
        u0, P = -APPLIED.checked(applied), CONFIDENCE.checked(confidence)
        place = None if position is None else POSITION.checked(position)
        shape = self._file.stop_shape(checked_direction(direction), place)
        with self._lock:
            self._go_on()
            posterior = self._posterior(i, P)
            live, reason = _of_brake(self._resistance.state(), self._brake_rate.state())
            rail = self._adhesion.limit()
        limit, of_rail = '', 0.0
        if rail is not None:
            least = rail.least(P)
            most, median = (self._command_at(x, posterior, shape) for x in (least, rail.adhesion))
            limit = _limited(least) if most < max(u1, u0) else ''
            # At the median, and only as far as the rail limits the command there.
            of_rail = rail.share * least / rail.adhesion * _probability_of_limit(u1, median, rail)
            u1, u0 = min(u1, most), min(u0, most)
        reason += f'; {limit}' if limit else ''
        return _Bounds(StoppingBounds(shape, posterior, u1, u0, P, limit), live, reason, of_rail)

    def _limited_plan(
        self, plan: Plan, posterior: StopPosterior, shape: RateShape, rail: Rail
    ) -> tuple[Plan, StopPosterior, str]:
        """Return a plan with no more braking than a slide permits, what is known with it, and more of the reason."""
        most, least = self._command_at(rail.adhesion, posterior, shape), -rail.adhesion * 1000.0 * self._file.k
        ends = *(t for t, _ in plan.command[1:]), math.inf
        over_s = -self._file.brake.delay  # Commands that ended before do not act any more
        u = max(plan.applied, *(u for (_, u), end in zip(plan.command, ends, strict=True) if end > over_s))
        p, rate_std = _probability_of_limit(u, most, rail), posterior.mean[0] * rail.share
        variance = (1.0 - p) * posterior.variances[0] + p * rate_std * rate_std
        known = replace(posterior, variances=(variance, *posterior.variances[1:]))
        if u <= most and min(a for _, a in plan.force) >= least:
            return plan, known, ''
        forces = [(t, max(a, least)) for t, a in plan.force]
        limited = Plan(forces, [(t, min(u, most)) for t, u in plan.command], min(plan.applied, most))
        return limited, known, f'; {_limited(rail.adhesion)}'

    def _command_at(self, adhesion: float, posterior: StopPosterior, shape: RateShape) -> float:
        """Return the brake command [m/s^2, > 0] that needs an adhesion [1] at the speed where the rate is largest."""
        return adhesion * 1000.0 * self._file.k / (posterior.mean[0] * max(shape.rates, default=1.0))

    def _posterior(self, gradient: float, confidence: float = 1.0) -> StopPosterior:
        file, davis, rate = self._file, self._resistance.normal(DAVIS), self._brake_rate.normal(BRAKE_RATE)
        config, (delay_std, lag_std) = file.config, file.timing_stds
        map_std = file.train_file.line.gradient_std
        mean = (rate.mean[0], 0.0, 0.0, *davis.mean, gradient, file.brake.delay, file.brake.time_constant)
        over_speed = (config.slope_std**2, config.blend_std**2)
        rest = (map_std**2, delay_std**2, lag_std**2)
        variances = (rate.covariance[0], *over_speed, 0.0, 0.0, 0.0, *rest)
        unseen_s = _UNSEEN_S if math.isinf(self._observed_s) else self._clock.now() - self._observed_s
        stated = file.train_file.brake
        dropped = -math.expm1(-stated.loss_per_hour * unseen_s / 3600.0)
        if stated.loss_per_hour * stated.loss_confidence > 0.0:
            # Of a share q of lower brakes, a bound holds at least 1 - (1 - P) / q: this q gives loss_confidence.
            dropped = max(dropped, min(1.0, (1.0 - confidence) / (1.0 - stated.loss_confidence)))
        return StopPosterior(mean, variances, davis.covariance, dropped, stated.loss)

    def _resistance_at(self, speed: float, direction: int) -> Value:
        w, variance = self._resistance.normal(DAVIS).along((1.0, speed, speed * speed))
        extra = self._file.effects.resistance(speed, direction)
        live, reason = self._resistance.state()
        low, high = self._learned_speeds
        if live and not low <= speed <= high:
            reason = f'{reason}; outside the speeds learned from, {low:.1f} to {high:.1f} m/s'
        return Value(w + extra, math.sqrt(variance), live, reason)

    def _traction_scale(self, speed: float, direction: int) -> tuple[float, float]:
        """Return the actual over the reported traction, and its standard deviation [1]."""
        scale, variance = self._resistance.normal(FORCE_SCALE).along((1.0,))
        # As the estimators do: they subtract what effects take from the reported force, which they scale.
        return max(scale + (self._file.effects.traction_share(speed, direction) - 1.0), MIN_SCALE), math.sqrt(variance)

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


def _beyond_rail(needed: float, rail: Rail | None) -> str:
    """Return what to add to the reason of a braking that needs more adhesion [1] than there was in a slide."""
    if rail is None or needed <= rail.adhesion:
        return ''
    return f'; needs an adhesion of {needed:.3f}, after a slide at {rail.adhesion:.3f}'


def _probability_of_limit(command: float, median: float, rail: Rail) -> float:
    """Return the probability that a rail limits a brake command [m/s^2, >= 0], the median of its limit given."""
    return NORMAL.cdf(math.log(max(command, _TINY) / median) / max(rail.share, _TINY))


def _limited(adhesion: float) -> str:
    return f'braking limited to an adhesion of {adhesion:.3f} by a slide'


def _of_brake(resistance: tuple[bool, str], rate: tuple[bool, str]) -> tuple[bool, str]:
    """Return whether an answer on the brake is live, as its rate is, and the reasons of both where they differ."""
    same = resistance[1] == rate[1]
    return rate[0], rate[1] if same else f'resistance {resistance[1]}; brake rate {rate[1]}'

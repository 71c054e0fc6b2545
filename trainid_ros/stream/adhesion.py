# SPDX-License-Identifier: Apache-2.0
"""Adhesion: the force between wheel and rail over the weight of the train, and slip and slide of the measured axle.

Without slip the axle turns as fast as the train runs. A Kalman filter on the train speed v and an error b of the known
acceleration then predicts it:

    dv/dt = (u + b) - (w(v) + i) / J,        u = F / J + r(v) z,        J = 1000 (1 + gamma) / g0,

with the specific traction F, the brake rate r and the lagged command z of the train file, and what is transmitted
between wheel and rail, u + b. The used adhesion is J |u + b| / 1000. b is an error of the drive or the brake, of
gradient and resistance.

Slip and slide are found by a generalised likelihood ratio. For each sample of the last seconds as the last one without
slip, the speed is predicted from there, and

    S = max (y - v)^2 / var(y - v)

exceeds a threshold, in the sense of the force: faster than the drive, or slower than the brake can make it. From then
on the measured speed says nothing. The train is predicted from the last sample without slip, by an acceleration c that
is constant but unknown. c is between zero and u + b.

Axle and train agree again when the axle moves for a while as a train can, and has come back, is without force, or moves
as the force demands. A force of the other sense ends slip too; an axle that has not come back slips in that sense then.
That speed updates v and, as the mean over the slide, c. J |c| / 1000 is the adhesion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import ClassVar, Final

from trainid_ros.interface.results import AdhesionEstimate, Reason, Rejection
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, several
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeActuator, CommandHistory, davis

RAIL: Final = 0.20
"""Mean of the adhesion without any evidence [1]: dry .3, wet .15, a tenth with less."""
RAIL_STD: Final = 0.07
"""Its standard deviation [1]."""
STRETCH_M: Final = 1000.0
"""Length of the line behind the train that counts [m]."""

_BINS: Final = 20  # parts of that stretch ...
_CONFIRMED: Final = 5  # ... and how many the train must have run before the inputs are believed
_MIN_SPEED: Final = 0.5  # m/s: a slower axle gives too few pulses

# Errors of the known acceleration

_ERROR: Final = 0.03  # m/s^2: gradient map, gusts and resistance; 3 N/kN
_ERROR_S: Final = 20.0  # s: their correlation time
_SHARE: Final = 0.25  # error of drive and brake, as a share of their acceleration [1]
_TIMING: Final = 0.3  # error of the timing, as a share of dead time and lag of the brake [1]
_MIN_TIMING: Final = 0.1  # s: the same of stamps and filters
_ALIGNED: Final = 0.25  # the same of the alignment, as a share of the time between samples [1]
_COARSE: Final = 1.0 / 3.6  # m/s: a speed is taken to be in whole km/h ...
_COARSE_S: Final = 0.5  # s ... where samples are further apart
_WHITE: Final = 0.02  # (m/s)/sqrt(s): unmodelled motion, as the jerk of couplers

# Decision

_UNKNOWN: Final = 1e6  # (m/s)^2: variance of a speed that says nothing
_WINDOW_S: Final = 2.5  # s in which slip must have begun to be found
_KEPT: Final = 16  # samples that are kept for it at most
_SURE_S: Final = 1.5  # s after which a sample had no slip for sure
_THRESHOLD: Final = 5.5  # standard deviations: 4e-8 for each sample of a normal distribution
MIN_SLIP: Final = 0.3  # m/s: a smaller difference of the speeds is no slip that matters ...
_MIN_RATIO: Final = 0.02  # ... nor is a smaller share of the speed: wheels that transmit force creep by 1 %
_MIN_FORCE: Final = 10.0  # N/kN: wheels that transmit less do not slip
_STEADY_S: Final = 0.8  # s for which an axle moves as the train may, to be taken for the train again
_BACK: Final = 0.25  # share of the largest slip by which it must have come back before
_CREEP: Final = 0.04  # slip that wheel slide protection leaves when it lets the axle come back [1]; 0 to 8 %
_FREE_S: Final = 1.0  # s without force after which no wheel slips any more
_LONGEST_S: Final = 60.0  # s: no slide is longer
_SETTLED_S: Final = 4.0  # s of such motion, as the force demands, after which it is the train in any case
_NOISE: Final = 4.0  # standard deviations of a difference of two speeds: the most that noise changes it
_HOLD: Final = 4.0  # standard deviations of an odd speed that is not used, and may be the first of a slide

# Acceleration while it slips, as a share of what is demanded as it begins, and its change [1/sqrt(s)]

_MEAN_SHARE: Final = 0.7
_STD_SHARE: Final = 0.25
_WALK: Final = 0.1
_SPREADS: Final = 0.35  # relative change of the adhesion along STRETCH_M [1]: patches of leaves or grease


@dataclass
class Past:
    """The filter after a sample, and what has happened up to it."""

    stamp_ns: int = 0  # Its stamp [ns]
    speed: float = 0.0  # Measured speed [m/s]
    v: float = 0.0  # Speed of the train [m/s]
    b: float = 0.0  # Error of the known acceleration; while wheels slip, c in its place [m/s^2]
    vv: float = 0.0  # Variance of v [(m/s)^2]
    vb: float = 0.0  # Covariance of v and b
    bb: float = 0.0  # Variance of b [(m/s^2)^2]
    u: float = 0.0  # Known acceleration by drive and brake [m/s^2]
    driven: float = 0.0  # Speed gained by drive and brake so far [m/s]
    rolled: float = 0.0  # Speed gained by resistance and gradient so far [m/s]

    def predict(self, dt: float, gain: float, decay: float, q_v: float, q_b: float) -> None:
        """Predict over a time [s] with a known gain of speed [m/s], and what it adds to the variances of v and b."""
        self.v += gain + dt * self.b
        self.vv += dt * (2.0 * self.vb + dt * self.bb) + q_v
        self.vb = decay * (self.vb + dt * self.bb)
        self.b, self.bb = decay * self.b, decay * decay * self.bb + q_b

    def correct(self, speed: float, r: float) -> None:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]."""
        S = self.vv + r
        nu, k, left = speed - self.v, self.vb / S, r / S
        self.v, self.b = speed - left * nu, self.b + k * nu
        self.bb -= k * self.vb
        self.vv, self.vb = left * self.vv, left * self.vb


@dataclass
class Slide:
    """Slip or slide of the axle, if there is one."""

    side: float = 0.0  # 1: slip under traction, -1: slide under braking, 0: none
    error: float = 0.0  # Error b before it [m/s^2]
    lead: float = 0.0  # Speed of the axle less that of the train when it began to move as a train may [m/s]
    has_returned: bool = False  # Whether the axle has come back since it ran away last
    steady_s: float = 0.0  # Time for which it has moved as a train may [s]
    free_s: float = 0.0  # Time without force [s]
    lasted_s: float = 0.0  # Time since it was found [s]


@dataclass
class Part:
    """What was used on a part of the line."""

    used: float = 0.0  # Largest adhesion used without slip, less two standard deviations [1]
    run: float = 0.0  # Distance run [m]
    slipped: float = 0.0  # Distance run while the axle slipped [m]


@dataclass
class Found:
    """Adhesion of the last slide."""

    mean: float = 0.0  # Its mean [1]
    variance: float = 0.0  # Its variance [1]
    away_m: float = math.inf  # Distance run since then [m]


class AdhesionEstimator:
    """Estimate adhesion and slip from aligned samples.

    Attributes:
        slide: Slip or slide that is going on.
        used: Number of samples taken in.
        rejected: Number of samples not taken in.
        last_rejection: The newest rejection, None if there was none.
    """

    STATE: ClassVar[State] = declare(
        'slide', '_actuator', several('_past', Past), several('_parts', Part), '_found', '_train', '_stamp_ns', 'used',
        'rejected',
        several('last_rejection', Rejection),
    )  # fmt: skip

    def __init__(self, known: KnownForce) -> None:
        self._known, self._brake, self._davis = known, known.brake, known.train_file.resistance
        self._timing = max(_TIMING * (known.brake.delay + known.brake.time_constant), _MIN_TIMING)
        self._actuator = BrakeActuator(known.brake)
        self.slide = Slide()
        self._stamp_ns = 0  # Stamp of the last sample [ns]
        self._past = list[Past]()  # The last samples, the newest last; none after a gap
        self._train = Past()  # The train while wheels slip
        self._parts = [Part()]  # The parts of the last kilometre, the newest last
        self._found = Found()
        self.used = self.rejected = 0
        self.last_rejection: Rejection | None = None

    def step(self, sample: Sample, noise: SpeedNoise) -> Rejection | None:
        """Take in one sample, with the noise of its speed; return why it was not used, None if it was."""
        # Speeds are rounded even where each is another one; far apart they do not show how.
        quantum = max(noise.quantum, _COARSE) if sample.dt > _COARSE_S else noise.quantum
        r = max(noise.variance, quantum * quantum / 12.0)
        braked = self._brake_since(sample)
        if (rejection := self._reject(sample)) is not None:
            if self.is_slipping:
                is_stop = rejection.reason is Reason.STANDSTILL
                self._end_slide(0.0 if is_stop else self._train.v, _MIN_SPEED * _MIN_SPEED if is_stop else _UNKNOWN)
            self.rejected += 1
            self.last_rejection = rejection
            self._past.clear()
            return rejection
        self.used += 1
        if not self._past:
            self._begin(sample, r)
            return None
        now, dt = self._moved(sample, braked), sample.dt
        if self.slide.side == 0.0:
            self._follow(now, dt, r)
        else:
            self._slip(now, dt, r)
        self._past.append(now)
        while len(self._past) > 2 and (
            len(self._past) > _KEPT or seconds(now.stamp_ns - self._past[0].stamp_ns) > _WINDOW_S
        ):
            del self._past[0]
        self._account(now, dt)
        return None

    def _brake_since(self, sample: Sample) -> float:
        """Return the speed that a brake of rate 1 has gained since the last sample [m/s]."""
        start_ns = self._stamp_ns
        if not 0 < start_ns <= sample.stamp_ns:  # another time base
            start_ns, self._actuator.commands = sample.stamp_ns, CommandHistory()
        self._stamp_ns = sample.stamp_ns
        self._actuator.commands.follow(sample.brake_changes)
        return self._actuator.advance(start_ns, sample.stamp_ns)

    def _reject(self, sample: Sample) -> Rejection | None:
        """Return why motion and forces since the last sample are not known, None if they are."""
        if math.isnan(sample.dt):
            return Rejection(sample.stamp_ns, Reason.GAP, sample.dt, math.nan)
        # A sliding axle contradicts the forces.
        if sample.brake_rejection is not None and not self.is_slipping:
            return sample.brake_rejection
        if not is_finite(sample.brake_command):
            return Rejection(sample.stamp_ns, Reason.BRAKE_COMMAND_MISSING, sample.brake_command, math.nan)
        if sample.speed < _MIN_SPEED and (self.slide.side == 0.0 or self._train.v < 2.0 * math.sqrt(self._train.vv)):
            return Rejection(sample.stamp_ns, Reason.STANDSTILL, sample.speed, _MIN_SPEED)
        return self._known.reject(sample)

    def _begin(self, sample: Sample, r: float) -> None:
        """Begin with the measured speed, as that of the train."""
        start = Past(sample.stamp_ns, sample.speed, sample.speed)
        start.u = self._acceleration(sample)
        start.vv, start.bb = r, self._error_variance(start.u)
        self._past.append(start)

    def _error_variance(self, u: float) -> float:
        return _ERROR * _ERROR + (_SHARE * u) * (_SHARE * u)

    def _acceleration(self, sample: Sample) -> float:
        """Return the known acceleration by drive and brake at the stamp [m/s^2]."""
        traction = max(self._known.traction(sample.force, sample), 0.0) / self._known.inertia
        return traction + self._brake.rate_at(sample.speed) * self._actuator.output

    def _moved(self, sample: Sample, braked: float) -> Past:
        """Return the last state with what is known of the motion since then; the brake alone has gained ``braked``."""
        known, last, dt = self._known, self._past[-1], sample.dt
        v = last.v if self.slide.side == 0.0 else self._train.v
        traction = known.traction(sample.force_mean, sample)
        driven = self._brake.rate_at(v) * known.brake_share(sample) * braked
        if traction > 0.0:
            driven += dt * traction / known.inertia
        rolled = -dt * (davis(self._davis, v) + known.track(sample)) / known.inertia
        return Past(
            sample.stamp_ns, sample.speed, last.v, last.b, last.vv, last.vb, last.bb, self._acceleration(sample),
            last.driven + driven, last.rolled + rolled,
        )  # fmt: skip

    # Without slip

    def _follow(self, now: Past, dt: float, r: float) -> None:
        """Predict and correct speed and error, unless the axle does not turn as the train runs."""
        last = self._past[-1]
        decay = math.exp(-dt / _ERROR_S)
        late = (self._timing + _ALIGNED * dt) * (now.u - last.u)
        share = _SHARE * _SHARE * abs(now.u * now.u - last.u * last.u)
        now.predict(
            dt,
            now.driven + now.rolled - last.driven - last.rolled,
            decay,
            _WHITE * _WHITE * dt + late * late,
            (1.0 - decay * decay) * self._error_variance(now.u) + share,
        )
        begin, side = self._onset(now, dt, r)
        if side != 0.0:
            self._begin_slide(now, begin, side)
        elif (now.speed - now.v) * (now.speed - now.v) < _HOLD * _HOLD * (now.vv + r) or now.vv > 1.0:
            now.correct(now.speed, r)

    def _onset(self, now: Past, dt: float, r: float) -> tuple[int, float]:
        """Return the place of the last sample without slip, and the sense of the slip, 0 if there is none."""
        best, begin, side = _THRESHOLD * _THRESHOLD, 0, 0.0
        timing, force = self._timing + _ALIGNED * dt, _MIN_FORCE / self._known.inertia
        least = max(MIN_SLIP, _MIN_RATIO * now.v)
        for k in range(len(self._past)):
            past = self._past[k]
            if past.u < -force or now.u < -force:
                sense = -1.0
            elif past.u > force or now.u > force:
                sense = 1.0
            else:
                continue
            t = seconds(now.stamp_ns - past.stamp_ns)
            gap = now.speed - past.v - t * past.b - (now.driven - past.driven) - (now.rolled - past.rolled)
            if sense * gap < least:
                continue
            late = timing * (now.u - past.u)
            share = _SHARE * _SHARE * abs(now.u * now.u - past.u * past.u)
            variance = past.vv + t * (2.0 * past.vb + t * (past.bb + share)) + _WHITE * _WHITE * t + late * late + r
            if gap * gap > best * variance:
                best, begin, side = gap * gap / variance, k, sense
        return begin, side

    def _begin_slide(self, now: Past, begin: int, side: float) -> None:
        """Predict the train from the last sample without slip."""
        start = self._past[begin]
        c = self._start(now, start, side, start.b)
        train, t = self._train, seconds(now.stamp_ns - start.stamp_ns)
        train.predict(t, now.rolled - start.rolled, 1.0, _WHITE * _WHITE * t, (_WALK * c) * (_WALK * c) * t)
        self._copy(now)

    def _start(self, now: Past, start: Past, side: float, error: float) -> float:
        """Start with the train as it was and an unknown acceleration; return the demanded one [m/s^2]."""
        self.slide = Slide(side, error)
        self._parts = [replace(part, used=0.0) for part in self._parts]
        least = _MIN_FORCE / self._known.inertia
        c = side * max(side * (now.u + error), side * (start.u + error), least)
        self._train = replace(start, b=_MEAN_SHARE * c, bb=(_STD_SHARE * c) * (_STD_SHARE * c), vb=0.0)
        return c

    def _copy(self, now: Past) -> None:
        train = self._train
        now.v, now.b, now.vv, now.vb, now.bb = train.v, train.b, train.vv, train.vb, train.bb

    # With slip

    def _slip(self, now: Past, dt: float, r: float) -> None:
        """Predict the train by an unknown force, until the axle turns as it runs again, or slips in the other sense."""
        slide, train, last, side = self.slide, self._train, self._past[-1], self.slide.side
        walk = _WALK * abs(train.b)
        # Wheels transmit no more than is asked for.
        excess = max(side * (train.b - slide.error) - max(side * now.u, 0.0), 0.0)
        gain = now.rolled - last.rolled - side * excess * dt
        train.predict(dt, gain, 1.0, _WHITE * _WHITE * dt, walk * walk * dt)
        if -side * now.u * self._known.inertia > _MIN_FORCE:
            self._turn(now, r)
            return
        slide.lasted_s += dt
        is_free = side * now.u * self._known.inertia < _MIN_FORCE
        slide.free_s = slide.free_s + dt if is_free else 0.0
        noise = _NOISE * math.sqrt(2.0 * r)
        if slide.steady_s == 0.0:
            slide.lead = last.speed - last.v
        slide.steady_s = slide.steady_s + dt if self._may_be_train(last, now, noise) else 0.0
        peak, was_back, largest = now, slide.has_returned, 0.0
        for past in self._past:
            if side * past.speed < side * peak.speed:
                peak = past
            largest = max(largest, side * (past.speed - past.v))
            _, change, by_rail = self._change(past, now)
            if change - by_rail > max(MIN_SLIP, noise):
                slide.has_returned = False
            elif -change > max(_BACK * largest, noise):
                slide.has_returned = True
        if was_back and not slide.has_returned:
            # Between two slides the axle has run nearly as fast as the train.
            creep = _CREEP * peak.speed
            train.correct(train.v + peak.speed - side * creep - peak.v, creep * creep + r)
        since = self._past[0]
        for past in self._past:
            if seconds(now.stamp_ns - past.stamp_ns) >= _STEADY_S:
                since = past
        is_steady = slide.steady_s >= _STEADY_S and self._may_be_train(since, now, noise)
        is_settled = slide.steady_s > _SETTLED_S and self._is_as_demanded(self._past[0], now, noise)
        if (is_steady and (slide.has_returned or is_settled or slide.free_s > _FREE_S)) or (
            slide.lasted_s > _LONGEST_S
        ):
            # It was the train's since the axle moves so.
            self._resume(now, train.v + slide.lead, r)
        else:
            self._copy(now)

    def _turn(self, now: Past, r: float) -> None:
        """End a slip whose force has changed its sense; an axle that has not come back slips in the other sense."""
        if self.slide.has_returned:
            self._resume(now, now.speed, r)
        else:
            self._start(now, self._train, -self.slide.side, self.slide.error)
            self._copy(now)

    def _resume(self, now: Past, speed: float, r: float) -> None:
        """End the slide with a speed of the train [m/s] of variance r, and go on with that of the axle."""
        error = self.slide.error
        self._end_slide(speed, r)
        self._past.clear()
        now.b, now.bb = error, self._error_variance(now.u)
        now.v, now.vv, now.vb = now.speed, r, 0.0

    def _may_be_train(self, past: Past, now: Past, noise: float) -> bool:
        """Return whether the axle has changed its speed since then as the train may, but for noise [m/s]."""
        t, change, by_rail = self._change(past, now)
        return -noise - _ERROR * t < change < (1.0 + _SHARE) * by_rail + noise + _ERROR * t

    def _is_as_demanded(self, past: Past, now: Past, noise: float) -> bool:
        """Return whether that is not less than by the force demanded: wheel slide protection may hold a slip."""
        t, change, by_rail = self._change(past, now)
        return change > (1.0 - _SHARE) * by_rail - noise - _ERROR * t

    def _change(self, past: Past, now: Past) -> tuple[float, float, float]:
        """Return the time since then [s], and the change of speed by the rail, as measured and as demanded [m/s]."""
        t, side = seconds(now.stamp_ns - past.stamp_ns), self.slide.side
        by_rail = side * (now.driven - past.driven + self.slide.error * t)
        return t, side * (now.speed - past.speed - now.rolled + past.rolled), max(by_rail, 0.0)

    def _end_slide(self, speed: float, r: float) -> None:
        """Correct the train by a speed of variance r; this gives the mean force since the slide began."""
        self._train.correct(speed, r)
        mean, variance = self._adhesion_of(self._train)
        if self._found.away_m < STRETCH_M and self._found.mean < mean:  # the worst of the last km may come again
            mean, variance = self._found.mean, self._found.variance
        self._found, self.slide = Found(mean, variance, 0.0), Slide()

    def _adhesion_of(self, train: Past) -> tuple[float, float]:
        scale = self._known.inertia / 1000.0
        return scale * abs(train.b), scale * scale * train.bb

    # Line

    def _account(self, now: Past, dt: float) -> None:
        """Add up what was used, and where the axle slipped."""
        distance, slips = dt * now.v, self.slide.side != 0.0
        self._found.away_m += distance
        if self._parts[-1].run >= STRETCH_M / _BINS:
            self._parts.append(Part())
            while math.fsum(part.run for part in self._parts[1:]) >= STRETCH_M:
                del self._parts[0]
        part = self._parts[-1]
        part.run += distance
        part.slipped += distance if slips else 0.0
        # The oldest sample: had it slipped, that would be known by now.
        past, scale = self._past[0], self._known.inertia / 1000.0
        if not slips and seconds(now.stamp_ns - past.stamp_ns) > _SURE_S:
            used = scale * (abs(past.u + past.b) - 2.0 * math.sqrt(past.bb))
            part.used = max(part.used, used)

    @property
    def is_confirmed(self) -> bool:
        """Whether the train has run far enough for wrong units and signs to show."""
        return len(self._parts) > _CONFIRMED

    @property
    def is_slipping(self) -> bool:
        """Whether the axle slips or slides."""
        return self.slide.side != 0.0

    def estimate(self) -> AdhesionEstimate:
        """Return the present estimate."""
        scale, at_least, run, slipped = self._known.inertia / 1000.0, 0.0, 0.0, 0.0
        for part in self._parts:
            at_least, run, slipped = max(at_least, part.used), run + part.run, slipped + part.slipped
        used = slip = 0.0
        if self._past:
            now = self._past[-1]
            used = scale * abs(now.b if self.is_slipping else now.u + now.b)
            # Under traction the axle is faster, while braking slower.
            side = self.slide.side
            slip = side * max(side * (now.speed / max(now.v, _MIN_SPEED) - 1.0), 0.0)
        mean, std = RAIL, RAIL_STD
        if self.is_slipping:
            mean, variance = self._adhesion_of(self._train)
            std = math.sqrt(variance)
        elif slipped > 0.0:
            mean, along = self._found.mean, min(self._found.away_m / STRETCH_M, 1.0)
            std = math.sqrt(self._found.variance + (_SPREADS * mean) * (_SPREADS * mean) * along)
        else:
            mean, std = _above(mean, std, at_least)
        return AdhesionEstimate(
            used=used,
            at_least=at_least,
            adhesion=mean,
            adhesion_std=std,
            slip=slip,
            slipping=self.is_slipping,
            slip_share=slipped / run if run > 0.0 else 0.0,
        )


_NORMAL: Final = NormalDist()


def _above(mean: float, std: float, least: float) -> tuple[float, float]:
    """Return mean and standard deviation of a normal variable that is known to be larger than a number."""
    z = (least - mean) / max(std, 1e-9)
    if z > _FAR:
        return least + std / z, std / z
    rise = _NORMAL.pdf(z) / (1.0 - _NORMAL.cdf(z))
    return mean + std * rise, std * math.sqrt(1.0 + rise * (z - rise))


_FAR: Final = 5.0  # standard deviations beyond which the tail is taken as exponential

# SPDX-License-Identifier: Apache-2.0
"""two-window: streaming form of the trajectory fit of Xia et al. 2023 (section 4.2.3).

The paper refits 20 samples of 100 m, which at its noise gives an error of w(v) of 0.6 N/kN or more. Here a long window
gives the estimate and a short one monitors it: when they differ significantly in w(v) at the current speed, a, b, c
have changed, and rows older than the short window are discarded. Both are linear fits with a prior (:mod:`window`).
Braking, standstill and gaps end a piece; the next one has its own initial speed.

Samples may come at 5 Hz or every 100 m: rows are means of ``stride`` samples, and the time between comes from their
stamps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from trainid_lab.resistance.trajectory.window import (
    Row,
    RowNoise,
    WindowPosterior,
    WindowPrior,
    fit_rows,
    newest_regime,
)
from trainid_ros.estimators.settings import PriorSettings, prior_variances
from trainid_ros.interface.errors import InputError, check_settings, setting
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.interface.state import State, declare, encode, restore, stored
from trainid_ros.resistance.davis_posterior import largest_std
from trainid_ros.stream.known_force import Admission, KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

# Standard deviation of the known force in the speed prediction, in addition to gusts [N/kN].
_PREDICTION: Final = 1.0


@dataclass(frozen=True, slots=True)
class TwoWindowConfig(PriorSettings):
    """Settings of the two windows."""

    stride: int = setting(10, 'samples in a row', 'samples', 1, 100)
    short: int = setting(20, 'rows in the short window', 'rows', 5, 200)
    long: int = setting(150, 'rows in the long window', 'rows', 6, 400)
    switch: float = setting(3.5, 'difference of the windows that counts as a change', 'standard deviations', 1.0, 100.0)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.12, 'unmodelled resistance', 'N/kN', 0.0, 10.0)
    disturbance_time: float = setting(6.0, 'correlation time of the disturbance', 's', 0.01, 600.0)
    force_error: float = setting(0.005, 'relative error of the traction force', '1', 1e-9, 0.5)
    force_skew: float = setting(0.06, 'unknown delay of the reported force', 's', 1e-9, 5.0)
    gate: float = setting(5.0, 'speeds farther from the prediction are rejected', 'standard deviations', 1.0, 100.0)
    patience: float = setting(3.0, 'duration of consecutive rejections after which a piece ends', 's', 0.2, 60.0)
    valid_std: float = setting(0.15, 'resistance is fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)


@dataclass(frozen=True, slots=True)
class PieceState:
    """State of the current piece."""

    speed: float  # Last accepted or predicted speed [m/s]
    rejected_s: float = 0.0  # Time since the last accepted speed [s]
    # Regressors at the last sample: three sums of powers of speed, traction, sum of traction.
    sums: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    impulse: float = 0.0  # Integral of the known force, as speed [m/s]
    # Sums of residual speed and regressors over the samples of the current row.
    row: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    filled: int = 0  # Number of these samples
    speed_min: float = 0.0  # Their slowest speed [m/s]
    speed_max: float = 0.0  # Their fastest speed [m/s]


@dataclass(frozen=True, slots=True)
class TwoWindowState:
    """Saved state of the two windows."""

    posterior: WindowPosterior
    noise: SpeedNoise
    rows: tuple[Row, ...] = stored((), kind=Row)
    motion: PieceState | None = stored(None, kind=PieceState)  # noqa: RUF009 - makes a field
    pieces: int = 0
    row_time: float = 0.0
    braked_ns: int = 0
    switches: int = 0
    innovation: float = 0.0
    innovation_variance: float = 0.0
    test_ratio: float = 0.0
    converged: bool = False


class TwoWindow:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples.

    In its estimates ``innovation`` is the difference of w between the windows at the current speed [N/kN].
    """

    STATE: ClassVar[State] = declare('state', '_admission')

    def __init__(self, train_file: TrainFile, config: TwoWindowConfig) -> None:
        check_settings(config)
        if config.short >= config.long:
            raise InputError(f'short = {config.short} must be less than long = {config.long}')
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis = train_file.resistance
        theta = (davis.a, davis.b, davis.c)
        a, b, c = prior_variances(theta, config)
        variance = (math.sqrt(a), math.sqrt(b), math.sqrt(c))
        self._prior = WindowPrior(theta, (*variance, config.force_skew, config.force_error))
        self._first = WindowPosterior(theta, (a, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c))
        self._density = 2.0 * config.disturbance_time * config.disturbance_std**2
        self.reset()

    def reset(self) -> None:
        """Return to the prior."""
        self.state = TwoWindowState(self._first, SpeedNoise.declared(self.config.speed_std))
        self._admission.braked_ns = 0

    def idle(self, seconds: float) -> None:
        """Do nothing: the method of the paper has no drift."""

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the speeds of the window."""
        return self.state.converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; every ``stride`` good samples give one row and one fit."""
        rejection = self._admission.reject(sample)
        self.state = replace(self.state, braked_ns=self._admission.braked_ns)
        noise = replace(self.state.noise)
        noise.add(sample.speed, math.nan if rejection else sample.dt)
        if rejection is not None:
            self.state = replace(self.state, motion=None, noise=noise)
            return rejection
        motion = self.state.motion
        if motion is None:
            self.state = replace(self.state, motion=PieceState(sample.speed), pieces=self.state.pieces + 1, noise=noise)
            return None
        moved, rejection = self._move(motion, sample)
        if rejection is not None:
            lost = moved.rejected_s > self.config.patience
            self.state = replace(self.state, motion=None if lost else moved)
            return rejection
        self.state = replace(self.state, motion=moved, noise=noise)
        if moved.filled >= self.config.stride:
            self._end_row(moved, sample)
        return None

    def _move(self, motion: PieceState, sample: Sample) -> tuple[PieceState, Rejection | None]:
        """Advance by one stage: predict the speed, reject an outlier, update the sums."""
        inertia, dt, v0 = self._known.inertia, sample.dt, motion.speed
        traction = self._known.traction(sample.force_mean, sample)
        force = traction - self._known.track(sample)
        w, variance = self.state.posterior.resistance(v0)
        elapsed = motion.rejected_s + dt
        predicted_speed = max(0.0, v0 + dt * (force - w) / inertia)
        unknown = variance + _PREDICTION**2 + (self.config.force_error * traction) ** 2
        walk = self._density * elapsed + unknown * elapsed**2
        spread = math.sqrt(2.0 * self.state.noise.variance + walk / inertia**2)
        off = sample.speed - predicted_speed
        rejected = abs(off) > self.config.gate * spread
        v1 = predicted_speed if rejected else sample.speed
        sums = advance(motion.sums, v0, v1, dt / inertia, traction)
        moved = replace(
            motion,
            speed=v1,
            sums=sums,
            impulse=motion.impulse + force * dt / inertia,
            rejected_s=elapsed if rejected else 0.0,
        )
        if rejected:
            return moved, Rejection(sample.stamp_ns, Reason.OUTLIER, off, self.config.gate * spread)
        regressors = (-sums[0], -sums[1], -sums[2], sums[3] / inertia, sums[4])
        row = tuple(map(sum, zip(motion.row, (v1 - moved.impulse, *regressors), strict=True)))
        slow, fast = (v1, v1) if motion.filled == 0 else (motion.speed_min, motion.speed_max)
        filled = motion.filled + 1
        return replace(moved, row=row, filled=filled, speed_min=min(slow, v1), speed_max=max(fast, v1)), None

    def _end_row(self, motion: PieceState, sample: Sample) -> None:
        """Append the full row, fit both windows, and discard old rows if they disagree."""
        config, state = self.config, self.state
        rest, *sums = (total / motion.filled for total in motion.row)
        row = Row(state.pieces, rest, tuple(sums), motion.speed_min, motion.speed_max)
        rows = (*state.rows, row)[-config.long :]
        time = config.stride * sample.dt
        row_time = time if state.row_time == 0.0 else state.row_time + 0.05 * (time - state.row_time)
        emptied = replace(motion, row=(0.0,) * 6, filled=0)
        self.state = state = replace(state, rows=rows, row_time=row_time, motion=emptied)
        noise = self._row_noise()
        posterior = fit_rows(rows, noise, self._prior)
        if len(rows) > config.short:
            recent = fit_rows(rows[-config.short :], noise, self._prior)
            self._compare(posterior, recent, sample.speed)
            if self.state.test_ratio > 1.0:
                posterior = self._switch(noise)
        if all(map(math.isfinite, (*posterior.theta, *posterior.P))):
            self.state = replace(self.state, posterior=posterior)
        self._judge()

    def _switch(self, noise: RowNoise) -> WindowPosterior:
        """Discard all rows before the change of a, b, c, which lies within the short window; return the posterior."""
        rows, short = self.state.rows, self.config.short
        known = fit_rows(rows[:-short], noise, self._prior)
        count, posterior = newest_regime(rows[-short:], noise, self._prior, known)
        self.state = replace(self.state, rows=rows[-count:], switches=self.state.switches + 1)
        return posterior

    def _compare(self, steady: WindowPosterior, recent: WindowPosterior, speed: float) -> None:
        """Test whether the two windows agree on w at a speed."""
        (w, variance), (w_recent, variance_recent) = steady.resistance(speed), recent.resistance(speed)
        # The long window is efficient, so the variance of the difference is the difference of the variances.
        nu, S = w_recent - w, max(variance_recent - variance, 1e-3 * variance_recent)
        ratio = nu * nu / (self.config.switch**2 * S)
        self.state = replace(self.state, innovation=nu, innovation_variance=S, test_ratio=ratio)

    def _row_noise(self) -> RowNoise:
        walk = math.sqrt(self._density * self.state.row_time) / self._known.inertia
        # The declared noise is the lower limit, so that noise after a quiet stretch is not detected as a change.
        std = max(self.config.speed_std, self.state.noise.std)
        return RowNoise(std / math.sqrt(self.config.stride), walk)

    def _judge(self) -> None:
        """Decide whether w is fit to use: rms standard deviation over the speeds of the window; hysteresis of 50 %."""
        slow, fast = self._speeds()
        variances = [self.state.posterior.resistance(v)[1] for v in (slow, 0.5 * (slow + fast), fast)]
        limit = self.config.valid_std * (1.5 if self.state.converged else 1.0)
        self.state = replace(self.state, converged=math.sqrt(float(np.mean(variances))) < limit)

    def _speeds(self) -> tuple[float, float]:
        rows = self.state.rows
        return min((row.speed_min for row in rows), default=0.0), max((row.speed_max for row in rows), default=0.0)

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [N/kN] and its variance before it [(N/kN)^2], as in the estimate."""
        return self.state.innovation, self.state.innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        state = self.state
        (a, b, c), (w, variance), (slow, fast) = (
            state.posterior.theta,
            state.posterior.resistance(speed),
            self._speeds(),
        )
        std = math.sqrt(variance)
        return ResistanceEstimate(
            a=a,
            b=b,
            c=c,
            covariance=state.posterior.P,
            resistance=w,
            resistance_std=std,
            speed=speed,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
            speed_min=slow,
            speed_max=fast,
            resistance_std_max=largest_std(state.posterior.P, (slow, fast), std),
        )


def advance(sums: tuple[float, ...], v0: float, v1: float, mu: float, traction: float) -> tuple[float, ...]:
    """Return the regressors one stage later: sums of mu times the exact means of v^n, traction, sum of mu traction.

    Args:
        sums: Regressors before the stage.
        v0: Speed at the start of the stage [m/s].
        v1: Speed at its end [m/s].
        mu: dt / inertia [m/s per N/kN].
        traction: Specific traction [N/kN].

    """
    return (
        sums[0] + mu,
        sums[1] + mu * 0.5 * (v0 + v1),
        sums[2] + mu * (v0 * v0 + v0 * v1 + v1 * v1) / 3.0,
        traction,
        sums[4] + mu * traction,
    )

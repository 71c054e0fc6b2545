# SPDX-License-Identifier: Apache-2.0
"""Posterior of the Davis parameters: force errors, drift, inflation, the published estimate, and its validity.

With T the reported specific traction [N/kN] and R the curve radius, the true forces are modelled as

    (1 + kappa) T(t + delta)   and   w_curve + kappa_curve 600 m / R.

Force gain and mass share one scale kappa: only their ratio is observable in the motion.

An estimate is valid while w is accurate over the driven speeds, with hysteresis.

Parameters alone can mislead: driven at one speed, w is known there while a, b and c are not. So observability judges
each by the relative reduction of its prior variance, and w by its standard deviation inside and outside the range of
speeds seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

from trainid_ros.interface.results import ResistanceEstimate
from trainid_ros.train.train_file import Train, TrainFile

CURVE_RADIUS: Final = 600.0
"""Radius at which the error of the curve resistance is stated [m]."""
MIN_DELAY: Final = -0.2  # shortest estimable force delay [s]
MAX_DELAY: Final = 0.4
"""Range of estimable force delays [s], limited by the reports available ahead and the range of the cubic."""
MIN_FORCE_STD: Final = 1e-4
"""Smallest prior standard deviation of a force error [1, s, N/kN], so that information is finite."""


def force_variances(train_file: TrainFile, delay_std: float) -> tuple[float, float, float]:
    """Return the prior variances of kappa [1], delta [s^2], kappa_curve [(N/kN)^2]; ``delay_std`` [s] is a setting."""
    train = train_file.train
    stds = math.hypot(train.mass_std, train.force_std), delay_std, curve_std(train_file)
    scale, delay, curve = (max(std, MIN_FORCE_STD) ** 2 for std in stds)
    return scale, delay, curve


def curve_std(train_file: TrainFile) -> float:
    """Return the prior std of the curve resistance at 600 m [N/kN]: as stated, else a fifth; 0.5 without an effect."""
    for effect in train_file.effects:
        if effect.name == 'curve_resistance':
            coefficient = dict(effect.parameters).get('coefficient', 0.0)
            return dict(effect.std).get('coefficient', 0.2 * coefficient) / CURVE_RADIUS
    return 0.5


def length_under_train(length: float, train_length: float) -> float:
    """Return the correlation length of the map error as a train feels it, as its mean over the train [m].

    With the autocorrelation exp(-d / l) along the line, the mean over the train's length L has the variance share
    2 l / L (1 - l / L (1 - exp(-L / l))). Averaging keeps the integral of the autocovariance, so the correlation
    length, integral over variance, becomes l over that share: l for short trains, (l + L) / 2 for long ones.
    """
    x = train_length / length
    # Its limit for short trains: the formula would lose digits.
    return length * (1.0 + x / 3.0) if x < 1e-3 else length * x * x / (2.0 * (x - 1.0 + math.exp(-x)))


def is_delay_at_end(delay: float) -> bool:
    """Return whether a delay [s] is at an end of its range, so that the true one may lie beyond.

    The mean of a mixture never quite reaches the end: 0.01 s before it counts as beyond.
    """
    return abs(delay - MIN_DELAY) < 0.01 or abs(delay - MAX_DELAY) < 0.01


def scale_step(train: Train, *, weighed: bool) -> float:
    """Return the std of the change of kappa at a stop [1]: of the load, 0.4 % of the mass if weighed and 3 % if not.

    The errors of empty train and scales are constant: of the weighed mass at most half of the error changes.
    """
    return min(0.004, 0.5 * train.mass_std) if weighed else 0.03


DavisPosterior = tuple[float, ...]
"""Gaussian estimate: a, b, c, then the upper triangle of their covariance, row by row, in N/kN with v in m/s.

Floats, since arrays of three cost more than the arithmetic.
"""


def drift_growth(share: float) -> float:
    """Return the growth of a variance per second as a share of the prior one [1/s]; ``share`` of its std in an hour."""
    return share**2 / 3600.0


def drift_rates(share: float, prior: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the growth of three variances per second from the prior ones; ``share`` as in :func:`drift_growth`."""
    growth = drift_growth(share)
    a, b, c = prior
    return growth * a, growth * b, growth * c


def drifted(
    estimate: DavisPosterior, rates: tuple[float, float, float], elapsed_s: float, limits: tuple[float, float, float]
) -> DavisPosterior:
    """Return an estimate after a random walk: variances grow by rates per second, up to limits, correlations stay."""
    a, b, c, A, B, C, D, E, F = estimate
    A, D, F = A + rates[0] * elapsed_s, D + rates[1] * elapsed_s, F + rates[2] * elapsed_s
    if limits[0] >= A and limits[1] >= D and limits[2] >= F:
        return a, b, c, A, B, C, D, E, F
    r0, r1, r2 = (min(1.0, math.sqrt(limit / P)) for limit, P in zip(limits, (A, D, F), strict=True))
    return a, b, c, A * r0 * r0, B * r0 * r1, C * r0 * r2, D * r1 * r1, E * r1 * r2, F * r2 * r2


# Driving time of a batch [s], several times the correlation time of gusts.
_BATCH_S: Final = 48.0
# One batch determines a variance only to a factor 1.4, so several are averaged and each ratio is limited.
_INFLATION_MEMORY: Final = 8.0
_MAX_INFLATION: Final = 9.0


@dataclass(slots=True)
class Inflation:
    """Factor on the published covariance for unmodelled errors, and the current batch of innovations.

    The noise of neighbouring observations is correlated (gusts, map errors, overlapping windows). If the predicted
    variances are correct, the expected squared sum of the innovations of a batch longer than the correlation time
    equals the sum of the variances. Any excess is unmodelled error.
    """

    ratio: float = 1.0  # Mean ratio, 1 if the model is consistent
    total: float = 0.0  # Sum of the innovations of the batch, in any unit or normalised by their standard deviations
    variance: float = 0.0  # Sum of their predicted variances, in the square of that unit
    length: float = 0.0  # Driving time of the batch so far [s]

    @property
    def factor(self) -> float:
        """Factor on the covariance of the parameters [1], at least 1."""
        return max(1.0, self.ratio)

    def foreseen(self, duration_s: float) -> float:
        """Return the mean factor after a driving time [s] that the model describes [1]."""
        # The ratio of a batch is chi-square of one degree of freedom: mean 1, variance 2.
        kept = math.exp(-duration_s / (_BATCH_S * _INFLATION_MEMORY))
        excess, variance = (self.ratio - 1.0) * kept, 2.0 / (2.0 * _INFLATION_MEMORY - 1.0) * (1.0 - kept * kept)
        # E max(0, x) of a normal x
        z = excess / math.sqrt(variance)
        above = 0.5 * (1.0 + math.erf(z / math.sqrt(2.0)))
        return 1.0 + excess * above + math.sqrt(variance / (2.0 * math.pi)) * math.exp(-0.5 * z * z)

    def add(self, nu: float, variance: float, dt: float) -> None:
        """Add one innovation times its outlier weight, its variance in the mean of many, and its driving time [s]."""
        self.total += nu
        self.variance += variance
        self.length += dt
        if self.length < _BATCH_S - 0.5 * dt:
            return
        found = min(self.total * self.total / self.variance, _MAX_INFLATION)
        self.ratio += (found - self.ratio) / _INFLATION_MEMORY
        self.total = self.variance = self.length = 0.0


def predict(estimate: DavisPosterior, v: float, s: float) -> tuple[float, float]:
    """Return mean [N/kN] and variance [(N/kN)^2] of a + b v + c s at speed v [m/s] and mean square speed s."""
    a, b, c, A, B, C, D, E, F = estimate
    variance = A + v * (2.0 * (B + E * s) + D * v) + s * (2.0 * C + F * s)
    return a + b * v + c * s, max(variance, 0.0)


def largest_std(covariance: tuple[float, ...], driven: tuple[float, float], present: float) -> float:
    """Return the largest standard deviation of w [N/kN]: ``present``, or that at one of nine driven speeds.

    The covariance of (a, b, c) is 3x3, row-major; ``driven`` are the slowest and fastest speed learned from [m/s].
    """
    A, B, C, _, D, E, _, _, F = covariance
    largest = 0.0
    for k in range(9):
        v = driven[0] + (driven[1] - driven[0]) * k / 8
        largest = max(largest, A + v * (2.0 * B + v * (2.0 * C + D + v * (2.0 * E + v * F))))
    return max(present, math.sqrt(largest))


def resistance_estimate(
    posterior: DavisPosterior,
    speed: float,
    innovation: tuple[float, float, float],
    driven: tuple[float, float],
    force: tuple[float, float, float, float] = (math.nan, math.nan, math.nan, math.nan),
) -> ResistanceEstimate:
    """Return what is published.

    Args:
        posterior: Posterior of a, b, c.
        speed: Present speed [m/s].
        innovation: Innovation of the last update [N/kN], its variance, and its test ratio [1].
        driven: Slowest and fastest speed learned from [m/s].
        force: Scale of the force [1] and its std, delay of the force [s] and its std.
    """
    a, b, c, A, B, C, D, E, F = posterior
    resistance, variance = predict(posterior, speed, speed * speed)
    nu, S, test_ratio = innovation
    scale, scale_std, delay, delay_std = force
    covariance = A, B, C, B, D, E, C, E, F
    return ResistanceEstimate(
        a=a,
        b=b,
        c=c,
        covariance=covariance,
        resistance=resistance,
        resistance_std=math.sqrt(variance),
        speed=speed,
        innovation=nu,
        innovation_variance=S,
        test_ratio=test_ratio,
        speed_min=driven[0],
        speed_max=driven[1],
        resistance_std_max=largest_std(covariance, driven, math.sqrt(variance)),
        force_scale=scale,
        force_scale_std=scale_std,
        force_delay=delay,
        force_delay_std=delay_std,
    )


def representative_speeds(slowest: float, fastest: float) -> tuple[float, float, float]:
    """Return the speeds at which :func:`is_accurate` needs the variance of the resistance [m/s]."""
    return slowest, 0.5 * (slowest + fastest), fastest


def is_accurate(variances: tuple[float, float, float], valid_std: float, *, was_accurate: bool) -> bool:
    """Return whether w is accurate: its std in root mean square over :func:`representative_speeds` is below a limit.

    The variances there are in (N/kN)^2, the limit in N/kN. An estimate that was accurate stays so up to 1.5 times the
    limit, so that the status does not flicker.
    """
    at_slowest, between, at_fastest = variances
    rms = math.sqrt((at_slowest + between + at_fastest) / 3.0)
    return rms < valid_std * (1.5 if was_accurate else 1.0)


@dataclass(slots=True)
class DrivenSpeeds:
    """Moments of all speeds used for estimation."""

    count: int = 0  # Number of speeds
    slowest: float = 0.0  # Slowest speed [m/s], 0 before the first
    fastest: float = 0.0  # Fastest speed [m/s]
    m1: float = 0.0  # Mean of v [m/s]
    m2: float = 0.0  # Mean of v^2 [(m/s)^2]
    m3: float = 0.0  # Mean of v^3 [(m/s)^3]
    m4: float = 0.0  # Mean of v^4 [(m/s)^4]

    def add(self, v: float) -> None:
        """Add one speed [m/s]."""
        self.add_mean(v, v, v)

    def add_mean(self, v: float, slowest: float, fastest: float) -> None:
        """Add the mean of speeds from slowest to fastest [m/s]."""
        self.slowest = min(self.slowest, slowest) if self.count else slowest
        self.fastest = max(self.fastest, fastest)
        self.count += 1
        square = v * v
        share = 1.0 / self.count
        self.m1 += share * (v - self.m1)
        self.m2 += share * (square - self.m2)
        self.m3 += share * (square * v - self.m3)
        self.m4 += share * (square * square - self.m4)


def is_accurate_over_driven_speeds(
    posterior: DavisPosterior, driven: DrivenSpeeds, valid_std: float, valid_share: float, *, was_accurate: bool
) -> bool:
    """Return whether w is accurate: its std in root mean square over the driven speeds is below a limit.

    Each speed counts as often as it was driven. The limit is in N/kN and as a share of the resistance [1], added in
    squares; an estimate that was accurate stays so up to twice the limit.
    """
    if not driven.count:
        return False
    a, b, c, A, B, C, D, E, F = posterior
    m1, m2, m3, m4 = driven.m1, driven.m2, driven.m3, driven.m4
    # Means of phi' P phi and of w^2 = (phi' theta)^2 with phi = (1, v, v^2).
    variance = A + 2.0 * B * m1 + (2.0 * C + D) * m2 + 2.0 * E * m3 + F * m4
    square = a * a + 2.0 * a * b * m1 + (2.0 * a * c + b * b) * m2 + 2.0 * b * c * m3 + c * c * m4
    limit = valid_std * valid_std + valid_share * valid_share * square
    return variance < limit * (4.0 if was_accurate else 1.0)


def is_accurate_at(speed: float, posterior: DavisPosterior, valid_std: float, valid_share: float) -> bool:
    """Return whether w is accurate at one speed [m/s]; limits as for driven speeds."""
    w, variance = predict(posterior, speed, speed * speed)
    return variance < valid_std * valid_std + valid_share * valid_share * w * w


# Multiple of the limit up to which an estimate is fit to use while a step is suspected, and up to which it stays so.
_SUSPECTED: Final = 2.0
_STILL_SUSPECTED: Final = 3.0


def is_fit_to_use(
    settled: DavisPosterior,
    stated: DavisPosterior,
    driven: DrivenSpeeds,
    speed: float,
    limits: tuple[float, float],
    *,
    was_fit: bool,
) -> bool:
    """Return whether w is accurate over the driven speeds, and at the present one even if a step just happened.

    Args:
        settled: The posterior without a step that the data do not show yet.
        stated: The posterior with it.
        driven: Speeds learned from.
        speed: Present speed [m/s].
        limits: Largest standard deviation [N/kN], and as a share of the resistance [1].
        was_fit: Whether it was fit to use before.
    """
    suspected = _STILL_SUSPECTED if was_fit else _SUSPECTED
    return is_accurate_over_driven_speeds(settled, driven, *limits, was_accurate=was_fit) and is_accurate_at(
        speed, stated, suspected * limits[0], suspected * limits[1]
    )


SEEN_SHARE: Final = 0.5
"""Relative reduction of the prior variance from which a parameter counts as seen [1]."""
# A parameter shows where its standard deviation changes w by this many standard deviations of w at the speeds seen, and
# w counts as known where its own is at most this many times that [1].
_NOTICEABLE: Final = 2.0
REACH_M_S: Final = 25.0
"""Fastest speed at which w is judged by default [m/s]."""


@dataclass(frozen=True, slots=True)
class Observability:
    """How well the data determine w(v)."""

    # Relative reductions of the prior variances of a, b, c [1], from 0 (nothing learned) to 1
    shares: tuple[float, float, float]
    std_observed: float  # Largest std of w over the speeds seen [N/kN]; NaN if there are none
    std_outside: float  # Largest std of w over all other speeds up to the reach [N/kN]
    # Range of speeds around those seen where w is known nearly as well [m/s]; NaN if there are none
    known: tuple[float, float]
    text: str  # Summary as text


def resistance_std(covariance: Sequence[float], speed: float) -> float:
    """Return the standard deviation of w [N/kN] at a speed [m/s]; ``covariance`` is 3x3, row-major."""
    phi = (1.0, speed, speed * speed)
    # Not sum(), whose rounding depends on the version of Python.
    return math.sqrt(max(0.0, math.fsum(phi[i] * phi[j] * covariance[3 * i + j] for i in range(3) for j in range(3))))


def observe(
    covariance: Sequence[float],
    prior_covariance: Sequence[float],
    speed_min: float,
    speed_max: float,
    reach: float = REACH_M_S,
) -> Observability:
    """Judge how well a, b, c and w(v) are determined.

    Args:
        covariance: Present covariance of a, b, c, 3x3, row-major.
        prior_covariance: Covariance before the first sample, likewise.
        speed_min: Slowest speed learned from [m/s].
        speed_max: Fastest speed learned from [m/s]; 0 if nothing was learned.
        reach: Fastest speed at which w is needed [m/s].
    """
    pairs = ((covariance[k], prior_covariance[k]) for k in (0, 4, 8))
    a, b, c = (min(1.0, max(0.0, 1.0 - now / prior)) if prior > 0.0 else 0.0 for now, prior in pairs)
    if not speed_max > 0.0:
        nothing = 'nothing seen yet: estimates are the prior'
        return Observability((0.0, 0.0, 0.0), math.nan, math.nan, (math.nan, math.nan), nothing)
    top = max(reach, speed_max)
    speeds = [0.5 * k for k in range(int(2.0 * top) + 1)]
    seen = [speed_min, *(v for v in speeds if speed_min < v < speed_max), speed_max]
    std_observed = max(resistance_std(covariance, v) for v in seen)
    outside = [v for v in (*speeds, top) if not speed_min <= v <= speed_max]
    std_outside = max((resistance_std(covariance, v) for v in outside), default=0.0)
    limit = _NOTICEABLE * std_observed
    slower, faster = [v for v in reversed(speeds) if v < speed_min], [v for v in speeds if v > speed_max]
    known = _last_known(covariance, [speed_min, *slower], limit), _last_known(covariance, [speed_max, *faster], limit)
    text = _summary((a, b, c), covariance, std_observed, (speed_min, speed_max, top))
    return Observability((a, b, c), std_observed, std_outside, known, text)


def _last_known(covariance: Sequence[float], speeds: Sequence[float], limit: float) -> float:
    """Return the last of the speeds up to which the standard deviation of w stays within a limit; the first always."""
    return [speeds[0], *takewhile(lambda v: resistance_std(covariance, v) <= limit, speeds[1:])][-1]


def _summary(
    shares: Sequence[float], covariance: Sequence[float], std_observed: float, speeds: tuple[float, float, float]
) -> str:
    slowest, fastest, top = speeds
    seen = [name for name, share in zip('abc', shares, strict=True) if share >= SEEN_SHARE]
    parts = [f'{_listed(seen)} seen'] if seen else []
    confounded = []
    for power, name in enumerate('abc'):
        if name in seen:
            continue
        # From this speed on the parameter's uncertainty would show against that of w at the speeds seen.
        std = math.sqrt(max(covariance[4 * power], 0.0))
        shows = (_NOTICEABLE * std_observed / std) ** (1.0 / power) if power and std > 0.0 else 0.0
        if shows > top:
            parts.append(f'{name} not seen up to {top:.0f} m/s')
        elif shows > fastest:
            parts.append(f'{name} not seen below {shows:.0f} m/s')
        else:
            confounded.append(name)
    if confounded:
        parts.append(f'{_listed(confounded)} not distinguishable from the others')
    return f'{", ".join(parts)}: speeds seen {slowest:.1f} to {fastest:.1f} m/s'


def _listed(names: Sequence[str]) -> str:
    return ' and '.join((', '.join(names[:-1]), names[-1])) if len(names) > 1 else names[0]

# SPDX-License-Identifier: Apache-2.0
"""How large the unmodelled acceleration b is, learned from a train that runs with its brake released.

Maps are wrong by 0.05 per mille or by 2, and the deviation of the brake rate stands and falls with it. While no
brake acts, speed shows b: one Kalman filter on [v, b] runs for each of some deviations of b, and the innovations
tell how likely each is. The mean variance over them is what is believed, wide while little is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.state_validation import is_covariance

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Transition

# Deviations that are held possible, as multiples of what is declared: a factor 1.42 apart.
_RANGE: Final = (0.3, 10.0)
_LEVELS: Final = 11
_FACTORS: Final = tuple(_RANGE[0] * (_RANGE[1] / _RANGE[0]) ** (k / (_LEVELS - 1)) for k in range(_LEVELS))
# What is declared is believed to a factor of this, one standard deviation of the logarithm.
_TRUST: Final = 2.5
_PRIOR: Final = tuple(-0.5 * (math.log(factor) / math.log(_TRUST)) ** 2 for factor in _FACTORS)
# What was seen counts less and less over this distance [m].
_MEMORY_M: Final = 5_000.0
# An innovation beyond this many deviations tells no more than one of this size: slip is no disturbance.
_MOST: Final = 3.0

# Means of v and b, then the covariance vv, vb, bb.
Motion = tuple[float, float, float, float, float]
_SIZE: Final = 5


@dataclass(frozen=True, slots=True)
class DisturbanceNoise:
    """What is believed of the deviation of b.

    Attributes:
        declared_std: Deviation as declared [m/s^2]; 0: nothing is learned.
        variance: Mean variance of b [(m/s^2)^2].
        evidence: Log-likelihood of each deviation, the largest 0.
        motions: State of the filter of each deviation; none while the brake acts or the train stands.

    """

    declared_std: float
    variance: float
    evidence: tuple[float, ...]
    motions: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def declared(cls, std: float) -> DisturbanceNoise:
        """Return the deviation as declared [m/s^2], nothing learned yet."""
        evidence = (0.0,) * _LEVELS
        return cls(std, mean_variance(std, evidence), evidence)

    @classmethod
    def reported(cls, std: float) -> DisturbanceNoise:
        """Return a deviation that is known [m/s^2], and not learned."""
        return cls(0.0, std * std, (0.0,) * _LEVELS)

    @property
    def std(self) -> float:
        """Deviation of b [m/s^2]."""
        return math.sqrt(self.variance)

    @property
    def is_valid(self) -> bool:
        """True if all is finite, of the right size and no variance negative, as it may not be when restored."""
        numbers = (self.declared_std, self.variance, *self.evidence, *(x for item in self.motions for x in item))
        sized = len(self.evidence) == _LEVELS and len(self.motions) in {0, _LEVELS}
        followed = all(len(item) == _SIZE and is_covariance(item[2:]) for item in self.motions)
        positive = self.variance >= 0.0 and self.declared_std >= 0.0
        return sized and all(map(math.isfinite, numbers)) and followed and positive

    def paused(self) -> DisturbanceNoise:
        """Return the same at a train that brakes or stands."""
        if not self.motions:
            return self
        return DisturbanceNoise(self.declared_std, self.variance, self.evidence)

    def add(self, interval: Transition, speed: float, r: float) -> DisturbanceNoise:
        """Return what is believed after a speed with variance r of a freely running train."""
        if self.declared_std <= 0.0:
            return self
        variances = tuple((factor * self.declared_std) ** 2 for factor in _FACTORS)
        if not self.motions:
            motions: tuple[tuple[float, ...], ...] = tuple((speed, 0.0, r, 0.0, variance) for variance in variances)
            return DisturbanceNoise(self.declared_std, self.variance, self.evidence, motions)
        kept = math.exp(-speed * interval.dt / _MEMORY_M)
        evidence, moved = [], []
        for before, (v, b, vv, vb, bb), variance in zip(self.evidence, self.motions, variances, strict=True):
            after, likelihood = advance((v, b, vv, vb, bb), interval, variance, speed, r)
            moved.append(after)
            evidence.append(kept * before + likelihood)
        best = max(evidence)
        relative = tuple(item - best for item in evidence)
        return DisturbanceNoise(self.declared_std, mean_variance(self.declared_std, relative), relative, tuple(moved))


def advance(motion: Motion, interval: Transition, variance: float, speed: float, r: float) -> tuple[Motion, float]:
    """Follow v' = v + dt b + known, b' = rho b over an interval, and take in a speed.

    Args:
        motion: Mean and covariance before.
        interval: What moves the train; no brake.
        variance: Stationary variance of b.
        speed: Measured speed.
        r: Its variance.

    Returns:
        Mean and covariance after, and the log-likelihood of the speed.

    """
    v, b, vv, vb, bb = motion
    dt, rho = interval.dt, interval.rho
    S = vv + dt * (2.0 * vb + dt * bb) + interval.q_v + r
    vb = rho * (vb + dt * bb)
    bb = rho * rho * bb + (1.0 - rho * rho) * variance
    ahead = v + dt * b + interval.known
    most = _MOST * math.sqrt(S)
    nu = min(max(speed - ahead, -most), most)
    k, kept = nu / S, r / S
    after = (ahead + (S - r) * k, rho * b + vb * k, (S - r) * kept, vb * kept, bb - vb * vb / S)
    return after, -0.5 * (nu * k + math.log(S))


def mean_variance(std: float, evidence: tuple[float, ...]) -> float:
    """Return the mean variance of b over all deviations, from what is declared and the evidence."""
    logs = [a + b for a, b in zip(evidence, _PRIOR, strict=True)]
    best = max(logs)
    weights = [math.exp(item - best) for item in logs]
    mean = math.fsum(w * f * f for w, f in zip(weights, _FACTORS, strict=True)) / math.fsum(weights)
    return std * std * mean

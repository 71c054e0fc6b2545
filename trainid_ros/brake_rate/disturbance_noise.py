# SPDX-License-Identifier: Apache-2.0
"""Size of the unmodelled acceleration b, estimated while the train runs with its brake released.

Errors of gradient maps range from 0.05 to 2 per mille, and the uncertainty of the brake rate depends directly on them.
While no brake acts, the speed shows b: a bank of Kalman filters on [v, b], one for each candidate standard deviation
of b, gives their likelihoods through the innovations. The estimate is the posterior mean of the variance, which stays
large while there is little data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.state import is_covariance

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Transition

# Candidate standard deviations, as multiples of the configured one: a factor of 1.42 apart.
_RANGE: Final = (0.3, 10.0)
_LEVELS: Final = 11
_FACTORS: Final = tuple(_RANGE[0] * (_RANGE[1] / _RANGE[0]) ** (k / (_LEVELS - 1)) for k in range(_LEVELS))
# Prior of the configured value: log-normal, one standard deviation is this factor.
_PRIOR_FACTOR: Final = 2.5
_PRIOR: Final = tuple(-0.5 * (math.log(factor) / math.log(_PRIOR_FACTOR)) ** 2 for factor in _FACTORS)
# The evidence is forgotten exponentially over this distance [m].
_MEMORY_M: Final = 5_000.0
# Innovations are clipped at this many standard deviations: slip is not a disturbance.
_MOST: Final = 3.0

# Means of v and b, then the covariance vv, vb, bb.
Motion = tuple[float, float, float, float, float]
_SIZE: Final = 5


@dataclass(frozen=True, slots=True)
class DisturbanceNoise:
    """Posterior of the standard deviation of b.

    Attributes:
        declared_std: Configured standard deviation [m/s^2]; 0: no estimation.
        variance: Mean variance of b [(m/s^2)^2].
        evidence: Log-likelihood of each candidate; the largest is 0.
        motions: State of the filter of each candidate; empty while the brake acts or the train stands.

    """

    declared_std: float
    variance: float
    evidence: tuple[float, ...]
    motions: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def declared(cls, std: float) -> DisturbanceNoise:
        """Return the prior for a configured standard deviation [m/s^2]."""
        evidence = (0.0,) * _LEVELS
        return cls(std, mean_variance(std, evidence), evidence)

    @classmethod
    def reported(cls, std: float) -> DisturbanceNoise:
        """Return a known standard deviation [m/s^2], which is not estimated."""
        return cls(0.0, std * std, (0.0,) * _LEVELS)

    @property
    def std(self) -> float:
        """Standard deviation of b [m/s^2]."""
        return math.sqrt(self.variance)

    @property
    def is_valid(self) -> bool:
        """Whether a restored state is finite, of the right size and without negative variances."""
        numbers = (self.declared_std, self.variance, *self.evidence, *(x for item in self.motions for x in item))
        sized = len(self.evidence) == _LEVELS and len(self.motions) in {0, _LEVELS}
        valid_motions = all(len(item) == _SIZE and is_covariance(item[2:]) for item in self.motions)
        positive = self.variance >= 0.0 and self.declared_std >= 0.0
        return sized and all(map(math.isfinite, numbers)) and valid_motions and positive

    def paused(self) -> DisturbanceNoise:
        """Return the state without filters, for a train that brakes or stands."""
        if not self.motions:
            return self
        return DisturbanceNoise(self.declared_std, self.variance, self.evidence)

    def add(self, interval: Transition, speed: float, r: float) -> DisturbanceNoise:
        """Update with a measured speed [m/s] of variance r [(m/s)^2] while no brake acts."""
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
    """Predict v' = v + dt b + known, b' = rho b over an interval, and update with a measured speed.

    Args:
        motion: Mean and covariance before.
        interval: Motion model without a brake.
        variance: Stationary variance of b [(m/s^2)^2].
        speed: Measured speed [m/s].
        r: Its variance [(m/s)^2].

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
    """Return the posterior mean of the variance of b [(m/s^2)^2]; ``std`` is the configured value [m/s^2]."""
    logs = [a + b for a, b in zip(evidence, _PRIOR, strict=True)]
    best = max(logs)
    weights = [math.exp(item - best) for item in logs]
    mean = math.fsum(w * f * f for w, f in zip(weights, _FACTORS, strict=True)) / math.fsum(weights)
    return std * std * mean

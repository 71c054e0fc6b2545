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

from trainid_ros.state import is_covariance, several

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Transition

# Candidate standard deviations, as multiples of the configured one: a factor of 1.42 apart.
_LOW: Final = 0.3
_HIGH: Final = 10.0
_LEVELS: Final = 11
# Prior of the configured value: log-normal, one standard deviation is this factor.
_PRIOR_FACTOR: Final = 2.5
# The evidence is forgotten exponentially over this distance [m].
_MEMORY_M: Final = 5_000.0
# Innovations are clipped at this many standard deviations: slip is not a disturbance.
_MOST: Final = 3.0


@dataclass
class Candidate:
    """A standard deviation of b with its Kalman filter on [v, b].

    Attributes:
        factor: Standard deviation of b, as a multiple of the configured one [1].
        prior: Logarithm of its prior probability.
        evidence: Its log-likelihood; the largest of all is 0.
        v: Speed [m/s].
        b: Disturbance [m/s^2].
        vv: Variance of v [(m/s)^2].
        vb: Covariance of v and b.
        bb: Variance of b [(m/s^2)^2].

    """

    factor: float
    prior: float
    evidence: float = 0.0
    v: float = 0.0
    b: float = 0.0
    vv: float = 0.0
    vb: float = 0.0
    bb: float = 0.0

    def start(self, variance: float, speed: float, r: float) -> None:
        """Start from a measured speed [m/s] of variance r [(m/s)^2]; ``variance`` is that of b [(m/s^2)^2]."""
        self.v, self.b, self.vv, self.vb, self.bb = speed, 0.0, r, 0.0, variance

    def advance(self, interval: Transition, known: float, variance: float, speed: float, r: float) -> float:
        """Predict v' = v + dt b + known, b' = rho b over an interval, and update with a measured speed.

        Args:
            interval: Motion model without a brake.
            known: Gain of speed by all known forces [m/s].
            variance: Stationary variance of b [(m/s^2)^2].
            speed: Measured speed [m/s].
            r: Its variance [(m/s)^2].

        Returns:
            The log-likelihood of the speed.

        """
        dt, rho = interval.dt, interval.rho
        S = self.vv + dt * (2.0 * self.vb + dt * self.bb) + interval.q_v + r
        vb = rho * (self.vb + dt * self.bb)
        bb = rho * rho * self.bb + (1.0 - rho * rho) * variance
        ahead = self.v + dt * self.b + known
        most = _MOST * math.sqrt(S)
        nu = min(max(speed - ahead, -most), most)
        k, kept = nu / S, r / S
        self.v, self.b = ahead + (S - r) * k, rho * self.b + vb * k
        self.vv, self.vb, self.bb = (S - r) * kept, vb * kept, bb - vb * vb / S
        return -0.5 * (nu * k + math.log(S))

    @property
    def is_valid(self) -> bool:
        """Whether a restored state is finite and its covariance possible."""
        numbers = (self.factor, self.prior, self.evidence, self.v, self.b)
        return all(map(math.isfinite, numbers)) and is_covariance((self.vv, self.vb, self.bb))


@dataclass
class DisturbanceNoise:
    """Posterior of the standard deviation of b.

    Attributes:
        declared_std: Configured standard deviation [m/s^2]; 0: no estimation.
        variance: Mean variance of b [(m/s^2)^2].
        candidates: The possible standard deviations.
        running: Whether their filters run; not while the brake acts or the train stands.

    """

    declared_std: float
    variance: float
    candidates: tuple[Candidate, ...] = several(Candidate)
    running: bool = False

    @classmethod
    def declared(cls, std: float) -> DisturbanceNoise:
        """Return the prior for a configured standard deviation [m/s^2]."""
        noise = DisturbanceNoise(std, 0.0, _candidates())
        noise.variance = noise.mean_variance()
        return noise

    @classmethod
    def reported(cls, std: float) -> DisturbanceNoise:
        """Return a known standard deviation [m/s^2], which is not estimated."""
        return DisturbanceNoise(0.0, std * std, _candidates())

    @property
    def std(self) -> float:
        """Standard deviation of b [m/s^2]."""
        return math.sqrt(self.variance)

    @property
    def is_valid(self) -> bool:
        """Whether a restored state is finite, of the right size and without negative variances."""
        valid = len(self.candidates) == _LEVELS and all(item.is_valid for item in self.candidates)
        return valid and 0.0 <= self.variance < math.inf and 0.0 <= self.declared_std < math.inf

    def pause(self) -> None:
        """Stop the filters, for a train that brakes or stands."""
        self.running = False

    def add(self, interval: Transition, known: float, speed: float, r: float) -> None:
        """Update while no brake acts, see :meth:`Candidate.advance`."""
        std = self.declared_std
        if std <= 0.0:
            return
        if not self.running:
            for item in self.candidates:
                item.start((item.factor * std) * (item.factor * std), speed, r)
            self.running = True
            return
        kept, best = math.exp(-speed * interval.dt / _MEMORY_M), -math.inf
        for item in self.candidates:
            variance = (item.factor * std) * (item.factor * std)
            item.evidence = kept * item.evidence + item.advance(interval, known, variance, speed, r)
            best = max(best, item.evidence)
        for item in self.candidates:
            item.evidence -= best
        self.variance = self.mean_variance()

    def mean_variance(self) -> float:
        """Return the posterior mean of the variance of b [(m/s^2)^2]."""
        best, total, mean = -math.inf, 0.0, 0.0
        for item in self.candidates:
            best = max(best, item.evidence + item.prior)
        for item in self.candidates:
            weight = math.exp(item.evidence + item.prior - best)
            total += weight
            mean += weight * item.factor * item.factor
        return self.declared_std * self.declared_std * (mean / total)


def _candidates() -> tuple[Candidate, ...]:
    factors = [_LOW * (_HIGH / _LOW) ** (k / (_LEVELS - 1)) for k in range(_LEVELS)]
    return tuple(Candidate(f, -0.5 * (math.log(f) / math.log(_PRIOR_FACTOR)) ** 2) for f in factors)

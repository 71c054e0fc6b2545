# SPDX-License-Identifier: Apache-2.0
"""Changes of the speed that the balance of forces, as it was until now, does not explain.

Where no brake acts, y = o + R x with the traction x; recursive least squares follow the offset o, by which map and
resistance are off, and the gain R, by which mass and force are. What they leave of the acceleration is summed up, with
forgetting, to the change of the speed that is not explained. It stays within a few standard deviations of what it was
before, whatever the train; beyond that something has changed, in the train or in one of the inputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# Standard deviations of offset [N/kN] and gain [1] at the start, and of the gain after a stop where the load was
# weighed [1]: passengers change.
_OFFSET_STD: Final = 1.0
_GAIN_STD: Final = 0.1
_WEIGHED_STD: Final = 0.01
# Random walk of the offset [(N/kN)^2 per block]: it follows the line within some minutes.
_OFFSET_WALK: Final = 1e-3
# Errors of y besides the noise of the speed: of map and gusts [N/kN], and as a share of x [1].
_ERROR: Final = 1.0
_ERROR_SHARE: Final = 0.03
# A residual counts for at most this many standard deviations [1].
_CLIP: Final = 3.0
# Memory of the sum [s], and of its smoothing, which leaves out the noise of a single speed [blocks].
_MEMORY_S: Final = 8.0
_SMOOTH: Final = 3.0
# Mean square of the sum at the start [(m/s)^2], memory [blocks], blocks before anything is suspected.
_SQUARE: Final = 2.5e-3
_SQUARE_BLOCKS: Final = 20.0
_SQUARE_MEMORY: Final = 300.0
_LEAST: Final = 60.0
# Standard deviations that are hardly ever exceeded [1], least limit [m/s], share of it below which it is over [1].
_SIGMAS: Final = 5.0
_LEAST_LIMIT: Final = 0.04
_OVER: Final = 0.5
# Time in motion after which a change is no fault but the train as it is now [s]; its limit may then be higher [1].
_LONGEST_S: Final = 60.0
_GROWTH: Final = 1.5
# A change that is proportional to the traction is no change of the resistance: least change of the gain [1], and of the
# force in root mean square [N/kN], standard deviations of it [1], time in motion that shows it [s].
_GAIN: Final = 0.1
_FORCE: Final = 5.0
_GAIN_SIGMAS: Final = 5.0
_NAMED_S: Final = 4.0
# Ratios to the gain before that say something [1].
_LEAST_RATIO: Final = 0.1
_MOST_RATIO: Final = 10.0


@dataclass(slots=True)
class ChangeCheck:
    """Change of the speed that is not explained.

    Attributes:
        finding: What is wrong, empty if nothing is.
        offset: Offset o [N/kN].
        gain: Gain R [1].
        offset_variance: Variance of o [(N/kN)^2].
        covariance: Covariance of both [N/kN].
        gain_variance: Variance of R [1].
        scatter: Mean square of the residuals [(N/kN)^2].
        count: Number of blocks learned from.
        total: Change of the speed that is not explained, with forgetting [m/s].
        change: The same, smoothed [m/s].
        square: Its mean square while nothing is suspected [(m/s)^2].
        peak: Largest change since something is suspected [m/s].
        suspected_s: Time in motion since then [s].
        is_suspected: True while something has changed.
        residual_x: Sum of residual times traction since then [(N/kN)^2].
        xx: Sum of the squared traction since then [(N/kN)^2].
        blocks: Number of blocks since then.

    """

    finding: str = ''
    offset: float = 0.0
    gain: float = 1.0
    offset_variance: float = _OFFSET_STD * _OFFSET_STD
    covariance: float = 0.0
    gain_variance: float = _GAIN_STD * _GAIN_STD
    scatter: float = 0.0
    count: float = 0.0
    total: float = 0.0
    change: float = 0.0
    square: float = _SQUARE
    peak: float = 0.0
    suspected_s: float = 0.0
    is_suspected: bool = False
    residual_x: float = 0.0
    xx: float = 0.0
    blocks: float = 0.0

    @property
    def is_valid(self) -> bool:
        """True if the covariance is positive semidefinite, but for rounding."""
        return self.covariance * self.covariance <= (1.0 + 1e-9) * self.offset_variance * self.gain_variance

    @property
    def has_returned(self) -> bool:
        """True if the last suspicion ended because all was as before, not because it lasted."""
        return self.suspected_s <= _LONGEST_S

    @property
    def ratio(self) -> float:
        """Gain since something is suspected, relative to that before [1]."""
        return 1.0 + self.residual_x / (self.gain * self.xx) if self.gain * self.xx > 0.0 else 1.0

    @property
    def limit(self) -> float:
        """Change that is hardly ever exceeded [m/s]."""
        return max(_SIGMAS * math.sqrt(self.square), _LEAST_LIMIT)

    def stand(self, *, weighed: bool) -> None:
        """Take note of a stop, where the mass changes."""
        std = _WEIGHED_STD if weighed else _GAIN_STD
        self.gain_variance = max(self.gain_variance, std * std)

    def add(self, y: float, x: float, inertia: float, speed_std: float, seconds: float, *, off: bool) -> None:
        """Add a block where no brake acts.

        Args:
            y: Its acceleration, gradient and resistance [N/kN].
            x: Its traction [N/kN].
            inertia: Specific force per acceleration [N/kN per m/s^2].
            speed_std: Standard deviation of the noise of the speed [m/s].
            seconds: Its length [s].
            off: Whether it must not be learned from.

        """
        error = _ERROR_SHARE * x
        noise = inertia * speed_std / seconds
        variance = 2.0 * noise * noise + _ERROR * _ERROR + error * error
        offset_gain = self.offset_variance + self.covariance * x
        gain_gain = self.covariance + self.gain_variance * x
        innovation_variance = variance + offset_gain + gain_gain * x
        residual = y - self.offset - self.gain * x
        # The part of the residual that offset and gain, as far as they are known, do not take.
        left = residual * variance / innovation_variance
        self.total = self.total * math.exp(-seconds / _MEMORY_S) + left * seconds / inertia
        self.change += (self.total - self.change) / _SMOOTH
        if self.count >= _LEAST:
            self._judge(seconds)
        if off:
            return
        if self.is_suspected:
            self._name(residual, x)
        else:
            self._learn(residual, innovation_variance, offset_gain, gain_gain)

    def _learn(self, residual: float, innovation_variance: float, offset_gain: float, gain_gain: float) -> None:
        """Learn offset and gain from a residual and its covariance with both, and what is usual."""
        most = _CLIP * math.sqrt(innovation_variance)
        residual = min(max(residual, -most), most)
        step = residual / innovation_variance
        self.offset += offset_gain * step
        self.gain += gain_gain * step
        self.offset_variance += _OFFSET_WALK - offset_gain * offset_gain / innovation_variance
        self.covariance -= offset_gain * gain_gain / innovation_variance
        self.gain_variance -= gain_gain * gain_gain / innovation_variance
        if self.offset_variance > _OFFSET_STD * _OFFSET_STD:  # limited with its correlation unchanged
            self.covariance *= _OFFSET_STD / math.sqrt(self.offset_variance)
            self.offset_variance = _OFFSET_STD * _OFFSET_STD
        square = min(self.change * self.change, _CLIP * _CLIP * self.square)
        share = 1.0 / min(_SQUARE_BLOCKS + self.count, _SQUARE_MEMORY)
        self.square += share * (square - self.square)
        self.scatter += share * (residual * residual - self.scatter)
        self.count += 1.0

    def _judge(self, seconds: float) -> None:
        """Begin or end a suspicion."""
        size, limit = abs(self.change), self.limit
        if not self.is_suspected:
            self.is_suspected, self.peak = size > limit, size
            if self.is_suspected:
                self.suspected_s = self.residual_x = self.xx = self.blocks = 0.0
            return
        self.peak = max(self.peak, size)
        self.suspected_s += seconds
        is_over = size < _OVER * limit
        lasts = self.suspected_s > _LONGEST_S and not self.finding
        if is_over or lasts:
            self.is_suspected, self.finding = False, ''
            usual = self.peak / _SIGMAS
            self.square = min(max(self.square, usual * usual), _GROWTH * _GROWTH * self.square)
        if lasts:
            self.total = self.change = self.covariance = 0.0
            self.offset_variance, self.gain_variance = _OFFSET_STD * _OFFSET_STD, _GAIN_STD * _GAIN_STD

    def _name(self, residual: float, x: float) -> None:
        """Name a change of the gain by residual and traction of a block [N/kN]."""
        self.residual_x += residual * x
        self.xx += x * x
        self.blocks += 1.0
        if self.suspected_s < _NAMED_S or self.xx == 0.0:
            return
        change = abs(self.residual_x) / self.xx
        certain = change > max(_GAIN * self.gain, _GAIN_SIGMAS * math.sqrt(self.scatter / self.xx))
        if certain and change * change * self.xx > _FORCE * _FORCE * self.blocks:
            times = f'follows ato/force {self.ratio:.2g} times as much as before'
            plain = _LEAST_RATIO < self.ratio < _MOST_RATIO
            self.finding = f'the speed suddenly {times if plain else "does not follow ato/force any more"}'

# SPDX-License-Identifier: Apache-2.0
"""Changes of the speed that the balance of forces, as it was until now, does not explain.

Where no brake acts, y = o + R x with the traction x; recursive least squares follow the offset o, by which map and
resistance are off, and the gain R, by which mass and force are. What they leave of the acceleration is summed up, with
forgetting, to the change of the speed that is not explained. It stays within a few standard deviations of what it was
before, whatever the train; beyond that something has changed, in the train or in one of the inputs.

Further checks: the residual of the balance, sudden and on average; the gradient of the topic against the line of the
train file; and steps of the acceleration against those of the traction, of which one may be late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# Standard deviation of the offset at the start [N/kN].
_OFFSET_STD: Final = 1.0
# Standard deviation of the gain at the start, and after a stop where passengers change [1].
_GAIN_STD: Final = 0.1
# Standard deviation of the gain after a stop where the load was weighed [1].
_WEIGHED_STD: Final = 0.01
# Random walk of the offset [(N/kN)^2 per block]: it follows the line within some minutes.
_OFFSET_WALK: Final = 1e-3
# Error of y by map and gusts, besides the noise of the speed [N/kN].
_CHANGE_ERROR: Final = 1.0
# Error of y that grows with the traction, as a share of it [1].
_ERROR_SHARE: Final = 0.03
# A residual counts for at most this many standard deviations [1].
_CLIP: Final = 3.0
# Memory of the unexplained change of the speed [s].
_MEMORY_S: Final = 8.0
# Memory of its smoothing, which leaves out the noise of a single speed [blocks].
_SMOOTH: Final = 3.0
# Mean square of the change at the start [(m/s)^2].
_SQUARE: Final = 2.5e-3
# Number of blocks for which that counts.
_SQUARE_BLOCKS: Final = 20.0
# Memory of the mean square [blocks].
_SQUARE_MEMORY: Final = 300.0
# Number of blocks before anything is suspected.
_MIN_COUNT: Final = 60.0
# A larger change than this many standard deviations is suspected [1].
_SIGMAS: Final = 5.0
# Smallest limit of the change [m/s].
_MIN_LIMIT: Final = 0.04
# Share of the limit below which a suspected change is over [1].
_CHANGE_OVER: Final = 0.5
# Time in motion after which a change is no fault but the train as it is now [s].
_MAX_SUSPECTED_S: Final = 60.0
# Largest factor by which the limit grows with each suspicion [1].
_GROWTH: Final = 1.5
# A change that is proportional to the traction is named. Smallest change of the gain, as a share of it [1].
_GAIN: Final = 0.1
# Smallest change of the force, in root mean square [N/kN].
_FORCE: Final = 5.0
# Smallest change of the gain, in standard deviations [1].
_GAIN_SIGMAS: Final = 5.0
# Shortest time in motion since the suspicion began [s].
_NAMED_S: Final = 4.0
# Range of the ratio to the gain before that the text states [1]; outside, the speed does not follow the force.
_MIN_RATIO: Final = 0.1
_MAX_RATIO: Final = 10.0


@dataclass(slots=True)
class ChangeCheck:
    """Change of the speed that is not explained."""

    finding: str = ''  # What is wrong, empty if nothing is
    offset: float = 0.0  # Offset o [N/kN]
    gain: float = 1.0  # Gain R [1]
    offset_variance: float = _OFFSET_STD * _OFFSET_STD  # Variance of o [(N/kN)^2]
    covariance: float = 0.0  # Covariance of both [N/kN]
    gain_variance: float = _GAIN_STD * _GAIN_STD  # Variance of R [1]
    scatter: float = 0.0  # Mean square of the residuals [(N/kN)^2]
    count: float = 0.0  # Number of blocks learned from
    total: float = 0.0  # Change of the speed that is not explained, with forgetting [m/s]
    change: float = 0.0  # The same, smoothed [m/s]
    square: float = _SQUARE  # Its mean square while nothing is suspected [(m/s)^2]
    peak: float = 0.0  # Largest change since something is suspected [m/s]
    suspected_s: float = 0.0  # Time in motion since then [s]
    is_suspected: bool = False  # True while something has changed
    residual_x: float = 0.0  # Sum of residual times traction since then [(N/kN)^2]
    xx: float = 0.0  # Sum of the squared traction since then [(N/kN)^2]
    blocks: float = 0.0  # Number of blocks since then

    @property
    def was_false_alarm(self) -> bool:
        """True if the last suspected change was a false alarm: it ended before it was confirmed."""
        return self.suspected_s <= _MAX_SUSPECTED_S

    @property
    def ratio(self) -> float:
        """Gain since something is suspected, relative to that before [1]."""
        return 1.0 + self.residual_x / (self.gain * self.xx) if self.gain * self.xx > 0.0 else 1.0

    @property
    def limit(self) -> float:
        """Limit of normal changes [m/s]."""
        return max(_SIGMAS * math.sqrt(self.square), _MIN_LIMIT)

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
        variance = 2.0 * noise * noise + _CHANGE_ERROR * _CHANGE_ERROR + error * error
        offset_gain = self.offset_variance + self.covariance * x
        gain_gain = self.covariance + self.gain_variance * x
        innovation_variance = variance + offset_gain + gain_gain * x
        residual = y - self.offset - self.gain * x
        # The part of the residual that offset and gain, as far as they are known, do not take.
        left = residual * variance / innovation_variance
        self.total = self.total * math.exp(-seconds / _MEMORY_S) + left * seconds / inertia
        self.change += (self.total - self.change) / _SMOOTH
        if self.count >= _MIN_COUNT:
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
        is_over = size < _CHANGE_OVER * limit
        lasts = self.suspected_s > _MAX_SUSPECTED_S and not self.finding
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
            plain = _MIN_RATIO < self.ratio < _MAX_RATIO
            self.finding = f'the speed suddenly {times if plain else "does not follow ato/force any more"}'


# Memory of sudden residuals [blocks].
SUDDEN_MEMORY: Final = 4.0
# Their limit at the start [N/kN].
_FIRST_LIMIT: Final = 10.0
# Largest mean residual over a longer time without resistance [N/kN].
_MEAN: Final = 6.0
# Share of the resistance added to it [1].
_MEAN_SHARE: Final = 1.0
# Memory of that mean [blocks].
_MEMORY: Final = 60.0
# Share of its limit beyond which the mean is suspected [1].
_SUSPECTED: Final = 0.5
# The force drifts when the mean is farther from the offset, which follows more slowly, than map, wind and tunnels
# explain: this distance [N/kN],
_DRIFT: Final = 2.0
# plus this share of the resistance [1];
_DRIFT_SHARE: Final = 0.16
# where the map is worse, its standard deviations instead of the distance [1].
_MAP_SIGMAS: Final = 2.5
# Share of that limit within which a drift is over [1].
_OVER: Final = 0.8
# Share of it that the offset must have moved for the drift to count as followed by the offset [1].
_FOLLOWED: Final = 0.5


@dataclass(slots=True)
class BalanceCheck:
    """Residuals y - x of the balance of forces [N/kN]."""

    finding: str = ''  # What is wrong, empty if nothing is
    residual: float = 0.0  # Mean of the last residuals
    limit: float = _FIRST_LIMIT  # Mean of the largest ones that a resistance explains
    mean: float = 0.0  # Mean residual where no brake acts, over a longer time
    resistance: float = 0.0  # Mean of w(v) over the same time
    drift: float = 0.0  # Mean residual less the offset that has been learned
    is_drifting: bool = False  # True while that is more than map, wind and tunnels explain
    has_stayed: bool = False  # True if the last drift ended because the offset has followed
    before: float = 0.0  # Offset when it began

    @property
    def is_sudden(self) -> bool:
        """True if the last residuals are larger than any resistance."""
        return abs(self.residual) > self.limit

    @property
    def is_suspected(self) -> bool:
        """True while no resistance plausibly explains the last residuals, or their mean."""
        return self.is_sudden or self.is_drifting or abs(self.mean) > _SUSPECTED * self.mean_limit

    @property
    def mean_limit(self) -> float:
        """Largest mean residual over a longer time [N/kN]."""
        return _MEAN + _MEAN_SHARE * self.resistance

    def add(self, residual: float, limit: float) -> None:
        """Add the residual of a block and the largest one that a resistance explains [N/kN]."""
        self.residual += (residual - self.residual) / SUDDEN_MEMORY
        self.limit += (limit - self.limit) / SUDDEN_MEMORY

    def contradict(self) -> None:
        """Take note of a sudden contradiction of another kind."""
        self.residual = 2.0 * self.limit

    def decay(self, keep: float) -> None:
        """Forget sudden residuals but for a share [1] of them, while nothing can be compared."""
        self.residual *= keep

    def add_released(
        self, residual: float, offset: float, resistance: float, map_std: float, *, named: bool = True
    ) -> None:
        """Add a block where no brake acts.

        Args:
            residual: Its residual by the gain that has been learned [N/kN].
            offset: The offset that has been learned [N/kN].
            resistance: w(v) [N/kN].
            map_std: Standard deviation of the gradients of the map [per mille].
            named: Whether a mean that is too large is named already, as no error that grows with the traction.
        """
        self.mean += (residual - self.mean) / _MEMORY
        self.resistance += (resistance - self.resistance) / _MEMORY
        self._follow_drift(offset, map_std)
        if abs(self.mean) > self.mean_limit:
            if not (named or self.finding):
                return
            self.finding = f'forces do not balance by {-self.mean:+.0f} N/kN: ato/force or ato/gradient is off'
        elif abs(self.mean) < _SUSPECTED * self.mean_limit:
            self.finding = ''

    def _follow_drift(self, offset: float, map_std: float) -> None:
        """Begin or end a drift away from the offset that has been learned [N/kN]."""
        self.drift = self.mean - offset
        limit = max(_DRIFT, _MAP_SIGMAS * map_std) + _DRIFT_SHARE * self.resistance
        if not self.is_drifting:
            self.is_drifting = abs(self.drift) > limit
            self.before = offset
        elif abs(self.drift) < _OVER * limit:
            self.is_drifting, self.has_stayed = False, abs(offset - self.before) > _FOLLOWED * limit


# Error of the gradient that the topic may have against the line [per mille].
_ERROR: Final = 0.3
# Multiple of the stated std of the line added to it for the mean error [1].
_STDS: Final = 2.5
# Memory of the errors [blocks].
_LINE_MEMORY: Final = 300.0
# Share of the mean square of the line's gradient that the squared error may have [1]: it is 1 if they are unrelated.
_SHARE: Final = 0.6
# Multiple of the limit of the mean that the error may have as well, where the position is off [1].
_SCATTER: Final = 3.0
# Memory of the mean over a short time [blocks].
_SHORT: Final = 4.0
# Multiple of its usual distance from the long mean, added to the error above and the stated std, beyond which the
# gradient is suddenly off [1].
_SUDDEN_SIGMAS: Final = 3.0
# Largest deviation that is learned [per mille].
_LEARNED: Final = 0.1
# Multiple of the usual deviation added to it [1].
_LEARNED_SIGMAS: Final = 3.0
# Number of blocks that are suddenly off, less those since that are not, before that is suspected.
_SUSPECTED_BLOCKS: Final = 2
# The same before it is a finding.
_SUDDEN_BLOCKS: Final = 12
# Weight of blocks in a row that agree before a finding is over.
_MENDED: Final = 20.0
# The line is flat below this multiple of the limit [1]: signs and units do not show there.
_FLAT: Final = 6.0
# Weight of a block there; 1 elsewhere.
_FLAT_WEIGHT: Final = 0.25


@dataclass(slots=True)
class LineCheck:
    """Error of the gradient of the topic against that of the line nearby [per mille]."""

    finding: str = ''  # What is wrong, empty if nothing is
    count: float = 0.0  # Number of gradients compared, with forgetting
    offset: float = 0.0  # Mean error
    square: float = 0.0  # Mean square error
    steepness: float = 0.0  # Mean square of the gradient of the line
    lately: float = 0.0  # Mean error over a short time
    spread: float = 0.0  # Mean square of its distance from the mean error
    off: int = 0  # Number of blocks that are suddenly off, less those since that are not
    mended: float = 0.0  # Number of blocks in a row that agree, by their weight
    value: float = 0.0  # Error that was judged last
    limit: float = _ERROR  # Its limit

    @property
    def is_suspected(self) -> bool:
        """True while the gradient is suddenly off."""
        return self.off >= _SUSPECTED_BLOCKS

    def add(self, gradient: float, expected: float, least: float, most: float, std: float) -> None:
        """Add the gradient of a block [per mille].

        Args:
            gradient: That of the topic.
            expected: That of the line.
            least: Lowest one of the line nearby, as the position may be off.
            most: Highest one nearby.
            std: Stated std of the line.
        """
        error = gradient - min(max(gradient, least), most)
        self.lately += (error - self.lately) / _SHORT
        usual, known = math.sqrt(self.spread), self.count >= _MIN_COUNT
        sudden, limit = self.lately - self.offset, _ERROR + std + _SUDDEN_SIGMAS * usual
        is_sudden = known and abs(sudden) > limit
        self.off = min(self.off + 1, _SUDDEN_BLOCKS) if is_sudden else max(self.off - 1, 0)
        if not is_sudden:
            self._learn(error, sudden, expected, known=known)
            self._judge(expected, _ERROR + _STDS * std)
            return
        self.mended = 0.0
        if self.off == _SUDDEN_BLOCKS:
            self.value, self.limit = sudden, limit
            self.finding = f'ato/gradient is suddenly {sudden:+.1f} per mille off the line'

    def _learn(self, error: float, sudden: float, expected: float, *, known: bool) -> None:
        if known:  # what is sudden is not yet usual
            most = _LEARNED + _LEARNED_SIGMAS * math.sqrt(max(self.square - self.offset * self.offset, 0.0))
            error = min(max(error, self.offset - most), self.offset + most)
            sudden = min(abs(sudden), _LEARNED + _LEARNED_SIGMAS * math.sqrt(self.spread))
        self.count += 1.0 - self.count / _LINE_MEMORY
        share = 1.0 / self.count
        self.offset += share * (error - self.offset)
        self.square += share * (error * error - self.square)
        self.spread += share * (sudden * sudden - self.spread)
        self.steepness += share * (expected * expected - self.steepness)

    def _judge(self, expected: float, limit: float) -> None:
        """Judge the errors over a long time by the limit of their mean [per mille]."""
        most = math.sqrt(_SHARE * self.steepness + (_SCATTER * limit) ** 2)
        if self.count >= _MIN_COUNT and abs(self.offset) > limit:
            self.value, self.limit = self.offset, limit
            self.finding = f'ato/gradient is about {self.offset:+.1f} per mille off the line of the train file'
        elif self.count >= _MIN_COUNT and self.square > most * most:
            self.value, self.limit = math.sqrt(self.square), most
            self.finding = 'ato/gradient does not follow the line of the train file'
        elif self.finding:
            weight = 1.0 if abs(expected) > _FLAT * limit else _FLAT_WEIGHT
            self.mended += weight
            self.finding = '' if self.mended >= _MENDED else self.finding
            return
        self.mended = 0.0


# Largest shift that is tried, either way [blocks].
_MAX_SHIFT: Final = 6
_SHIFTS: Final = 2 * _MAX_SHIFT + 1
# Smallest step of the traction that counts [N/kN].
_EDGE: Final = 6.0
# Smallest sum of their squares that shows a shift [(N/kN)^2].
_EDGES: Final = 2000.0
# Share of the sums kept from block to block [1].
_SHIFT_KEPT: Final = 0.998
# Standard deviations by which a shift must stand out from chance [1].
_SHIFT_KNOWN: Final = 5.0
# Standard deviations by which it must stand out from no shift [1].
_SHIFT_BETTER: Final = 3.0


@dataclass(slots=True)
class ShiftCheck:
    """Steps of the acceleration against earlier and later steps of the traction: which of them is late."""

    finding: str = ''  # What is wrong, empty if nothing is
    delay: float = 0.0  # How much later the acceleration is than the traction by it [s]
    edges: float = 0.0  # Sum of squared steps of the traction [(N/kN)^2]
    jerks: float = 0.0  # Sum of squared steps of the acceleration, as a specific force [(N/kN)^2]
    count: float = 0.0  # Number of steps, with forgetting
    # Sums of products of both, the acceleration -6 to 6 blocks later [(N/kN)^2]
    products: tuple[float, ...] = (0.0,) * _SHIFTS
    recent: tuple[float, ...] = ()  # Acceleration and traction of the last blocks, in turn, oldest first [N/kN]

    @property
    def is_suspected(self) -> bool:
        """True where a delay was found before the check began anew, and no steps have contradicted it since."""
        return self.delay != 0.0 and self.finding == ''

    def interrupt(self) -> None:
        """Start a new run of blocks."""
        self.recent = ()

    def add(self, y: float, x: float, block_s: float) -> None:
        """Add the next block: acceleration y and traction x [N/kN], and its length [s]."""
        run = (*self.recent, y, x)[-2 * (_MAX_SHIFT + 2) :]
        self.recent = run
        if len(run) < 2 * (_MAX_SHIFT + 2):
            return
        dy, dx = run[-2] - run[-4], run[-1] - run[-3]
        edge = abs(dx) > _EDGE
        products = [_SHIFT_KEPT * product for product in self.products]
        for k in range(_MAX_SHIFT + 1):
            end = len(run) - 2 * k
            earlier_dy, earlier_dx = run[end - 2] - run[end - 4], run[end - 1] - run[end - 3]
            if abs(earlier_dx) > _EDGE:
                products[_MAX_SHIFT + k] += dy * earlier_dx
            if k and edge:
                products[_MAX_SHIFT - k] += earlier_dy * dx
        self.products = tuple(products)
        self.edges = _SHIFT_KEPT * self.edges + (dx * dx if edge else 0.0)
        self.jerks = _SHIFT_KEPT * self.jerks + dy * dy
        self.count = _SHIFT_KEPT * self.count + 1.0
        if self.edges >= _EDGES:
            self._judge(block_s)

    def _judge(self, block_s: float) -> None:
        chance = math.sqrt(self.jerks / self.count * self.edges)
        best = 0
        for k in range(_SHIFTS):
            if self.products[k] > self.products[best]:
                best = k
        if self.products[best] < max(_SHIFT_KNOWN * chance, 0.5 * self.edges):
            return
        if self.products[best] - self.products[_MAX_SHIFT] < _SHIFT_BETTER * chance:
            self.finding, self.delay = '', 0.0
            return
        self.delay = (best - _MAX_SHIFT) * block_s
        later, sooner = ('ato/speed', 'ato/force') if best > _MAX_SHIFT else ('ato/force', 'ato/speed')
        self.finding = f'{later} is about {abs(self.delay):.1f} s late, or {sooner} early'

# SPDX-License-Identifier: Apache-2.0
"""Gradient of the topic against the line of the train file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# Error of the gradient that the topic may have against the line [per mille], and multiple of its stated std added.
_ERROR: Final = 0.3
_STDS: Final = 2.5
# Memory [blocks]; number of blocks before anything is found.
_MEMORY: Final = 300.0
_LEAST: Final = 60.0
# Share of the mean square of the line's gradient that the error may have [1]: it is 1 if they are unrelated. Multiple
# of the limit that the error may have besides where the position is off [1].
_SHARE: Final = 0.6
_SCATTER: Final = 3.0
# Memory of the mean over a short time [blocks]. Its distance from that over a long time hardly exceeds the error above
# with the stated std and this multiple of its own rms, which knows how long errors of the map last.
_SHORT: Final = 4.0
_SUDDEN_SIGMAS: Final = 3.0
# Largest errors that are learned [per mille], with this multiple of the usual ones added.
_LEARNED: Final = 0.1
_LEARNED_SIGMAS: Final = 3.0
# Number of blocks that are suddenly off, less those since that are not, before that is suspected, and found.
_SUSPECTED_BLOCKS: Final = 2
_SUDDEN_BLOCKS: Final = 12
# Blocks that agree before a finding is over; on a flat line they count less, since signs and units do not show there.
_MENDED: Final = 20.0
_FLAT: Final = 6.0
_FLAT_WEIGHT: Final = 0.25


@dataclass(slots=True)
class LineCheck:
    """Error of the gradient of the topic against that of the line nearby [per mille].

    Attributes:
        finding: What is wrong, empty if nothing is.
        count: Number of gradients compared, with forgetting.
        offset: Mean error.
        square: Mean square error.
        steepness: Mean square of the gradient of the line.
        lately: Mean error over a short time.
        spread: Mean square of its distance from the mean error.
        off: Number of blocks that are suddenly off, less those since that are not.
        mended: Number of blocks in a row that agree, by their weight.
        value: Error that was judged last.
        limit: Its limit.

    """

    finding: str = ''
    count: float = 0.0
    offset: float = 0.0
    square: float = 0.0
    steepness: float = 0.0
    lately: float = 0.0
    spread: float = 0.0
    off: int = 0
    mended: float = 0.0
    value: float = 0.0
    limit: float = _ERROR

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
        usual, known = math.sqrt(self.spread), self.count >= _LEAST
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
        self.count += 1.0 - self.count / _MEMORY
        share = 1.0 / self.count
        self.offset += share * (error - self.offset)
        self.square += share * (error * error - self.square)
        self.spread += share * (sudden * sudden - self.spread)
        self.steepness += share * (expected * expected - self.steepness)

    def _judge(self, expected: float, limit: float) -> None:
        """Judge the errors over a long time by the limit of their mean [per mille]."""
        most = math.sqrt(_SHARE * self.steepness + (_SCATTER * limit) ** 2)
        if self.count >= _LEAST and abs(self.offset) > limit:
            self.value, self.limit = self.offset, limit
            self.finding = f'ato/gradient is about {self.offset:+.1f} per mille off the line of the train file'
        elif self.count >= _LEAST and self.square > most * most:
            self.value, self.limit = math.sqrt(self.square), most
            self.finding = 'ato/gradient does not follow the line of the train file'
        elif self.finding:
            weight = 1.0 if abs(expected) > _FLAT * limit else _FLAT_WEIGHT
            self.mended += weight
            self.finding = '' if self.mended >= _MENDED else self.finding
            return
        self.mended = 0.0

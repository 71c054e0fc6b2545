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
# Memory of sudden errors [blocks]; they exceed this [per mille] and this multiple of the usual deviation.
_SHORT: Final = 4.0
_SUDDEN: Final = 0.8
_SUDDEN_SIGMAS: Final = 8.0
# Largest deviation that is learned [per mille], with this multiple of the usual one added.
_LEARNED: Final = 0.1
_LEARNED_SIGMAS: Final = 3.0
# Number of blocks in a row that are suddenly off before that is found.
_SUDDEN_BLOCKS: Final = 6
# Blocks that agree before a finding is over; on a flat line they count less, since signs and units do not show there.
_MENDED: Final = 20.0
_FLAT: Final = 6.0
_FLAT_WEIGHT: Final = 0.25


@dataclass(slots=True)
class LineCheck:
    """Error of the gradient of the topic against that of the line [per mille].

    Attributes:
        finding: What is wrong, empty if nothing is.
        count: Number of gradients compared, with forgetting.
        mean: Mean error.
        offset: Mean error against the line nearby.
        square: Mean square error.
        scatter: Mean square error against the line nearby.
        steepness: Mean square of the gradient of the line.
        lately: Mean error against the line nearby over a short time.
        off: Number of blocks in a row that are suddenly off.
        mended: Number of blocks in a row that agree, by their weight.
        limit: Largest error of the last block.

    """

    finding: str = ''
    count: float = 0.0
    mean: float = 0.0
    offset: float = 0.0
    square: float = 0.0
    scatter: float = 0.0
    steepness: float = 0.0
    lately: float = 0.0
    off: int = 0
    mended: float = 0.0
    limit: float = _ERROR

    @property
    def is_suspected(self) -> bool:
        """True while the gradient is suddenly off."""
        return self.off > 0

    def add(self, gradient: float, expected: float, least: float, most: float, std: float) -> None:
        """Add the gradient of a block [per mille].

        Args:
            gradient: That of the topic.
            expected: That of the line.
            least: Lowest one of the line nearby, as the position may be off.
            most: Highest one nearby.
            std: Stated std of the line.

        """
        error, nearby = gradient - expected, gradient - min(max(gradient, least), most)
        self.lately += (nearby - self.lately) / _SHORT
        self.limit = _ERROR + _STDS * std
        deviation = math.sqrt(max(self.square - self.mean * self.mean, 0.0))
        sudden = _SUDDEN + _SUDDEN_SIGMAS * deviation
        is_sudden = self.count >= _LEAST and abs(self.lately) > sudden + abs(self.offset)
        self.off = self.off + 1 if is_sudden else 0
        if self.count >= _LEAST:  # what is sudden is not yet usual
            usual = _LEARNED + _LEARNED_SIGMAS * deviation
            error = min(max(error, self.mean - usual), self.mean + usual)
            nearby = min(max(nearby, self.offset - usual), self.offset + usual)
        if not is_sudden:
            self._learn(error, nearby, expected)
        self._judge(expected)

    def _learn(self, error: float, nearby: float, expected: float) -> None:
        self.count += 1.0 - self.count / _MEMORY
        share = 1.0 / self.count
        self.mean += share * (error - self.mean)
        self.offset += share * (nearby - self.offset)
        self.square += share * (error * error - self.square)
        self.scatter += share * (nearby * nearby - self.scatter)
        self.steepness += share * (expected * expected - self.steepness)

    def _judge(self, expected: float) -> None:
        if self.off >= _SUDDEN_BLOCKS:
            self.finding = f'ato/gradient is suddenly {self.lately:+.1f} per mille off the line'
        elif self.count >= _LEAST and abs(self.offset) > self.limit:
            self.finding = f'ato/gradient is about {self.mean:+.1f} per mille off the line of the train file'
        elif self.count >= _LEAST and self.scatter > _SHARE * self.steepness + (_SCATTER * self.limit) ** 2:
            self.finding = 'ato/gradient does not follow the line of the train file'
        elif self.finding:
            weight = 1.0 if abs(expected) > _FLAT * self.limit else _FLAT_WEIGHT
            self.mended = 0.0 if self.off else self.mended + weight
            self.finding = '' if self.mended >= _MENDED else self.finding
            return
        self.mended = 0.0

# SPDX-License-Identifier: Apache-2.0
"""When the inputs of a replay contradicted each other."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(slots=True)
class Contradiction:
    """The last time that inputs contradicted each other, in time covered by the samples."""

    finding: str = ''  # What contradicted what, empty if nothing ever did
    begin_s: float = math.nan  # When it began [s], NaN if it never did
    end_s: float = math.nan  # When it ended [s], NaN while it lasts

    def follow(self, finding: str, now_s: float) -> None:
        """Take in what contradicts what after a sample, '' if nothing does; a new contradiction replaces the last."""
        lasts = self.finding != '' and math.isnan(self.end_s)
        if finding and not lasts:
            self.begin_s, self.end_s = now_s, math.nan
        elif lasts and not finding:
            self.end_s = now_s
        self.finding = finding or self.finding

    @property
    def text(self) -> str:
        """What contradicted what, and when."""
        if math.isnan(self.end_s):
            return f'inputs contradict each other since {self.begin_s:.1f} s: {self.finding}'
        return f'inputs contradicted each other from {self.begin_s:.1f} to {self.end_s:.1f} s: {self.finding}'

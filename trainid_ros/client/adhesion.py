# SPDX-License-Identifier: Apache-2.0
"""The adhesion as the client knows it, and the braking force that it leaves after a slide.

A slide says that the rail transmits no more, here and probably ahead. While one is less than a kilometre away, no
bound relies on more than the adhesion then estimated, at its lower quantile.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

from trainid_ros.client.live_estimate import USABLE, WORDS
from trainid_ros.interface.results import Status
from trainid_ros.stream.adhesion import RAIL, RAIL_STD

if TYPE_CHECKING:
    from trainid_ros.interface.results import AdhesionEstimate


class LiveAdhesion:
    """The newest adhesion; not used any more after ``max_age_s`` [s] without a new one, but for its limit."""

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s, self._heard_s, self._newest_ns = max_age_s, -math.inf, -1
        self._estimate: AdhesionEstimate | None = None
        self._status, self._problem = Status.UNINITIALIZED, 'no estimate yet'
        self._is_slide = False  # Whether the last slip was one under braking

    def take_new(self, status: Status, estimate: Any, time_s: float, stamp_ns: int) -> None:
        """Take in an estimate that arrived at a time [s]."""
        numbers = (estimate.adhesion, estimate.adhesion_std, estimate.slip, estimate.slip_share)
        if not (all(map(math.isfinite, numbers)) and estimate.adhesion > 0.0 and estimate.adhesion_std >= 0.0):
            self.refuse('its numbers are not possible', time_s)
            return
        if stamp_ns == self._newest_ns and status in USABLE:
            return
        self._estimate, self._status, self._heard_s, self._newest_ns = estimate, status, time_s, stamp_ns
        self._problem = '' if status in USABLE else WORDS[status]
        if estimate.slip != 0.0:
            self._is_slide = estimate.slip < 0.0

    def refuse(self, reason: str, _time_s: float) -> None:
        """Use what rails are like although an estimate has arrived, for a reason."""
        self._problem = reason

    mark_lost = refuse

    def go_on(self, time_s: float) -> None:
        """Advance to a time [s]."""
        if not self._problem and time_s > self._heard_s + self._max_age_s:
            self._problem = f'no new estimate for more than {self._max_age_s:g} s'

    def value(self) -> tuple[float, float, bool, str]:
        """Return the adhesion, its standard deviation [1], whether it is live, and the reason."""
        if self._problem or self._estimate is None:
            return RAIL, RAIL_STD, False, f'dry to wet rail: {self._problem}'
        return self._estimate.adhesion, self._estimate.adhesion_std, True, self._status.name

    def limit(self, confidence: float) -> tuple[float, str]:
        """Return the most braking force over weight [1] at a confidence, and why; infinite where no slide was.

        The adhesion is log-normal. Without new estimates the last limit stays: nothing says that it is over.
        """
        found = self._estimate
        if found is None or not self._is_slide or not (found.slipping or found.slip_share > 0.0):
            return math.inf, ''
        share = found.adhesion_std / found.adhesion
        least = found.adhesion * math.exp(-NormalDist().inv_cdf(confidence) * share)
        return least, f'braking limited to an adhesion of {least:.3f} by a slide'

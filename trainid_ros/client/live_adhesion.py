# SPDX-License-Identifier: Apache-2.0
"""The adhesion of the nodes: whether it may be used now, and the limit that a slide sets to the brake.

A slide says that the rail transmits no more, here and probably ahead. While one is less than a kilometre away, no bound
relies on more than the adhesion then estimated, at its lower quantile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.client.live_estimate import ABSURD, FAR, LEAST_STD, ROUNDING, WORDS, Stamps
from trainid_ros.interface.results import Status
from trainid_ros.stream.adhesion import RAIL, RAIL_STD

if TYPE_CHECKING:
    from trainid_ros.interface.results import AdhesionEstimate


@dataclass(frozen=True, slots=True)
class Rail:
    """Adhesion between wheel and rail, log-normal with this median."""

    adhesion: float  # [1]
    std: float  # Its standard deviation [1]

    @property
    def share(self) -> float:
        """Standard deviation of the logarithm of the adhesion [1], at most 1."""
        return min(self.std / self.adhesion, 1.0)

    def least(self, confidence: float) -> float:
        """Return the adhesion that there is at least at a confidence [1]."""
        return self.adhesion * math.exp(-NormalDist().inv_cdf(confidence) * self.share)


class LiveAdhesion:
    """The newest adhesion; not used any more after ``max_age_s`` [s] without a new one, but for its limit.

    The limit is the lowest adhesion of the slides of the last km: of a slide that goes on the newest, of one that is
    over the last. Only an estimate that may be used ends it. Slip under traction is no limit, since not all axles are
    driven; slip of which the beginning was not heard may have been a slide.
    """

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s, self._heard_s, self._stamps = max_age_s, -math.inf, Stamps(max_age_s)
        self._rail = Rail(RAIL, RAIL_STD)
        self._slide: Rail | None = None  # Of the slide that goes on
        self._past: Rail | None = None  # Of the slides before it
        self._is_traction = False  # Whether the last slip was one under traction
        self._is_unheard = True  # Whether slip may have begun unheard
        self._status, self._problem = Status.UNINITIALIZED, 'no estimate yet'

    def take_new(self, status: Status, estimate: Any, time_s: float, stamp_ns: int) -> None:
        """Take in an estimate that arrived at a time [s]."""
        self.go_on(time_s)
        if problem := _doubt(estimate):
            self.refuse(problem, time_s)
            return
        is_newer, slides = self._stamps.are_newer(stamp_ns), _is_slide(estimate)
        if status.is_usable and not is_newer and not (slides and self.limit() is None):
            return
        rail = Rail(float(estimate.adhesion), max(float(estimate.adhesion_std), LEAST_STD * RAIL_STD))
        slipping, has_slipped = estimate.slipping, estimate.slipping or estimate.slip_share > 0.0
        self._follow(rail, status, slides=slides, slipping=slipping, has_slipped=has_slipped)
        if status.is_usable:
            self._rail = rail
            self._past = self._past if has_slipped else None
        self._status, self._heard_s, self._problem = status, time_s, '' if status.is_usable else WORDS[status]
        self._is_traction = has_slipped and not slides and (slipping or self._is_traction)
        self._is_unheard = False

    def _follow(self, rail: Rail, status: Status, *, slides: bool, slipping: bool, has_slipped: bool) -> None:
        """Follow the slide that goes on, and those before it."""
        if slides:
            if self._is_unheard:  # After silence or a refusal it is another one
                self._past, self._slide = self.limit(), None
            self._slide = rail if status.is_usable else _worst(self._slide, rail)
        elif self._slide is not None:  # It is over, and its adhesion known best now
            is_known = status.is_usable and not self._is_unheard and not slipping
            self._past, self._slide = _worst(self._past, rail if is_known else self._slide), None
        elif has_slipped:
            is_that = status.is_usable and self._past is not None and not (slipping or self._is_traction)
            self._past = _worst(self._past, rail) if is_that or self._is_unheard else self._past

    def refuse(self, reason: str, _time_s: float) -> None:
        """Use what rails are like although an estimate has arrived, for a reason."""
        self._problem, self._is_unheard = reason, True

    mark_lost = refuse

    def go_on(self, time_s: float) -> None:
        """Advance to a time [s]."""
        if not self._is_unheard and time_s > self._heard_s + self._max_age_s:
            self.refuse(f'no new estimate for more than {self._max_age_s:g} s', time_s)

    def value(self) -> tuple[float, float, bool, str]:
        """Return the adhesion, its standard deviation [1], whether it is live, and the reason."""
        if self._problem:
            return RAIL, RAIL_STD, False, f'dry to wet rail: {self._problem}'
        return self._rail.adhesion, self._rail.std, True, self._status.name

    def limit(self) -> Rail | None:
        """Return the adhesion that limits the brake, None where no slide was.

        Without new estimates the last limit stays: nothing says that it is over.
        """
        return _worst(self._past, self._slide)


def _worst(*rails: Rail | None) -> Rail | None:
    """Return the rail with the least adhesion at 95 %."""
    return min((rail for rail in rails if rail is not None), key=lambda rail: rail.least(0.95), default=None)


def _is_slide(estimate: AdhesionEstimate) -> bool:
    """Return whether wheels slide; while the axle has come back, only the sign of a slip of zero says so."""
    return estimate.slip < 0.0 or (estimate.slipping and math.copysign(1.0, estimate.slip) < 0.0)


_LEAST_ADHESION: Final = 1e-3
"""Less is not possible [1]: leaves and oil leave .02."""


def _doubt(rail: AdhesionEstimate) -> str:
    """Return what is not possible or not credible of an adhesion; empty if it is."""
    numbers: tuple[object, ...] = (rail.adhesion, rail.adhesion_std, rail.slip, rail.slip_share)
    are_possible = all(isinstance(x, (float, int, np.floating)) and -ABSURD < x < ABSURD for x in numbers)
    if not are_possible or not (rail.adhesion >= _LEAST_ADHESION and 0.0 <= rail.adhesion_std <= FAR * RAIL_STD):
        return 'its numbers are not possible'
    if rail.slip < -1.0 - ROUNDING or not 0.0 <= rail.slip_share <= 1.0 + ROUNDING:
        return 'its slip is not possible'
    if rail.adhesion > RAIL + FAR * RAIL_STD:
        return f'adhesion = {rail.adhesion:g} is more than any rail has'
    return ''

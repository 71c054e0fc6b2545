# SPDX-License-Identifier: Apache-2.0
"""One estimate of the nodes: whether it may be used now, and its values, which move gradually.

A VALID or HOLDING estimate may be used until the next one is due. When a VALID estimate becomes CONVERGING, its last
valid values are kept, but their uncertainty is raised at once to that of the train file; they are given up when the
present estimate refutes them. Otherwise the train file applies: at most ``FALL_BACK_S`` after the reason for it, such
as a status, silence, or the end of the node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.client.gradual import ABSURD, Gradual, Normal
from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Mapping

FALL_BACK_S: Final = 0.2
"""Time in which values go back to those of the train file [s]."""
MAX_AGE_S: Final = 0.75
"""Time without a new estimate after which the last one is not used any more [s]."""
USABLE: Final = frozenset({Status.VALID, Status.HOLDING})
_WORDS: Final = {
    Status.UNINITIALIZED: 'UNINITIALIZED, the node has no sample yet',
    Status.CONVERGING: 'CONVERGING, not fit to use',
    Status.STALE: 'STALE, inputs of the node are missing',
    Status.FAULT: 'FAULT, the node has failed',
}
SUSPECTED: Final = 'CONVERGING, the last valid value as uncertain as that of the train file'
REFUTED: Final = 'CONVERGING, the present estimate refutes the last valid value'
NOT_YET: Final = 'no estimate yet'
GONE: Final = 'its node is gone'
# A way to the live value that takes longer is said, until it takes less than FALL_BACK_S [s].
_LONG_WAY_S: Final = 1.0
# A value this many standard deviations of the present estimate away from it is refuted.
_REFUTES: Final = 3.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameters that are estimated together.

    Attributes:
        file: Their distribution by the train file.
        probes: Directions in which their moves are measured.
        least: Least value of a parameter, and of a weighted sum along a probe, that is possible.
        most: Largest one.
        most_std: Largest standard deviation along a probe that is possible.

    """

    file: Normal
    probes: tuple[tuple[float, ...], ...]
    least: float = -ABSURD
    most: float = ABSURD
    most_std: float = ABSURD

    def problem(self, name: str, found: Normal) -> str:
        """Return what is not possible of an estimate; empty if it is."""
        if found.is_possible() and self._is_within(found):
            return ''
        if len(found.mean) > 1:
            return f'{name} or their covariance are not possible'
        std = math.copysign(math.sqrt(abs(found.covariance[0])), found.covariance[0])
        return f'{name} = {found.mean[0]:g} with a std of {std:g} is not possible'

    def _is_within(self, found: Normal) -> bool:
        sums = [found.along(probe) for probe in self.probes]
        values = (*found.mean, *(value for value, _ in sums))
        stds_fit = all(variance <= self.most_std * self.most_std for _, variance in sums)
        return stds_fit and self.least <= min(values) and max(values) <= self.most

    def is_refuted(self, value: Normal, present: Normal) -> bool:
        """Return whether the present estimate contradicts a value along any probe."""
        for probe in self.probes:
            now, variance = present.along(probe)
            if abs(value.along(probe)[0] - now) > _REFUTES * math.sqrt(variance):
                return True
        return False


class Channel:
    """Parameters of one estimate, by name.

    Args:
        parameters: Parameters of the train file.
        max_age_s: Time without a new estimate after which the last one is not used any more [s].

    """

    def __init__(self, parameters: Mapping[str, Parameter], max_age_s: float) -> None:
        self._parameters = parameters
        self._file = {name: parameter.file for name, parameter in parameters.items()}
        self._valid = self._file
        self._gradual = {name: Gradual(x.file, x.probes) for name, x in parameters.items()}
        self._max_age_s = max_age_s
        self._heard_s = self._now_s = self._moving_until_s = -math.inf
        self._stamp_ns = -1
        self._lost = ''
        self._status = Status.UNINITIALIZED
        self._problem = NOT_YET

    @property
    def is_live(self) -> bool:
        """Whether the values are those of an estimate, or on the way to them."""
        return not self._problem

    def is_heard(self, time_s: float) -> bool:
        """Return whether an estimate, usable or not, has come lately."""
        return time_s - self._heard_s <= self._max_age_s

    def take_new(self, status: Status, values: Mapping[str, Normal], time_s: float, stamp_ns: int) -> None:
        """Take in an estimate with a stamp [ns].

        One that repeats the previous stamp is ignored, unless it says that the previous one must not be used any more.
        """
        is_repeated, self._stamp_ns = stamp_ns == self._stamp_ns, stamp_ns
        is_no_news = status in USABLE or status is self._status is Status.CONVERGING
        if not (is_repeated and is_no_news):
            self.take(status, values, time_s)

    def take(self, status: Status, values: Mapping[str, Normal], time_s: float) -> None:
        """Take in an estimate that arrived at a time [s]."""
        self.go_on(time_s)
        self._heard_s, before, self._status, self._lost = time_s, self._status, status, ''
        if status is Status.CONVERGING and self.is_live:
            if self._is_refuted(values):
                self._fall_back(REFUTED, time_s)
            elif before is not status:
                self._suspect()
        elif status not in USABLE:
            is_known = status is Status.CONVERGING and self._problem == REFUTED
            self._fall_back(REFUTED if is_known else _WORDS[status], time_s)
        elif problem := self._find_problem(values):
            self._fall_back(problem, time_s)
        else:
            self._problem = ''
            self._valid = {name: values.get(name, self._file[name]) for name in self._file}
            for name, gradual in self._gradual.items():
                gradual.go_to(self._valid[name], self._now_s)
            self._note_move()

    def take_latched(self, status: Status, values: Mapping[str, Normal], time_s: float) -> bool:
        """Take in the last valid estimate, of which a copy is kept for those who join later; return if it counts.

        It does where nothing else is known, and as the last valid one where a CONVERGING one came before it.
        """
        is_heard = self.is_heard(time_s)
        if is_heard and (self.is_live or self._status is not Status.CONVERGING):
            return False
        self.take(status, values, time_s)
        if is_heard:
            self.take(Status.CONVERGING, {}, time_s)
        return True

    def _find_problem(self, values: Mapping[str, Normal]) -> str:
        found = (self._parameters[name].problem(name, normal) for name, normal in values.items())
        return next(filter(None, found), '')

    def _is_refuted(self, values: Mapping[str, Normal]) -> bool:
        """Return whether a CONVERGING estimate, if it is possible, contradicts the last valid values."""
        refuted = (self._parameters[name].is_refuted(self._valid[name], now) for name, now in values.items())
        return not self._find_problem(values) and any(refuted)

    def _note_move(self) -> None:
        """Note until when values move to the live ones; small moves, as of each estimate, are none."""
        left_s = max(gradual.left_s(self._now_s) for gradual in self._gradual.values())
        if left_s > _LONG_WAY_S or self._now_s < self._moving_until_s:
            self._moving_until_s = self._now_s + left_s - FALL_BACK_S

    def _suspect(self) -> None:
        """Keep the last valid values, or the way to them, with the uncertainty of the train file."""
        for name, gradual in self._gradual.items():
            gradual.go_to(Normal(self._valid[name].mean, self._file[name].covariance), self._now_s)

    def lose(self, reason: str, time_s: float) -> None:
        """Say why estimates will not come any more; the train file applies once the next one is overdue.

        The event may be of another publisher, so it does not end what is still heard.
        """
        self.go_on(time_s)
        self._lost = reason
        if not self.is_heard(time_s):
            self._fall_back(reason, time_s)

    def go_on(self, time_s: float) -> None:
        """Advance to a time [s]; one that is before the last stands still."""
        due_s = self._heard_s + self._max_age_s
        if self.is_live and time_s > due_s:
            self._fall_back(self._lost or f'no new estimate for more than {self._max_age_s:g} s', due_s)
        self._now_s = max(self._now_s, time_s)

    def _fall_back(self, reason: str, time_s: float) -> None:
        if self.is_live:
            for name, gradual in self._gradual.items():
                gradual.go_to(self._file[name], max(time_s, self._now_s), FALL_BACK_S)
        self._problem = reason

    def normal(self, name: str) -> Normal:
        """Return a parameter now."""
        return self._gradual[name].at(self._now_s)

    def reason(self) -> str:
        """Return why the values are those of the train file, or how the live ones are."""
        if not self.is_live:
            return f'train file: {self._problem}'
        if self._status is Status.CONVERGING:
            return SUSPECTED
        moving = self._now_s < self._moving_until_s
        return f'{self._status.name}, moving to the live value' if moving else self._status.name

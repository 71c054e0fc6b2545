# SPDX-License-Identifier: Apache-2.0
"""One estimate of the nodes: whether it may be used now, and its values, which move gradually.

A VALID or HOLDING estimate may be used until the next one is due. While one that was VALID is CONVERGING, its last
valid values stand, as uncertain as those of the train file. Otherwise the train file applies: at most ``FALL_BACK_S``
after the reason for it, such as a status, silence, or the end of the node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.client.gradual import Gradual, Normal
from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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
DOUBTED: Final = 'CONVERGING, the last valid value as uncertain as that of the train file'
NOT_YET: Final = 'no estimate yet'
GONE: Final = 'its node is gone'
IMPOSSIBLE: Final = 'its values are not possible'


class Channel:
    """Parameters of one estimate, by name.

    Args:
        values: Parameters of the train file, and the directions in which their moves are measured.
        max_age_s: Time without a new estimate after which the last one is not used any more [s].

    """

    def __init__(self, values: Mapping[str, tuple[Normal, Sequence[Sequence[float]]]], max_age_s: float) -> None:
        self._file = {name: normal for name, (normal, _) in values.items()}
        self._valid = self._file
        self._gradual = {name: Gradual(normal, probes) for name, (normal, probes) in values.items()}
        self._max_age_s = max_age_s
        self._seen_s = self._now_s = float('-inf')
        self._status = Status.UNINITIALIZED
        self._problem = NOT_YET

    @property
    def is_live(self) -> bool:
        """Whether the values are those of an estimate, or on the way to them."""
        return not self._problem

    def is_heard(self, time_s: float) -> bool:
        """Return whether an estimate, usable or not, has come lately."""
        return time_s - self._seen_s <= self._max_age_s

    def take(self, status: Status, values: Mapping[str, Normal], time_s: float) -> None:
        """Take in an estimate that arrived at a time [s]."""
        self.go_on(time_s)
        self._seen_s, before, self._status = time_s, self._status, status
        if status is Status.CONVERGING and self.is_live:
            if before is not status:
                self._doubt()
        elif status not in USABLE:
            self._fall_back(_WORDS[status], time_s)
        elif not all(normal.is_possible() for normal in values.values()):
            self._fall_back(IMPOSSIBLE, time_s)
        else:
            self._problem = ''
            self._valid = {name: values.get(name, self._file[name]) for name in self._file}
            for name, gradual in self._gradual.items():
                gradual.go_to(self._valid[name], self._now_s)

    def _doubt(self) -> None:
        """Keep the last valid values, with the uncertainty of the train file."""
        for name, gradual in self._gradual.items():
            doubted = Normal(self._valid[name].mean, self._file[name].covariance)
            gradual.go_to(doubted, self._now_s, FALL_BACK_S)

    def lose(self, reason: str, time_s: float) -> None:
        """Use the train file from a time [s] on, until the next estimate."""
        self.go_on(time_s)
        self._fall_back(reason, time_s)

    def go_on(self, time_s: float) -> None:
        """Advance to a time [s]; a clock that goes back stands still."""
        due_s = self._seen_s + self._max_age_s
        if self.is_live and time_s > due_s:
            self._fall_back(f'no estimate for more than {self._max_age_s:g} s', due_s)
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
            return DOUBTED
        moving = any(gradual.left_s(self._now_s) > FALL_BACK_S for gradual in self._gradual.values())
        return f'{self._status.name}, moving to the live value' if moving else self._status.name

# SPDX-License-Identifier: Apache-2.0
"""Whole applications of the brake: their impulse by the command, by the reported force and by the speed.

Over a whole application the impulses do not depend on dead time and lag, so that a short one shows as much as a long
one whether the command is right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# A weaker brake is released [N/kN], for this long [s].
_RELEASED: Final = 1.0
_RELEASED_S: Final = 0.9
# Least impulse that says something [N/kN s]: .6 m/s.
_LEAST: Final = 60.0


@dataclass(slots=True)
class BrakeApplication:
    """An application of the brake.

    Attributes:
        by_command: Impulse of a nominal brake [N/kN s].
        by_force: Impulse of the reported force, as far as it brakes [N/kN s].
        by_speed: Impulse that the speed shows [N/kN s].
        released_s: Time since the nominal brake was released [s].

    """

    by_command: float = 0.0
    by_force: float = 0.0
    by_speed: float = 0.0
    released_s: float = 0.0

    @property
    def is_over(self) -> bool:
        """True once the brake is released."""
        return self.released_s > _RELEASED_S

    @property
    def is_known(self) -> bool:
        """True if the impulse is large enough to compare."""
        return self.by_command < -_LEAST

    def add(self, nominal: float, force: float, answer: float, seconds: float) -> None:
        """Add a block.

        Args:
            nominal: Mean force of a nominal brake after dead time and lag [N/kN].
            force: Mean reported force [N/kN].
            answer: Mean force by the speed, without traction [N/kN].
            seconds: Its length [s].

        """
        brakes = nominal < -_RELEASED
        if not brakes and self.by_command == 0.0:
            return
        self.released_s = 0.0 if brakes else self.released_s + seconds
        self.by_command += seconds * nominal
        self.by_force += seconds * min(force, 0.0)
        self.by_speed += seconds * answer

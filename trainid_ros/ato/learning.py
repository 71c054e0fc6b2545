# SPDX-License-Identifier: Apache-2.0
"""The usual practice: a controller that learns from its last stops where to aim."""

from __future__ import annotations

from dataclasses import dataclass

# Share of the error of a stop that the next one corrects [1], and largest correction [m].
_GAIN = 0.4
_MOST = 2.0


@dataclass(slots=True)
class StopBias:
    """Iterative learning of the bias of the stops: ``aim(k + 1) = aim(k) - gain error(k)``."""

    aim: float = 0.0

    def learn(self, error: float) -> None:
        """Take in the error of a stop, > 0 beyond it [m]."""
        self.aim = min(_MOST, max(-_MOST, self.aim - _GAIN * error))

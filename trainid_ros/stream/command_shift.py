# SPDX-License-Identifier: Apache-2.0
"""Steps of the acceleration against those of a nominal brake: is the brake command late, or the speed?

The command passes the dead time and the lag of the train file. What speed and traction leave of the acceleration must
then step with it, as far as these two are known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.stream.brake_application import BrakeApplication
from trainid_ros.stream.shift_check import MAX_SHIFT, ShiftCheck
from trainid_ros.train.brake import lag_integral, lag_response

# Length of a block [s].
_BLOCK_S: Final = 0.5
# No brake decelerates more [N/kN]; a wheel that locks does.
_MOST: Final = 200.0
# Standard deviations of chance by which a shift must stand out [1], and share of the steps that it explains [1].
_KNOWN: Final = 2.0
_SHARE: Final = 0.5
# A shift is found beyond this many standard deviations of the stated times [1], and this error of blocks [s].
_SIGMAS: Final = 2.5
_ERROR_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class BrakeTiming:
    """Dead time and time constant of a brake, and the standard deviation of their sum [s]."""

    delay: float
    lag: float
    std: float


@dataclass(slots=True)
class CommandShift(ShiftCheck):
    """Shift of the brake against its command.

    Attributes:
        limit: Largest shift that the stated times explain [s].
        commands: Forces of a brake without dead time and lag over the last blocks, oldest first [N/kN].
        lagged: That with both at the end of the last block [N/kN], NaN while it is not known.
        seconds: Length of the block that is being filled [s].
        answer: Integral of the force by speed, gradient, w(v) and traction over it [N/kN s].
        command: Integral of the force of a brake without dead time and lag over it [N/kN s].
        force: Integral of the reported force over it [N/kN s].
        application: The present application of the brake.

    """

    limit: float = 0.0
    commands: tuple[float, ...] = ()
    lagged: float = math.nan
    seconds: float = 0.0
    answer: float = 0.0
    command: float = 0.0
    force: float = 0.0
    application: BrakeApplication = field(default_factory=BrakeApplication)

    def pause(self) -> None:
        """Begin anew after a stop or a gap, where the state of the brake is not known."""
        self.interrupt()
        self.commands, self.lagged = (), math.nan
        self.seconds = self.answer = self.command = self.force = 0.0

    def follow(self, answer: float, nominal: float, force: float, dt: float, timing: BrakeTiming) -> None:
        """Add a sample.

        Args:
            answer: Integral of the force by speed, gradient and w(v) less traction [N/kN s].
            nominal: Force of the command, of a brake without dead time and lag [N/kN].
            force: Reported force [N/kN].
            dt: Its length [s].
            timing: Dead time and lag of the brake.

        """
        self.seconds += dt
        self.answer += answer
        self.command += nominal * dt
        self.force += force * dt
        if self.seconds < _BLOCK_S:
            return
        block_s, y = self.seconds, min(max(self.answer / self.seconds, -_MOST), _MOST)
        x, force = self._respond(self.command / block_s, block_s, timing), self.force / block_s
        self.seconds = self.answer = self.command = self.force = 0.0
        self.limit = _SIGMAS * timing.std + _ERROR_S
        if not math.isnan(x):
            self.add(y, x, block_s)
            self.application.add(x, force, y, block_s)

    def ended(self, *, moves: bool) -> BrakeApplication | None:
        """Return the application that has ended, which it also does where the train no longer moves, or None."""
        application = self.application
        if application.by_command == 0.0 or (moves and not application.is_over):
            return None
        self.application = BrakeApplication()
        return application if application.is_known else None

    def _respond(self, force: float, block_s: float, timing: BrakeTiming) -> float:
        """Return the mean force after dead time and lag over a block [N/kN]; NaN while they are not known."""
        behind = timing.delay / block_s
        blocks = math.floor(behind)
        self.commands = (*self.commands, force)[-(blocks + 2) :]
        if len(self.commands) < blocks + 2:
            return math.nan
        target = self.commands[1] + (behind - blocks) * (self.commands[0] - self.commands[1])
        if math.isnan(self.lagged):  # what acted before is not known
            self.lagged = target
        mean = lag_integral(self.lagged, target, timing.lag, block_s) / block_s
        self.lagged = lag_response(self.lagged, target, timing.lag, block_s)
        return mean

    def _judge(self, block_s: float) -> None:
        chance = math.sqrt(self.jerks / self.count * self.edges)
        best = self.best
        if self.products[best] < max(_KNOWN * chance, _SHARE * self.edges):
            return
        delay = (best - MAX_SHIFT + self._between(best)) * block_s
        if abs(delay) < self.limit:
            self.finding, self.delay = '', 0.0
            return
        self.delay = delay
        later, sooner = ('ato/speed', 'ato/brake_command') if delay > 0.0 else ('ato/brake_command', 'ato/speed')
        self.finding = f'{later} is about {abs(delay):.1f} s late, or {sooner} early'

    def _between(self, best: int) -> float:
        """Return how far the vertex of a parabola through the products is from the largest [blocks]."""
        if not 0 < best < 2 * MAX_SHIFT:
            return 0.0
        before, most, after = self.products[best - 1], self.products[best], self.products[best + 1]
        curvature = before - 2.0 * most + after
        return 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0

# SPDX-License-Identifier: Apache-2.0
"""State of the checks of inputs against each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.stream.balance_checks import BalanceCheck, ChangeCheck, LineCheck, ShiftCheck
from trainid_ros.stream.brake_checks import BrakeDelayCheck
from trainid_ros.stream.known_force import SpeedNoise
from trainid_ros.stream.message_check import CommandCheck, ExcursionCheck, MassCheck, ReleaseCheck, SpikeCheck
from trainid_ros.stream.slope_checks import BRAKE_RANGE, TRACTION_RANGE, DistanceCheck, Effort, Regression, Slope

# Noise of the speed at the start [m/s].
_SPEED_STD: Final = 0.025
# Motion after the checks have begun anew in which a delay that was found before is suspected still [s]: steps of the
# traction may be rare.
_SUSPECTED_S: Final = 900.0

# Height [per mille] and longest time [s] of a spike of the gradient, which as the mean under a train cannot change for
# a moment. The same of the brake command [m/s^2, s], and time for which it has held before [s].
_GRADIENT_SPIKE: Final = 5.0
_GRADIENT_SPIKE_S: Final = 0.65
_COMMAND_SPIKE: Final = 0.15
_COMMAND_SPIKE_S: Final = 0.25
_COMMAND_HELD_S: Final = 1.0

# Memory of acceleration over force, and least number [blocks]; least force that shows it [N/kN]. Acceleration
# that no train has [m/s^2], and noise of the speed added [std].
RECENT: Final = 8.0
_RECENT_LEAST: Final = 4.0
_RECENT_FORCE: Final = 15.0
_STEP: Final = 4.0
_STEP_SIGMAS: Final = 8.0

NO_BLOCK: Final = 0
"""Kind of a block: nothing can be compared."""
RELEASED: Final = 1
"""No brake acts."""
BRAKED: Final = 2
"""The brake has followed its command."""


@dataclass(slots=True)
class Block:
    """Integrals over the samples of a block, all of which have the brake off, or applied."""

    kind: int = NO_BLOCK  # Which of them
    seconds: float = 0.0  # Its length [s]
    answer: float = 0.0  # Integral of the force by speed, gradient and w(v) [N/kN s]
    traction: float = 0.0  # Integral of traction [N/kN s]
    command: float = 0.0  # Integral of the brake command [m/s]

    def add(self, dt: float, answer: float, traction: float, command: float) -> None:
        """Add a sample: its length [s], the integral of the answer, means of traction [N/kN] and command [m/s^2]."""
        self.seconds += dt
        self.answer += answer
        self.traction += dt * traction
        self.command += dt * command


@dataclass(slots=True)
class PlausibilityState:
    """State of the monitor."""

    mass: MassCheck = field(default_factory=MassCheck)  # Check of the mass
    commands: CommandCheck = field(default_factory=CommandCheck)  # Check for two publishers of the brake command
    # Check for spikes of the brake command
    command_spikes: ExcursionCheck = field(
        default_factory=lambda: ExcursionCheck(
            topic='ato/brake_command',
            height=_COMMAND_SPIKE,
            longest_s=_COMMAND_SPIKE_S,
            calm_s=_COMMAND_HELD_S,
            direction=-1.0,
        )
    )
    releases: ReleaseCheck = field(default_factory=ReleaseCheck)  # Check for spikes of the brake command towards zero
    spikes: SpikeCheck = field(default_factory=SpikeCheck)  # Check for spikes of the force
    # Check for spikes of the gradient
    gradient_spikes: ExcursionCheck = field(
        default_factory=lambda: ExcursionCheck(
            topic='ato/gradient', height=_GRADIENT_SPIKE, longest_s=_GRADIENT_SPIKE_S
        )
    )
    distance: DistanceCheck = field(default_factory=DistanceCheck)  # Check of speed against position
    line: LineCheck = field(default_factory=LineCheck)  # Check of the gradient
    shift: ShiftCheck = field(default_factory=ShiftCheck)  # Check of the times of steps
    traction: Slope = field(default_factory=Slope)  # Slope of traction
    brake: Slope = field(default_factory=Slope)  # Slope of the brake
    # Slope of the reported force over the brake command, while the brake is applied
    effort: Effort = field(default_factory=Effort)
    recent: Regression = field(default_factory=Regression)  # Acceleration over traction or brake in the last seconds
    balance: BalanceCheck = field(default_factory=BalanceCheck)  # Check of the residual
    change: ChangeCheck = field(default_factory=ChangeCheck)  # Check for changes that the balance does not explain
    brake_delay: BrakeDelayCheck = field(default_factory=BrakeDelayCheck)  # Check of the dead time of the brake
    last: str = ''  # The last finding, empty if there never was one
    confirmed: bool = False  # True once the slope of traction was plausible
    moved_s: float = 0.0  # Time in motion with known forces [s]
    found_s: float = 0.0  # Time in motion under findings since the checks began [s]
    lasting_s: float = 0.0  # Time in motion under the present finding [s]
    retried: bool = False  # True if the checks have begun anew under a finding: they must then hold for some time
    # Noise of the speed
    noise: SpeedNoise = field(default_factory=lambda: SpeedNoise.declared(_SPEED_STD, robust=True))
    block: Block = field(default_factory=Block)  # The block that is being filled
    held_s: float = 0.0  # Time since the brake was applied, or released [s]
    slowest: float = 0.0  # Lowest speed since the brake has followed its command, the speed itself before that [m/s]
    strongest: float = 0.0  # Strongest brake command since some time [m/s^2]
    strongest_before: float = 0.0  # That over the same time before [m/s^2]
    strongest_s: float = 0.0  # This time [s]
    steady: float = 0.0  # Brake command when it last changed by more than a brake need follow [m/s^2]
    steady_s: float = 0.0  # Time since then [s]
    has_alternated: bool = True  # True if it was applied or released since the last finding about it
    driven: float = 0.0  # Distance driven [m]
    stopped: float = 0.0  # The same at the last stop [m]
    speed: float = math.nan  # Last speed [m/s], NaN before the first
    position: float = math.nan  # Last position [m]

    @property
    def finding(self) -> str:
        """What contradicts what, empty if nothing does."""
        return (
            self.mass.finding
            or self.commands.finding
            or self.command_spikes.finding
            or self.releases.finding
            or self.spikes.finding
            or self.gradient_spikes.finding
            or self.traction.finding
            or self.brake.finding
            or self.effort.finding
            or self.distance.finding
            or self.shift.finding
            or self.line.finding
            or self.change.finding
            or self.balance.finding
        )

    @property
    def is_suspected(self) -> bool:
        """True while the last seconds are improbable by those before."""
        commands = self.command_spikes.is_suspected or self.releases.is_suspected
        spikes = self.spikes.is_suspected or commands or self.gradient_spikes.is_suspected
        late = self.shift.is_suspected and self.moved_s < _SUSPECTED_S
        sudden = self.balance.is_suspected or self.change.is_suspected
        slopes = self.traction.is_suspected or self.brake.is_suspected or self.effort.is_suspected
        return sudden or slopes or late or spikes or self.distance.is_suspected or self.line.is_suspected

    @property
    def by_force(self) -> float:
        """Acceleration over what traction and brake give, over the last seconds [1]; NaN if they hardly act."""
        recent = self.recent
        strong = recent.count > _RECENT_LEAST and recent.xx > _RECENT_FORCE * _RECENT_FORCE * recent.count
        return recent.value if strong else math.nan

    def follow_step(self, change: float, dt: float) -> None:
        """Forget what relates the speed to other inputs where it changes [m/s] as no train does in this time [s]."""
        if abs(change) > _STEP * dt + _STEP_SIGMAS * self.noise.std:
            self.recent = Regression()
            self.distance.forget_ratio()

    @property
    def numbers(self) -> tuple[float, float]:
        """Value of what the finding is about, and its limit."""
        traction, brake, shift, balance = self.traction, self.brake, self.shift, self.balance
        for finding, value, limit in (
            (self.mass.finding, self.mass.ratio, self.mass.limit),
            (self.commands.finding, self.commands.reversals, self.commands.limit),
            (self.command_spikes.finding, self.command_spikes.spikes, self.command_spikes.limit),
            (self.releases.finding, self.releases.spikes, self.releases.limit),
            (self.spikes.finding, self.spikes.spikes, self.spikes.limit),
            (self.gradient_spikes.finding, self.gradient_spikes.spikes, self.gradient_spikes.limit),
            (traction.finding, traction.value, traction.limit(TRACTION_RANGE)),
            (brake.finding, brake.value, brake.limit(BRAKE_RANGE)),
            (self.effort.finding, self.effort.value, 1.0),
            (self.distance.finding, self.distance.error, self.distance.limit),
            (shift.finding, shift.delay, 0.0),
            (self.line.finding, self.line.value, self.line.limit),
            (self.change.finding, self.change.ratio, 1.0),
        ):
            if finding:
                return value, limit
        return balance.mean, balance.mean_limit

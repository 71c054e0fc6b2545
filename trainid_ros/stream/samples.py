# SPDX-License-Identifier: Apache-2.0
"""The aligned sample: what every estimator steps on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.interface.results import AdhesionEstimate, Rejection
from trainid_ros.train.forces import BrakeCommandChange

SAMPLE_PERIOD: Final = 0.2
"""Default time between samples [s]."""


@dataclass(frozen=True, slots=True)
class Motion:
    """History of the drive, for effects that depend on it; by default run in, warm, and with a cold brake."""

    time_s: float = math.inf  # Time since the start [s]
    distance_run: float = math.inf  # Distance run since the start [m]
    # Time since the brake was released [s]; 0 while applied, infinite while it has not been
    since_release: float = math.inf
    heat: float = 0.0  # Heat of the brake by the train file [J per kg of train]
    brake: float = 0.0  # Acceleration target of the brake after the dead time and lag of the train file [m/s^2, <= 0]
    brake_mean: float = 0.0  # Its mean since the previous sample [m/s^2, <= 0]
    run: int = 0  # Number of departures since the start


NO_HISTORY: Final = Motion()


@dataclass(slots=True)
class Sample:
    """All inputs brought to the stamp of one speed measurement."""

    stamp_ns: int  # Stamp of the speed measurement
    dt: float  # Time since the previous sample [s]; NaN for the first and after a gap
    speed: float  # Measured speed [m/s]
    position: float  # Position along the line [m], NaN if unknown
    direction: int  # +1 while positions rise (also while unknown), -1 while they fall
    force: float  # Wheel-rim force at the stamp [N], NaN if unknown
    force_mean: float  # Mean of the force since the previous sample [N], NaN if unknown
    gradient: float  # Gradient at the stamp [per mille], NaN if unknown
    gradient_mean: float  # Mean of the gradient since the previous sample [per mille]
    curve_radius: float  # Radius [m], 0 = straight
    tunnel: bool  # True inside a tunnel
    mass: float  # Mass from load weighing [kg], NaN if not weighed
    brake_command: float  # Commanded acceleration in force at the stamp [m/s^2, <= 0], NaN if unknown
    brake_changes: tuple[BrakeCommandChange, ...]  # Commands that became valid since the previous sample, oldest first
    brake_gap: bool  # True if a change of the command may have been missed since the previous sample
    emergency: bool  # True under emergency braking
    motion: Motion = NO_HISTORY  # The drive so far, where effects of the train file depend on it
    curvature_mean: float = math.nan  # Mean curvature since the previous sample [1/m], 0 = straight, NaN if not known
    force_interval: float = 0.0  # Time between the two reports of the force around the stamp [s], 0 if not known
    stood_since_weighing: bool = False  # True if the train has come to a stop since the mass was weighed
    is_weighing_overdue: bool = False  # True if a mass has been due since then, by the interval of the messages
    # Why resistance and speed model cannot use it (a stuck speed, inputs that contradict each other), None if they can
    rejection: Rejection | None = None
    brake_rejection: Rejection | None = None  # The same for the brake rate
    adhesion: AdhesionEstimate | None = field(default=None, init=False, repr=False, compare=False)  # After this sample
    # Resistance of the effects of the stream's train file, without brake force [N/kN]; NaN if not evaluated
    extra: float = field(default=math.nan, init=False, repr=False, compare=False)

    # The constructor that a dataclass writes for itself is not compiled, and a sample is made five times a second.
    def __init__(
        self,
        stamp_ns: int,
        dt: float,
        speed: float,
        position: float,
        direction: int,
        force: float,
        force_mean: float,
        gradient: float,
        gradient_mean: float,
        curve_radius: float,
        tunnel: bool,
        mass: float,
        brake_command: float,
        brake_changes: tuple[BrakeCommandChange, ...],
        brake_gap: bool,
        emergency: bool,
        motion: Motion = NO_HISTORY,
        curvature_mean: float = math.nan,
        force_interval: float = 0.0,
        stood_since_weighing: bool = False,
        is_weighing_overdue: bool = False,
        rejection: Rejection | None = None,
        brake_rejection: Rejection | None = None,
    ) -> None:
        self.stamp_ns = stamp_ns
        self.dt = dt
        self.speed = speed
        self.position = position
        self.direction = direction
        self.force = force
        self.force_mean = force_mean
        self.gradient = gradient
        self.gradient_mean = gradient_mean
        self.curve_radius = curve_radius
        self.tunnel = tunnel
        self.mass = mass
        self.brake_command = brake_command
        self.brake_changes = brake_changes
        self.brake_gap = brake_gap
        self.emergency = emergency
        self.motion = motion
        self.curvature_mean = curvature_mean
        self.force_interval = force_interval
        self.stood_since_weighing = stood_since_weighing
        self.is_weighing_overdue = is_weighing_overdue
        self.rejection = rejection
        self.brake_rejection = brake_rejection
        self.adhesion = None
        self.extra = math.nan

    @property
    def weighed(self) -> bool:
        """True if the present load was weighed; a mass from before the last stop is that of other passengers."""
        return not math.isnan(self.mass) and not self.stood_since_weighing

    @property
    def curvature(self) -> float:
        """Curvature of the track since the previous sample [1/m], that at the stamp where the mean is not known."""
        if not math.isnan(self.curvature_mean):
            return self.curvature_mean
        return 1.0 / self.curve_radius if self.curve_radius > 0.0 else 0.0


def coasting_sample(stamp_ns: int, dt: float, speed: float) -> Sample:
    """Return a sample of a train that coasts on level, straight track; the fields can be set afterwards."""
    return Sample(
        stamp_ns=stamp_ns,
        dt=dt,
        speed=speed,
        position=math.nan,
        direction=1,
        force=0.0,
        force_mean=0.0,
        gradient=0.0,
        gradient_mean=0.0,
        curve_radius=0.0,
        tunnel=False,
        mass=math.nan,
        brake_command=0.0,
        brake_changes=(),
        brake_gap=False,
        emergency=False,
    )

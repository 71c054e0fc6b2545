# SPDX-License-Identifier: Apache-2.0
"""Definition of a hidden effect, and the state of the ride that it depends on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

G = 9.81


@dataclass(slots=True)
class Moment:
    """State of the true train on which effects depend; one object, updated at each step.

    Attributes:
        time: Time since the start of the bag [s].
        front: Position of the train's front [m].
        heading: +1 while positions rise, -1 while they fall.
        speed: Speed [m/s].
        tunnel_share: Share of the train that is in a tunnel.
        curvature: Mean curvature under the train [1/m].
        travelled: Distance since the start of the bag [m].
        released_for: Time since the brake was released [s], infinite before its first use.
        applied_for: Time since the brake was applied [s], 0 while it is released.
        pull: Reported traction over weight [N/kN].
        heat: Energy in the brake [J/kg].
        acceleration: Acceleration of the previous step [m/s^2].
        load: True mass over the mean mass of the case.
        run: Number of the run in the bag.

    """

    time: float = 0.0
    front: float = 0.0
    heading: int = 1
    speed: float = 0.0
    tunnel_share: float = 0.0
    curvature: float = 0.0
    travelled: float = 0.0
    released_for: float = math.inf
    applied_for: float = 0.0
    pull: float = 0.0
    heat: float = 0.0
    acceleration: float = 0.0
    load: float = 1.0
    run: int = 0


Law = Callable[[Moment], float]


@dataclass(frozen=True, slots=True)
class Hidden:
    """One effect with its size, as it acts in the ride.

    Attributes:
        name: Name in the interface, or a name of this generator for an effect outside the library.
        parameters: Parameters in the form of the interface; for outside effects those of this generator.
        comparable: False if the law differs from that of the interface, so that parameters cannot be compared.
        near: Acceptable generic names for an effect outside the library.
        drag: Additional resistance [N/kN].
        pull_gain: True over reported traction.
        brake_gain: True over nominal brake force.
        mass_ratio: True over assumed mass.
        inertia_ratio: True over assumed (1 + rotary mass).
        brake_wait: Additional dead time of the brake [s].
        wheel_ratio: Measured over true speed.
        slip: Share of the running time with slip [1] and greatest slip speed [m/s].

    """

    name: str
    parameters: tuple[tuple[str, float], ...]
    comparable: bool = True
    near: tuple[str, ...] = ()
    drag: Law | None = None
    pull_gain: Law | None = None
    brake_gain: Law | None = None
    mass_ratio: float = 1.0
    inertia_ratio: float = 1.0
    brake_wait: float = 0.0
    wheel_ratio: float = 1.0
    slip: tuple[float, float] = (0.0, 0.0)

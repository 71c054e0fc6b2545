# SPDX-License-Identifier: Apache-2.0
"""What a hidden effect may touch, and the moment of the ride at which it is asked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

G = 9.81


@dataclass(slots=True)
class Moment:
    """State of the true train that effects see; one object, renewed at each step.

    Attributes:
        time: Since the start of the bag [s].
        front: Position of the train's front [m].
        heading: +1 while positions rise, -1 while they fall.
        speed: [m/s].
        tunnel_share: Share of the train that is in a tunnel.
        curvature: Mean curvature under the train [1/m].
        travelled: Distance since the start of the bag [m].
        released_for: Time since the brake came off [s], infinite before its first use.
        applied_for: Time since the brake came on [s], 0 while it is off.
        pull: Reported traction over weight [N/kN].
        heat: Energy in the brake [J/kg].
        acceleration: Of the step before [m/s^2].
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
    """One effect with its size, as the ride feels it.

    Attributes:
        name: Name of the interface, or one of ours for an effect outside the library.
        parameters: Parameters in the form of the interface; for outside effects our own.
        comparable: False where the law has another form than the usual one, so that parameters can't be compared.
        near: Names that would be an honest generic answer for an effect outside the library.
        drag: Further resistance [N/kN].
        pull_gain: True over reported traction.
        brake_gain: True over nominal brake force.
        mass_ratio: True over believed mass.
        inertia_ratio: True over believed (1 + rotary mass).
        brake_wait: Further dead time of the brake [s].
        wheel_ratio: Measured over true speed.
        slip: Share of the running time in slip and greatest slip speed [m/s].

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

# SPDX-License-Identifier: Apache-2.0
"""All possible errors of the assumed model, as one flat tuple of numbers; all neutral by default."""

from __future__ import annotations

from typing import NamedTuple


class Quirks(NamedTuple):
    """Strength of every effect; read by compiled code, so it holds floats only."""

    bore_gain: float = 1.0  # aerodynamic drag inside a tunnel over that outside
    flange: float = 0.0  # N/kN m
    slope_from: float = 0.0
    slope_to: float = 0.0
    slope_miss: float = 0.0  # true minus map gradient, rising position
    wind: float = 0.0  # m/s, + against rising position
    heavy: float = 1.0  # true over weighed mass
    pull: float = 1.0  # true over reported traction
    bite: float = 1.0  # true over nominal brake
    fade_loss: float = 0.0
    fade_heat: float = 1.0  # J/kg
    fade_cool: float = 250.0  # s
    late: float = 0.0  # s
    drag_after: float = 0.0  # N/kN
    drag_for: float = 0.0  # s
    stiction: float = 0.0  # N/kN
    stiction_v: float = 1.0  # m/s
    cold: float = 0.0  # N/kN
    cold_time: float = 0.0  # s; 0: by distance
    cold_run: float = 1.0  # m
    jump: float = 0.0  # N/kN
    jump_at: float = 1e9  # s
    rub_from: float = 0.0
    rub_to: float = 0.0
    rub: float = 0.0  # N/kN, both ways
    cubic: float = 0.0
    # Outside the library.
    wave: float = 0.0  # N/kN, along the line
    wave_length: float = 1000.0
    wave_phase: float = 0.0
    creep: float = 0.0  # N/kN per hour
    bite_speed: float = 0.0  # loss of brake per m/s
    sag: float = 0.0  # loss of traction per m/s beyond sag_from
    sag_from: float = 1e9
    rotary: float = 0.0  # true minus assumed gamma
    surge: float = 0.0  # N/kN per m/s^2 of |acceleration|
    oneway_pull: float = 0.0  # N/kN, in traction, rising position only
    whim: float = 0.0  # N/kN, times a factor of the run
    damp: float = 0.0  # N/kN in a speed band
    damp_mid: float = 0.0
    damp_wide: float = 1.0
    parked: float = 0.0  # N/kN at departure, decays
    parked_time: float = 60.0
    cant: float = 0.0  # N/kN per m/s^2 of lateral acceleration
    crowd: float = 0.0  # N/kN per 1 % of load above usual
    storm: float = 0.0  # N/kN between two times
    storm_from: float = 1e9
    storm_to: float = 1e9
    feeder_from: float = 0.0
    feeder_to: float = 0.0
    feeder: float = 0.0  # loss of traction on a section of the line
    hill: float = 0.0  # N/kN per per mille of |gradient|
    # Sensors; the kernel does not read them.
    wheel: float = 1.0
    slip_share: float = 0.0
    slip_speed: float = 0.0
    map_ahead: float = 0.0  # m
    force_late: float = 0.0  # s


NEUTRAL = Quirks()

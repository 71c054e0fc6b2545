# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filter on x = [v, a, b, c] from raw speed, in floats.

    v' = v + k dt (u - a - b v - c v^2),  k = 1 / inertia,  u the known specific force,

with white process noise of variance q on v for unmodelled forces. Unlike windows, the filter loses no information: on
clean coasting runs it reaches the Cramer-Rao bound with and without gusts.

A state is a tuple of 14 floats: x, then the upper triangle of its covariance, row by row.
"""

from __future__ import annotations

State = tuple[float, ...]


def predicted(state: State, dt: float, u: float, k: float, q: float) -> State:
    """Return the state predicted ``dt`` [s] ahead.

    Args:
        state: State estimate.
        dt: Time step [s].
        u: Mean known specific force over the step [N/kN].
        k: Acceleration per specific force [m/s^2 per N/kN].
        q: Process noise variance added to v [(m/s)^2].

    """
    v, a, b, c, Pvv, Pva, Pvb, Pvc, Paa, Pab, Pac, Pbb, Pbc, Pcc = state
    # Speed in the middle of the step; w at the initial speed would lag by half a step.
    h = k * dt
    m = v + 0.5 * h * (u - a - v * (b + c * v))
    # F = [1 - h (b + 2 c m), -h, -h m, -h m^2; 0 I];  P = F P F' + Q
    f, fb, fc = 1.0 - h * (b + 2.0 * c * m), h * m, h * m * m
    Ra = f * Pva - h * Paa - fb * Pab - fc * Pac
    Rb = f * Pvb - h * Pab - fb * Pbb - fc * Pbc
    Rc = f * Pvc - h * Pac - fb * Pbc - fc * Pcc
    Pvv = f * (f * Pvv - h * Pva - fb * Pvb - fc * Pvc) - h * Ra - fb * Rb - fc * Rc + q
    return v + h * (u - a - m * (b + c * m)), a, b, c, Pvv, Ra, Rb, Rc, Paa, Pab, Pac, Pbb, Pbc, Pcc


def corrected(state: State, speed: float, R: float) -> State:
    """Return the state after a measurement of v [m/s] with variance R [(m/s)^2]."""
    v, a, b, c, Pvv, Pva, Pvb, Pvc, Paa, Pab, Pac, Pbb, Pbc, Pcc = state
    # K = P e / S;  P -= K S K'
    S = Pvv + R
    nu = speed - v
    K0, K1, K2, K3 = Pvv / S, Pva / S, Pvb / S, Pvc / S
    rest = R / S
    return (
        *(v + K0 * nu, a + K1 * nu, b + K2 * nu, c + K3 * nu),
        *(rest * Pvv, rest * Pva, rest * Pvb, rest * Pvc),
        *(Paa - K1 * Pva, Pab - K1 * Pvb, Pac - K1 * Pvc),
        *(Pbb - K2 * Pvb, Pbc - K2 * Pvc, Pcc - K3 * Pvc),
    )


def restarted(state: State, speed: float, R: float) -> State:
    """Return the state with v reset to one measurement [m/s] of variance R [(m/s)^2]; the parameters are kept."""
    return speed, *state[1:4], R, 0.0, 0.0, 0.0, *state[8:]

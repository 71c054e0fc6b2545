# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation least squares that uses each observation p times with total weight one, at a cost independent of p.

Liu et al. 2018, section 3, after Ding et al. 2010: step t uses the innovations of the last p observations together.
The paper gives them unit variance each time, so an observation used p times has p times its weight and P is not a
covariance. With p times their variance, all uses of an observation together have its weight exactly once. The
information after step t is then that of step t - 1 plus the mean information of the last p observations,

    P^-1(t) = P^-1(t-1) + sum_{i=t-p+1..t} phi(i) phi(i)' / (p R(i)),

and likewise for the vector P^-1 theta. The sum is a running one: the newest term is added, the oldest subtracted.

Information is a tuple of nine floats: the upper triangle of P^-1 row by row, then P^-1 theta.
"""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.resistance.change_points import weigh
from trainid_ros.resistance.davis_posterior import DavisPosterior

Information = tuple[float, ...]
MilsState = tuple[float, ...]

NOTHING: Final[Information] = (0.0,) * 9


def mils_step(
    state: MilsState, oldest: Information, v: float, s: float, y: float, R: float, slow: float, eps: float, p: int
) -> tuple[MilsState, Information, float, float]:
    """Make one step of multi-innovation least squares with the soft gate of :func:`weigh`.

    Args:
        state: Information before the step, then the mean information of the last p observations: 18 floats.
        oldest: Term to subtract from that mean: ``newest`` of p steps ago, NOTHING in the first p steps.
        v: Mean speed of the observation [m/s].
        s: Mean square speed of the observation [(m/s)^2].
        y: Observed resistance [N/kN].
        R: Its noise variance [(N/kN)^2].
        slow: Factor on R in the mean of many observations with correlated noise; 1 if the noise is white.
        eps: Share of outliers [1], 0 for plain least squares.
        p: Innovation length.

    Returns:
        state, newest, the weight of the observation and the logarithm of its likelihood.

    """
    A, B, C, D, E, F, h0, h1, h2, r0, r1, r2, r3, r4, r5, r6, r7, r8 = state
    # P^-1 = L diag(A, d1, d2) L';  L diag L' theta = h
    l1, l2 = B / A, C / A
    d1, e = D - l1 * B, E - l1 * C
    l3 = e / d1
    d2 = F - l2 * C - l3 * e
    u1 = h1 - l1 * h0
    c = (h2 - l2 * h0 - l3 * u1) / d2
    b = u1 / d1 - l3 * c
    nu = y - (h0 / A - l1 * b - l2 * c) - b * v - c * s
    # S = phi' P phi + R with phi' P phi = z' diag^-1 z, L z = phi
    z1 = v - l1
    z2 = s - l2 - l3 * z1
    weight, log_likelihood = weigh(nu, 1.0 / A + z1 * z1 / d1 + z2 * z2 / d2 + R, R, eps)
    # recent += phi phi' / (p R) - oldest;  information += recent
    k = weight / (p * slow * R)
    kv, ks = k * v, k * s
    newest = k, kv, ks, kv * v, kv * s, ks * s, k * y, kv * y, ks * y
    o0, o1, o2, o3, o4, o5, o6, o7, o8 = oldest
    r0 += k - o0
    r1 += kv - o1
    r2 += ks - o2
    r3 += kv * v - o3
    r4 += kv * s - o4
    r5 += ks * s - o5
    r6 += k * y - o6
    r7 += kv * y - o7
    r8 += ks * y - o8
    information = A + r0, B + r1, C + r2, D + r3, E + r4, F + r5, h0 + r6, h1 + r7, h2 + r8
    return (*information, r0, r1, r2, r3, r4, r5, r6, r7, r8), newest, weight, log_likelihood


def posterior_of(info: Information) -> DavisPosterior:
    """Return a, b, c [N/kN, v in m/s] and the upper triangle of their covariance."""
    A, B, C, D, E, F, h0, h1, h2 = info
    l1, l2 = B / A, C / A
    d1, e = D - l1 * B, E - l1 * C
    l3 = e / d1
    d2 = F - l2 * C - l3 * e
    # L^-1 = [1; -l1 1; m -l3 1]; P = L'^-1 diag^-1 L^-1
    m = l1 * l3 - l2
    i0, i1, i2 = 1.0 / A, 1.0 / d1, 1.0 / d2
    P22, P12, P02 = i2, -l3 * i2, m * i2
    P11, P01 = i1 + l3 * l3 * i2, -l1 * i1 - l3 * m * i2
    P00 = i0 + l1 * l1 * i1 + m * m * i2
    a, b, c = P00 * h0 + P01 * h1 + P02 * h2, P01 * h0 + P11 * h1 + P12 * h2, P02 * h0 + P12 * h1 + P22 * h2
    return a, b, c, P00, P01, P02, P11, P12, P22


def information_of(estimate: DavisPosterior) -> Information:
    """Return P^-1 and P^-1 theta of an estimate."""
    a, b, c, *P = estimate
    A, B, C, D, E, F = posterior_of((*P, 0.0, 0.0, 0.0))[3:]
    return A, B, C, D, E, F, A * a + B * b + C * c, B * a + D * b + E * c, C * a + E * b + F * c


def is_finite(numbers: tuple[float, ...]) -> bool:
    """Return whether all numbers are finite."""
    return all(map(math.isfinite, numbers))

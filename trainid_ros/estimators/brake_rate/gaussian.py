# SPDX-License-Identifier: Apache-2.0
"""Kernels of a Gaussian belief in x = [v, a, b, f] on plain floats: no particle is needed where all is linear.

f enters speed v and brake acceleration a with known coefficients (Zheng et al. 2015, eqs. (1), (2): f multiplies
the command after its dead time), so the Kalman filter is the exact posterior of a Gaussian random walk of f.

A mean is (v, a, b, f); a covariance its upper triangle (vv, va, vb, vf, aa, ab, af, bb, bf, ff).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainid_ros.estimators.brake_rate.belief import Interval

Mean = tuple[float, float, float, float]
Cov = tuple[float, float, float, float, float, float, float, float, float, float]


def predict(m: Mean, P: Cov, step: Interval) -> tuple[Mean, Cov]:
    """Follow x = F x + known input, P = F P F' + Q; f stands.

    Args:
        m: Mean.
        P: Covariance.
        step: What moves the train.

    Returns:
        Mean and covariance at the end.

    """
    dt, reach, decay, gain_v, gain_a, rho, known, q_v, q_b = step
    v, a, b, f = m
    vv, va, vb, vf, aa, ab, af, bb, bf, ff = P
    # Row v of F P, then F P F'.
    uv = vv + reach * va + dt * vb + gain_v * vf
    ua = va + reach * aa + dt * ab + gain_v * af
    ub = vb + reach * ab + dt * bb + gain_v * bf
    uf = vf + reach * af + dt * bf + gain_v * ff
    wa = decay * aa + gain_a * af
    wf = decay * af + gain_a * ff
    wb = decay * ab + gain_a * bf
    mean = (v + reach * a + dt * b + gain_v * f + known, decay * a + gain_a * f, rho * b, f)
    cov = (
        uv + reach * ua + dt * ub + gain_v * uf + q_v,
        decay * ua + gain_a * uf,
        rho * ub,
        uf,
        decay * wa + gain_a * wf,
        rho * wb,
        wf,
        rho * rho * bb + q_b,
        rho * bf,
        ff,
    )
    return mean, cov


def drift(P: Cov, gain_v: float, gain_a: float, q: float) -> Cov:
    """Add the drift of f over an interval, of variance q, which has acted on v and a since its start."""
    vv, va, vb, vf, aa, ab, af, bb, bf, ff = P
    return (
        vv + q * gain_v * gain_v,
        va + q * gain_v * gain_a,
        vb,
        vf + q * gain_v,
        aa + q * gain_a * gain_a,
        ab,
        af + q * gain_a,
        bb,
        bf,
        ff + q,
    )


def update(m: Mean, P: Cov, speed: float, r: float, *, learns: bool) -> tuple[Mean, Cov]:
    """Take in a measured speed, K = P h / S.

    With ``learns`` False the gain of f is zero, and f stands (the filter of Schmidt).
    """
    vv, va, vb, vf, aa, ab, af, bb, bf, ff = P
    S = vv + r
    nu = (speed - m[0]) / S
    kept = r / S
    mean = (m[0] + vv * nu, m[1] + va * nu, m[2] + vb * nu, m[3] + (vf * nu if learns else 0.0))
    cov = (
        vv * kept,
        va * kept,
        vb * kept,
        vf * kept,
        aa - va * va / S,
        ab - va * vb / S,
        af - va * vf / S,
        bb - vb * vb / S,
        bf - vb * vf / S,
        ff - vf * vf / S if learns else ff,
    )
    return mean, cov


def anchored(f: float, ff: float, speed: float, target: float, variances: tuple[float, ...]) -> tuple[Mean, Cov]:
    """Start v, a = f target and b anew; f stands."""
    r, doubt, disturbance = variances
    cov = (r, 0.0, 0.0, 0.0, doubt + ff * target * target, 0.0, ff * target, disturbance, 0.0, ff)
    return (speed, f * target, 0.0, f), cov


def mixed(weights: tuple[float, ...], means: tuple[Mean, ...], covs: tuple[Cov, ...]) -> tuple[Mean, Cov]:
    """Mean and covariance of a mixture; weights sum to one."""
    v, a, b, f = (sum(w * m[i] for w, m in zip(weights, means, strict=True)) for i in range(4))
    cov = [sum(w * P[i] for w, P in zip(weights, covs, strict=True)) for i in range(10)]
    for w, m in zip(weights, means, strict=True):
        d = (m[0] - v, m[1] - a, m[2] - b, m[3] - f)
        k = 0
        for i in range(4):
            for j in range(i, 4):
                cov[k] += w * d[i] * d[j]
                k += 1
    return (v, a, b, f), (cov[0], cov[1], cov[2], cov[3], cov[4], cov[5], cov[6], cov[7], cov[8], cov[9])

# SPDX-License-Identifier: Apache-2.0
"""Prior uncertainty of the Davis parameters of the train file."""

from __future__ import annotations

from dataclasses import dataclass

from trainid_ros.settings import setting


@dataclass(frozen=True, slots=True)
class PriorSettings:
    """Settings of an estimator's prior standard deviations: a share of the train file's values, and floors."""

    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their stated values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)


def prior_variances(davis: tuple[float, float, float], settings: PriorSettings) -> tuple[float, float, float]:
    """Return the prior variances of (a, b, c), in the squared units of N/kN and m/s.

    Trains differ by decades in c and in a, so the standard deviation is a share of the train file's value; the floors
    keep a parameter free whose value there is zero.
    """
    a, b, c = (settings.prior_share * value for value in davis)
    return (
        a * a + settings.prior_std_a * settings.prior_std_a,
        b * b + settings.prior_std_b * settings.prior_std_b,
        c * c + settings.prior_std_c * settings.prior_std_c,
    )

# SPDX-License-Identifier: Apache-2.0
"""Forces of row i act from row i - 1 to row i; here they become values at the rows."""

import numpy as np

WEIGHT = 9485000.0 * 9.80665  # N
INERTIA = 9785000.0  # mass with rotating parts [kg]


def _at_rows(steps):
    return 0.5 * (steps + np.append(steps[1:], np.nan))


def force(net, ok):
    """Force at the wheels with that of the friction brakes [N], where it is not stale."""
    return _at_rows(np.where(ok > 0.0, net, np.nan))


def gradient(grade, curve):
    """Gradient under the train with the resistance of curves [per mille]."""
    return _at_rows(1000.0 * (grade + curve) / WEIGHT)


def brake(net, wheel):
    """Brake command [m/s^2]: the deceleration that the brakes give, from the row on at which they act."""
    brakes = (wheel - net > 0.0) | (wheel < 0.0)
    return np.append(np.where(brakes, np.minimum(net, 0.0) / INERTIA, 0.0)[1:], np.nan)

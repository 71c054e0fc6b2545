# SPDX-License-Identifier: Apache-2.0
"""Force from power, gradient from altitude over distance."""

import numpy as np
from scipy.ndimage import gaussian_filter1d as smooth


def force(time, speed, power):
    """Force [N]: power over speed; both are means over the second before, so the mean with the next one is taken."""
    force = np.where(speed > 1.0, power / np.maximum(speed, 1.0), np.nan)
    follows = np.append(np.diff(time) < 1.5, False)
    return np.where(follows, 0.5 * (force + np.append(force[1:], np.nan)), np.nan)


def gradient(distance, altitude):
    """Gradient [per mille] from altitude and distance [m], smoothed over some seconds."""
    return 1000.0 * np.gradient(smooth(altitude, 4.0)) / np.maximum(np.gradient(smooth(distance, 4.0)), 0.5)

# SPDX-License-Identifier: Apache-2.0
"""What a mapping cannot say of the measured trips: sums of steps, force from torque, gradient from two sensors."""

import numpy as np
from scipy.ndimage import gaussian_filter1d as smooth

RATE = 10.0  # rows a second
GEAR, RADIUS = 9.665, 0.3397  # ratio [1], rolling radius [m]
CROSSOVER = 300.0  # rows; slower changes of the gradient come from the elevation, faster ones from the accelerometer
G = 9.80665


def time(t):
    """Time since the start [s], from steps of 0.1 s."""
    return 0.1 * np.cumsum(t)


def speed(steps):
    """Speed [km/h], from steps of 0.01 km/h."""
    return np.maximum(0.01 * np.cumsum(steps), 0.0)


def force(torque):
    """Force at the wheels [N], without losses, from steps of 0.01 N m of the motor torque."""
    return GEAR * 0.01 * np.cumsum(torque) / RADIUS


def gradient(speed_steps, acceleration_steps, elevation_steps):
    """Gradient [per mille]: accelerometer less dv/dt, its slow part replaced by climb over speed."""
    v = speed(speed_steps) / 3.6
    slope = (smooth(0.01 * np.cumsum(acceleration_steps), 5.0) - np.gradient(smooth(v, 5.0)) * RATE) / G
    climb = np.gradient(smooth(0.01 * np.cumsum(elevation_steps), 10.0)) * RATE
    slow = smooth(climb - slope * v, CROSSOVER) / np.maximum(smooth(v, CROSSOVER), 1.0)
    return 1000.0 * (slope + slow)


def brake(throttle):
    """Brake command: the pedal of the brake is not recorded, so it may act while that of the motor is up."""
    return np.where(0.01 * np.cumsum(throttle) > 1.0, 0.0, -np.inf)

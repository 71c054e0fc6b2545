# SPDX-License-Identifier: Apache-2.0
"""Visibility of an effect: speed gap after the best Davis fit, relative to the noise floor.

The gap e = simulated - measured speed obeys e' = -g / (1000 (1 + gamma)) (r + w'(v) e), where r [N/kN] is the
residual of the assumed balance on the true ride. Refitting a, b, c and the initial speed of each leg is linear in e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.forces import GRAV
from benchmarks.hidden_cases_b.motion import FLAW, GUST, LEG, NOM, PULL, REAL, WAY, WEIGHED, T, V, X
from benchmarks.hidden_cases_b.quirks import Quirks
from benchmarks.hidden_cases_b.scene import Scene
from benchmarks.hidden_cases_b.sensing import Instruments, map_gradient, slip_bursts

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Visible:
    """Speed gaps [m/s rms] after the refit, and the excess of the gap over the floor [%]."""

    percent: float
    effect: float
    floor: float
    raw: float


@njit(cache=True)
def _gaps(load: Array, damping: Array, dt: float) -> Array:
    """Integrate columns of load [m/s^2] with de/dt = load - damping e; shape (n, k)."""
    out = np.zeros(load.shape)
    for i in range(1, load.shape[0]):
        keep = 1.0 - dt * damping[i]
        for j in range(load.shape[1]):
            out[i, j] = keep * out[i - 1, j] + 0.5 * dt * (load[i - 1, j] + load[i, j])
    return out


def balance_residual(scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> Array:
    """Return the residual r of the assumed balance, without gusts, map and weighing errors [N/kN]."""
    stock = scene.stocks[0]
    gamma = stock.gamma
    time = log[:, T]
    weighed = log[:, WEIGHED]
    # The true load, so that the specific force has no weighing error.
    loaded = np.array([s.loaded for s in scene.stocks])[log[:, LEG].astype(int)]
    effort = log[:, REAL] if kit.force_carries_delay else log[:, NOM]
    pull = log[:, PULL] / loaded
    bite = (1.0 + gamma) * effort * weighed / loaded
    specific = 1000.0 / GRAV * np.interp(time - quirks.force_late, time, pull + bite)
    v = quirks.wheel * log[:, V]
    slope = map_gradient(scene, log[:, X] + log[:, WAY] * quirks.map_ahead, log[:, WAY])
    rise = np.gradient(v, 0.1)
    balance = specific - (stock.a + stock.b * v + stock.c * v * v) - slope
    r: Array = balance - 1000.0 / GRAV * (1.0 + gamma) * rise - log[:, GUST] - log[:, FLAW]
    return r


def weighing_residual(scene: Scene, kit: Instruments, log: Array) -> Array:
    """Return the residual of the assumed balance due to the weighing error, part of the floor [N/kN]."""
    weighed = log[:, WEIGHED]
    loaded = np.array([s.loaded for s in scene.stocks])[log[:, LEG].astype(int)]
    effort = log[:, REAL] if kit.force_carries_delay else log[:, NOM]
    force = log[:, PULL] + (1.0 + scene.stocks[0].gamma) * effort * weighed
    error: Array = 1000.0 / GRAV * force * (1.0 / weighed - 1.0 / loaded)
    return error


def visible(scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> Visible:
    """Return the rise of the rms speed gap of the refitted assumed model due to the effects."""
    stock = scene.stocks[0]
    r = balance_residual(scene, quirks, kit, log)
    noise = log[:, GUST] + log[:, FLAW] + weighing_residual(scene, kit, log)
    slip = slip_bursts(np.random.default_rng([kit.base_ns % 2**31, 5]), log, quirks.slip_share, quirks.slip_speed)
    scale = -GRAV / (1000.0 * (1.0 + stock.gamma))
    blocks: list[Array] = []
    for leg in np.unique(log[:, LEG]):
        rows = np.flatnonzero(log[:, LEG] == leg)
        moving = rows[log[rows, V] > 0.5]
        rows = np.arange(moving[0] + 3, moving[-1] - 2)
        v = log[rows, V]
        damping = -scale * (stock.b + 2.0 * stock.c * v)
        load = scale * np.column_stack([r[rows], noise[rows], np.ones(len(v)), v, v * v, np.zeros(len(v))])
        gaps = _gaps(load, damping, 0.1)
        start = np.exp(-np.cumsum(damping) * 0.1)
        gaps[:, 0] -= slip[rows]
        gaps[:, 5] = start
        inside = gaps[:, :5] - np.outer(start, start @ gaps[:, :5]) / float(start @ start)
        blocks.append(inside[::2])
    stack = np.vstack(blocks)
    base = stack[:, 2:5] / np.linalg.norm(stack[:, 2:5], axis=0)
    fitted = np.linalg.lstsq(base, stack[:, :2], rcond=None)[0]
    rest = stack[:, :2] - base @ fitted
    effect, drift = np.sqrt(np.mean(rest**2, axis=0)).tolist()
    floor = float(np.sqrt(drift**2 + kit.speed_noise**2 + kit.quantum**2 / 12.0))
    raw = float(np.sqrt(np.mean(stack[:, 0] ** 2)))
    return Visible(100.0 * (float(np.hypot(effect, floor)) / floor - 1.0), effect, floor, raw)

# SPDX-License-Identifier: Apache-2.0
"""Scores of speed models on station lines, and the Cramer-Rao bound."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from research.papers.lockstep import Track
    from research.papers.station_lines import Lines

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

START: Final = 200
"""Samples before this are not scored, the convergence time of the paper."""
MOVING: Final = 1.0
_LOST_RMS: Final = 1.0
_LOST_SPEED: Final = 100.0
_EVERY: Final = 7
# Speed at which resistances are compared [m/s].
_SPEED: Final = 18.0


@dataclass(frozen=True, slots=True)
class Score:
    """Score of a method on some lines."""

    error: float  # Measured minus predicted speed, root mean square [m/s]
    ahead: float  # Predicted minus true speed at the next sample, root mean square [m/s]
    five: tuple[float, float]  # Error of a 5 s free run from the method's own state: median and 95th percentile [m/s]
    thirty: tuple[float, float]  # The same for 30 s
    b1: float  # Median error of b1 [%]
    r18: float  # Median error of the resistance at 18 m/s with the gradient [mm/s^2]
    # Median error of the acceleration at samples 1130, 1160 and 1200, gradient drop at 1100-1130 [mm/s^2].
    step: tuple[float, float, float]
    lost: float  # Share of lines that end not finite, diverged, or with an error above 1 m/s


def moving(lines: Lines, start: int = START) -> Mask:
    """Return a mask of the samples that are scored."""
    mask: Mask = lines.x > MOVING
    mask[:start] = False
    return mask


def score(lines: Lines, track: Track) -> Score:
    """Score a track."""
    mask = moving(lines)
    state = np.moveaxis(track.state, 1, 0)
    with np.errstate(all='ignore'):
        b1 = 100.0 * np.abs(state[3] / lines.theta[:, 2] - 1.0)
        r18 = np.abs(acceleration(state[1:], _SPEED, 0.0) - acceleration(true(lines), _SPEED, 0.0))
        now = np.abs(acceleration(state[1:], lines.x, lines.u) - acceleration(true(lines), lines.x, lines.u))
        scored = mask[1095:1201].all(axis=0)
        five, thirty = (free_run(lines, track, round(seconds / SAMPLE_PERIOD)) for seconds in (5.0, 30.0))
        return Score(
            rms(track.error[mask]),
            rms((track.predicted - lines.x)[mask]),
            (float(np.median(five)), float(np.percentile(five, 95.0))),
            (float(np.median(thirty)), float(np.percentile(thirty, 95.0))),
            float(np.nanmedian(b1[mask])),
            1e3 * float(np.nanmedian(r18[mask])),
            tuple(1e3 * float(np.nanmedian(now[n][scored])) for n in (1130, 1160, 1200)),  # type: ignore[arg-type]
            float(np.mean(lost(lines, track))),
        )


def rms(values: Array) -> float:
    """Return the root mean square of the values that are not NaN, clipped to 1e6."""
    finite = np.where(np.isnan(values), 0.0, np.clip(values, -1e6, 1e6))
    return math.sqrt(float(np.sum(finite**2)) / max(1, int(np.sum(~np.isnan(values)))))


def true(lines: Lines) -> Array:
    """Return theta with the parameters first, shape (4, samples, lines)."""
    return np.moveaxis(lines.theta, 1, 0)


def acceleration(theta: Array, x: Array | float, u: Array | float) -> Array:
    """Return the acceleration of a model [m/s^2]; theta has the parameters first."""
    a: Array = (theta[0] * x * x + (theta[1] - 1.0) * x + theta[2] * u + theta[3]) / SAMPLE_PERIOD
    return a


def free_run(lines: Lines, track: Track, steps: int) -> Array:
    """Return |error| of the speed [m/s] after ``steps`` with true force and frozen parameters, starting in motion."""
    mask = moving(lines)
    starts = np.arange(START, len(lines.x) - steps, _EVERY)
    in_motion = np.stack([mask[n : n + steps + 1].all(axis=0) for n in starts])
    z, theta = track.state[starts, 0], np.moveaxis(track.state[starts, 1:], 1, 0)
    for k in range(steps):
        z = z + SAMPLE_PERIOD * acceleration(theta, z, lines.u[starts + k])
    error = np.abs(z - lines.x[starts + steps])[in_motion]
    return np.where(np.isfinite(error), error, 1e9)


def lost(lines: Lines, track: Track) -> Mask:
    """Return a mask of the lines that are lost."""
    wrong = np.where(moving(lines), track.predicted - lines.x, 0.0)
    share = np.sqrt(np.sum(np.clip(wrong, -1e3, 1e3) ** 2, axis=0) / moving(lines).sum(axis=0))
    speed = np.max(np.abs(track.state[:, 0]), axis=0)
    mask: Mask = ~np.isfinite(track.state).all(axis=(0, 1)) | (speed > _LOST_SPEED) | ~(share <= _LOST_RMS)
    return mask


def nees(lines: Lines, track: Track) -> Array:
    """Return (theta - true)' S^-1 (theta - true) / 4 at every tenth sample in motion."""
    rows = np.arange(0, len(lines.x), 10)
    mask = moving(lines)[rows]
    error = (track.state[rows, 1:] - lines.theta[rows]).transpose(0, 2, 1)[mask]
    S = np.empty((*error.shape, 4))
    for k, (i, j) in enumerate(zip(*np.triu_indices(4), strict=True)):
        S[..., i, j] = S[..., j, i] = track.S[: len(rows), k][mask]
    scale = np.sqrt(np.einsum('nii->ni', S))
    scaled = error / scale
    solved = np.linalg.solve(S / (scale[:, :, None] * scale[:, None, :]), scaled[..., None])[..., 0]
    result: Array = np.sum(scaled * solved, axis=1) / 4.0
    return result


@dataclass(frozen=True, slots=True)
class OneRun:
    """One run with constant parameters: samples in motion only, theta and the Cramer-Rao bound of each line."""

    theta: Array  # True parameters, shape (lines, 4)
    bound: Array  # Standard deviations of a1, a2, b1, d0 and of the acceleration at 18 m/s, shape (lines, 5)
    fitted: Array  # Parameters by maximum likelihood (output error), shape (lines, 4)
    one_step: Array  # Parameters by least squares on single steps, (5), shape (lines, 4)
    integral: Array  # Parameters by least squares on changes over 25 samples, shape (lines, 4)


def identify(lines: Lines, y: Array, std: float) -> OneRun:
    """Return bound and batch estimates of every line."""
    results = [_identify_line(lines, y, k, std) for k in range(y.shape[1])]
    return OneRun(*(np.array(column) for column in zip(*results, strict=True)))


def _identify_line(lines: Lines, y: Array, line: int, std: float) -> tuple[Array, ...]:
    # From the last sample before the first fast one, up to the last fast one.
    fast = np.nonzero(y[:, line] >= 0.5)[0]
    first, last = int(fast[0]) - 1, int(fast[-1])
    seen, u = y[first : last + 1, line], lines.u[first:last, line]
    theta = lines.theta[first, :, line]
    information = _sensitivity(np.array([lines.x[first, line], *theta]), u)[1]
    bound = _bound(information / std, std)
    fitted = np.array([seen[0], *theta])
    for _ in range(4):
        x, psi = _sensitivity(fitted, u)
        fitted = fitted + _solve(psi, seen - x)
    phi = np.stack([seen[:-1] ** 2, seen[:-1], u, np.ones_like(u)], axis=1)
    sums = np.cumsum(np.vstack([np.zeros(4), phi]), axis=0)
    k = 25
    integral = _solve(sums[k:] - sums[:-k], seen[k:] - seen[:-k]) + np.array([0.0, 1.0, 0.0, 0.0])
    return theta, bound, fitted[1:], _solve(phi, seen[1:]), integral


def _sensitivity(start: Array, u: Array) -> tuple[Array, Array]:
    """Return x [m/s] simulated from x(0) and theta, and its gradient, shape (samples, 5)."""
    x, (a1, a2, b1, d0) = float(start[0]), start[1:].tolist()
    psi = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    xs, rows = [x], [psi]
    for force in u.tolist():
        psi = (2.0 * a1 * x + a2) * psi
        psi[1:] += (x * x, x, force, 1.0)
        x = a1 * x * x + a2 * x + b1 * force + d0
        xs.append(x)
        rows.append(psi)
    return np.array(xs), np.array(rows)


def _solve(phi: Array, y: Array) -> Array:
    """Return the least-squares solution, computed with scaled columns."""
    scale = np.linalg.norm(phi, axis=0)
    solution: Array = np.linalg.lstsq(phi / scale, y, rcond=None)[0] / scale
    return solution


def _bound(rows: Array, std: float) -> Array:
    """Return the bounds from rows of the gradient over the noise, with x(0) known from one measurement."""
    rows = np.vstack([rows, np.array([1.0 / std, 0.0, 0.0, 0.0, 0.0])])
    scale = np.linalg.norm(rows, axis=0)
    R = np.linalg.qr(rows / scale, mode='r')
    root = np.linalg.inv(R) / scale[:, None]
    at_18 = np.array([0.0, _SPEED**2, _SPEED, 0.0, 1.0]) / SAMPLE_PERIOD
    std_all = np.linalg.norm(np.vstack([root[1:], at_18 @ root]), axis=1)
    return np.array(std_all)


def over_bound(run: OneRun, found: Array) -> Array:
    """Return root mean square error over the bound for a1, a2, b1, d0 and the acceleration at 18 m/s, shape (5,)."""
    wrong = found - run.theta
    r18 = wrong @ np.array([_SPEED**2, _SPEED, 0.0, 1.0]) / SAMPLE_PERIOD
    ratio = np.column_stack([wrong, r18]) / run.bound
    result: Array = np.sqrt(np.mean(ratio**2, axis=0))
    return result

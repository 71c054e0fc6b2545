# SPDX-License-Identifier: Apache-2.0
"""A random railway line: stations, map of gradients, curves and tunnels, and the error of the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CELL: Final = 2.0
APRON: Final = 600.0


@dataclass(frozen=True, slots=True)
class Ground:
    """The line; running integrals over position on a grid of ``CELL`` metres that starts at ``origin``.

    Attributes:
        stops: Stopping points [m].
        gradient: (position, per mille) of the map.
        curve: (position, radius) of the map.
        tunnel: (start, end).
        origin: Position of the first grid node [m].
        climb: Integral of the map's gradient [per mille m].
        flaw: Integral of true minus map gradient [per mille m].
        bend: Integral of 1/R [-].
        bore: Integral of the tunnel indicator [m].

    """

    stops: tuple[float, ...]
    gradient: tuple[tuple[float, float], ...]
    curve: tuple[tuple[float, float], ...]
    tunnel: tuple[tuple[float, float], ...]
    origin: float
    climb: Array
    flaw: Array
    bend: Array
    bore: Array

    def at(self, table: Array, x: Array) -> Array:
        """Interpolate one of the integrals."""
        return np.interp(x, self.origin + CELL * np.arange(len(table)), table)

    def mean_under(self, table: Array, front: Array, facing: Array, length: float) -> Array:
        """Return the mean of the integrand between rear and front."""
        return np.abs(self.at(table, front) - self.at(table, front - facing * length)) / length

    def signed_mean_under(self, table: Array, front: Array, facing: Array, length: float) -> Array:
        """Return the mean of the integrand under the train, with the sign of the direction of travel."""
        return (self.at(table, front) - self.at(table, front - facing * length)) / length


def draw_ground(
    rng: np.random.Generator,
    gaps: list[float],
    *,
    steepest: float,
    tightest: float,
    curves: bool,
    tunnels: bool,
    flaw_std: float,
    flaw_length: float,
) -> Ground:
    """Draw a line with these distances between its stops."""
    first = float(rng.uniform(0.0, 3000.0))
    stops = tuple(round(float(first + s), 1) for s in np.concatenate([[0.0], np.cumsum(gaps)]))
    low, high = stops[0] - APRON, stops[-1] + APRON
    gradient = _gradients(rng, low, high, steepest, float(np.mean(gaps)), stops)
    curve = _curves(rng, low, stops, tightest) if curves else ((round(low, 1), 0.0),)
    tunnel = _tunnels(rng, stops) if tunnels else ()
    nodes = np.arange(low, high + CELL, CELL)
    middle = nodes[:-1] + 0.5 * CELL
    return Ground(
        stops,
        gradient,
        curve,
        tunnel,
        float(low),
        _integral(_steps(gradient, middle)),
        _integral(_coloured(rng, len(middle), flaw_std, flaw_length)),
        _integral(np.where(_steps(curve, middle) > 0.0, 1.0 / np.maximum(_steps(curve, middle), 1.0), 0.0)),
        _integral(np.array([sum(1.0 for s, e in tunnel if s <= x < e) for x in middle])),
    )


def _gradients(
    rng: np.random.Generator, low: float, high: float, steepest: float, gap: float, stops: tuple[float, ...]
) -> tuple[tuple[float, float], ...]:
    """Draw gradients in pieces of lognormal length; they revert to level, so that the height stays bounded."""
    out, x, slope = [], low, 0.0
    typical = float(np.clip(0.12 * gap, 150.0, 700.0))
    while x < high:
        slope = float(np.clip(0.2 * slope + rng.standard_normal() * 0.5 * steepest, -steepest, steepest))
        if min(abs(x - s) for s in stops) < 150.0:
            slope *= 0.25
        out.append((round(x, 1), round(slope, 1)))
        x += typical * float(np.clip(rng.lognormal(0.0, 0.6), 0.3, 3.0))
    return tuple(out)


def _curves(
    rng: np.random.Generator, low: float, stops: tuple[float, ...], tightest: float
) -> tuple[tuple[float, float], ...]:
    out, x = [(round(low, 1), 0.0)], stops[0] + float(rng.uniform(50.0, 400.0))
    while x < stops[-1] - 200.0:
        length = float(rng.uniform(120.0, 700.0))
        radius = float(np.clip(tightest * rng.lognormal(0.5, 0.5), 250.0, 1500.0))
        out += [(round(x, 1), float(round(radius))), (round(x + length, 1), 0.0)]
        x += length + float(rng.uniform(150.0, 1500.0))
    return tuple(out)


def _tunnels(rng: np.random.Generator, stops: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """Draw a tunnel on one or two random legs."""
    legs = rng.permutation(len(stops) - 1)[: int(rng.integers(1, 3))]
    out = []
    for leg in sorted(legs.tolist()):
        gap = stops[leg + 1] - stops[leg]
        length = float(np.clip(rng.uniform(0.15, 0.45) * gap, 200.0, 2200.0))
        start = stops[leg] + float(rng.uniform(0.15, 0.8 - length / gap)) * gap
        out.append((round(start, 1), round(start + length, 1)))
    return tuple(out)


def _steps(pairs: tuple[tuple[float, float], ...], x: Array) -> Array:
    at = np.searchsorted(np.array([p for p, _ in pairs]), x, side='right') - 1
    values: Array = np.array([v for _, v in pairs])[np.maximum(at, 0)]
    return values


def _integral(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values) * CELL])


def _coloured(rng: np.random.Generator, count: int, std: float, length: float) -> Array:
    """Return a smooth stationary process: white noise filtered with a Gaussian window."""
    reach = int(3.0 * length / CELL)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * CELL / (0.7 * length)) ** 2)
    window /= np.sqrt(np.sum(window**2))
    noise = rng.standard_normal(count + 2 * reach)
    size = 1 << int(np.ceil(np.log2(len(noise) + len(window))))
    smooth = np.fft.irfft(np.fft.rfft(noise, size) * np.fft.rfft(window, size), size)
    values: Array = std * smooth[2 * reach : 2 * reach + count]
    return values

# SPDX-License-Identifier: Apache-2.0
"""The lines: two public (TTOBench, BSD-2, licence in ``data``) and three random, in both directions of travel."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

Range = tuple[float, float]
Pairs = tuple[tuple[float, float], ...]


# Curvature below which track counts as straight [1/m]; margin before the first and after the last stop [m].
MIN_CURVATURE: Final = 1e-5
MARGIN: Final = 1500.0
DATA: Final = Path(__file__).parent / 'data'


@dataclass(frozen=True, slots=True)
class Track:
    """A line by rising position [m]: gradients in per mille, radii in m (0 straight), limits in m/s."""

    stops: tuple[float, ...]
    gradient: Pairs
    radius: Pairs
    limit: Pairs


@dataclass(frozen=True, slots=True)
class Way:
    """A line in one direction; at index ``i`` the train's front is ``i - offset`` m from the first stop."""

    sign: int  # 1 if positions rise in the direction of travel, else -1
    origin: float  # Position of the first stop of this direction [m]
    offset: float  # Index of that stop
    gradient: NDArray[np.float64]  # Mean gradient under the train [per mille, + uphill in the direction of travel]
    curvature: NDArray[np.float64]  # Mean curvature under the train [1/m]
    slope: list[float]  # Gradient and curve resistance together [N/kN]
    stops: tuple[float, ...]  # Distances of the stops from the first one [m]
    limits: Pairs  # Distance from which a speed limit holds for the entire train [m], and the limit [m/s]

    def position(self, way: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions along the line [m]."""
        return self.origin + self.sign * way


def lay_way(track: Track, sign: int, length: float, curve: float) -> Way:
    """Return a line in one direction for a train length [m] and a curve resistance coefficient [N/kN m]."""
    first, last = track.stops[0] - MARGIN, track.stops[-1] + MARGIN
    grid = np.arange(first, last, 1.0) + 0.5
    gradient, limit = _sampled(track.gradient, grid), _sampled(track.limit, grid)
    radius = _sampled(track.radius, grid)
    curvature = np.where(radius > 0.0, 1.0 / np.maximum(radius, 1.0), 0.0)
    if sign < 0:
        gradient, limit, curvature = -gradient[::-1], limit[::-1], curvature[::-1]
    mean_gradient, mean_curvature = _under_train(gradient, length), _under_train(curvature, length)
    mean_curvature[mean_curvature < MIN_CURVATURE] = 0.0
    origin = track.stops[0] if sign > 0 else track.stops[-1]
    offset = MARGIN if sign > 0 else grid.size - (track.stops[-1] - first)
    return Way(
        sign=sign,
        origin=origin,
        offset=offset,
        gradient=mean_gradient,
        curvature=mean_curvature,
        slope=(mean_gradient + curve * mean_curvature).tolist(),
        stops=tuple(sorted(sign * (stop - origin) for stop in track.stops)),
        limits=_pieces(_limit_of_train(limit, length), offset),
    )


def _sampled(pairs: Pairs, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    starts = np.array([start for start, _ in pairs])
    values = np.array([value for _, value in pairs])
    return values[np.clip(np.searchsorted(starts, grid, side='right') - 1, 0, values.size - 1)]


def _under_train(values: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Return the means over ``length`` behind each integer metre; ``values[i]`` holds from i to i + 1 m."""
    total = np.concatenate(([0.0], np.cumsum(values)))
    at = np.arange(values.size + 1, dtype=np.float64)
    rear = np.maximum(at - length, 0.0)
    return np.asarray((total - np.interp(rear, at, total)) / np.maximum(at - rear, 1.0))


def _limit_of_train(limit: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    size = round(length)
    return np.asarray(minimum_filter1d(limit, size, origin=(size - 1) // 2, mode='nearest'))


def _pieces(limit: NDArray[np.float64], offset: float) -> Pairs:
    starts = np.concatenate(([0], np.flatnonzero(np.diff(limit)) + 1))
    return tuple((float(i) - offset, float(limit[i])) for i in starts)


@cache
def track_of(world: str) -> Track:
    if world == 'metro':
        return _metro()
    if world == 'emu':
        return _emu()
    return {'high_speed': _high_speed, 'freight': _freight, 'tram': _tram}[world]()


def _public(name: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((DATA / f'{name}.json').read_text(encoding='utf-8'))
    return data


def _metro() -> Track:
    """Return the Yizhuang line; its file has no curves, so they are random."""
    data = _public('CN_Songjiazhuang_Yizhuang')
    rng = np.random.default_rng(11)
    stops = tuple(float(stop) for stop in data['stops']['values'])
    return Track(
        stops=stops,
        gradient=tuple((float(s), float(i)) for s, i in data['gradients']['values']),
        radius=_curves(rng, stops[-1], (350.0, 1500.0), (150.0, 400.0), (150.0, 700.0)),
        limit=tuple((float(s), float(v) / 3.6) for s, v in data['speed limits']['values']),
    )


def _emu() -> Track:
    """Return St. Gallen - Wil with its intermediate stations and the limits of a faster train category."""
    data = _public('CH_StGallen_Wil')
    radius = []
    for start, first, last in data['curvatures']['values']:
        bend = 0.5 * sum(1.0 / abs(r) if np.isfinite(r) and r != 0.0 else 0.0 for r in (float(first), float(last)))
        radius.append((float(start), 1.0 / bend if bend > MIN_CURVATURE else 0.0))
    return Track(
        stops=(0.0, 5150.0, 10100.0, 17300.0, 22600.0, 29450.0),
        gradient=tuple((float(s), float(i)) for s, i in data['gradients']['values']),
        radius=tuple(radius),
        limit=tuple((float(s), min(1.25 * float(v), 150.0) / 3.6) for s, v in data['speed limits']['values']),
    )


def _high_speed() -> Track:
    rng = np.random.default_rng(12)
    end = 246e3
    limit = ((0.0, 44.5), (4000.0, 69.5), (15e3, 77.8), (63e3, 69.5), (74e3, 77.8), (150e3, 72.2), (170e3, 77.8),
             (end - 8000.0, 55.6), (end - 2000.0, 33.4))  # fmt: skip
    return Track(
        stops=(0.0, 68e3, 148e3, end),
        gradient=_grades(rng, end, 5.0, 14.0, (900.0, 4000.0)),
        radius=_curves(rng, end, (4000.0, 7000.0), (1500.0, 4000.0), (1000.0, 6000.0)),
        limit=limit,
    )


def _freight() -> Track:
    rng = np.random.default_rng(13)
    end = 96e3
    limit = ((0.0, 16.7), (2500.0, 25.0), (19e3, 22.2), (27e3, 25.0), (44e3, 19.4), (48e3, 25.0), (72e3, 22.2),
             (80e3, 25.0), (end - 2500.0, 16.7))  # fmt: skip
    return Track(
        stops=(0.0, 31e3, 62e3, end),
        gradient=_grades(rng, end, 3.2, 7.5, (500.0, 2500.0)),
        radius=_curves(rng, end, (350.0, 1800.0), (200.0, 700.0), (300.0, 2500.0)),
        limit=limit,
    )


def _tram() -> Track:
    rng = np.random.default_rng(14)
    stops = np.concatenate(([0.0], np.cumsum(np.round(rng.uniform(400.0, 700.0, 20)))))
    end = float(stops[-1])
    radius = _curves(rng, end, (30.0, 300.0), (20.0, 90.0), (60.0, 420.0))
    limit = tuple((s, 15.3 if r == 0.0 else min(15.3, float(np.sqrt(0.85 * r)))) for s, r in radius)
    grades = _grades(rng, end, 22.0, 60.0, (60.0, 350.0))
    # Tram stops lie on smaller gradients than the streets between them.
    return Track(tuple(float(s) for s in stops), _limited_at_stops(grades, stops, 20.0), radius, limit)


def _grades(rng: np.random.Generator, end: float, std: float, most: float, lengths: Range) -> Pairs:
    """Return random gradients that revert to the initial height, in pieces of random length."""
    starts, values = [-MARGIN], [0.0]
    height = 0.0
    while starts[-1] < end + MARGIN:
        step = float(rng.uniform(*lengths))
        value = float(np.clip(rng.normal(-height / (8.0 * lengths[1]) * 1000.0, std), -most, most))
        starts.append(starts[-1] + step)
        values.append(round(value, 1))
        height += value * step / 1000.0
    return tuple(zip(starts, values, strict=True))


def _limited_at_stops(grades: Pairs, stops: NDArray[np.float64], most: float) -> Pairs:
    cuts = sorted({start for start, _ in grades} | {float(s + d) for s in stops for d in (-40.0, 10.0)})
    values = _sampled(grades, np.array(cuts) + 0.5)
    at_stop = [bool(np.any((cut >= stops - 40.0) & (cut < stops + 10.0))) for cut in cuts]
    return tuple(
        (cut, float(np.clip(value, -most, most)) if near else float(value))
        for cut, value, near in zip(cuts, values, at_stop, strict=True)
    )


def _curves(rng: np.random.Generator, end: float, radii: Range, curved: Range, straight: Range) -> Pairs:
    """Return alternating curves and straights; radii are log-uniform."""
    out = [(-MARGIN, 0.0)]
    at = float(rng.uniform(*straight))
    while at < end:
        radius = float(np.exp(rng.uniform(np.log(radii[0]), np.log(radii[1]))))
        out.append((at, round(radius, 1)))
        at += float(rng.uniform(*curved))
        out.append((at, 0.0))
        at += float(rng.uniform(*straight))
    return tuple(out)

# SPDX-License-Identifier: Apache-2.0
"""Claims of Yuan et al. 2017 on Figs. 4 and 5, checked on station lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from benchmarks.tables import Table
from research.papers.line_scores import Score, moving, rms
from research.papers.lockstep import Track
from research.papers.station_lines import NOISES, Lines, Noise, measured
from research.papers.yuan_methods import PRINTED, paper

WHITE: Final = NOISES[0]
_SHARP: Final = 0.005
_MAJORITY: Final = 0.5
_SHARP_NOISES: Final = (0.002, 0.005, 0.02)
_CONVERGED: Final = 0.2
# Fig. 4: lowest and highest printed value of each parameter.
PRINTED_RANGES: Final = {'a1': (-0.012, 0.008), 'a2': (0.96, 1.02), 'b1': (-0.003, 0.01)}
# Physical limits: resistance decelerates and traction accelerates.
_PHYSICAL: Final = {'a1': (-math.inf, 0.0), 'a2': (-math.inf, 1.0), 'b1': (0.0, math.inf)}


def claims_table(
    lines: Lines, tracks: dict[str, Track], scores: dict[str, dict[str, Score]], seeds: Sequence[int]
) -> Table:
    white = scores[WHITE.name]
    printed, vff, am = tracks[PRINTED], tracks['VFF-RLS'], tracks['AM-RLS']
    wins = _share_of_lines(lines, printed, vff)
    by_noise = ', '.join(
        f'{noise}: {by[PRINTED].error / by["VFF-RLS"].error:.2f} / {by[PRINTED].five[0] / by["VFF-RLS"].five[0]:.2f}'
        for noise, by in scores.items()
    )
    drift = [_rms_of(lines, am, part) for part in (slice(200, 700), slice(1700, 2200))]
    ours = white['AM-VFF-RLS']
    sharp = {std: _sharp_share(lines, seeds, std) for std in _SHARP_NOISES}
    at_200 = _parameter_error(lines, printed, 220)
    better = [
        sum(by[PRINTED].error < by['VFF-RLS'].error for by in scores.values()),
        sum(by[PRINTED].five[0] < by['VFF-RLS'].five[0] for by in scores.values()),
    ]
    rows = (
        (
            'Fig. 5: AM-VFF-RLS better than VFF-RLS', 'smaller error', f'{wins:.0%} of lines, one step',
            f'one step / 5 s, ratio to VFF-RLS: {by_noise}', f'{ours.five[0] / white["VFF-RLS"].five[0]:.2f} (5 s)',
            f'one step: confirmed for {better[0]} of {len(scores)} noises; 5 s, which ranks models: for {better[1]}',
        ),
        (
            'Fig. 5: error of AM-RLS grows', 'close at first, then "significantly"',
            f'rms {drift[0]:.3f} -> {drift[1]:.3f} m/s', '', '', _verdict(drift[1] > 1.5 * drift[0]),
        ),
        (
            'Fig. 5: |error| < 0.005 most of the time', '> 50 %',
            ', '.join(f'{share:.0%} at noise of {std:g} m/s' for std, share in sharp.items()),
            'of noise alone: ' + ', '.join(f'{sharp_noise(std):.0%}' for std in sharp), '', sharp_verdict(sharp),
        ),
        (
            'Fig. 4: parameters converge in 200 samples', '200',
            'median errors at 200 samples in motion: ' + ', '.join(f'{e:.0%}' for e in at_200), '', '',
            parameters_verdict(at_200),
        ),
        (
            'Fig. 4: ranges of the parameters', _span(PRINTED_RANGES), _span(_ranges(lines)), '', '',
            ranges_verdict(_ranges(lines)),
        ),
    )  # fmt: skip
    header = ('claim', 'printed', 'ours, as printed', 'by noise', 'ours, corrected', 'verdict')
    return Table('Claims of the paper', header, rows, 'The data of the paper (Hangzhou Line 4) are not public.')


def _verdict(holds: bool) -> str:
    return 'confirmed' if holds else 'refuted'


def _share_of_lines(lines: Lines, one: Track, other: Track) -> float:
    mask = moving(lines)
    totals = [np.nansum(np.where(mask, np.clip(t.error, -1e3, 1e3) ** 2, 0.0), axis=0) for t in (one, other)]
    return float(np.mean(totals[0] < totals[1]))


def _rms_of(lines: Lines, track: Track, part: slice) -> float:
    mask = moving(lines)[part]
    return rms((track.predicted - lines.x)[part][mask])


def _sharp_share(lines: Lines, seeds: Sequence[int], std: float) -> float:
    noise = Noise(f'white {std}', std=std)
    y = measured(lines, noise, seeds)
    error = paper('', std**2, 0.0, 75.0).drive(lines, y).error
    return float(np.mean(np.abs(error[moving(lines)]) < _SHARP))


def _parameter_error(lines: Lines, track: Track, n: int) -> tuple[float, ...]:
    """Return the median relative error of a1, a2 - 1, b1, d0 at a sample."""
    one = np.array([0.0, 1.0, 0.0, 0.0])[:, None]
    wrong = np.abs(track.state[n, 1:] - lines.theta[n]) / np.abs(lines.theta[n] - one)
    return tuple(float(v) for v in np.median(wrong, axis=1))


def sharp_noise(std: float) -> float:
    """Return the probability that white noise alone is below 0.005 m/s."""
    return math.erf(_SHARP / (std * math.sqrt(2.0)))


def sharp_verdict(sharp: dict[float, float]) -> str:
    """Return the noises [m/s] for which most errors are small, and whether noise alone gives the same result."""
    so = [std for std, share in sharp.items() if share > _MAJORITY]
    as_noise = all((sharp_noise(std) > _MAJORITY) == (std in so) for std in sharp)
    found = f'confirmed at noise of {", ".join(f"{std:g}" for std in so)} m/s' if so else 'refuted at every noise'
    if so and len(so) < len(sharp):
        found += f', refuted at {", ".join(f"{std:g}" for std in sharp if std not in so)}'
    reason = 'as with noise alone, so it characterises the sensor' if as_noise else 'noise alone gives another result'
    return f'{found}: {reason}'


def parameters_verdict(errors: tuple[float, ...]) -> str:
    """Return which of a1, a2 - 1, b1, d0 have converged."""
    known = [name for name, error in zip(('a1', 'a2', 'b1', 'd0'), errors, strict=True) if error < _CONVERGED]
    if len(known) == len(errors):
        return 'confirmed'
    which = f'only {", ".join(known)}' if known else 'none'
    return f'refuted: of four {which} within {_CONVERGED:.0%}'


def ranges_verdict(ours: dict[str, tuple[float, float]]) -> str:
    """Return the verdict on the printed ranges, compared with the true ones."""
    signs = []
    for name, (low, high) in PRINTED_RANGES.items():
        least, most = _PHYSICAL[name]
        signs += [f'{name} = {value:g}' for value, bad in ((low, low < least), (high, high > most)) if bad]
    beyond = max(map(abs, PRINTED_RANGES['a1'])) / max(map(abs, ours['a1']))
    inside = all(ours[name][0] <= low and high <= ours[name][1] for name, (low, high) in PRINTED_RANGES.items())
    if inside and not signs:
        return 'confirmed'
    return (
        f'refuted: a1 up to {beyond:.0f} times the greatest true one; of the wrong sign: {", ".join(signs) or "none"}'
    )


def _ranges(lines: Lines) -> dict[str, tuple[float, float]]:
    low, high = lines.theta.min(axis=(0, 2)), lines.theta.max(axis=(0, 2))
    return {name: (float(a), float(b)) for name, a, b in zip(('a1', 'a2', 'b1', 'd0'), low, high, strict=True)}


def _span(ranges: dict[str, tuple[float, float]]) -> str:
    return ', '.join(f'{name} {a:.3g} to {b:.5g}' for name, (a, b) in ranges.items())

# SPDX-License-Identifier: Apache-2.0
"""Claims of Liu et al. 2018, one per row; every verdict follows from the numbers in its row."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from benchmarks.tables import Table, columns
from research.papers import coasts as data
from research.papers.liu_errata import resistance_printed
from research.papers.liu_table1 import LENGTHS, PLAIN_LS, PRINTED, dilution

if TYPE_CHECKING:
    from collections.abc import Iterable

    from research.papers.liu_streams import Trial

Row: TypeAlias = tuple[str, str, str, str, str, str]

_HEADER: Final = ('claim', 'paper', 'as printed', 'corrected', 'bound', 'verdict')


def _claim(text: str, verdict: str) -> Row:
    """Return a row of cells, with `` | `` between them, and the verdict."""
    claim, paper, printed, corrected, bound = columns(text)
    return claim, paper, printed, corrected, bound, verdict


def judged(refuted: bool, reason: str) -> str:
    """Return the verdict on a claim."""
    return f'refuted: {reason}' if refuted else 'confirmed'


def equations(trials: list[Trial]) -> Table:
    """Return the table of errors in the equations."""
    return Table(
        'Equations of Liu et al. 2018',
        _HEADER,
        (
            *_data_rows(trials),
            *_penalty_rows(trials),
            *_innovation_rows(trials),
            *_skipping_rows(trials),
            *_sign_rows(trials),
        ),
        'Error: greatest relative difference of a parameter, median over seeds, or the worst if due to rounding. '
        '1032 observations in white noise of 0.75 N/kN, lambda = 50.',
    )


def _data_rows(trials: list[Trial]) -> Iterable[Row]:
    w = [resistance_printed(3.0, gradient) for gradient in (0.0, 10.0, -10.0)]
    bias = np.mean([trial.prepared[0].bias for trial in trials], axis=0)
    yield _claim(
        f'(5) gives w = 3 N/kN coasting at i = 0, 10, -10 | -100 alpha - i | {_list(w, ".2f")} | 3.00 | 3.00',
        judged(abs(w[0] - 3.0) > 0.05, 'no rotating mass, g = 10'),
    )
    yield _claim(
        f'segments of Fig. 2 show w; bias at 25, 75 km/h, N/kN | - | {_list(bias[:2], ".3f")} | '
        f'{_list(bias[2:], ".3f")} (11 samples) | 0',
        judged(bool(bias[1] > 0.1), 'they end where noise crosses the limit'),
    )


def _penalty_rows(trials: list[Trial]) -> Iterable[Row]:
    halved, middle, earlier, peak, a_kmh, a_ms = (
        _median(trials, name) for name in ('halved', 'middle', 'earlier', 'earlier_peak', 'a_kmh', 'a_ms')
    )
    ends, exact = _worst(trials, 'ends'), f'{_worst(trials, "exact"):.0e}'
    biased, unbiased = (data.pooled(_of(trials, name)) for name in ('bias_printed', 'bias_ls'))
    yield _claim(
        f'(7) minimises J with lambda/2; error | 0 | {_percent(halved)} | 0 (J with lambda) | 0',
        judged(halved > 0.01, 'it minimises SSE + lambda |theta|^2'),
    )
    yield _claim(
        f'(12)-(16) equal (7) at t = N; error | 0 | {ends:.0e} | {exact} (P(0) = I/lambda) | 0',
        judged(ends > 1e-6, 'not equal'),
    )
    yield _claim(
        f'(12)-(16) equal (7) online; error at t = N/2 | 0 | {_percent(middle)} | {exact} (P(0) = I/lambda) | 0',
        judged(middle > 0.01, 'the penalty grows with t'),
    )
    yield _claim(
        f'P(t) in (12) may be P(t-1); error at t = N, greatest |theta| | no | {earlier:.1f}x, {peak:.0f} | - | 0',
        judged(earlier > 0.01, 'P(t) as printed is right'),
    )
    yield _claim(
        f'regularised RLS is accurate: RMSE, large a, N/kN | yes | {biased:.3f} | {unbiased:.3f} (LS) | -',
        judged(biased > 2.0 * unbiased, 'the penalty does not decay'),
    )
    yield _claim(
        f'lambda is a property of the train: a with v in km/h, in m/s | - | {a_kmh:.3f}, {a_ms:.3f} | prior, or '
        'scaled | 0.515',
        judged(abs(a_ms / a_kmh - 1.0) > 0.1, 'it depends on units'),
    )


def _innovation_rows(trials: list[Trial]) -> Iterable[Row]:
    differs, weighted = _worst(trials, 'mils_ls'), _worst(trials, 'weighted')
    nees = np.mean([trial.errata.nees for trial in trials], axis=0)
    stream = np.mean([trial.nees for trial in trials], axis=0)
    diluted = np.median([trial.errata.diluted for trial in trials], axis=0)
    yield _claim(
        f'MILS is more accurate than RLS: curves differ by at most, N/kN | yes | {differs:.4f} | {weighted:.0e} from '
        'weighted LS | -',
        judged(differs < 0.01, 'it is LS with each observation counted p times'),
    )
    yield _claim(
        f'P is the covariance: NEES/3 over sigma^2 P, p = {_list(LENGTHS)} | 1 | {_list(nees, ".2f")} | '
        f'{stream[0]:.2f} (RLS), {stream[1]:.2f} (MILS 4), streamed in gusts | 1',
        judged(bool(nees[-1] > 3.0), 'p times too small, and no sigma^2'),
    )
    yield _claim(
        f'regularised MILS keeps lambda; difference from lambda/p, p = {_list(LENGTHS)} | yes | '
        f'{", ".join(_percent(value) for value in diluted)} | P(0) = I/(p lambda) | -',
        judged(bool(diluted.max() < 0.1), 'it is diluted p times'),
    )


def _skipping_rows(trials: list[Trial]) -> Iterable[Row]:
    unused, missing = _median(trials, 'strict_unused'), data.pooled(_of(trials, 'missing'))
    yield _claim(
        f'V-MILS skips only bad data: good data unused, p = 4, 30 % bad | yes | {_percent(unused)} | 0 % (p = 1) | 0 %',
        judged(unused > 0.1, 'a step needs p consecutive good observations'),
    )
    yield _claim(
        f'RLS degrades with missing data: error over bound, 50 % missing | yes | {missing:.2f} | - | 1',
        judged(missing < 1.2, 'the model is static in v'),
    )


def _sign_rows(trials: list[Trial]) -> Iterable[Row]:
    lowest = float(data.resistance(PLAIN_LS, data.GRID).min())
    negative = float(np.mean([batch.negative for trial in trials for batch in trial.narrow]))
    yield _claim(
        f'b < 0 means resistance < 0: least w of the printed LS curve, N/kN | < 0 | {lowest:.2f} | - | -',
        judged(lowest > 0.0, 'it is positive at 20-80 km/h'),
    )
    yield _claim(
        f'the penalty keeps b, c >= 0: share negative, four short coasts, lambda = 1 | never | {_percent(negative)} | '
        '0 % (NNLS) | 0 %',
        judged(negative > 0.0, 'it guarantees no sign'),
    )


def table_one(trials: list[Trial]) -> Table:
    """Return Tables 1 and 2 of the paper with our results."""
    rows = (*_falls(trials), *_growth(trials), _misprint(), _residuals(trials), _velocities(trials))
    return Table(
        'Tables 1 and 2 of the paper',
        _HEADER,
        rows,
        'As printed: regularised MILS, lambda = 50, segments of Fig. 2 without gusts. Corrected: MILS without penalty. '
        'The LS row of the paper is ridge regression: true LS has the least training variance of all rows.',
    )


def _falls(trials: list[Trial]) -> Iterable[Row]:
    names = ('penalised', 'training', 'held_out')
    variances = (np.array([getattr(trial.shape, name) for trial in trials]) for name in names)
    shrunk, plain, unseen = (100.0 * (x / x[:, :1] - 1.0) for x in variances)
    for k in range(1, len(LENGTHS)):
        paper = 100.0 * (PRINTED[k + 1][4] / PRINTED[1][4] - 1.0)
        mean = float(plain[:, k].mean())
        yield _claim(
            f'residual variance falls from p = 1 to {LENGTHS[k]}; share of seeds | {paper:.2f} % | '
            f'{shrunk[:, k].mean():.3f} %; {_percent(np.mean(shrunk[:, k] < 0.0))} | {mean:+.4f} %; '
            f'{_percent(np.mean(plain[:, k] < 0.0))}; held out {unseen[:, k].mean():+.4f} % | 0 %',
            judged(mean >= 0.0, 'only the penalty decreases'),
        )


def _growth(trials: list[Trial]) -> Iterable[Row]:
    growth, printed = np.mean([trial.shape.a for trial in trials], axis=0), [row[1] for row in PRINTED[1:]]
    a4, a1 = dilution()
    yield _claim(
        f'a with p = {_list(LENGTHS)} | {_list(printed, ".3f")} | {_list(growth, ".3f")} | {data.PAPER[0]} at any p | '
        '-',
        judged(bool(np.all(np.diff(growth) > 0.0)), 'a diluted penalty, a = A p/(p + k)'),
    )
    yield _claim(
        f'a of p = 4 by dilution from p = 2, 6; a of p = 1 | {printed[2]}; {PRINTED[0][1]} (LS), {printed[0]} (RLS) | '
        f'{a4:.3f}; {a1:.3f} | - | -',
        'explains p = 2, 4, 6 and LS' if abs(a4 - printed[2]) < 0.01 else 'does not explain them',
    )


def _misprint() -> Row:
    curves = [row[1:4] for row in PRINTED]
    values = [float(data.resistance(curve, np.array(50.0))) for curve in curves]
    a, b, c = curves[3]
    corrected = float(data.resistance((a, b, c - 0.3e-3), np.array(50.0)))
    outlying = values[3] > max(values[2], values[4]) + 0.3
    return _claim(
        f'w(50 km/h) of the rows, N/kN | {_list(values, ".2f")} | p = 4 with c = 1.122e-3: {corrected:.2f} | - | -',
        'c of p = 4 probably a misprint of 1.122' if outlying else 'consistent',
    )


def _residuals(trials: list[Trial]) -> Row:
    still, gusty = (float(np.mean([trial.prepared[k].residual for trial in trials])) for k in range(2))
    return _claim(
        f'residual variance of LS, (N/kN)^2 | {PRINTED[0][4]:.3f} | {still:.3f}, in gusts {gusty:.3f} | - | -',
        'not reproducible: data not public',
    )


def _velocities(trials: list[Trial]) -> Row:
    ls, mils = np.mean([trial.shape.velocity for trial in trials], axis=0)
    change = 100.0 * (mils / ls - 1.0)
    return _claim(
        f'Table 2: variance of predicted speed, MILS against LS | {100.0 * (0.88 / 0.99 - 1.0):.0f} % | {change:+.2f} '
        '% (p = 4, held out) | - | 0 %',
        judged(bool(abs(change) < 2.0), 'the curves are the same'),
    )


def _of(trials: list[Trial], name: str) -> list[float]:
    return [float(getattr(trial.errata, name)) for trial in trials]


def _worst(trials: list[Trial], name: str) -> float:
    return max(_of(trials, name))


def _median(trials: list[Trial], name: str) -> float:
    return float(np.median(_of(trials, name)))


def _percent(value: Any) -> str:
    return f'{100.0 * value:.0f} %' if value >= 0.1 or value == 0.0 else f'{100.0 * value:.1g} %'


def _list(values: Iterable[Any], form: str = '') -> str:
    return ', '.join(format(value, form) for value in values)

# SPDX-License-Identifier: Apache-2.0
"""Brake rate: the experiment and claims of Zheng et al. 2015, bounds, and the estimators of the nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.seeds import over_seeds
from benchmarks.tables import Plot, Table
from research.papers import zheng2015_metro as metro
from research.papers import zheng2015_paper as paper
from research.papers.brake_runs import JUMP_AFTER_S, jump_run
from research.papers.zheng2015_paper import Errors, Estimates, PaperRun

Filter = Callable[['PaperRun', int], 'Estimates']

SCALES: Final = (1.0, 0.25, 0.1, 0.05, 0.02)
_RW: Final = 0.01
_SLOPE: Final = (0.0, 0.01)

# Table 1 as printed: f, D, v, a.
PRINTED: Final = {
    'RBPF': (0.105, 0.305, 0.185, 0.095),
    'SMA': (0.027, 0.304, 0.181, 0.037),
    'GSMA': (0.023, 0.304, 0.180, 0.036),
}
# Table 2 as printed: time of 150 steps [s].
PRINTED_S: Final = {'RBPF': 6.590, 'SMA': 56.505, 'GSMA': 16.760}
# Kalman updates per step: 50 particles of SMA with 11 values each, 50 of GSMA with three if always pruned.
_SMA_UPDATES: Final = 550.0
_PRUNED_UPDATES: Final = 150.0
_SAME_COST: Final = 0.25

# Row, name in the paper, filter.
ON_PAPER: Final[tuple[tuple[str, str, Filter], ...]] = (
    ('RBPF-250, static f', 'RBPF', paper.rbpf_static),
    ('RBPF-250, optimal proposal (9)-(13)', 'RBPF', paper.rbpf_drawing),
    ('RBPF-250, most likely value (text)', 'RBPF', partial(paper.rbpf_drawing, likeliest=True)),
    ('SMA as printed', 'SMA', paper.sma),
    ('SMA corrected: weights, stochastic', 'SMA', partial(paper.sma, stochastic=True)),
    ('GSMA as printed', 'GSMA', paper.gsma),
    ('GSMA: weights, stochastic', 'GSMA', partial(paper.gsma, stochastic=True)),
    ('GSMA: weights, stochastic, missing group', 'GSMA', partial(paper.gsma, stochastic=True, first=1)),
    ('GSMA corrected: no grid, 100', 'GSMA', paper.gsma_free),
    ('RBPF-500, walking f', '', paper.rbpf_walking),
    ('linear KF, walk 0.03', '', lambda run, _: paper.kalman(run, paper.WALK)),
    ('linear KF with trend', '', lambda run, _: paper.kalman(run, 0.0, 2e-4, _SLOPE)),
    ('bound: ramp of unknown slope', '', lambda run, _: paper.kalman(run, 0.0, 0.0, _SLOPE)),
    ('bound: ramp of known slope', '', lambda run, _: paper.kalman(run, 0.0, 0.0, (-0.005, 0.0))),
    ('bound of D, v, a: f known', '', lambda run, _: paper.known_rate(run)),
)
ON_SCALES: Final[tuple[tuple[str, Filter], ...]] = (
    ('SMA as printed', paper.sma),
    ('GSMA as printed', paper.gsma),
    ('GSMA corrected: no grid, 100', paper.gsma_free),
    ('linear KF with trend', lambda run, _: paper.kalman(run, 0.0, 2e-4, _SLOPE)),
)
ON_WALK: Final[tuple[tuple[str, Filter], ...]] = (
    ('linear KF: PCRB', lambda run, _: paper.kalman(run, _RW)),
    ('GSMA corrected: no grid, 100', partial(paper.gsma_free, walk=_RW)),
    ('RBPF-500, walking f', partial(paper.rbpf_walking, walk=_RW)),
    ('GSMA: weights, stochastic, missing group', partial(paper.gsma, stochastic=True, first=1)),
    ('GSMA as printed', paper.gsma),
    ('SMA as printed', paper.sma),
)


@dataclass(frozen=True, slots=True)
class SeedScores:
    """All results of one seed, in the order of the lists above."""

    paper: tuple[Errors, ...]
    scales: tuple[tuple[float, ...], ...]
    walk: tuple[tuple[float, float, float], ...]
    pruned_each_step_s: float
    metro: metro.MetroScores


def measure(seeds: int) -> list[Table | Plot]:
    """Run all experiments over ``seeds`` seeds."""
    scores = over_seeds(score_seed, range(metro.FIRST_SEED, metro.FIRST_SEED + seeds))
    timings, difference = metro.compare_covariances(metro.FIRST_SEED)
    steps = metro.time_estimators(metro.FIRST_SEED)
    return [
        _targets(scores, timings, difference, steps),
        _table_1(scores),
        _table_2(scores),
        _noise_table(scores),
        _walk_table(scores),
        *_metro_tables(scores),
        _cost_table(timings, difference, steps),
        plot_claims(),
        plot_jump(),
    ]


def score_seed(seed: int) -> SeedScores:
    """Run all filters on all data of one seed."""
    run, walking = paper.paper_run(seed), paper.walking_run(seed, _RW)
    scaled = [paper.paper_run(seed, noise=scale) for scale in SCALES]
    walk = []
    for _, f in ON_WALK:
        got = f(walking, seed)
        e = paper.errors(walking, got)
        walk.append((float(np.sqrt(np.mean(np.square(got.f - walking.f)))), e.inside_68, e.inside_95))
    return SeedScores(
        paper=tuple(paper.errors(run, f(run, seed)) for *_, f in ON_PAPER),
        scales=tuple(tuple(paper.errors(data, f(data, seed)).f for data in scaled) for _, f in ON_SCALES),
        walk=tuple(walk),
        pruned_each_step_s=paper.gsma(run, seed, most=50).cpu_s,
        metro=metro.score_seed(seed),
    )


def _mean(scores: Sequence[SeedScores], row: int, field: str) -> float:
    return float(np.mean([getattr(s.paper[row], field) for s in scores]))


def _paper_row(name: str) -> int:
    return [row for row, *_ in ON_PAPER].index(name)


def _table_1(scores: Sequence[SeedScores]) -> Table:
    floor = _mean(scores, _paper_row('bound: ramp of known slope'), 'f')
    rows = []
    for i, (name, printed, _) in enumerate(ON_PAPER):
        got = [_mean(scores, i, field) for field in ('f', 'D', 'v', 'a')]
        said = PRINTED.get(printed)
        cover = f'{_mean(scores, i, "inside_68"):.2f} / {_mean(scores, i, "inside_95"):.2f}'
        cells = [f'{said[0]:.3f}' if said else '-', *(f'{x:.3f}' for x in got)]
        rows.append(
            (name, *cells, cover if 'known' not in name or 'slope' in name else '-', _verdict(said, got[0], floor))
        )
    header = ('mean absolute errors', 'f printed', 'f', 'D m', 'v m/s', 'a m/s^2', '68 / 95 %', 'verdict')
    note = (
        f'{len(scores)} seeds of 150 steps of 1 s, f = 1 - 0.005 k. The command is -1 m/s^2 and the measurement noise '
        f'{paper.STD_D} m and {paper.STD_V} m/s: with those a filter that is given f has the printed errors of D, v. '
        'The printed errors of f lie below those of a filter that knows the slope of the ramp, so no causal filter '
        'can reach them together with the printed errors of D and v.'
    )
    return Table('Zheng et al., table 1', header, tuple(rows), note)


def _verdict(said: tuple[float, ...] | None, got: float, floor: float) -> str:
    if said is None:
        return '-'
    if said[0] < floor:
        return 'not reproducible: printed is below the bound'
    return 'confirmed' if abs(got / said[0] - 1.0) < 0.2 else f'refuted: {got / said[0]:.1f} x printed'


def _table_2(scores: Sequence[SeedScores]) -> Table:
    names = {
        'RBPF': ('RBPF-250, static f', 250.0),
        'SMA': ('SMA as printed', _SMA_UPDATES),
        'GSMA': ('GSMA as printed', 650.0),
    }
    base = _mean(scores, _paper_row('SMA as printed'), 'cpu_s')
    rows = []
    for name, (row, updates) in names.items():
        share = _mean(scores, _paper_row(row), 'cpu_s') / base
        said = PRINTED_S[name] / PRINTED_S['SMA']
        verdict = '(reference)' if name == 'SMA' else cost_verdict(said, updates / _SMA_UPDATES, share)
        cells = (f'{said:.3f}', f'{updates:.0f}', f'{updates / _SMA_UPDATES:.2f}', f'{share:.2f}')
        rows.append((name, *cells, verdict))
    each, count = float(np.mean([s.pruned_each_step_s for s in scores])) / base, _PRUNED_UPDATES / _SMA_UPDATES
    said = PRINTED_S['GSMA'] / PRINTED_S['SMA']
    cells = (f'{said:.3f}', f'{_PRUNED_UPDATES:.0f}', f'{count:.2f}', f'{each:.2f}')
    rows.append(('GSMA, pruned at each step', *cells, cost_verdict(said, count, each)))
    header = ('time / SMA', 'printed', 'updates per step', 'in count', 'in CPU time', 'verdict')
    note = (
        'Kalman updates per step: GSMA grows to 150, 450, 1350 before it exceeds its limit of 500 and is pruned, as '
        'printed. CPU time with arrays and one shared covariance, where overhead costs as much as updates.'
    )
    return Table('Zheng et al., table 2: SMA / GSMA / RBPF', header, tuple(rows), note)


def cost_verdict(said: float, count: float, share: float) -> str:
    """Return the verdict on a printed time relative to SMA, by number of updates and by CPU time."""
    by_count, by_time = (abs(ours / said - 1.0) < _SAME_COST for ours in (count, share))
    if by_count and by_time:
        return 'confirmed'
    if by_count or by_time:
        which, other = ('count', share) if by_count else ('CPU time', count)
        return f'confirmed in {which} only, the other is {other / said:.1f} x printed'
    return f'refuted: {count / said:.1f} x printed in count, {share / said:.1f} x in CPU time'


def _noise_table(scores: Sequence[SeedScores]) -> Table:
    values = np.mean([s.scales for s in scores], axis=0)
    rows = tuple((name, *(f'{x:.4f}' for x in row)) for (name, _), row in zip(ON_SCALES, values, strict=True))
    header = ('mean absolute error of f', *(f'noise x {scale:g}' for scale in SCALES))
    note = (
        'The printed .027 and .023 are near .025, the mean rounding error of a ramp on a grid of 0.1: the noise of the '
        'paper must have been about 20 times lower than its own errors of D and v imply. There, too, filters without '
        'a grid are better. (Walk or trend of f are not retuned to the noise.)'
    )
    return Table('Noise level of the paper', header, rows, note)


def _walk_table(scores: Sequence[SeedScores]) -> Table:
    values = np.mean([s.walk for s in scores], axis=0)
    rows = tuple(
        (name, f'{rms:.4f}', f'{rms / values[0][0]:.2f}', f'{a:.2f} / {b:.2f}')
        for (name, _), (rms, a, b) in zip(ON_WALK, values, strict=True)
    )
    header = ('random walk of f, 0.01 per step', 'rms error', '/ PCRB', '68 / 95 %')
    note = 'Truth from the model of the linear Kalman filter, which then attains the posterior Cramer-Rao bound.'
    return Table("The paper's train, random walk of the brake rate", header, rows, note)


def _metro_tables(scores: Sequence[SeedScores]) -> list[Table]:
    got = [s.metro for s in scores]
    header = ('while braking', 'MAE', 'bias', '68 %', '95 %', 'within 0.05 after s')
    hard_rows = tuple((name, *_common([s.hard[i] for s in got])) for i, (name, *_) in enumerate(metro.ON_HARD))
    metro_rows = tuple((name, *_common([s.metro[i] for s in got])) for i, (name, *_) in enumerate(metro.ON_METRO))
    exact = float(np.mean([s.walk[-1].mae for s in got]))
    walk_rows = tuple(
        (name, *_common([s.walk[i] for s in got]), f'{np.mean([s.walk[i].mae for s in got]) / exact:.2f}')
        for i, (name, *_) in enumerate(metro.ON_WALK)
    )
    jump_rows = tuple(_jump_row(name, [s.jump[i] for s in got]) for i, (name, *_) in enumerate(metro.ON_JUMP))
    unbraked_rows = tuple(
        _unbraked_row(name, [s.unbraked[i] for s in got]) for i, (name, *_) in enumerate(metro.ON_UNBRAKED)
    )
    later = tuple(f'+{t:g} s' for t in metro.LATER_S)
    return [
        Table(
            'Metro train at 5 Hz, one level per braking',
            header,
            hard_rows,
            f'{len(got)} seeds, five stops each. Map error 0.02 m/s^2 over 200 m; as shipped the estimators assume '
            '0.006 and estimate the actual size while coasting. Resistance 10 %, wheel 0.5 %, resolution 0.1 km/h, '
            'dead time 1.2 s. From 3 s after the command on and above 1 m/s; last column: time from which on the first '
            'braking stays within 0.05, median.',
        ),
        Table('The same, new level every 15 to 30 s', header, metro_rows, 'Levels of 0.3 to 1.2 m/s^2 in both.'),
        Table(
            'Metro train, random walk of the brake rate as declared',
            (*header, '/ KF'),
            walk_rows,
            'The train file is exact; f(0) ~ N(1, 0.2^2), then a random walk of 0.003 per sqrt(s). The exact filter is '
            'given the noise and the size of the disturbance, the others estimate both.',
        ),
        Table(
            'A jump of -0.25 during braking',
            ('', 'detected after s, median', 'p90', 'MAE elsewhere', '68 %', '95 %'),
            jump_rows,
            'Detected: error below 0.07. Elsewhere: all except the 10 s after the jump.',
        ),
        Table(
            'Four minutes without braking while f falls by 0.15',
            ('absolute error after the command', *later, 'growth of std, worst'),
            unbraked_rows,
            'Growth of std: deviation from sqrt(s^2 + drift^2 t), from 3 s after brake release.',
        ),
    ]


def _common(scores: Sequence[metro.Score]) -> tuple[str, ...]:
    means = [float(np.mean([getattr(s, key) for s in scores])) for key in ('mae', 'bias', 'inside_68', 'inside_95')]
    good = float(np.median([s.good_s for s in scores]))
    return f'{means[0]:.4f}', f'{means[1]:+.4f}', f'{means[2]:.3f}', f'{means[3]:.3f}', f'{good:.1f}'


def _jump_row(name: str, scores: Sequence[metro.Score]) -> tuple[str, ...]:
    found = [s.found_s for s in scores]
    mae, _, a, b, _ = _common(scores)
    return name, _seconds(found, 0.5), _seconds(found, 0.9), mae, a, b


def quantile(values: Sequence[float], share: float) -> float:
    """Return a quantile without interpolation, since values may be infinite."""
    return float(np.quantile(values, share, method='higher'))


def _seconds(values: Sequence[float], share: float) -> str:
    value = quantile(values, share)
    return f'{value:.1f}' if math.isfinite(value) else 'never'


def _unbraked_row(name: str, scores: Sequence[metro.Score]) -> tuple[str, ...]:
    later = np.mean([s.later for s in scores], axis=0)
    return name, *(f'{x:.3f}' for x in later), f'{100.0 * max(s.law for s in scores):.2g} %'


def _cost_table(timings: Sequence[metro.Timing], difference: float, steps: Sequence[metro.Timing]) -> Table:
    rows = [(t.name, f'{t.p50:.0f}', f'{t.p99:.0f}', f'{t.p50 / timings[0].p50:.1f}') for t in timings]
    rows += [(f'node step: {t.name}', f'{t.p50:.0f}', f'{t.p99:.0f}', '-') for t in steps]
    note = (
        f'With equal random numbers the three forms of RBPF differ by at most {difference:.0e} in f. '
        'Loops: 20 steps timed, arrays 150. Node steps: a complete step of the estimator with update.'
    )
    return Table('CPU time of a step', ('us', 'p50', 'p99', '/ shared'), tuple(rows), note)


def _targets(
    scores: Sequence[SeedScores],
    timings: Sequence[metro.Timing],
    difference: float,
    steps: Sequence[metro.Timing],
) -> Table:
    got = [s.metro for s in scores]
    walk = np.mean([[x.mae for x in s.walk] for s in got], axis=0)
    walk_68, walk_95 = (float(np.mean([getattr(s.walk[0], k) for s in got])) for k in ('inside_68', 'inside_95'))
    hard_68, hard_95 = (float(np.mean([getattr(s.hard[0], k) for s in got])) for k in ('inside_68', 'inside_95'))
    found = [s.jump[0].found_s for s in got]
    good_s = quantile([s.hard[0].good_s for s in got], 0.5)
    by_name = {t.name: t.p50 for t in steps}
    rms = np.mean([s.walk for s in scores], axis=0)[:, 0]
    rows = [
        _at_most('GSMA: MAE on metro data', 0.026, float(np.mean([s.hard[0].mae for s in got]))),
        _at_most('GSMA: MAE / linear KF on random-walk truth', 1.1, float(walk[0] / walk[-1])),
        _within('GSMA: coverage of 68 % on random-walk truth', (0.63, 0.73), walk_68),
        _within('GSMA: coverage of 95 % on random-walk truth', (0.92, 0.98), walk_95),
        _within('GSMA: coverage of 68 % on metro data', (0.63, 0.73), hard_68),
        _within('GSMA: coverage of 95 % on metro data', (0.92, 0.98), hard_95),
        _at_most('GSMA: first braking within 0.05 after, s, median', 7.0, good_s),
        _at_most('GSMA: growth of std without braking, worst deviation', 0.02, max(s.unbraked[0].law for s in got)),
        _at_most('GSMA: jump of -0.25 detected after, s, median', 2.2, quantile(found, 0.5)),
        _at_most('GSMA: the same, p90', 4.5, quantile(found, 0.9)),
        _at_most('GSMA: MAE elsewhere with the jump', 0.037, float(np.mean([s.jump[0].mae for s in got]))),
        _at_most("RBPF-500 / PCRB, the paper's train", 1.03, float(rms[2] / rms[0])),
        _at_most("GSMA / PCRB, the paper's train", 1.03, float(rms[1] / rms[0])),
        _at_most('RBPF, 500 particles, step, p50, us', 200.0, by_name['RBPF, 500']),
        _at_most('GSMA, 500 particles, step, p50, us', 200.0, by_name['GSMA, 500']),
        _at_least('RBPF: loops / shared covariance', 100.0, timings[2].p50 / timings[0].p50),
        _at_most('RBPF: difference to own covariances', 1e-9, difference),
    ]
    return Table('Targets', ('', 'target', 'reached', 'met?'), tuple(rows))


def _at_most(name: str, limit: float, got: float) -> tuple[str, ...]:
    return name, f'<= {limit:g}', f'{got:.3g}', 'yes' if got <= limit else 'no'


def _at_least(name: str, limit: float, got: float) -> tuple[str, ...]:
    return name, f'>= {limit:g}', f'{got:.3g}', 'yes' if got >= limit else 'no'


def _within(name: str, limits: tuple[float, float], got: float) -> tuple[str, ...]:
    low, high = limits
    return name, f'{low:g} to {high:g}', f'{got:.3f}', 'yes' if low <= got <= high else 'no'


_SHOWN_S: Final = (8.0, 30.0)


def plot_claims() -> Plot:
    """Return the plot of one run of the paper's experiment."""
    run = paper.paper_run(metro.FIRST_SEED)
    figure = Figure(figsize=(8.0, 4.0), layout='constrained')
    axes: Axes = figure.subplots()
    k = np.arange(1, len(run.f) + 1)
    axes.plot(k, run.f, 'k', label='true')
    axes.plot(k, paper.sma(run, metro.FIRST_SEED).f, lw=0.8, label='SMA as printed')
    axes.plot(k, paper.gsma(run, metro.FIRST_SEED).f, lw=0.8, label='GSMA as printed')
    axes.plot(k, paper.gsma_free(run, metro.FIRST_SEED).f, lw=1.2, label='GSMA corrected')
    axes.plot(k, paper.kalman(run, 0.0, 2e-4, (0.0, 0.01)).f, lw=1.2, label='linear KF with trend')
    axes.set(xlabel='step of 1 s', ylabel='brake rate f')
    axes.legend(fontsize=8)
    note = 'One seed. As printed, f depends on the grid and on the newest sample; without a grid it follows the ramp.'
    return Plot('zheng2015_ramp', 'Brake rate on the data of Zheng et al.', figure, note)


def plot_jump() -> Plot:
    """Return the plot of a jump during braking."""
    run = jump_run(metro.FIRST_SEED)
    shown = (run.phase == run.phase[-1]) & (run.braked_s > _SHOWN_S[0]) & (run.braked_s < _SHOWN_S[1])
    t = run.braked_s[shown] - JUMP_AFTER_S
    figure = Figure(figsize=(8.0, 4.0), layout='constrained')
    axes: Axes = figure.subplots()
    axes.plot(t, run.rate[shown], 'k', label='true')
    for name in ('GSMA', 'IMM', 'KF'):
        got = metro.trace(run, name, metro.FIRST_SEED, metro.SHIPPED)[shown]
        (line,) = axes.plot(t, got[:, 0], label=name)
        if name == 'GSMA':
            axes.fill_between(t, got[:, 0] - got[:, 1], got[:, 0] + got[:, 1], color=line.get_color(), alpha=0.2, lw=0)
    axes.set(xlabel='time since the jump, s', ylabel='brake rate f')
    axes.legend(fontsize=8)
    note = 'One seed; the band is one standard deviation of GSMA.'
    return Plot('zheng2015_jump', 'A jump of the brake rate during braking', figure, note)

# SPDX-License-Identifier: Apache-2.0
"""What a user would pick instead of `trainid explain`: regressions and a classifier on the same hidden cases.

All rivals get the same columns: the speed responses to the effects of the library, with the shapes that the search
tries. Gap and columns are differenced along each run and filtered so that the noise is nearly white. a, b, c have no
penalty: they are projected out. Slip comes from the same detector. Libraries come from `.venv-peers`; without it only
forward selection runs beside `explain`.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import Any, Final

import numpy as np
from scipy.signal import lfilter

from benchmarks import explain
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, columns
from research.peers.contest import PEERS, installed
from trainid_ros.explain.dataset import Array, Dataset, Flags, Indices, Run
from trainid_ros.explain.model import Model, find_slip
from trainid_ros.explain.nuisances import DAVIS, Bins
from trainid_ros.explain.result import NONE, OTHER
from trainid_ros.explain.search import SECTIONS, named_families
from trainid_ros.explain.variables import OF_CURVES, variables
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import NamedValues, TrainFile, parse_train_file

EXPLAIN: Final = 'trainid explain'
BOOSTING: Final = 'gradient boosting'
SLIP: Final = 'wheel_slip'
CAUSES: Final = (*EFFECTS, NONE, OTHER)
_SEED: Final = 48611
_CASES_PER_SEED: Final[Mapping[explain.Generator, float]] = {'A': 5.0, 'B': 2.5, 'C': 2.5}
_TRAINING_SEED: Final = 59407
_TRAINING: Final[Mapping[explain.Generator, int]] = {'A': 60, 'B': 30, 'C': 30}
_JOBS: Final = 1  # Cases at a time, since CPU times are compared
_MAX_FOLDS: Final = 5  # Folds of a cross-validation: the default of scikit-learn
_PATH: Final = 0.01  # Least over greatest penalty of the Lasso: with less, most columns have a coefficient [1]
_MAX_COLUMNS: Final = 6  # Columns that forward selection may add: twice the effects of `explain`
_CLEAR: Final = 2.0  # Least fall of the error, of 95 % confidence [std]
_BINS: Final = (2, 4, 8, 16)  # Lengths of the sections tried, in bins of 50 m or more
_THRESHOLDS: Final = np.geomspace(0.02, 0.5, 8)  # Of STLSQ, about its default of 0.1, in std of the gap [1]
_MODELS: Final = 20  # Of the ensemble: the default of pysindy
_MOST_NEGATIVE: Final = -0.49  # Correlation of neighbouring differences: -0.5 if all noise is that of the speed


@dataclass(frozen=True, slots=True)
class Problem:
    """Regression of a gap on the columns of all effects, both white and of unit rms."""

    y: Array  # Gap, shape (m,)
    X: Array  # Columns, shape (m, k)
    names: tuple[str, ...]  # Effect of each column, k of them
    groups: tuple[Array, ...]  # Columns of dependences without a name, shapes (m, any)
    run: Indices  # Run of each row, shape (m,)
    slip: float  # Evidence of slip [1], 0 if there is none

    @classmethod
    def of(cls, runs: Sequence[Run], train_file: TrainFile) -> Problem:
        """Return the problem of the runs of a case."""
        model, length = Model.of(runs, train_file), train_file.train.length
        dataset = model.dataset
        names, candidates = _candidates(model, length)
        groups = [dataset.column(one.coarse()) for one in variables(model) if one.name not in OF_CURVES]
        nuisances = model.nuisance_columns[:, DAVIS]
        everything = np.concatenate([model.residual[:, None], candidates, *groups], axis=1)
        white, run = _whitened(nuisances, everything, sum(name not in SECTIONS for name in names), dataset)
        scale = np.sqrt(np.mean(np.square(white), axis=0))
        kept = 1 + np.flatnonzero(scale[1 : 1 + len(names)] > 1e-6)  # not one of a, b, c, nor without response
        edges = np.cumsum([1 + len(names), *(group.shape[1] for group in groups)])
        slip = find_slip(dataset)
        return cls(
            white[:, 0] / scale[0],
            white[:, kept] / scale[kept],
            tuple(names[k - 1] for k in kept.tolist()),
            tuple(np.split(white, edges, axis=1)[1:-1]),
            run,
            0.0 if slip is None else slip.evidence,
        )


def _candidates(model: Model, length: float) -> tuple[list[str], Array]:
    """Return the effect of each column, and the speed responses (m, k) [m/s] to a unit of its amplitude."""
    dataset, families = model.dataset, named_families(model.evaluator)
    resistances = [family.resistance for family in families]
    names = [family.kind.name for family in families for _ in family.shapes]
    if dataset.positioned:
        sums = np.cumsum(Bins.of(dataset, length, fine=True).shares(dataset, length), axis=1)
        drags = [
            sums[:, first + n - 1] - sums[:, first - 1] for n in _BINS for first in range(1, sums.shape[1] - n, n // 2)
        ]
        drag = np.stack(drags, axis=1)
        names += [name for name in SECTIONS for _ in drags]
        resistances += [dataset.direction[:, None] * drag, drag]
    return names, dataset.column(np.concatenate(resistances, axis=1))


def _whitened(nuisances: Array, others: Array, count: int, dataset: Dataset) -> tuple[Array, Indices]:
    """Return columns (m, k), the gap first, white and without nuisances (m, q), and the run of each row.

    White noise of the speed on a random walk has differences whose noise is a moving average of two, which is inverted.
    The noise is what ``count`` columns after the gap do not explain: those without a section of the line.
    """
    seen = dataset.point_count > 0.0
    run = dataset.point_run[seen]
    same = np.diff(run) == 0
    rows = np.diff(np.concatenate([nuisances, others], axis=1)[seen], axis=0)[same]
    run, q = run[1:][same], nuisances.shape[1]
    of_effects = np.concatenate([rows[:, :q], rows[:, q + 1 : q + 1 + count]], axis=1)
    noise = _without(of_effects, rows[:, q : q + 1])[:, 0]
    neighbours = np.diff(run) == 0
    correlation = float(np.sum((noise[1:] * noise[:-1])[neighbours]) / (noise @ noise))
    r = min(max(correlation, _MOST_NEGATIVE), -1e-6)
    past = (1.0 - math.sqrt(1.0 - 4.0 * r * r)) / (-2.0 * r)
    white = np.concatenate([lfilter([1.0], [1.0, -past], rows[run == k], axis=0) for k in np.unique(run)])
    return _without(white[:, :q], white[:, q:]), run


def _without(some: Array, others: Array) -> Array:
    """Return columns (m, k) less what they have in common with others (m, q)."""
    return np.asarray(others - some @ np.linalg.lstsq(some, others, rcond=None)[0])


def _folds(run: Indices) -> list[tuple[Indices, Indices]]:
    """Return training and test rows of each fold; a run is in one fold."""
    fold = np.unique(run, return_inverse=True)[1] % _MAX_FOLDS
    return [(np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in np.unique(fold)]


def _sparsest(errors: Array) -> int:
    """Return the first row, from the sparsest, whose mean error is within a standard error of the least, (s, folds)."""
    mean = errors.mean(axis=1)
    best = int(np.argmin(mean))
    limit = mean[best] + errors[best].std(ddof=1) / math.sqrt(errors.shape[1])
    return int(np.argmax(mean <= limit))


def lasso(problem: Problem) -> set[str]:
    """Return the effects with a coefficient in the sparsest Lasso within a standard error of the best."""
    linear = import_module('sklearn.linear_model')
    path = linear.LassoCV(eps=_PATH, fit_intercept=False, cv=_folds(problem.run)).fit(problem.X, problem.y)
    alpha = path.alphas_[_sparsest(path.mse_path_)]
    found = linear.Lasso(alpha, fit_intercept=False).fit(problem.X, problem.y).coef_
    return {problem.names[k] for k in np.flatnonzero(found).tolist()}


def forward(problem: Problem) -> set[str]:
    """Add the column with the least error on runs left out, as long as that falls by two standard errors."""
    y, X, runs = problem.y, problem.X, np.unique(problem.run)
    chosen: list[int] = []
    reached = np.array([y[problem.run == run] @ y[problem.run == run] for run in runs])
    while len(chosen) < _MAX_COLUMNS:
        errors = np.stack([_errors_of(X, y, chosen, problem.run == run) for run in runs])
        best = int(np.argmin(errors.sum(axis=0)))
        gain = reached - errors[:, best]
        if gain.mean() <= _CLEAR * gain.std(ddof=1) / math.sqrt(runs.size):
            break
        chosen.append(best)
        reached = errors[:, best]
    return {problem.names[k] for k in chosen}


def _errors_of(X: Array, y: Array, chosen: list[int], out: Flags) -> Array:
    """Return the squared error on rows left out (m,) with each column added to those chosen, shape (k,)."""
    both_sides = np.column_stack([y, X])
    fit = np.linalg.lstsq(X[~out][:, chosen], both_sides[~out], rcond=None)[0]
    left = both_sides - X[:, chosen] @ fit
    inside, outside = left[~out], left[out]
    power = np.sum(np.square(inside[:, 1:]), axis=0)
    usable = power > 1e-6 * len(inside)  # the columns chosen have nothing left
    size = np.where(usable, inside[:, 0] @ inside[:, 1:] / np.where(usable, power, 1.0), 0.0)
    return np.asarray(np.sum(np.square(outside[:, :1] - size * outside[:, 1:]), axis=0))


def sindy(problem: Problem) -> set[str]:
    """Return the effects in most models of pysindy's ensemble, from the best column of each effect.

    Columns are integrals of the forces, so this is the weak form. STLSQ would share the effect among similar columns.
    """
    library = import_module('pysindy')
    best = [k for k, _ in _best(problem).values()]
    X, y = problem.X[:, best], problem.y[:, None]
    errors: list[list[float]] = []
    for threshold in _THRESHOLDS[::-1].tolist():
        errors.append([])
        for inside, outside in _folds(problem.run):
            coefficients = library.STLSQ(threshold=threshold).fit(X[inside], y[inside]).coef_
            errors[-1].append(float(np.mean(np.square(y[outside] - X[outside] @ coefficients.T))))
    threshold = _THRESHOLDS[::-1][_sparsest(np.array(errors))]
    np.random.seed(0)  # noqa: NPY002 (the one that pysindy draws from)
    ensemble = library.EnsembleOptimizer(library.STLSQ(threshold=threshold), bagging=True, n_models=_MODELS)
    ensemble.fit(X, y)
    found = np.median(ensemble.coef_list, axis=0)[0]
    return {problem.names[best[k]] for k in np.flatnonzero(found).tolist()}


def _best(problem: Problem, y: Array | None = None) -> dict[str, tuple[int, float]]:
    """Return the best column of each effect, with 2 ln of the likelihood ratio up to the noise [1]."""
    target = problem.y if y is None else y
    gains = np.square(target @ problem.X) / len(target)
    best: dict[str, tuple[int, float]] = {}
    for k, (name, gain) in enumerate(zip(problem.names, gains.tolist(), strict=True)):
        if name not in best or gain > best[name][1]:
            best[name] = k, gain
    return best


def features(problem: Problem) -> Array:
    """Return what a classifier gets on each of :data:`CAUSES`, shape (causes, 13); the first is its number."""
    best = _best(problem)
    first = max(best, key=lambda name: best[name][1])
    order = sorted(best, key=lambda name: -best[name][1])
    left = _without(problem.X[:, [best[first][0]]], problem.y[:, None])[:, 0]
    after, runs = _best(problem, left), np.unique(problem.run)
    groups = [_group_gains(problem.groups, y) for y in (problem.y, left)]
    of_case = [math.log1p(best[first][1]), *groups, math.log1p(problem.slip), len(runs), math.log(len(problem.y))]
    rows = []
    for number, cause in enumerate(CAUSES):
        row: list[Any] = [math.nan] * 6
        if cause in best:
            k, gain = best[cause]
            along = problem.y * problem.X[:, k]
            rivals = [best[other][1] for other in best if other != cause]
            agreed = np.mean([along[problem.run == run].sum() * along.sum() > 0.0 for run in runs])
            ahead = math.log1p(gain) - math.log1p(max(rivals, default=0.0))
            row = [math.log1p(gain), ahead, order.index(cause), along.mean(), agreed, math.log1p(after[cause][1])]
        rows.append([number, *row, *of_case])
    return np.array(rows)


def _group_gains(groups: Sequence[Array], y: Array) -> float:
    """Return the best Bayesian information of a dependence without a name [1]."""
    gains = [float(y @ y - np.sum(np.square(_without(group, y[:, None])))) for group in groups]
    return max(float(gain - group.shape[1] * math.log(len(y))) for gain, group in zip(gains, groups, strict=True))


RIVALS: Final[Mapping[str, Callable[[Problem], set[str]]]] = {
    'LassoCV': lasso, 'forward selection': forward, 'pysindy, ensemble of STLSQ': sindy,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Trial:
    """A case, what each method answered, and what a classifier gets."""

    outcomes: Mapping[str, explain.Outcome]  # By method
    nothing: explain.Outcome  # Without an answer; its time is that of the features
    features: Array  # See :func:`features`


def try_rivals(spec: explain.Spec, rivals: Sequence[str] = (), *, explained: bool = False) -> Trial:
    """Generate a case and give it to the named rivals, and to the workflow if ``explained``."""
    case = explain.open_case(spec)
    train_file = parse_train_file(case.train_yaml, 'assumed train file')
    runs = explain.runs_of(case.bags, train_file)
    begin = time.process_time()
    problem = Problem.of(runs, train_file)
    columns_s = time.process_time() - begin
    nothing = explain.Outcome(spec, case.answer, 'no_gap', (), (), None, '', len(runs), columns_s)
    outcomes = {name: _answered(nothing, RIVALS[name], problem) for name in rivals}
    if explained:
        outcomes[EXPLAIN] = explain.explain_case(spec, case)
    begin = time.process_time()
    given = features(problem)
    return Trial(outcomes, replace(nothing, explain_s=columns_s + time.process_time() - begin), given)


def _answered(nothing: explain.Outcome, rival: Callable[[Problem], set[str]], problem: Problem) -> explain.Outcome:
    """Return the outcome of a rival; runs are left out, so one run gives no answer."""
    begin, names = time.process_time(), {SLIP} if problem.slip else set[str]()
    if len(np.unique(problem.run)) > 1:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of slow convergence, and of thresholds that leave no term
            names |= rival(problem)
    return _naming(replace(nothing, explain_s=nothing.explain_s + time.process_time() - begin), names)


def _naming(nothing: explain.Outcome, names: set[str], probabilities: NamedValues = ()) -> explain.Outcome:
    found = tuple(explain.Named(name, (), (), math.nan, ()) for name in sorted(names))
    return replace(nothing, verdict='explained' if found else 'no_gap', found=found, probabilities=probabilities)


def trained(trials: Sequence[Trial]) -> Any:
    """Return a classifier of a cause of a case; its number of trees is that with the least loss on cases left out."""
    choice = import_module('sklearn.model_selection')
    model = import_module('sklearn.ensemble').HistGradientBoostingClassifier(categorical_features=[0], random_state=0)
    given = np.concatenate([trial.features for trial in trials])
    true = np.array([cause in explain.causes(trial.nothing) for trial in trials for cause in CAUSES])
    case = np.repeat(np.arange(len(trials)), len(CAUSES))
    trees = {'max_iter': (10, 20, 40, 100)}
    search = choice.GridSearchCV(model, trees, scoring='neg_log_loss', cv=choice.GroupKFold(_MAX_FOLDS))
    return search.fit(given, true, groups=case)


def classified(trial: Trial, model: Any) -> explain.Outcome:
    """Return the answer of the classifier: all effects that are more probable than not."""
    begin = time.process_time()
    p = model.predict_proba(trial.features)[:, 1]
    seconds = trial.nothing.explain_s + time.process_time() - begin
    likely = {cause for cause, share in zip(CAUSES, p.tolist(), strict=True) if share > 0.5}
    shares = tuple(zip(CAUSES, (p / p.sum()).tolist(), strict=True))
    outcome = _naming(replace(trial.nothing, explain_s=seconds), likely - {NONE, OTHER}, shares)
    return replace(outcome, verdict='unexplained') if OTHER in likely and not outcome.found else outcome


def honest(outcome: explain.Outcome) -> bool:
    """True if nothing was named, or only what implies no mechanism."""
    return outcome.verdict != explain.CRASHED and {effect.name for effect in explain.named(outcome)} <= explain.GENERIC


def measure(seeds: int) -> list[Table]:
    """Compare on five cases of generator A and 2.5 of each other one per seed."""
    if PEERS.is_dir() and str(PEERS) not in sys.path:
        sys.path.append(str(PEERS))  # last, so that packages of .venv have priority; child processes inherit the path
    full = installed('sklearn', 'pysindy')
    rivals = tuple(name for name in RIVALS if full or RIVALS[name] is forward)
    specs = _drawn({name: round(each * seeds) for name, each in _CASES_PER_SEED.items()}, _SEED)
    compare = partial(try_rivals, rivals=rivals, explained=True)
    trials = over_seeds(compare, specs, 'compared cases', _JOBS)
    outcomes = {name: [trial.outcomes[name] for trial in trials] for name in (EXPLAIN, *rivals)}
    note = 'The libraries of `.venv-peers` are missing.'
    if full:
        training = over_seeds(try_rivals, _drawn(_TRAINING, _TRAINING_SEED), 'training cases', _JOBS)
        model = trained(training)
        outcomes[BOOSTING] = [classified(trial, model) for trial in trials]
        note = f'Gradient boosting learned from {len(training)} cases of other seeds; its probabilities add up to one.'
    return [comparison(outcomes, note)]


def _drawn(counts: Mapping[explain.Generator, int], seed: int) -> list[explain.Spec]:
    return [spec for name, count in counts.items() for spec in explain.draw_specs(name, seed, count)]


def comparison(outcomes: Mapping[str, Sequence[explain.Outcome]], note: str) -> Table:
    """Return a table with a row per method."""
    header = columns(
        'method | exact name, one visible effect | false alarms, nothing hidden | both of two | outside: nothing or '
        'generic | probability of the true cause | stated >= 0.9: true | CPU for 8 runs [s]'
    )
    about = (
        'The same cases, columns and detector of slip for all. Effects count if each raises the gap by 20 %; the '
        'probabilities are those of all cases. CPU time: median, with that of the columns. PySR has no row: it needs '
        'Julia, which its package does not contain.'
    )
    rows = tuple((name, *_row(of_one)) for name, of_one in outcomes.items())
    return Table('Explain and what a user would pick instead', header, rows, f'{about} {note}')


def _row(outcomes: Sequence[explain.Outcome]) -> tuple[str, ...]:
    shown = [one for one in outcomes if explain.visible(one) or one.answer.kind == 'none']
    holds = {'single': explain.exact, 'none': explain.alarmed, 'pair': explain.both, 'outside': honest}
    rates = [explain.rate((one for one in shown if one.answer.kind == kind), right) for kind, right in holds.items()]
    stated = [name in explain.causes(one) for one in outcomes for name, p in one.probabilities if p >= 0.9]
    given = np.mean([explain.given_to_truth(one) for one in outcomes])
    has_any = any(one.probabilities for one in outcomes)
    of_probabilities = (f'{given:.2f}', _of(explain.Rate(sum(stated), len(stated)))) if has_any else ('-', '-')
    seconds = np.median([explain.seconds_for_eight(one) for one in outcomes])
    return (*map(_of, rates), *of_probabilities, f'{seconds:.1f}')


def _of(reached: explain.Rate) -> str:
    return f'{reached.hits} of {reached.cases}' if reached.cases else '-'

# SPDX-License-Identifier: Apache-2.0
"""Linear mixed model of a channel, a quantity of the table: what trains have in common, and what is each train's own.

    y_n = mu + u_train(n) + sum_k b_k(n) + e_n,   u ~ N(0, s_T^2),   b_k ~ N(0, s_k^2),   e_n ~ N(0, v_n)
    v_n = (kappa^2 std_n^2 + s_E^2) / omega_n

with a common effect b for each line, weather, day, and line on a day. The standard deviations s and the factor kappa on
what the estimators state (an error that a train repeats every day is in u, not in e) maximise the marginal likelihood
with mu, u and b integrated out (empirical Bayes; with a flat prior of mu this is REML). Trains are eliminated first, so
that a system of the size of the common effects is left (Henderson's equations and their Schur complement). Of small
fleets the most likely s_T and kappa are often zero: weak log-normal priors keep them from it.

omega are the weights of Student's t (iteratively reweighted least squares), so that single bad runs do not count; its
degrees of freedom are those under which the residuals are most likely.

Sources: Harville, J. Am. Stat. Assoc. 72 (1977) 320; Henderson, Biometrics 31 (1975) 423; Lange, Little and Taylor,
J. Am. Stat. Assoc. 84 (1989) 881.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from trainid_ros.explain.dataset import MAD_TO_STD

if TYPE_CHECKING:
    from trainid_ros.fleet.table_file import Row

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.intp]

ROUNDS: Final = 4
"""Number of rounds, after which the weights have converged."""
MIN_TRAINS: Final = 4
"""Minimum number of trains on most days for effects of days: with fewer they would absorb those of the trains."""
_DEGREES: Final = (4.0, 8.0, 16.0, 32.0)  # Degrees of freedom of Student's t among which the data choose


class Channel(NamedTuple):
    """A quantity that is compared."""

    name: str  # Column of the value; that of its standard deviation ends with ``_std``
    title: str  # What it is
    unit: str  # Its unit, '' for ratios
    change: float  # Standard deviation of a change that matters, as a share of the mean of the fleet [1]
    slack: float  # Standard deviation of a change beside the direction of its cause, as the same share [1]


CHANNELS: Final = (
    Channel('w15', 'resistance at 15 m/s', 'N/kN', 0.2, 0.04),
    Channel('brake_rate', 'brake rate', '', 0.08, 0.004),
    Channel('force_scale', 'force scale', '', 0.06, 0.004),
    Channel('wheel_ratio', 'wheel ratio', '', 0.02, 0.0005),
)


@dataclass(frozen=True, slots=True)
class Labels:
    """Names of trains, days and common causes; the tables of all channels count by them."""

    trains: tuple[str, ...]
    days: tuple[str, ...]
    lines: tuple[str, ...]
    weathers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Cells:
    """Values of one channel, runs of a train on one day, line and weather taken together; shapes (n,)."""

    value: Array  # Mean, weighted by the inverse variances
    std: Array  # Standard deviation stated by the estimator, of the mean
    train: Indices  # Index in the labels; likewise day, line and weather
    day: Indices
    line: Indices
    weather: Indices


_LABELS: Final = ('train', 'day', 'line', 'weather')


def labels_of(rows: Sequence[Row]) -> Labels:
    """Return all labels in use, in order; rows without train or day do not count."""
    known = [row for row in rows if is_known(row)]
    return Labels(*(tuple(sorted({row[column] or '' for row in known})) for column in _LABELS))


def is_known(row: Row) -> bool:
    """Return whether a row has an estimate of a known train and day, from inputs that do not contradict each other."""
    return has_estimate(row) and not row['contradiction']


def has_estimate(row: Row) -> bool:
    """Return whether a row has an estimate of a known train and day, whatever its inputs."""
    return bool(row['train'] and row['day'] and row['status'] in {'CONVERGING', 'VALID', 'HOLDING', 'STALE'})


def cells_of(rows: Sequence[Row], channel: Channel, labels: Labels) -> Cells:
    """Return the cells of a channel; rows without a finite value are left out."""
    names = (labels.trains, labels.days, labels.lines, labels.weathers)
    index = [(column, {name: k for k, name in enumerate(found)}) for column, found in zip(_LABELS, names, strict=True)]
    runs: dict[tuple[int, ...], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        value, std = row[channel.name], row[f'{channel.name}_std']
        if not is_known(row) or value is None or std is None or not std > 0.0 or not math.isfinite(value + std):
            continue
        runs[tuple(numbers[row[column] or ''] for column, numbers in index)].append((value, std))
    keys, means = sorted(runs), []
    for key in keys:
        weights = [1.0 / (std * std) for _, std in runs[key]]
        total = sum(weights)
        mean = sum(w * value for w, (value, _) in zip(weights, runs[key], strict=True)) / total
        means.append((mean, total**-0.5))
    value, std = np.array(means).reshape(-1, 2).T
    return Cells(value, std, *np.array(keys, dtype=np.intp).reshape(-1, 4).T)


@dataclass(frozen=True, slots=True)
class SharedEffects:
    """Shared random effects, numbered through; number 0 is the mean of the fleet."""

    of_cell: Indices  # Effects of each cell, shape (n, 1 + factors)
    factor: Indices  # Factor of each effect, shape (m,); -1 for the mean, whose prior is flat
    names: tuple[str, ...]  # Names of the factors


@dataclass(frozen=True, slots=True)
class MixedFit:
    """The fitted model of one channel."""

    mean: float  # Mean of the fleet
    train: Array  # Effect of each train, shape (trains,), 0 where it has no cell
    train_std: Array  # Its standard deviation
    common: Array  # Mean and common effects of each cell, shape (n,)
    common_variance: Array  # Variance of the latter
    variance: Array  # Variance of each cell, without the weights, shape (n,)
    stds: dict[str, float]  # Standard deviation of the effects by name; 'train', 'error', and the factor 'stated' [1]
    degrees: float  # Degrees of freedom of the errors


def shared_effects(cells: Cells, labels: Labels) -> SharedEffects:
    """Return the effects that can be told apart: those with two levels or more, and days with trains enough."""
    factors = [('line', cells.line), ('weather', cells.weather)]
    if np.median(np.bincount(cells.day)[np.unique(cells.day)]) >= MIN_TRAINS:
        factors.append(('day', cells.day))
        if len(labels.lines) > 1:
            factors.append(('line on a day', cells.day * len(labels.lines) + cells.line))
    names: list[str] = []
    columns, owners = [np.zeros(cells.value.size, dtype=np.intp)], [-1]
    for name, level in factors:
        levels, column = np.unique(level, return_inverse=True)
        if levels.size > 1:
            columns.append(column + len(owners))
            owners += [len(names)] * levels.size
            names.append(name)
    return SharedEffects(np.stack(columns, axis=1), np.array(owners), tuple(names))


class _Problem:
    """Marginal likelihood and effects for given variances; see :func:`fit`."""

    def __init__(self, cells: Cells, effects: SharedEffects, trains: int, used: Flags, level_std: float) -> None:
        self.cells, self.effects, self.used, self._trains = cells, effects, used, trains
        self.weights = used.astype(float)
        # Numbers near zero: sums of squares of values far from it would lose all digits.
        self.origin = float(np.median(cells.value[used]))
        self._y = cells.value - self.origin
        # Unit of the variances, not zero, so that their logarithms are near zero.
        unit = max(robust_std(cells.value[used]), 1e-6 * float(np.abs(cells.value[used]).max()), 1e-12) ** 2
        self._units = np.array([1.0, unit, unit, *np.full(len(effects.names), unit)])
        # Prior means of ln kappa^2, for 1/2 as part of what the estimators state repeats every day, and of ln s_T^2.
        self._usual = np.array([math.log(0.5**2), math.log(level_std**2 / unit)])

    def variances(self, x: Array) -> Array:
        """Return kappa^2, s_E^2, s_T^2 and that of each common effect for their logarithms."""
        return np.asarray(np.exp(x) * self._units)

    def loss(self, x: Array) -> float:
        """Return -ln L, less ln of the priors, for logarithms of the variances."""
        # Their prior std is 2: a factor of e in the standard deviations either way.
        return self.solve(x).loss + 0.5 * float(((x[[0, 2]] - self._usual) ** 2).sum()) / 2.0**2

    def solve(self, x: Array) -> _Solution:
        """Return the effects for logarithms of the variances."""
        kappa2, error, train, *common = self.variances(x).tolist()
        v = kappa2 * self.cells.std**2 + error
        w = self.weights / v
        y, factor = self._y, self.effects.factor
        prior = np.where(factor < 0, 0.0, 1.0 / np.array([*common, 1.0])[factor])
        of_train = np.bincount(self.cells.train, w, self._trains) + 1.0 / train
        own = np.bincount(self.cells.train, w * y, self._trains)
        coupling, system, rhs = self._sums(w, w * y)
        system += np.diag(prior) - coupling.T @ (coupling / of_train[:, None])
        rhs -= coupling.T @ (own / of_train)
        cholesky = cho_factor(system, lower=True)
        b = cho_solve(cholesky, rhs)
        log_det = np.log(v[self.used]).sum() + np.log(of_train * train).sum() - np.log(prior[factor >= 0]).sum()
        log_det += 2.0 * np.log(np.diag(cholesky[0])).sum()
        square = y @ (w * y) - (own * own / of_train).sum() - rhs @ b
        u = (own - coupling @ b) / of_train
        return _Solution(0.5 * float(log_det + square), v, b, u, of_train, coupling, cholesky)

    def common(self, solution: _Solution) -> Array:
        """Return mean and common effects of each cell, shape (n,)."""
        return np.asarray(self.origin + solution.b[self.effects.of_cell].sum(axis=1))

    def common_variance(self, x: Array) -> Array:
        """Return the variance of the common effects of each cell, shape (n,), given mean and trains.

        What is uncertain in mean and level of the train is the same on all days, and no error of a day.
        """
        kappa2, error, _, *common = self.variances(x).tolist()
        w = self.weights / (kappa2 * self.cells.std**2 + error)
        found = np.zeros(w.size)
        for column in self.effects.of_cell.T[1:]:
            prior = common[int(self.effects.factor[column[0]])]
            found += 1.0 / (np.bincount(column, w) + 1.0 / prior)[column]
        return found

    def _sums(self, w: Array, wy: Array) -> tuple[Array, Array, Array]:
        """Return sums of the weights by train and effect (trains, m), by two effects (m, m), and of w y by effect."""
        m, columns = self.effects.factor.size, self.effects.of_cell.T
        coupling, system, rhs = np.zeros(self._trains * m), np.zeros(m * m), np.zeros(m)
        for column in columns:
            coupling += np.bincount(self.cells.train * m + column, w, coupling.size)
            rhs += np.bincount(column, wy, m)
            for other in columns:
                system += np.bincount(column * m + other, w, system.size)
        return coupling.reshape(-1, m), system.reshape(m, m), rhs


class _Solution(NamedTuple):
    """-ln L, variances v (n,), effects b (m,) and u (trains,), and what their variances are made of."""

    loss: float
    v: Array
    b: Array
    u: Array
    of_train: Array
    coupling: Array
    cholesky: tuple[Array, bool]


def fit(cells: Cells, labels: Labels, level_std: float, used: Flags | None = None, rounds: int = ROUNDS) -> MixedFit:
    """Fit the model, given the usual standard deviation among trains, with a number of rounds of weights.

    Only cells in ``used``, shape (n,), count, all if it is None; the others get their common effects.
    """
    used = np.ones(cells.value.size, dtype=np.bool_) if used is None else used
    problem = _Problem(cells, shared_effects(cells, labels), len(labels.trains), used, level_std)
    x, degrees = np.array([-1.0, -3.0, -1.0, *np.full(len(problem.effects.names), -2.0)]), _DEGREES[1]
    bounds = [(-14.0, 4.0)] * x.size  # of logarithms of variances, relative to that of the data
    for _ in range(rounds):
        x = minimize(problem.loss, x, method='L-BFGS-B', bounds=bounds, options={'ftol': 1e-7, 'eps': 1e-4}).x
        solution = problem.solve(x)
        z2 = (cells.value - problem.common(solution) - solution.u[cells.train]) ** 2 / solution.v
        degrees = max(_DEGREES, key=lambda degrees: float(log_t(z2[used], degrees).sum()))
        problem.weights = used * (degrees + 1.0) / (degrees + z2)
    solution, names = problem.solve(x), ('stated', 'error', 'train', *problem.effects.names)
    inverse = cho_solve(solution.cholesky, np.eye(solution.b.size))
    gain = solution.coupling / solution.of_train[:, None]
    train_variance = 1.0 / solution.of_train + ((gain @ inverse) * gain).sum(axis=1)
    return MixedFit(
        mean=problem.origin + float(solution.b[0]),
        train=solution.u,
        train_std=np.sqrt(train_variance),
        common=problem.common(solution),
        common_variance=problem.common_variance(x),
        variance=solution.v,
        stds=dict(zip(names, np.sqrt(problem.variances(x)).tolist(), strict=True)),
        degrees=degrees,
    )


def robust_std(values: Array) -> float:
    """Return the standard deviation of normal values with this median absolute deviation."""
    return MAD_TO_STD * float(np.median(np.abs(values - np.median(values))))


def log_t(z2: Array, degrees: float) -> Array:
    """Return ln of the density of Student's t at squared standardised values, without the scale."""
    half = 0.5 * (degrees + 1.0)
    constant = math.lgamma(half) - math.lgamma(0.5 * degrees) - 0.5 * math.log(math.pi * degrees)
    return constant - half * np.log1p(z2 / degrees)

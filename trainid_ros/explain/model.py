# SPDX-License-Identifier: Apache-2.0
"""The model to compare with the data, and the errors of the measurements that are corrected before the comparison.

The model is that of the train file with some effects added, linearised about their parameters. Three errors of the
measurements come before it:

- Wheel ratio: the integral of measured speed over the known distance between stops. It shows a wrong wheel diameter
  independently of the dynamics.
- Slip and slide: bursts in which the wheel is faster than the train under traction and slower while braking. They are
  not modelled as a resistance. They differ from single outliers in their duration and in having the sign of the force.
- Gradients: the interface specifies means under the train. Bags with the value at one point of the train look as if
  the map were shifted, which disturbs the search for effects; so both readings are compared before the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from trainid_ros.explain.dataset import MAD_TO_STD, PULLING, Array, Dataset, Flags, Indices, Run, assemble
from trainid_ros.explain.effects import EffectEvaluator, EffectTerm, prior_width
from trainid_ros.explain.likelihood import (
    Grid,
    Hyperparameters,
    Information,
    MarginalLikelihood,
    Noise,
    Whitener,
    Whitening,
    informations,
    log_bayes,
    posterior,
)
from trainid_ros.explain.nuisances import DAVIS, Bins, Spread, common_columns, common_std, prior_factor, run_columns
from trainid_ros.train.train_file import Davis, TrainFile

_MAX_EXCESS: Final = 0.1  # Deviation of the wheel ratio from one beyond which it is not due to the wheel [1]


@dataclass(frozen=True, slots=True)
class Odometry:
    """Ratio of measured to true distance, from all runs."""

    excess: float  # The ratio less one [1], 0 if unknown
    precision: float  # Inverse of its variance [1], 0 if unknown

    @classmethod
    def of(cls, dataset: Dataset, stops: Sequence[float]) -> Odometry:
        """Return the ratio from all runs between two standstills; ``stops`` are those of the line [m]."""
        ratios, weights = [], []
        for run, travelled in zip(dataset.runs, _travelled(dataset), strict=True):
            distance = _distance(run, travelled, stops)
            if distance is not None and abs(travelled / distance - 1.0) < _MAX_EXCESS:
                ratios.append(travelled / distance - 1.0)
                weights.append(distance)
        if len(ratios) < 2:
            return cls(0.0, 0.0)
        excess = float(np.median(ratios))
        spread = MAD_TO_STD * float(np.median(np.abs(np.array(ratios) - excess)))
        # Std of the stopping position, both ends of a run together: 1.5 m.
        single = max(spread, 1.5 / float(np.median(weights)))
        # Ratio of the variances of median and mean of normal values: pi / 2, 1.6 for few values. Relative error of the
        # map's distances, common to all runs: 0.0015.
        return cls(excess, 1.0 / (single**2 * 1.6 / len(ratios) + 0.0015**2))


def _travelled(dataset: Dataset) -> list[float]:
    """Return the integrals of speed from standstill to standstill, with outliers interpolated [m]."""
    out = []
    edges = pairwise(np.append(dataset.starts, dataset.dt.size).tolist())
    for run, (start, end) in zip(dataset.runs, edges, strict=True):
        middle = 0.5 * (run.speed[1:] + run.speed[:-1])
        out.append(run.travelled + float(np.sum(run.dt[1:] * (dataset.speed[start + 1 : end] - middle))))
    return out


def _distance(run: Run, travelled: float, stops: Sequence[float]) -> float | None:
    """Return the distance between the stops of a run [m]: from the line if both are on it, otherwise as measured."""
    begin, end = run.stops
    if not (math.isfinite(begin) and math.isfinite(end)) or not run.positioned:
        return None
    if stops:
        line = np.array(stops)
        first, last = line[np.argmin(np.abs(line - begin))], line[np.argmin(np.abs(line - end))]
        near = 60.0 + _MAX_EXCESS * travelled  # a train this near counts as stopped there [m]
        if first != last and abs(first - begin) < near and abs(last - end) < near:
            return float(abs(last - first))
    return abs(end - begin) or None


_MIN_SAMPLES: Final = 3  # Minimum number of samples of a burst


class Slip(NamedTuple):
    """Slip of the wheels."""

    term: EffectTerm  # The effect
    evidence: float  # 2 ln of the likelihood ratio of the bursts of each run, given the rate of bursts in all others
    square: float  # Mean square of its bursts over all samples [(m/s)^2]


def find_slip(dataset: Dataset) -> Slip | None:
    """Return the slip of a dataset; None if there is none."""
    force, runs = dataset.joined('traction') + dataset.joined('brake'), np.bincount(dataset.run_of)
    peaks, counts, square, samples, forced = [], np.zeros(runs.size), 0.0, 0, 0
    for start, end in zip(*(edges.tolist() for edges in _bursts(dataset)), strict=True):
        deviation, pull = dataset.deviation[start:end], float(np.median(force[start:end]))
        peak = float(deviation[np.argmax(np.abs(deviation))])
        if abs(pull) <= PULLING:
            continue  # no force whose sign could agree
        forced += 1
        if peak * pull > 0.0:
            peaks.append(abs(peak))
            counts[dataset.run_of[start]] += 1
            square += float(deviation @ deviation) / dataset.dt.size
            samples += end - start
    count, share = len(peaks), samples / dataset.dt.size
    # At least four bursts, 80 % of those under force, and 0.4 % of all samples.
    if runs.size < 2 or count < 4 or count < 0.8 * forced or share < 0.004:
        return None
    # The sample maximum underestimates the upper limit of the peaks.
    largest = max(peaks) * (count + 1) / count
    variances = [(share / math.sqrt(count)) ** 2 + (0.2 * share) ** 2, (largest / count) ** 2 + 0.1**2]
    # Bursts per sample by chance from independent outliers, half of them with the sign of the force (Poisson).
    chance = max(0.5 / dataset.dt.size, 0.5 * float(np.mean(dataset.outlier)) ** _MIN_SAMPLES)
    others = np.maximum((count - counts) / (dataset.dt.size - runs), chance)
    evidence = 2.0 * float(counts @ np.log(others / chance) - runs @ (others - chance))
    return Slip(EffectTerm('wheel_slip', {'share': share, 'speed': largest}, np.diag(variances)), evidence, square)


def _bursts(dataset: Dataset) -> tuple[Indices, Indices]:
    """Return first sample and end of all bursts: successive outliers of one sign in one run, shapes (k,).

    What lasts from the start or to the end of a run is none, since the speed does not come back: a start may bend it.
    """
    sign = np.where(dataset.outlier, np.sign(dataset.deviation), 0.0)
    borders = np.diff(dataset.run_of, prepend=-1, append=-1) != 0
    fresh = borders[:-1].copy()
    fresh[1:] |= sign[1:] != sign[:-1]
    starts = np.flatnonzero(fresh)
    ends = np.append(starts[1:], sign.size)
    lasting = (sign[starts] != 0.0) & (ends - starts >= _MIN_SAMPLES) & ~borders[starts] & ~borders[ends]
    return starts[lasting], ends[lasting]


POINTS: Final = {'front': 0.0, 'middle': 0.5, 'rear': 1.0}
"""Points of the train and their distance behind its front, as a share of its length."""
_CELL_M: Final = 5.0  # Length of a cell of the gradient profile [m]
_PLACES: Final = 24  # Points under the train over which the gradient is averaged


def read_at(point: str, runs: Sequence[Run], length: float) -> tuple[Run, ...]:
    """Return runs with the gradient, given at one of :data:`POINTS`, averaged under a train of this length [m].

    The gradient ahead of and behind the point is taken from all runs in the same direction.
    """
    profiles = {way: _profile([run for run in runs if run.direction == way]) for way in {r.direction for r in runs}}
    behind = length * ((np.arange(_PLACES) + 0.5) / _PLACES - POINTS[point])
    under = [np.interp(_middles(run)[:, None] - behind, *profiles[run.direction]) for run in runs]
    return tuple(replace(run, gradient=at.mean(axis=1)) for run, at in zip(runs, under, strict=True))


def preferred_point(model: Model, hyper: Hyperparameters, shift: float) -> str | None:
    """Return the point at which gradients are given, if that has more evidence than a shift of the map; else None."""
    dataset, length = model.dataset, model.train_file.train.length
    read = [np.concatenate([run.gradient for run in read_at(point, dataset.runs, length)]) for point in POINTS]
    changes = np.stack([gradient - dataset.joined('gradient') for gradient in read], axis=1)
    (found,) = model.informations(hyper, [dataset.column(changes)])
    A, b = np.diag(found.A), found.b
    share, evidence = b / (A + 1.0), log_bayes(A, b, 1.0, 1)
    best = int(np.argmax(evidence))
    # The change from the mean to the value at the point needs an evidence of 15 and a share near one.
    if evidence[best] > max(15.0, shift) and 0.5 < share[best] < 1.5:
        return tuple(POINTS)[best]
    return None


def _profile(runs: Sequence[Run]) -> tuple[Array, Array]:
    """Return positions in one direction [m], and the mean gradient of all runs in the cell there [per mille]."""
    way = np.concatenate([_middles(run) for run in runs])
    gradient = np.concatenate([run.gradient for run in runs])
    cells, index = np.unique(np.floor(way / _CELL_M), return_inverse=True)
    return (cells + 0.5) * _CELL_M, np.bincount(index, gradient) / np.bincount(index)


def _middles(run: Run) -> Array:
    """Return the position of the front at mid-stage, rising in the direction of travel [m], shape (n,)."""
    return np.asarray(run.direction * run.position - 0.5 * run.dt * run.speed)


WHEEL: Final = 'wheel_diameter'
"""The effect on which distances between stops give information too."""


class Model:
    """Dataset, train file, nuisances and effect terms; immutable.

    Attributes:
        evaluator: Resistances of effects on the dataset.
        terms: Effects in the model, linearised about their parameters and ``davis``.
        residual: Measured less predicted speed at the points of ``grid`` [m/s], shape (m,).
        nuisance_columns: Responses [m/s] at the grid points to nuisances that all runs share, first those of
            :func:`common_columns`, then of a dependence of no name and of the parameters of effects, then map errors,
            shape (m, q + k).
        common_std: Prior std of the first q of them, shape (q,).
        factor_columns: Responses [m/s] at the grid points to the factors of single runs, shape (m, 3).
        weighed: True if the mass of all runs is measured.
        odometry: Wheel ratio from the distances between stops.
    """

    def __init__(self, evaluator: EffectEvaluator, train_file: TrainFile, terms: tuple[EffectTerm, ...] = ()) -> None:
        self.evaluator, self.dataset, self.train_file = evaluator, evaluator.dataset, train_file
        dataset, length = self.dataset, train_file.train.length
        bins = Bins.of(dataset, length)
        self._common = dataset.column(common_columns(dataset, train_file.line.gradient_std))
        self._map = dataset.column(dataset.direction[:, None] * bins.shares(dataset, length))
        self._map_root = np.asarray(np.linalg.cholesky(bins.covariance() + 1e-9 * np.eye(bins.count)))
        self.factor_columns = dataset.column(run_columns(dataset, train_file.resistance.c))
        self.grid = Grid.of(dataset)
        self._period = float(np.median(dataset.dt))
        self.weighed = all(run.weighed for run in dataset.runs)
        self._gap = dataset.average(dataset.gap)
        self.odometry = Odometry.of(dataset, train_file.line.stops)
        self._whitened = lru_cache(8)(self._whitening)  # shared by models with other effects; 8 to bound the memory
        self._knows_davis = False
        self._dependence = np.zeros((self._gap.size, 0)), np.zeros(0)
        self._set(terms, train_file.resistance)

    @classmethod
    def of(cls, runs: Sequence[Run], train_file: TrainFile) -> Model:
        """Return the model of runs without further effects; those of the train file are in the predicted speed."""
        evaluator = EffectEvaluator(assemble(runs, train_file), train_file)
        if train_file.effects or train_file.train.c_by_weight:
            evaluator = EffectEvaluator(assemble(runs, train_file, evaluator.total(train_file.effects)), train_file)
        return cls(evaluator, train_file)

    def with_terms(self, terms: tuple[EffectTerm, ...], davis: Davis | None = None) -> Model:
        """Return the same model with other effects, linearised about another a, b, c if given."""
        other = copy(self)
        other._set(terms, davis or self.davis)
        return other

    def with_known_davis(self) -> Model:
        """Return the same model, but with a, b, c as in the train file."""
        other = copy(self)
        other._knows_davis = True
        other._set(self.terms, self.train_file.resistance)
        return other

    def without(self, k: int) -> Model:
        """Return the same model without effect k."""
        return self.with_terms((*self.terms[:k], *self.terms[k + 1 :]))

    def with_columns(self, columns: Array, std: Array) -> Model:
        """Return the same model with a dependence of no name: responses [m/s] (m, k), and their prior std (k,)."""
        other = copy(self)
        other._dependence = columns, std
        other._set(self.terms, self.davis)
        return other

    def _set(self, terms: tuple[EffectTerm, ...], davis: Davis) -> None:
        self.terms, self.davis = terms, davis
        derivatives, std = [], []
        total = np.zeros(self.dataset.dt.size)
        common, self._depends_on_davis = self._common, False
        beyond = _array(davis) - _array(self.train_file.resistance)
        for term in terms:
            total += self.evaluator.resistance(term.name, term.parameters, davis, term.runs)
            by_davis = self.evaluator.by_davis(term.name, term.parameters, davis, term.runs)
            if by_davis is not None:
                self._depends_on_davis = True
                # The columns of a, b, c are deviations from the train file.
                total -= by_davis @ beyond
                common = common.copy()
                common[:, DAVIS] += self.dataset.column(by_davis)
            for name, value in term.parameters.items():
                width = prior_width(term.kind, name, value)
                derivatives.append(self._derivative(term, name, 0.05 * width))
                std.append(width)
        self.residual = self._gap - self.dataset.column(total)
        of_terms = [self.dataset.column(np.stack(derivatives, axis=1))] if derivatives else []
        columns, stds = self._dependence
        self.nuisance_columns = np.concatenate([common, columns, *of_terms, self._map], axis=1)
        self.common_std = np.concatenate([common_std(self.train_file, self._period, weighed=self.weighed), stds, std])
        if self._knows_davis:
            self.common_std[DAVIS] *= 1e-6  # not zero, which would make matrices singular

    def _derivative(self, term: EffectTerm, name: str, step: float) -> Array:
        """Return the derivative of an effect's resistance by one of its parameters, shape (n,)."""
        limits, value = term.kind.parameters[name], term.parameters[name]
        other = value + step if value + step <= limits.high else value - step
        changed = self.evaluator.resistance(term.name, {**term.parameters, name: other}, self.davis, term.runs)
        here = self.evaluator.resistance(term.name, term.parameters, self.davis, term.runs)
        return np.asarray((changed - here) / (other - value))

    @property
    def columns(self) -> Array:
        """Residual and nuisance columns [m/s], shape (m, 1 + q + k)."""
        return np.concatenate([self.residual[:, None], self.nuisance_columns], axis=1)

    def evidence(self) -> MarginalLikelihood:
        """Return the marginal likelihood as a function of the hyperparameters."""
        return MarginalLikelihood(
            self.grid, self.columns, self.factor_columns, self.common_std, self._map_root, weighed=self.weighed,
            gradient_std=self.train_file.line.gradient_std, period=self._period,
        )  # fmt: skip

    def _whitening(self, noise: Noise, spread: Spread) -> tuple[Whitening, Array]:
        """Return the whitening and the whitened map errors."""
        whitening = Whitening.of(Whitener.of(self.grid, noise), self.factor_columns, spread.of_run)
        return whitening, whitening.apply(self._map)

    def white_columns(self, hyper: Hyperparameters) -> Array:
        """Return whitened residual and nuisance columns, shape (m, 1 + q + k)."""
        whitening, of_map = self._whitened(hyper.noise, hyper.spread)
        others = self.nuisance_columns[:, : -of_map.shape[1]]
        white = whitening.apply(np.concatenate([self.residual[:, None], others], axis=1))
        return np.concatenate([white, of_map], axis=1)

    def prior_factor(self, spread: Spread) -> Array:
        """Return the factor of the prior covariance of all nuisances, shape (q + k, q + k)."""
        return prior_factor(self.common_std, self._map_root, spread)

    def products_by_run(self, columns: Array, hyper: Hyperparameters) -> Array:
        """Return products of columns (m, C) at the grid points, whitened, by run, shape (R, C, C)."""
        white = self._whitened(hyper.noise, hyper.spread)[0].apply(columns)
        return np.stack([white[run].T @ white[run] for run in self.grid.runs])

    def fit(self, hyper: Hyperparameters) -> Model:
        """Fit the parameters of all effects together with the nuisances (Gauss-Newton)."""
        model = self
        for _ in range(5):
            terms, davis, moved = model._step(hyper)
            model = model.with_terms(terms, davis)
            if moved < 0.1:  # std, of any parameter
                break
        terms, _, _ = model._step(hyper, hold=True)
        return model.with_terms(terms)

    def informations(
        self, hyper: Hyperparameters, candidates: Sequence[Array], *, terms: bool = True
    ) -> list[Information]:
        """Return the information on groups of columns at the grid points (m, k), each alone, all nuisances eliminated.

        With ``terms`` the parameters of the effects are eliminated too; otherwise they are fixed.
        """
        columns, root = self.white_columns(hyper), self.prior_factor(hyper.spread)
        if not terms:
            kept = self.without_terms
            columns, root = columns[:, np.append(True, kept)], root[np.ix_(kept, kept)]
        white = self._whitened(hyper.noise, hyper.spread)[0].apply(np.concatenate(candidates, axis=1))
        edges = np.cumsum([group.shape[1] for group in candidates])[:-1]
        return informations(columns, np.split(white, edges, axis=1), root)

    def posterior(self, hyper: Hyperparameters) -> tuple[Array, Array]:
        """Return mean and covariance of all nuisances, which include the parameters of effects."""
        columns = self.white_columns(hyper)
        products = columns.T @ columns
        self.add_odometry(products)
        return posterior(products, self.prior_factor(hyper.spread))

    @property
    def without_terms(self) -> Flags:
        """True for nuisance columns that are not parameters of effects, shape (q + k,)."""
        kept = np.ones(self.nuisance_columns.shape[1], dtype=bool)
        for _, here in self.places():
            kept[here] = False
        return kept

    @property
    def dependence(self) -> slice:
        """Indices of the coefficients of a dependence of no name among the nuisances."""
        at = len(self.common_std) - sum(len(term.parameters) for term in self.terms)
        return slice(at - len(self._dependence[1]), at)

    @property
    def odometer_excess(self) -> float:
        """Wheel ratio from distances between stops, less one and less that of the effects in the model [1]."""
        known = (term.parameters['ratio'] - 1.0 for term in self.terms if term.name == WHEEL)
        return self.odometry.excess - sum(known)

    @property
    def odometry_cost(self) -> float:
        """Twice the negative log-likelihood of the distances between stops, up to a constant."""
        return self.odometry.precision * self.odometer_excess**2

    def add_odometry(self, products: Array) -> None:
        """Add the distances between stops to products of y and nuisances, as another measurement of the wheel."""
        for term, here in self.places():
            if term.name == WHEEL:
                at = 1 + here.start
                products[at, at] += self.odometry.precision
                products[0, at] += self.odometry.precision * self.odometer_excess
                products[at, 0] = products[0, at]

    def places(self) -> Iterator[tuple[EffectTerm, slice]]:
        """Yield all effects with the indices of their parameters among the nuisances."""
        at = len(self.common_std) - sum(len(term.parameters) for term in self.terms)
        for term in self.terms:
            yield term, slice(at, at + len(term.parameters))
            at += len(term.parameters)

    def found_davis(self, mean: Array) -> Davis:
        """Return a, b, c from the mean of all nuisances; negative a and c are set to zero."""
        a, b, c = (_array(self.train_file.resistance) + mean[DAVIS]).tolist()
        return Davis(max(a, 0.0), b, max(c, 0.0))

    def _step(self, hyper: Hyperparameters, *, hold: bool = False) -> tuple[tuple[EffectTerm, ...], Davis, float]:
        """Return the effects after one step, or with ``hold`` as they are; a, b, c; and the largest change [std]."""
        mean, covariance = self.posterior(hyper)
        terms = []
        davis = self.found_davis(mean) if self._depends_on_davis else self.davis
        std = np.sqrt(np.diag(covariance))
        # Distance of a, b, c from the point of linearisation: 0 where no effect depends on them.
        moved = float(np.max(np.abs(_array(davis) - _array(self.davis)) / std[DAVIS]))
        for term, here in self.places():
            move = np.zeros(len(term.parameters)) if hold else mean[here]
            width = self.common_std[here]
            moved = max(moved, float(np.max(np.abs(move) / std[here])))
            move = np.clip(move, -width, width)
            terms.append(term.moved(move, covariance[here, here]))
        return tuple(terms), davis, moved


def _array(davis: Davis) -> Array:
    return np.array([davis.a, davis.b, davis.c])

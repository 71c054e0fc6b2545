# SPDX-License-Identifier: Apache-2.0
"""The model of the train file with some effects added, linearised about their parameters, to compare with the data."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effects import EffectEvaluator, prior_width
from trainid_ros.explain.likelihood import Hyperparameters, MarginalLikelihood, informations, posterior
from trainid_ros.explain.measurement_errors import Odometry
from trainid_ros.explain.noise import (
    DAVIS,
    Bins,
    Grid,
    Spread,
    Whitener,
    Whitening,
    common_columns,
    common_std,
    prior_factor,
    run_columns,
)
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Davis

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.effects import EffectTerm
    from trainid_ros.explain.likelihood import Information
    from trainid_ros.explain.noise import Noise
    from trainid_ros.explain.run_data import Run
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

WHEEL: Final = 'wheel_diameter'
"""The effect on which distances between stops give information too."""
_KEPT: Final = 8
"""Maximum number of hyperparameters for which the whitening is kept, to bound the memory."""
_MAX_STEPS: Final = 5
_SETTLED: Final = 0.1


class Model:
    """Dataset, nuisances and effect terms; immutable.

    Attributes:
        evaluator: Resistances of effects on the dataset.
        dataset: The dataset to explain.
        train_file: The train file to extend.
        terms: Effects in the model.
        davis: a, b, c about which the effects are linearised.
        residual: Measured less predicted speed at the grid points [m/s], shape (m,).
        nuisance_columns: Responses [m/s] at the grid points to nuisances that all runs share, first those of
            :func:`common_columns`, then the parameters of effects, then map errors, shape (m, q + k).
        common_std: Prior std of the first q of them, shape (q,).
        factor_columns: Responses [m/s] at the grid points to the factors of single runs, shape (m, 2).
        grid: Grid of these points.
        weighed: True if the mass of all runs is measured.
        odometry: Wheel ratio from the distances between stops.

    """

    def __init__(self, evaluator: EffectEvaluator, train_file: TrainFile, terms: tuple[EffectTerm, ...] = ()) -> None:
        self.evaluator, self.dataset, self.train_file = evaluator, evaluator.dataset, train_file
        dataset, length = self.dataset, train_file.train.length
        bins = Bins.of(dataset, length)
        self._common = dataset.column(common_columns(dataset))
        self._map = dataset.column(dataset.direction[:, None] * bins.shares(dataset, length))
        self._map_root = np.asarray(np.linalg.cholesky(bins.covariance() + 1e-9 * np.eye(bins.count)))
        self.factor_columns = dataset.column(run_columns(dataset))
        self.grid = Grid.of(dataset)
        self.weighed = all(run.weighed for run in dataset.runs)
        self._gap = dataset.average(dataset.gap)
        self.odometry = Odometry.of(dataset, train_file.line.stops)
        self._kept: dict[tuple[Noise, Spread], tuple[Whitening, Array]] = {}
        self._set(terms, train_file.resistance)

    @classmethod
    def of(cls, runs: Sequence[Run], train_file: TrainFile) -> Model:
        """Return the model of runs without further effects; those of the train file are in the predicted speed."""
        evaluator = EffectEvaluator(assemble(runs, train_file), train_file)
        if train_file.effects:
            evaluator = EffectEvaluator(assemble(runs, train_file, evaluator.total(train_file.effects)), train_file)
        return cls(evaluator, train_file)

    def with_terms(self, terms: tuple[EffectTerm, ...], davis: Davis | None = None) -> Model:
        """Return the same model with other effects, linearised about another a, b, c if given."""
        other = copy(self)
        other._set(terms, davis or self.davis)
        return other

    def without(self, k: int) -> Model:
        """Return the same model without effect k."""
        return self.with_terms((*self.terms[:k], *self.terms[k + 1 :]))

    def with_nuisances(self, columns: Array, std: float) -> Model:
        """Return the same model with further nuisances that all runs share.

        Args:
            columns: Responses at the grid points [m/s], shape (m, k).
            std: Prior std of their coefficients.

        """
        other = copy(self)
        other.common_std = np.concatenate([np.full(columns.shape[1], std), self.common_std])
        other.nuisance_columns = np.concatenate([columns, self.nuisance_columns], axis=1)
        return other

    def _set(self, terms: tuple[EffectTerm, ...], davis: Davis) -> None:
        """Linearise about the parameters of effects, and about a, b, c where an effect depends on them."""
        self.terms, self.davis = terms, davis
        derivatives, std = [], []
        total = np.zeros(self.dataset.dt.size)
        common, self._depends_on_davis = self._common, False
        beyond = _array(davis) - _array(self.train_file.resistance)
        for term in terms:
            total += self.evaluator.resistance(term.name, term.parameters, davis)
            by_davis = self.evaluator.by_davis(term.name, term.parameters, davis)
            if by_davis is not None:
                self._depends_on_davis = True
                # The columns of a, b, c are deviations from the train file.
                total -= by_davis @ beyond
                common = common.copy()
                common[:, DAVIS] += self.dataset.column(by_davis)
            for name, value in term.parameters.items():
                width = prior_width(term.name, name, value)
                derivatives.append(self._derivative(term, name, 0.05 * width))
                std.append(width)
        self.residual = self._gap - self.dataset.column(total)
        of_terms = [self.dataset.column(np.stack(derivatives, axis=1))] if derivatives else []
        self.nuisance_columns = np.concatenate([common, *of_terms, self._map], axis=1)
        self.common_std = np.concatenate([common_std(self.train_file, weighed=self.weighed), std])

    def _derivative(self, term: EffectTerm, name: str, step: float) -> Array:
        """Return the derivative of an effect's resistance by one of its parameters, shape (n,)."""
        limits, value = EFFECTS[term.name].parameters[name], term.parameters[name]
        other = value + step if value + step <= limits.high else value - step
        changed = self.evaluator.resistance(term.name, {**term.parameters, name: other}, self.davis)
        here = self.evaluator.resistance(term.name, term.parameters, self.davis)
        return np.asarray((changed - here) / (other - value))

    @property
    def columns(self) -> Array:
        """Residual and nuisance columns [m/s], shape (m, 1 + q + k)."""
        return np.concatenate([self.residual[:, None], self.nuisance_columns], axis=1)

    def evidence(self) -> MarginalLikelihood:
        """Return the marginal likelihood as a function of the hyperparameters."""
        return MarginalLikelihood(
            self.grid, self.columns, self.factor_columns, self.common_std, self._map_root, weighed=self.weighed
        )

    def _whitened(self, hyper: Hyperparameters) -> tuple[Whitening, Array]:
        """Return the whitening and the whitened map errors, which models with other effects share."""
        key = hyper.noise, hyper.spread
        if key not in self._kept:
            if len(self._kept) >= _KEPT:
                self._kept.clear()
            whitener = Whitener.of(self.grid, hyper.noise)
            whitening = Whitening.of(whitener, self.factor_columns, hyper.spread.of_run)
            self._kept[key] = whitening, whitening.apply(self._map)
        return self._kept[key]

    def white_columns(self, hyper: Hyperparameters) -> Array:
        """Return whitened residual and nuisance columns, shape (m, 1 + q + k)."""
        whitening, of_map = self._whitened(hyper)
        others = self.nuisance_columns[:, : -of_map.shape[1]]
        white = whitening.apply(np.concatenate([self.residual[:, None], others], axis=1))
        return np.concatenate([white, of_map], axis=1)

    def prior_factor(self, spread: Spread) -> Array:
        """Return the factor of the prior covariance of all nuisances, shape (q + k, q + k)."""
        return prior_factor(self.common_std, self._map_root, spread)

    def products_by_run(self, columns: Array, hyper: Hyperparameters) -> Array:
        """Return products of columns at the grid points, whitened, shape (m, C), by run, shape (R, C, C)."""
        white = self._whitened(hyper)[0].apply(columns)
        return np.stack([white[run].T @ white[run] for run in self.grid.runs])

    def fit(self, hyper: Hyperparameters) -> Model:
        """Fit the parameters of all effects together with the nuisances (Gauss-Newton)."""
        model = self
        for _ in range(_MAX_STEPS):
            terms, davis, moved = model._step(hyper)
            model = model.with_terms(terms, davis)
            if moved < _SETTLED:
                break
        terms, _, _ = model._step(hyper, hold=True)
        return model.with_terms(terms)

    def informations(
        self, hyper: Hyperparameters, candidates: Sequence[Array], *, terms: bool = True
    ) -> list[Information]:
        """Return the information on groups of candidate columns, each alone, with all nuisances eliminated.

        Args:
            hyper: Hyperparameters of noise and nuisances.
            candidates: Columns of each group at the grid points, shapes (m, k).
            terms: Eliminate the parameters of the effects too; otherwise they are fixed.

        """
        columns, root = self.white_columns(hyper), self.prior_factor(hyper.spread)
        if not terms:
            kept = self.without_terms
            columns, root = columns[:, np.append(True, kept)], root[np.ix_(kept, kept)]
        white = self._whitened(hyper)[0].apply(np.concatenate(candidates, axis=1))
        edges = np.cumsum([group.shape[1] for group in candidates])[:-1]
        return informations(columns, np.split(white, edges, axis=1), root)

    def posterior(self, hyper: Hyperparameters) -> tuple[Array, Array]:
        """Return mean and covariance of all nuisances, which include the parameters of effects."""
        columns = self.white_columns(hyper)
        products = columns.T @ columns
        self.add_odometry(products)
        return posterior(products, self.prior_factor(hyper.spread))

    @property
    def without_terms(self) -> NDArray[np.bool_]:
        """True for nuisance columns that are not parameters of effects, shape (q + k,)."""
        kept = np.ones(self.nuisance_columns.shape[1], dtype=bool)
        for _, here in self.places():
            kept[here] = False
        return kept

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
        """Return the effects after one step, with covariances, a, b, c, and the largest change in standard deviations.

        With ``hold`` the parameters stay where they are and only get their covariances.
        """
        mean, covariance = self.posterior(hyper)
        terms = []
        davis = self.found_davis(mean) if self._depends_on_davis else self.davis
        moved = self._moved(davis, covariance)
        for term, here in self.places():
            move = np.zeros(len(term.parameters)) if hold else mean[here]
            width = self.common_std[here]
            moved = max(moved, float(np.max(np.abs(move) / np.sqrt(np.diag(covariance)[here]))))
            move = np.clip(move, -width, width)
            terms.append(term.moved(move, covariance[here, here]))
        return tuple(terms), davis, moved

    def _moved(self, davis: Davis, covariance: Array) -> float:
        """Return the distance of a, b, c from the linearisation point in std; 0 if no effect depends on them."""
        if not self._depends_on_davis:
            return 0.0
        off = np.abs(_array(davis) - _array(self.davis))
        return float(np.max(off / np.sqrt(np.diag(covariance)[DAVIS])))


def _array(davis: Davis) -> Array:
    return np.array([davis.a, davis.b, davis.c])

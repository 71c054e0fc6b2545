# SPDX-License-Identifier: Apache-2.0
"""The believed model with some effects in it, linear about their parameters, ready to be compared with the data."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.discrepancy.hyper import Evidence
from trainid_ros.discrepancy.noise import Grid, Whitener
from trainid_ros.discrepancy.nuisances import DAVIS, Bins, common_columns, common_std, prior_factor, run_columns
from trainid_ros.discrepancy.odometry import Odometry
from trainid_ros.discrepancy.regression import Gram, posterior
from trainid_ros.physics.effects import EFFECTS
from trainid_ros.physics.train_file import Davis

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.nodes import Drive
    from trainid_ros.discrepancy.nuisances import Spread
    from trainid_ros.discrepancy.points import Points
    from trainid_ros.physics.effects import Parameter
    from trainid_ros.physics.train_file import TrainFile

    Array = NDArray[np.float64]

WHEEL: Final = 'wheel_diameter'
"""The effect that distances between stops tell of as well."""
_RUNS_AT_ONCE: Final = 16
_MOST_STEPS: Final = 5
_SETTLED: Final = 0.1
# Prior of a shape parameter that is refined, about where it was found.
_METRES: Final = 80.0
_SECONDS: Final = 60.0
_LOG_WIDTH: Final = 1.0
_SHORTEST_M: Final = 50.0
"""Least length of an effect at one place [m]."""
# A normal density at its top is that of a flat one this many standard deviations wide.
_SPREAD: Final = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class Member:
    """An effect in the model: its parameters, and their covariance once fitted, in the same order."""

    name: str
    parameters: Mapping[str, float]
    covariance: NDArray[np.float64] | None = None

    @property
    def size(self) -> float:
        """How far the amplitude is from having no effect, in units of its usual size."""
        kind = EFFECTS[self.name]
        return abs(self.parameters[kind.amplitude] - kind.neutral) / kind.usual

    @property
    def significance(self) -> float:
        """How far it is in standard deviations that it has with its shape given; infinite before a fit."""
        if self.covariance is None:
            return math.inf
        kind = EFFECTS[self.name]
        at = list(self.parameters).index(kind.amplitude)
        return self.size * kind.usual * math.sqrt(max(float(np.linalg.pinv(self.covariance)[at, at]), 0.0))

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations of the parameters; empty before a fit."""
        if self.covariance is None:
            return {}
        deviations = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        return dict(zip(self.parameters, deviations, strict=True))


class Model:
    """Drive, nuisances and members; never changed once made.

    Attributes:
        points: Stages of the drive.
        drive: What is explained.
        train_file: What is believed.
        members: Effects in it.
        davis: a, b, c about which the effects are linear.
        residual: Measured less predicted speed at the nodes [m/s], shape (m,).
        nuisance_columns: Responses at the nodes to nuisances that all runs share, first those of
            :func:`common_columns`, then the members' parameters, then errors of the map, shape (m, q + k).
        common_std: Prior std of the first q of them, shape (q,).
        factor_columns: Responses at the nodes to the factors of single runs, shape (m, 2).
        grid: Where the nodes lie.
        weighed: True if the mass of all runs is measured.
        odometry: What distances between stops tell.

    """

    def __init__(self, points: Points, train_file: TrainFile, members: tuple[Member, ...] = ()) -> None:
        self.points, self.drive, self.train_file = points, points.drive, train_file
        drive, length = self.drive, train_file.train.length
        bins = Bins.of(drive, length)
        self._common = drive.column(common_columns(drive))
        self._map = drive.column(drive.direction[:, None] * bins.shares(drive, length))
        self._map_root = np.asarray(np.linalg.cholesky(bins.covariance() + 1e-9 * np.eye(bins.count)))
        self.factor_columns = drive.column(run_columns(drive))
        self.grid = Grid.of(drive)
        self.weighed = all(run.weighed for run in drive.runs)
        self._gap = drive.average(drive.gap)
        self.odometry = Odometry.of(drive, train_file.line.stops)
        self._set(members, train_file.resistance)

    def having(self, members: tuple[Member, ...], davis: Davis | None = None) -> Model:
        """Return the same model with other members, and linear about another a, b, c."""
        other = copy(self)
        other._set(members, davis or self.davis)
        return other

    def without(self, k: int) -> Model:
        """Return the same model without member k."""
        return self.having((*self.members[:k], *self.members[k + 1 :]))

    def beside(self, columns: Array, std: float) -> Model:
        """Return the same model with further nuisances that all runs share: columns at the nodes, shape (m, k)."""
        other = copy(self)
        other.common_std = np.concatenate([np.full(columns.shape[1], std), self.common_std])
        other.nuisance_columns = np.concatenate([columns, self.nuisance_columns], axis=1)
        return other

    def _set(self, members: tuple[Member, ...], davis: Davis) -> None:
        """Linearise about the parameters of some members, and about a, b, c where these are part of an effect."""
        self.members, self.davis = members, davis
        derivatives, std = [], []
        total = np.zeros(self.drive.dt.size)
        common, self._bends = self._common, False
        beyond = _array(davis) - _array(self.train_file.resistance)
        for member in members:
            total += self.points.resistance(member.name, member.parameters, davis)
            by_davis = self.points.by_davis(member.name, member.parameters, davis)
            if by_davis is not None:
                self._bends = True
                # The columns of a, b, c count from what is believed.
                total -= by_davis @ beyond
                common = common.copy()
                common[:, DAVIS] += self.drive.column(by_davis)
            for name, value in member.parameters.items():
                width = _width(member.name, name, value)
                derivatives.append(self._derivative(member, name, 0.05 * width))
                std.append(width)
        self.residual = self._gap - self.drive.column(total)
        of_members = [self.drive.column(np.stack(derivatives, axis=1))] if derivatives else []
        self.nuisance_columns = np.concatenate([common, *of_members, self._map], axis=1)
        self.common_std = np.concatenate([common_std(self.train_file, weighed=self.weighed), std])

    def _derivative(self, member: Member, name: str, step: float) -> Array:
        """Return the derivative of a member's resistance by one of its parameters, shape (n,)."""
        limits, value = EFFECTS[member.name].parameters[name], member.parameters[name]
        other = value + step if value + step <= limits.high else value - step
        changed = self.points.resistance(member.name, {**member.parameters, name: other}, self.davis)
        here = self.points.resistance(member.name, member.parameters, self.davis)
        return np.asarray((changed - here) / (other - value))

    @property
    def columns(self) -> Array:
        """Residual and nuisances, shape (m, 1 + q + k)."""
        return np.concatenate([self.residual[:, None], self.nuisance_columns], axis=1)

    def evidence(self) -> Evidence:
        """Return the marginal likelihood as a function of the sizes of noise and nuisances."""
        return Evidence(
            self.grid, self.columns, self.factor_columns, self.common_std, self._map_root, weighed=self.weighed
        )

    def whitener(self, sizes: Sizes) -> Whitener:
        """Return the filter for these sizes."""
        return Whitener.of(self.grid, sizes.noise)

    def prior_factor(self, spread: Spread) -> Array:
        """Return the factor of the prior covariance of all nuisances, shape (q + k, q + k)."""
        return prior_factor(self.common_std, self._map_root, spread)

    def products(self, columns: Array, spread: Spread, whitener: Whitener) -> Array:
        """Return products of whitened columns at the nodes, less what factors of single runs explain.

        Args:
            columns: Shape (m, C).
            spread: Sizes of these factors.
            whitener: Filter.

        Returns:
            Sum over runs, shape (C, C).

        """
        total = np.zeros((columns.shape[1], columns.shape[1]))
        for gram in self._grams(columns, whitener, by_run=False):
            total += gram.reduced(spread.of_run)[0]
        return total

    def products_by_run(self, columns: Array, spread: Spread, whitener: Whitener) -> Array:
        """Return the same run by run, shape (R, C, C)."""
        grams = self._grams(columns, whitener, by_run=True)
        return np.concatenate([gram.reduced(spread.of_run)[0] for gram in grams])

    def _grams(self, columns: Array, whitener: Whitener, *, by_run: bool) -> Iterator[Gram]:
        """Yield products of some runs at a time: columns of hours of driving are gigabytes."""
        for first in range(0, len(self.drive.runs), _RUNS_AT_ONCE):
            part = slice(first, first + _RUNS_AT_ONCE)
            yield Gram.of(columns, self.factor_columns, self.grid.part(part), whitener.part(part), by_run=by_run)

    def fit(self, sizes: Sizes) -> Model:
        """Refine the parameters of all members together with the nuisances (Gauss-Newton)."""
        model, whitener = self, self.whitener(sizes)
        for _ in range(_MOST_STEPS):
            members, davis, moved = model._step(sizes, whitener)
            model = model.having(members, davis)
            if moved < _SETTLED:
                break
        members, _, _ = model._step(sizes, whitener, stay=True)
        return model.having(members)

    def posterior(self, sizes: Sizes, whitener: Whitener) -> tuple[Array, Array]:
        """Return mean and covariance of all nuisances, members' parameters among them."""
        total = self.products(self.columns, sizes.spread, whitener)
        self.add_odometry(total)
        return posterior(total, self.prior_factor(sizes.spread))

    @property
    def without_members(self) -> NDArray[np.bool_]:
        """Which nuisance columns are no parameters of members, shape (q + k,)."""
        kept = np.ones(self.nuisance_columns.shape[1], dtype=bool)
        for _, here in self.places():
            kept[here] = False
        return kept

    @property
    def odometer_excess(self) -> float:
        """What distances between stops say of the wheel's ratio beyond what the members say."""
        known = (member.parameters['ratio'] - 1.0 for member in self.members if member.name == WHEEL)
        return self.odometry.excess - sum(known)

    @property
    def odometry_cost(self) -> float:
        """Twice the negative log-likelihood of the distances between stops, up to a constant."""
        return self.odometry.precision * self.odometer_excess**2

    def add_odometry(self, products: Array) -> None:
        """Add the distances between stops to products of y and nuisances, as one more measurement of the wheel."""
        for member, here in self.places():
            if member.name == WHEEL:
                at = 1 + here.start
                products[at, at] += self.odometry.precision
                products[0, at] += self.odometry.precision * self.odometer_excess
                products[at, 0] = products[0, at]

    def places(self) -> Iterator[tuple[Member, slice]]:
        """Yield all members and where their parameters stand among the nuisances."""
        at = len(self.common_std) - sum(len(member.parameters) for member in self.members)
        for member in self.members:
            yield member, slice(at, at + len(member.parameters))
            at += len(member.parameters)

    def found_davis(self, mean: Array) -> Davis:
        """Return a, b, c by the mean of all nuisances; what no train has is cut off."""
        a, b, c = (_array(self.train_file.resistance) + mean[DAVIS]).tolist()
        return Davis(max(a, 0.0), b, max(c, 0.0))

    def _step(
        self, sizes: Sizes, whitener: Whitener, *, stay: bool = False
    ) -> tuple[tuple[Member, ...], Davis, float]:
        """Return members one step on, with covariances, a, b, c, and the largest move in std; or where they are."""
        mean, covariance = self.posterior(sizes, whitener)
        members = []
        davis = self.found_davis(mean)
        moved = self._moved(davis, covariance)
        for member, here in self.places():
            move = np.zeros(len(member.parameters)) if stay else mean[here]
            width = self.common_std[here]
            moved = max(moved, float(np.max(np.abs(move) / np.sqrt(np.diag(covariance)[here]))))
            move = np.clip(move, -width, width)
            parameters = {
                name: _inside(value + delta, EFFECTS[member.name].parameters[name])
                for (name, value), delta in zip(member.parameters.items(), move.tolist(), strict=True)
            }
            members.append(Member(member.name, _ordered(parameters), covariance[here, here]))
        return tuple(members), davis, moved

    def _moved(self, davis: Davis, covariance: Array) -> float:
        """Return how far a, b, c are from where effects are linear, in std; 0 if no effect depends on them."""
        if not self._bends:
            return 0.0
        off = np.abs(_array(davis) - _array(self.davis))
        return float(np.max(off / np.sqrt(np.diag(covariance)[DAVIS])))


def _array(davis: Davis) -> Array:
    return np.array([davis.a, davis.b, davis.c])


def prior_cost(member: Member, drive: Drive) -> float:
    """Return what a member costs beyond the priors about where it was found, as twice a log.

    An amplitude is unlikely to lie far from its neutral value; a place or a time could have been any other.
    """
    kind, cost = EFFECTS[member.name], 0.0
    for name, value in member.parameters.items():
        width = _width(member.name, name, value)
        limits = kind.parameters[name]
        if name == kind.amplitude:
            cost += ((value - kind.neutral) / width) ** 2
        elif limits.search is not None:
            low, high = limits.search
            span = math.log(high / low) * abs(value) if limits.grid == 'log' else high - low
            cost += 2.0 * math.log(max(span / (_SPREAD * width), 1.0))
        else:
            along = drive.joined('position') if limits.unit == 'm' else drive.time
            cost += 2.0 * math.log(max(float(np.ptp(along)) / (_SPREAD * width), 1.0))
    return cost


def _width(effect: str, name: str, value: float) -> float:
    """Return the prior std of a parameter about where it was found."""
    kind = EFFECTS[effect]
    if name == kind.amplitude:
        return 3.0 * kind.usual
    limits = kind.parameters[name]
    if limits.unit == 'm' and limits.search is None:
        return _METRES
    if limits.search is None:
        return _SECONDS
    return _LOG_WIDTH * max(abs(value), limits.search[0])


def _inside(value: float, limits: Parameter) -> float:
    """Return the nearest value that a parameter may have; not far beyond where it was looked for."""
    low, high = limits.low, limits.high
    if limits.search is not None:
        low, high = max(low, 0.3 * limits.search[0]), min(high, 3.0 * limits.search[1])
    return min(max(value, low), high)


def _ordered(parameters: dict[str, float]) -> dict[str, float]:
    """Keep an end behind its start, and so far that a train, under which all is averaged, can show the length."""
    if 'start' in parameters and 'end' in parameters and parameters['end'] - parameters['start'] < _SHORTEST_M:
        middle = 0.5 * (parameters['start'] + parameters['end'])
        return {**parameters, 'start': middle - 0.5 * _SHORTEST_M, 'end': middle + 0.5 * _SHORTEST_M}
    return parameters

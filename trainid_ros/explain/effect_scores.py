# SPDX-License-Identifier: Apache-2.0
"""Score every effect and every generic dependence by how well it explains the residual of a model.

All columns pass through the same whitening and elimination of nuisances, so all hypotheses are compared by one number:
twice the log Bayes factor against the model without the hypothesis.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.special import logsumexp

from trainid_ros.explain.families import SECTIONS, named_families, sign
from trainid_ros.explain.generic import generic_groups
from trainid_ros.explain.model import WHEEL
from trainid_ros.explain.nuisances import Bins
from trainid_ros.explain.regression import eliminate, group_log_bayes, log_bayes
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from trainid_ros.explain.families import Family
    from trainid_ros.explain.generic import Group
    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import Model
    from trainid_ros.explain.regression import Information

    Array = NDArray[np.float64]

_GROUP_STD: Final = (0.1, 0.3, 1.0)
"""Prior std of the coefficients of a group [N/kN]; the Bayes factor is averaged over them."""
_SHARES: Final = (0.3, 1.0)
"""The same for the amplitude of an effect, in units of its usual value."""
# Limits of the section lengths that are tried.
_SHORTEST_M: Final = 60.0
_LONGEST_M: Final = 2500.0


@dataclass(frozen=True, slots=True)
class EffectScore:
    """Evidence of one hypothesis.

    Attributes:
        name: Effect, or group of columns.
        evidence: 2 ln of its Bayes factor [1].
        parameters: Best parameters tried, in the units of the effect; empty for a group.
        text: What a group depends on, as text; empty for an effect.

    """

    name: str
    evidence: float
    parameters: Mapping[str, float]
    text: str = ''


class EffectScorer:
    """Columns of all hypotheses for one dataset, at the nodes."""

    def __init__(self, model: Model) -> None:
        dataset, length = model.dataset, model.train_file.train.length
        self._families: tuple[Family, ...] = named_families(model.evaluator)
        self._groups: tuple[Group, ...] = generic_groups(dataset, length)
        self._bins = Bins.of(dataset, length, fine=True)
        shares = self._bins.shares(dataset, length)
        # In the order of SECTIONS: the sign of a gradient error depends on the direction, that of a drag does not.
        sections = (dataset.direction[:, None] * shares, shares) if dataset.positioned else ()
        self._sections = SECTIONS[: len(sections)]
        resistances = [*(f.resistance for f in self._families), *(g.resistance for g in self._groups)]
        blocks = [dataset.column(r) for r in (*resistances, *sections)]
        self._parts = [slice(*edges) for edges in pairwise(np.cumsum([0, *(b.shape[1] for b in blocks)]).tolist())]
        self._columns = np.concatenate(blocks, axis=1)

    def scores(self, model: Model, hyper: Hyperparameters) -> tuple[list[EffectScore], list[EffectScore]]:
        """Return the evidence of all named effects and of all groups when added to the model, best first."""
        information = reduced_information(model, hyper, self._columns)
        blocks = iter([(information.A[part, part], information.b[part]) for part in self._parts])
        named, groups = [], []
        for family in self._families:
            A, b = next(blocks)
            if family.name == WHEEL:
                A, b = A + model.odometry.precision, b + model.odometry.precision * model.odometer_excess
            named.append(_family(family, np.diag(A), b))
        for group in self._groups:
            A, b = next(blocks)
            values = [group_log_bayes(A, b, std) for std in _GROUP_STD]
            groups.append(EffectScore(group.name, _mean_evidence(np.array(values)), {}, group.text))
        named += [_section(name, self._bins, *next(blocks)) for name in self._sections]
        return sorted(named, key=_strongest), sorted(groups, key=_strongest)

    def group_columns(self, name: str) -> Array:
        """Return the columns of a group at the nodes, shape (m, k)."""
        k = next(i for i, group in enumerate(self._groups) if group.name == name)
        return self._columns[:, self._parts[len(self._families) + k]]


def reduced_information(model: Model, hyper: Hyperparameters, candidates: Array, *, terms: bool = True) -> Information:
    """Return the information on candidate columns at the nodes, shape (m, k), with all nuisances of a model eliminated.

    With ``terms`` the parameters of its effects are eliminated too, otherwise they are fixed.
    """
    nuisances, root = model.nuisance_columns, model.prior_factor(hyper.spread)
    if not terms:
        kept = model.without_terms
        nuisances, root = nuisances[:, kept], root[np.ix_(kept, kept)]
    columns = np.concatenate([model.residual[:, None], nuisances, candidates], axis=1)
    total = model.products(columns, hyper.spread, model.whitener(hyper))
    return eliminate(total, nuisances.shape[1], root)


def stretch_sums(A: Array, b: Array, first: NDArray[np.intp], end: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return A and b of the sums of columns ``first`` to ``end - 1``, shapes (k, k) and (k,) to (s,) each."""
    n = len(b)
    corner = np.zeros((n + 1, n + 1))
    corner[1:, 1:] = A.cumsum(axis=0).cumsum(axis=1)
    sums = np.concatenate([[0.0], np.cumsum(b)])
    block = corner[end, end] - corner[first, end] - corner[end, first] + corner[first, first]
    return block, sums[end] - sums[first]


def _family(family: Family, A: Array, b: Array) -> EffectScore:
    """Return the evidence of an effect, averaged over its shapes; A is the diagonal of the matrix."""
    values = [log_bayes(A, b, share * family.std, family.sign) for share in _SHARES]
    best = int(np.argmax(values[-1]))
    kind = EFFECTS[family.name]
    size = b[best] / (A[best] + family.std**-2)
    parameters = {**family.shapes[best], kind.amplitude: kind.neutral + float(size)}
    return EffectScore(family.name, _mean_evidence(np.array(values)), parameters)


def _section(name: str, bins: Bins, A: Array, b: Array) -> EffectScore:
    """Return the evidence of a constant resistance over a section of the line, averaged over all sections of bins."""
    kind = EFFECTS[name]
    i, j = np.triu_indices(bins.count + 1, 1)
    length = (j - i) * bins.width
    usable = (length >= _SHORTEST_M) & (length <= max(_LONGEST_M, 2.0 * bins.width))
    i, j = i[usable], j[usable]
    block, along = stretch_sums(A, b, i, j)
    block = np.maximum(block, 1e-9)
    values = np.stack([log_bayes(block, along, share * kind.usual, sign(kind)) for share in _SHARES])
    # The prior of the length is uniform on a log scale.
    weight = 1.0 / (j - i)
    best = int(np.argmax(values[-1]))
    size = along[best] / (block[best] + kind.usual**-2)
    edges = bins.edges
    parameters = {
        'start': float(edges[i[best]]),
        'end': float(edges[j[best]]),
        kind.amplitude: kind.neutral + float(size),
    }
    return EffectScore(name, _mean_evidence(values, weight / weight.sum()), parameters)


def _mean_evidence(values: Array, weight: Array | None = None) -> float:
    """Return 2 ln of the weighted mean of Bayes factors, which are given as 2 ln B."""
    weights = np.full(values.shape, 1.0) if weight is None else np.broadcast_to(weight, values.shape)
    return float(2.0 * (logsumexp(0.5 * values, b=weights) - np.log(weights.sum())))


def _strongest(score: EffectScore) -> float:
    return -score.evidence

# SPDX-License-Identifier: Apache-2.0
"""How well every effect, and every nameless dependence, explains what a model leaves.

All columns pass through the same whitening and elimination of nuisances, so all hypotheses are judged by one number:
twice the log Bayes factor against nothing more being there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.special import logsumexp

from trainid_ros.discrepancy.families import SECTIONS, named_families, sign, usual
from trainid_ros.discrepancy.generic import generic_groups
from trainid_ros.discrepancy.model import WHEEL
from trainid_ros.discrepancy.nuisances import Bins
from trainid_ros.discrepancy.regression import Gram, eliminate, group_log_bayes, log_bayes
from trainid_ros.physics.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from trainid_ros.discrepancy.families import Family
    from trainid_ros.discrepancy.generic import Group
    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Model
    from trainid_ros.discrepancy.regression import Information

    Array = NDArray[np.float64]

_GROUP_STD: Final = (0.1, 0.3, 1.0)
_SHARES: Final = (0.3, 1.0)
_SHORTEST_M: Final = 60.0
_LONGEST_M: Final = 2500.0
_CHUNK: Final = 16


@dataclass(frozen=True, slots=True)
class Score:
    """Evidence of one hypothesis.

    Attributes:
        name: Effect, or group of columns.
        evidence: 2 ln of its Bayes factor.
        parameters: Best parameters seen; empty for a group.

    """

    name: str
    evidence: float
    parameters: Mapping[str, float]


class Screen:
    """Columns of all hypotheses for one drive, at the nodes."""

    def __init__(self, model: Model) -> None:
        drive, length = model.drive, model.train_file.train.length
        self._families: tuple[Family, ...] = named_families(model.points)
        self._groups: tuple[Group, ...] = generic_groups(drive, length)
        self._bins = Bins.of(drive, length, fine=True)
        shares = self._bins.shares(drive, length)
        directions = np.array([run.direction for run in drive.runs])[drive.run_of][:, None]
        resistances = [*(f.resistance for f in self._families), *(g.resistance for g in self._groups)]
        blocks = [drive.column(r) for r in (*resistances, directions * shares, shares)]
        self._edges = np.cumsum([0, *(block.shape[1] for block in blocks)])
        self._columns = np.concatenate(blocks, axis=1)

    def scores(self, model: Model, sizes: Sizes) -> tuple[list[Score], list[Score]]:
        """Return the evidence of all named effects and of all groups beside the model, best first."""
        information = reduced_information(model, sizes, self._columns)
        named, groups = [], []
        for k, family in enumerate(self._families):
            part = slice(int(self._edges[k]), int(self._edges[k + 1]))
            A, b = np.diag(information.A)[part], information.b[part]
            if family.name == WHEEL:
                A, b = A + model.odometry.precision, b + model.odometry.precision * model.odometer_excess
            named.append(self._family(family, A, b))
        for k, group in enumerate(self._groups, len(self._families)):
            part = slice(int(self._edges[k]), int(self._edges[k + 1]))
            A, b = information.A[part, part], information.b[part]
            values = [group_log_bayes(A, b, std) for std in _GROUP_STD]
            groups.append(Score(group.name, _mean_evidence(np.array(values)), {}))
        first = len(self._families) + len(self._groups)
        for k, name in enumerate(SECTIONS, first):
            part = slice(int(self._edges[k]), int(self._edges[k + 1]))
            named.append(self._section(name, information.A[part, part], information.b[part]))
        return sorted(named, key=_strongest), sorted(groups, key=_strongest)

    def group_columns(self, name: str) -> Array:
        """Return the columns of a group at the nodes, shape (m, k)."""
        k = len(self._families) + next(i for i, group in enumerate(self._groups) if group.name == name)
        return self._columns[:, int(self._edges[k]) : int(self._edges[k + 1])]

    def _family(self, family: Family, A: Array, b: Array) -> Score:
        values = [log_bayes(A, b, share * family.std, family.sign) for share in _SHARES]
        best = int(np.argmax(values[-1]))
        kind = EFFECTS[family.name]
        size = b[best] / (A[best] + family.std**-2)
        parameters = {**family.shapes[best], kind.amplitude: kind.neutral + float(size)}
        return Score(family.name, _mean_evidence(np.array(values)), parameters)

    def _section(self, name: str, A: Array, b: Array) -> Score:
        """Evidence of a constant resistance over a stretch, over all stretches of bins (sums of blocks of A)."""
        kind, width = EFFECTS[name], self._bins.width
        n = self._bins.count
        P = np.zeros((n + 1, n + 1))
        P[1:, 1:] = A.cumsum(axis=0).cumsum(axis=1)
        sums = np.concatenate([[0.0], np.cumsum(b)])
        i, j = np.triu_indices(n + 1, 1)
        length = (j - i) * width
        usable = (length >= _SHORTEST_M) & (length <= max(_LONGEST_M, 2.0 * width))
        i, j = i[usable], j[usable]
        block = np.maximum(P[j, j] - P[i, j] - P[j, i] + P[i, i], 1e-9)
        along = sums[j] - sums[i]
        std = usual(kind)
        values = np.stack([log_bayes(block, along, share * std, sign(kind)) for share in _SHARES])
        # Lengths are as likely on a log scale.
        weight = 1.0 / (j - i)
        best = int(np.argmax(values[-1]))
        size = along[best] / (block[best] + std**-2)
        edges = self._bins.edges
        parameters = {
            'start': float(edges[i[best]]),
            'end': float(edges[j[best]]),
            kind.amplitude: kind.neutral + float(size),
        }
        return Score(name, _mean_evidence(values, weight / weight.sum()), parameters)


def reduced_information(model: Model, sizes: Sizes, candidates: Array, *, members: bool = True) -> Information:
    """Return what the data tell of columns at the nodes, shape (m, k), beside all nuisances of a model.

    With ``members`` its effects may move as well, otherwise they stand.
    """
    nuisances, root = model.nuisance_columns, model.prior_factor(sizes.spread)
    if not members:
        kept = model.without_members
        nuisances, root = nuisances[:, kept], root[np.ix_(kept, kept)]
    columns = np.concatenate([model.residual[:, None], nuisances, candidates], axis=1)
    std = np.array([sizes.spread.payload, sizes.spread.brake])
    total = np.zeros((columns.shape[1], columns.shape[1]))
    for grid, part in model.chunks(model.whitener(sizes), _CHUNK):
        products, _ = Gram.of(columns, model.factor_columns, grid, part).reduced(std)
        total += products.sum(axis=0)
    return eliminate(total, nuisances.shape[1], root)


def _mean_evidence(values: Array, weight: Array | None = None) -> float:
    """Return 2 ln of the mean of Bayes factors given as 2 ln B, shape (sizes, shapes) or any."""
    weights = np.full(values.shape, 1.0) if weight is None else np.broadcast_to(weight, values.shape)
    return float(2.0 * (logsumexp(0.5 * values, b=weights) - np.log(weights.sum())))


def _strongest(score: Score) -> float:
    return -score.evidence

# SPDX-License-Identifier: Apache-2.0
"""A single filter of filter-bank, given what the bank has to estimate: sizes of disturbances and times of changes.

It shows what the search over hypotheses costs. It is not a bound: force scale and delay remain unknown, as on a real
train, and which coefficient changes, and by how much, is not given either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan
from trainid_ros.resistance.speed_states import A, C
from trainid_ros.stream.known_force import KnownForce

if TYPE_CHECKING:
    from benchmarks.worlds import Truth
    from trainid_ros.interface.results import Rejection, ResistanceEstimate
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Information:
    """Truth data given to the filter: stds [N/kN], correlation time [s] and length [m], stamps of the changes [ns]."""

    gust_std: float
    gust_time: float
    map_std: float
    map_length: float
    changes_ns: tuple[int, ...]


def information_of(truth: Truth) -> Information:
    """Return the truth data of a drive that the filter is given."""
    start_ns = int(truth.time_ns[0])
    changes_ns = tuple(start_ns + round(change * NS_PER_S) for change in truth.changes)
    return Information(truth.gust_std, truth.gust_time, truth.map_std, truth.map_length, changes_ns)


class InformedFilter:
    """One hypothesis with the true disturbance sizes; each change of resistance adds the step variances to a and c."""

    def __init__(self, train_file: TrainFile, known: Information) -> None:
        config = FilterBankConfig()
        plan = bank_plan(train_file, config, KnownForce(train_file).inertia)
        self._plan = replace(
            plan,
            gust_stds=(known.gust_std,),
            map_stds=(known.map_std,),
            # No branching into further hypotheses.
            branch_interval=math.inf,
            noise=replace(plan.noise, gust_time=known.gust_time, map_length=known.map_length),
        )
        self._bank = FilterBank(train_file, config, self._plan)
        self._changes_ns = list(known.changes_ns)

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample, after the changes of resistance before it."""
        while self._changes_ns and sample.stamp_ns >= self._changes_ns[0]:
            self._changes_ns.pop(0)
            for state, variance in zip((A, C), self._plan.step_variances, strict=True):
                self._bank.bank.inflate_variance(state, variance, math.inf)
        return self._bank.step(sample)

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the estimate of the filter."""
        return self._bank.estimate(speed)

    @property
    def converged(self) -> bool:
        """True while the estimate is fit for use."""
        return self._bank.converged

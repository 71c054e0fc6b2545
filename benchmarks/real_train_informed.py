# SPDX-License-Identifier: Apache-2.0
"""The filter of filter-bank, informed of what the bank has to find out: sizes of disturbances and times of changes.

It shows what the search over hypotheses costs. It is no bound: force scale and delay are as unknown to it as on a
train, and which coefficient changes, and by how much, is not stated either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from trainid_ros.core.records import NS_PER_S
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.resistance.filter_bank import FilterBank, FilterBankConfig, bank_plan
from trainid_ros.resistance.hypotheses import Bank
from trainid_ros.resistance.speed_states import A, C

if TYPE_CHECKING:
    from benchmarks.worlds import Truth
    from trainid_ros.core.results import Rejection, ResistanceEstimate
    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Information:
    """What the filter is informed of: sizes [N/kN], correlation time [s] and length [m], stamps of the changes."""

    gust_std: float
    gust_time: float
    map_std: float
    map_length: float
    changes_ns: tuple[int, ...]


def information_of(truth: Truth) -> Information:
    """Return what the filter is informed of about a drive."""
    start_ns = int(truth.time_ns[0])
    changes_ns = tuple(start_ns + round(change * NS_PER_S) for change in truth.changes)
    return Information(truth.gust_std, truth.gust_time, truth.map_std, truth.map_length, changes_ns)


class InformedFilter(FilterBank):
    """One hypothesis with the true sizes; at each change of resistance a and c become uncertain by a step."""

    def __init__(self, train_file: TrainFile, known: Information) -> None:
        config = FilterBankConfig()
        super().__init__(train_file, config)
        plan = bank_plan(train_file, config, KnownForce(train_file).inertia)
        self._bank = Bank(
            replace(
                plan,
                gust_stds=(known.gust_std,),
                map_stds=(known.map_std,),
                # It never branches.
                spacing=math.inf,
                noise=replace(plan.noise, gust_time=known.gust_time, map_length=known.map_length),
            )
        )
        self._changes_ns = list(known.changes_ns)

    def step(self, sample: Sample) -> ResistanceEstimate | Rejection:
        """Take one sample in, after the changes of resistance before it."""
        while self._changes_ns and sample.stamp_ns >= self._changes_ns[0]:
            self._changes_ns.pop(0)
            self._widen()
        return super().step(sample)

    def _widen(self) -> None:
        variance_a, variance_c = self._bank.plan.step_variances
        self._bank.state.P[:, A, A] += variance_a
        self._bank.state.P[:, C, C] += variance_c
        self._mixture = None

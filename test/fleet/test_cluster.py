# SPDX-License-Identifier: Apache-2.0
"""Bags on the workers of a Dask scheduler."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.fleet.plan import PlannedBag, Setup, make_plan
from trainid_ros.fleet.run_fleet import TASK_BAGS, bag_row, rows_on_cluster
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

distributed = pytest.importorskip('distributed')


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Return a cluster in this process, with threads for workers: it starts fast."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=request.param, processes=False, dashboard_address=None, protocol='tcp'
    ) as found:
        yield found


@pytest.mark.parametrize('cluster', [1], indirect=True)
def test_rows_are_those_of_this_machine(cluster: Any, tiny: Path, setup: Setup) -> None:
    broken = PlannedBag('none', error='none: no such bag')
    bags = (PlannedBag(str(tiny), start_s=1.0, train='T1'), *[broken] * TASK_BAGS)
    plan, done = make_plan(setup, bags), list[float]()
    with rows_on_cluster(cluster.scheduler_address) as rows:
        found = dict(rows(plan, bags, done.append))
    assert sorted(done) == [1, TASK_BAGS]
    assert found == {number: bag_row(setup, plan.revision, bag, lambda _: None) for number, bag in enumerate(bags)}


@pytest.mark.parametrize('cluster', [2], indirect=True)
def test_workers_with_threads_are_refused(cluster: Any) -> None:
    with (
        pytest.raises(InputError, match='has 2 threads; start it with --nthreads 1'),
        rows_on_cluster(cluster.scheduler_address),
    ):
        pass

# SPDX-License-Identifier: Apache-2.0
"""Healthy trains of all kinds, a quarter of an hour each: nothing is found. The benchmark ``healthy`` has many more.

``make test`` drives each kind of unusual drive in one world, ``make test-long`` in the others too.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from benchmarks import healthy
from benchmarks.healthy import UNUSUAL, Case, moments_of, outcome_of, rows_of
from benchmarks.worlds import WORLDS, drive
from trainid_ros.bag.reader import BagReader
from trainid_ros.sim.worlds import REALISMS
from trainid_ros.train.train_file import load_train_file

SEED = 9000
DURATION_S = 900.0
# Least motion of a drive that shows something [s]: that of the one that shunts.
MIN_MOVED_S = 200.0
CASES = [
    *(Case(world, SEED) for world in WORLDS),
    *(Case(world, SEED, realism=realism) for world in WORLDS for realism in REALISMS),
    *(
        pytest.param(
            Case(unusual.world, SEED, place),
            marks=pytest.mark.long if unusual.name in {one.name for one in UNUSUAL[:place]} else (),
        )
        for place, unusual in enumerate(UNUSUAL)
    ),
]
# The same drive for all cases that change only its records.
driven = cache(drive)


def name_of(case: Case) -> str:
    return f'{UNUSUAL[case.place].name}, {case.world}' if case.place >= 0 else f'{case.world} {case.realism}'.strip()


@pytest.mark.slow
@pytest.mark.parametrize('case', CASES, ids=name_of)
def test_nothing_is_found_on_a_healthy_train(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(healthy, 'drive', driven)
    outcome = outcome_of(moments_of(*rows_of(case, DURATION_S)))
    print(name_of(case), outcome.findings, f'suspected {outcome.suspected:.1%}', outcome.suspicions)
    assert outcome.moved_s > MIN_MOVED_S
    assert outcome.findings == ()


@pytest.mark.slow
@pytest.mark.parametrize('seed', [9000, 8400, 8403])
def test_nothing_is_found_where_wheels_slip_in_one_eighth_of_the_time(seed: int) -> None:
    """A filter that learns from slip finds a wrong force, command or unit on these."""
    place = next(k for k, unusual in enumerate(UNUSUAL) if unusual.name == 'slip in 12 %')
    outcome = outcome_of(moments_of(*rows_of(Case('metro', seed, place), 600.0)))
    assert outcome.findings == ()


def test_nothing_is_found_on_the_freight_run_of_another_simulator() -> None:
    bag = Path(__file__).parents[2] / 'bags' / 'altrios_manifest'
    with BagReader(bag) as reader:
        outcome = outcome_of(moments_of(load_train_file(bag / 'train.yaml'), (r.row() for r in reader.records())))
    assert outcome.moved_s > 3000.0
    assert outcome.findings == ()

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.bag.worker_pool import map_bags, processors
from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

# A module of its own: processes cannot import those of the tests.
WORK = """
import os
from trainid_ros.errors import InputError

def square(item, advance):
    if item < 0:
        raise InputError(f'{item}: is negative')
    advance(0.5)
    advance(0.5)
    return item * item, os.getpid()

def end(item, advance):
    os._exit(1)
"""


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / 'work_of_test_worker_pool.py').write_text(WORK, encoding='utf-8')
    monkeypatch.syspath_prepend(tmp_path)
    return import_module('work_of_test_worker_pool')


def test_results_and_progress_are_those_of_one_process(work: Any) -> None:
    steps: list[float] = []
    here = map_bags(work.square, [3, 1, 2], 1, steps.append)
    assert here == [(9, os.getpid()), (1, os.getpid()), (4, os.getpid())]
    assert sum(steps) == 3.0
    steps.clear()
    there = map_bags(work.square, [3, 1, 2], 2, steps.append)
    assert [value for value, _ in there] == [9, 1, 4]
    assert os.getpid() not in {process for _, process in there}
    assert sum(steps) == 3.0


def test_an_error_in_a_process_is_raised(work: Any) -> None:
    with pytest.raises(InputError, match='-1: is negative'):
        map_bags(work.square, [1, -1], 2, lambda _: None)


def test_a_killed_process_is_an_error(work: Any) -> None:
    with pytest.raises(InputError, match='killed'):
        map_bags(work.end, [1, 2], 2, lambda _: None)


def test_there_is_a_processor() -> None:
    assert processors() >= 1

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.bag.worker_pool import each_bag
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

# A module of its own: processes cannot import those of the tests.
WORK = """
import os
import signal
import time
from trainid_ros.interface.errors import InputError

def square(item, advance):
    if item < 0:
        raise InputError(f'{item}: is negative')
    advance(0.5)
    advance(0.5)
    return item * item, os.getpid()

def end_once(path, advance):
    # Once 'one' has begun: 'two' kills its process the first time, 'three' each time.
    advance(0.5)
    if path.name == 'one':
        path.touch()
    while not (path.parent / 'one').exists():
        time.sleep(0.01)
    if path.name == 'three' or path.name == 'two' and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    advance(0.5)
    return path.name
"""


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / 'work_of_test_worker_pool.py').write_text(WORK, encoding='utf-8')
    monkeypatch.syspath_prepend(tmp_path)
    return import_module('work_of_test_worker_pool')


def killed(item: object) -> Any:
    return f'{item} is left'


def results_of(do: Any, items: list[Any], workers: int, advance: Any) -> list[Any]:
    return [result for _, result in sorted(each_bag(do, items, workers, advance, killed))]


def test_results_and_progress_are_those_of_one_process(work: Any) -> None:
    steps: list[float] = []
    here = results_of(work.square, [3, 1, 2], 1, steps.append)
    assert here == [(9, os.getpid()), (1, os.getpid()), (4, os.getpid())]
    assert sum(steps) == 3.0
    steps.clear()
    there = results_of(work.square, [3, 1, 2], 2, steps.append)
    assert [value for value, _ in there] == [9, 1, 4]
    assert os.getpid() not in {process for _, process in there}
    assert sum(steps) == 3.0


def test_results_of_many_items_come_as_they_are_done(work: Any) -> None:
    found = dict(each_bag(work.square, range(40), 2, lambda _: None, killed))
    assert {number: value for number, (value, _) in found.items()} == {k: k * k for k in range(40)}


def test_an_error_in_a_process_is_raised(work: Any) -> None:
    with pytest.raises(InputError, match='-1: is negative'):
        results_of(work.square, [1, -1], 2, lambda _: None)


def test_only_an_item_whose_own_process_is_killed_again_has_no_result(work: Any, tmp_path: Path) -> None:
    items = [tmp_path / name for name in ('four', 'one', 'two', 'three')]
    steps: list[float] = []
    results = results_of(work.end_once, items, 2, steps.append)
    assert results == ['four', 'one', 'two', f'{tmp_path}/three is left']
    assert min(steps) > 0.0
    assert sum(steps) == 3.5  # half of the last one

# SPDX-License-Identifier: Apache-2.0
"""What makes another row of a bag, and what only other labels."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from trainid_ros.fleet.plan import Plan, PlannedBag, make_plan

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.fleet.plan import Setup

BAG = PlannedBag('/depot/one', size=1, modified_ns=2, start_s=3.0, messages=4, train='T1', day='2026-01-31')


@pytest.mark.parametrize('name', ['g.py', 'my force.py', 'Zugkraft-für-Ü.py', 'a b.c.py'])
def test_an_edited_user_function_makes_another_row(setup: Setup, tmp_path: Path, name: str) -> None:
    mapping, function = tmp_path / 'map.yaml', tmp_path / name
    mapping.write_text(f'mass: {{function: "{name}:f", of: [{{topic: a, field: b}}]}}\n', encoding='utf-8')
    function.write_text('def f(x): return x\n', encoding='utf-8')
    first = key(replace(setup, mapping=mapping))
    assert key(replace(setup, mapping=mapping)) == first
    function.write_text('def f(x): return -x\n', encoding='utf-8')
    assert key(replace(setup, mapping=mapping)) != first


def test_every_file_of_the_setup_makes_another_row(setup: Setup, tmp_path: Path) -> None:
    files = {name: tmp_path / f'{name}.yaml' for name in ('train', 'params', 'mapping')}
    for path in files.values():
        path.write_text('{}\n', encoding='utf-8')
    whole = replace(setup, train=files['train'], params=files['params'], mapping=files['mapping'])
    keys = {key(whole), key(replace(whole, params=None)), key(replace(whole, mapping=None))}
    for path in files.values():
        path.write_text('{} # edited\n', encoding='utf-8')
        keys.add(key(whole))
    assert len(keys) == 6


def test_labels_make_no_other_row(setup: Setup) -> None:
    plan = make_plan(setup, ())
    assert plan.key(replace(BAG, train='T2', line='7', weather='rain', day='')) == plan.key(BAG)
    others = (replace(BAG, path='/x'), replace(BAG, size=9), replace(BAG, modified_ns=9), replace(BAG, messages=9))
    assert len({plan.key(bag) for bag in (BAG, *others)}) == 5


def key(setup: Setup) -> str:
    plan: Plan = make_plan(setup, (BAG,))
    return plan.key(BAG)

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from trainid_ros.fleet.table_file import Journal, read_journal
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path


def test_rows_survive_a_kill_at_any_byte(tmp_path: Path) -> None:
    path = tmp_path / 'rows.jsonl'
    assert read_journal(path) == {}
    with Journal(path) as journal:
        journal.add('k1', {'w15': 0.1, 'bag': 'ä'})
        journal.add('k2', {'w15': None})
    whole = path.read_bytes()
    end = whole.index(b'\n') + 1
    for cut in range(len(whole) + 1):
        path.write_bytes(whole[:cut])
        with Journal(path) as journal:
            journal.add('k3', {'w15': 3.0})
        found = read_journal(path)
        assert found.pop('k3') == {'w15': 3.0}
        assert list(found) == [*['k1'] * (cut >= end - 1), *['k2'] * (cut >= len(whole) - 1)], cut


def test_another_file_is_not_taken_for_rows(tmp_path: Path) -> None:
    path = tmp_path / 'rows.jsonl'
    path.write_text('hello\n', encoding='utf-8')
    with pytest.raises(InputError, match='holds no row of a fleet'):
        read_journal(path)


def test_rows_survive_what_a_loss_of_power_leaves(tmp_path: Path) -> None:
    path = tmp_path / 'rows.jsonl'
    with Journal(path) as journal:
        journal.add('k1', {'w15': 0.1})
    path.write_bytes(path.read_bytes() + bytes(512) + b'\xff\n')
    with Journal(path) as journal:
        journal.add('k2', {'w15': 0.2})
    assert read_journal(path) == {'k1': {'w15': 0.1}, 'k2': {'w15': 0.2}}

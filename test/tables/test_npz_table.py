# SPDX-License-Identifier: Apache-2.0
"""Files of NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.tables.columns import ROWS_AT_ONCE, joined
from trainid_ros.tables.npz_table import NpzTable


def table(tmp_path: Path, **columns: Any) -> NpzTable:
    path = tmp_path / 'log.npz'
    np.savez(path, **columns)
    return NpzTable(path)


def test_columns_of_all_types_are_read(tmp_path: Path) -> None:
    times = np.array(['2024-03-08'], dtype='datetime64[s]')
    v, n = np.array([1.5], dtype=np.float32), np.array([3], dtype=np.uint8)
    source = table(tmp_path, t=times, v=v, n=n, ok=np.array([True]), note=np.zeros((2, 2)))
    found = joined(source.blocks(('t', 'v', 'n', 'ok')), ('t', 'v', 'n', 'ok'))
    assert found['t'].dtype == np.dtype('datetime64[ns]')
    assert [found[name].tolist() for name in ('v', 'n', 'ok')] == [[1.5], [3], [1.0]]


def test_a_long_file_comes_in_blocks(tmp_path: Path) -> None:
    blocks = list(table(tmp_path, t=np.arange(ROWS_AT_ONCE + 1)).blocks(('t',)))
    assert [len(block.columns['t']) for block in blocks] == [ROWS_AT_ONCE, 1]
    assert sum(block.share for block in blocks) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('columns', 'error'),
    [
        ({'t': np.zeros(3)}, r"log\.npz: no column 'v' \(columns: 't'\)"),
        ({'t': np.zeros(3), 'v': np.zeros(2)}, r"log\.npz: column 'v' of type float64 and shape \(2,\)"),
        ({'t': np.zeros(3), 'v': np.zeros((3, 1))}, r"log\.npz: column 'v' of type float64 and shape \(3, 1\)"),
        ({'t': np.zeros(3), 'v': np.array(['a', 'b', 'c'])}, r"log\.npz: column 'v' of type <U1"),
        ({'t': np.zeros(3), 'v': np.array([None] * 3)}, r'log\.npz: cannot be read \(Object arrays'),
    ],
)
def test_an_error_names_file_and_column(tmp_path: Path, columns: dict[str, Any], error: str) -> None:
    with pytest.raises(InputError, match=error):
        list(table(tmp_path, **columns).blocks(('t', 'v')))


@pytest.mark.parametrize('content', [b'', b'PK\x03\x04', b'text'])
def test_another_file_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'log.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match=r'log\.npz: is not an npz file'):
        list(NpzTable(path).blocks(('t',)))

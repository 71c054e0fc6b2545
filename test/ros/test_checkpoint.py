# SPDX-License-Identifier: Apache-2.0
"""Checkpoints read back unchanged, report what is wrong with them, and are written atomically."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from trainid_ros.errors import InputError
from trainid_ros.ros.checkpoint import Checkpoint, default_path, read_checkpoint, write_checkpoint

SAVED = Checkpoint('0.1.0', 'V-MILS', 12, 34, '{"x": 0.1}')


def test_a_checkpoint_reads_back_unchanged(tmp_path: Path) -> None:
    path = tmp_path / 'new' / 'state.json'
    write_checkpoint(path, SAVED)
    assert read_checkpoint(path, 'V-MILS') == SAVED
    assert [item.name for item in path.parent.iterdir()] == ['state.json']


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / 'state.json'
    write_checkpoint(path, SAVED)

    def full(_handle: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(InputError, match=r'state\.json: checkpoint cannot be written: No space left'):
        write_checkpoint(path, Checkpoint('9', 'V-MILS', 0, 0, ''))
    assert read_checkpoint(path, 'V-MILS') == SAVED
    assert [item.name for item in tmp_path.iterdir()] == ['state.json']


def test_a_checkpoint_of_another_estimator_is_rejected(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / 's.json', SAVED)
    with pytest.raises(InputError, match='is a checkpoint of V-MILS, not of GSMA'):
        read_checkpoint(tmp_path / 's.json', 'GSMA')


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('{', 'is not a checkpoint'),
        ('[]', 'is not a checkpoint of this package'),
        ('{"format": 1, "package": "trainid_ros"}', 'is not a checkpoint of this package'),
        pytest.param('[' * 100_000, 'is not a checkpoint', id='deep'),
        pytest.param('1' * 5000, 'is not a checkpoint', id='long'),
        (
            json.dumps({'format': 2, 'package': 'trainid_ros', 'version': '1', 'estimator': 'V-MILS', 'saved_ns': 1.5}),
            'field saved_ns = 1.5',
        ),
    ],
)
def test_files_that_are_not_checkpoints_are_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / 'x.json'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=reason):
        read_checkpoint(path, 'V-MILS')


@pytest.mark.parametrize(('old', 'new'), [('0.1}', '0.7}'), ('state_sha256', 'sha256'), ('"state_sha256": "', '"')])
def test_a_modified_state_is_rejected(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / 's.json'
    write_checkpoint(path, SAVED)
    text = path.read_text(encoding='utf-8')
    assert old in text
    path.write_text(text.replace(old, new), encoding='utf-8')
    with pytest.raises(InputError, match=r's\.json: (checkpoint is damaged|is not a checkpoint)'):
        read_checkpoint(path, 'V-MILS')


def test_a_missing_file_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'none\.json: checkpoint cannot be read: No such file'):
        read_checkpoint(tmp_path / 'none.json', 'V-MILS')


def test_the_default_path_follows_ros_home_and_the_namespace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert default_path('/train1/gsma') == tmp_path / 'trainid' / 'train1' / 'gsma.json'
    monkeypatch.delenv('ROS_HOME')
    monkeypatch.setenv('HOME', '/nowhere')
    assert default_path('/gsma') == Path('/nowhere/.ros/trainid/gsma.json')

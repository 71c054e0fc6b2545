# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: what they refuse, and that they are replaced atomically."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.setup.checkpoint import (
    Checkpoint,
    CheckpointFile,
    ForeignFileError,
    Provenance,
    default_path,
    parse_checkpoint,
    provenance_of,
)
from trainid_ros.setup.pipelines import RESISTANCE, EstimatorSettings
from trainid_ros.train.train_file import Effect, TrainFile

LEARNED = Provenance('0.1.0', 'resistance', 'V-MILS', {'train.mass': 194000.0, 'line.gradient': 'ab'})
SAVED = Checkpoint(LEARNED, 12, 34, '{"x": 0.1}')


def written(folder: Path, checkpoint: Checkpoint = SAVED) -> Path:
    path = folder / 'state.json'
    CheckpointFile(path).write(checkpoint)
    return path


def names(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir())


def test_a_checkpoint_reads_back_unchanged(tmp_path: Path) -> None:
    path = tmp_path / 'new' / 'deep' / 'state.json'
    assert CheckpointFile(path).read(LEARNED) is None
    assert CheckpointFile(written(path.parent)).read(LEARNED) == SAVED
    assert names(path.parent) == ['state.json']


def test_an_interrupted_write_leaves_the_old_file_and_a_part_that_the_next_start_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', killed)
        patch.setattr(Path, 'unlink', lambda *_, **__: None)
        with pytest.raises(KeyboardInterrupt):
            CheckpointFile(path).write(replace(SAVED, saved_ns=13))
    assert [is_part(name) for name in names(tmp_path)] == [True, False]
    assert CheckpointFile(path).read(LEARNED) == SAVED
    assert names(tmp_path) == ['state.json']


def is_part(name: str) -> bool:
    return name.startswith('.state.json.') and name.endswith('.part')


def test_a_start_leaves_the_part_that_another_process_is_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, sync = tmp_path / 'state.json', os.fsync

    def start_another(handle: int) -> None:
        CheckpointFile(path)
        sync(handle)

    monkeypatch.setattr(os, 'fsync', start_another)
    CheckpointFile(path).write(SAVED)
    assert CheckpointFile(path).read(LEARNED) == SAVED


def test_a_part_that_was_removed_before_it_was_locked_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, lock = tmp_path / 'state.json', fcntl.flock
    removed: list[Path] = []

    def lock_late(handle: int, operation: int) -> None:
        if not removed:
            removed.extend(tmp_path.iterdir())
            removed[0].unlink()
        lock(handle, operation)

    file = CheckpointFile(path)
    monkeypatch.setattr(fcntl, 'flock', lock_late)
    file.write(SAVED)
    assert is_part(removed[0].name)
    assert names(tmp_path) == ['state.json']


def test_only_files_are_removed_as_parts(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / '.state.json.x.part')
    (tmp_path / '.state.json.y.part').mkdir()
    (tmp_path / '.state.json.z.part').symlink_to(tmp_path / 'other')
    (tmp_path / '.other.json.x.part').touch()
    before = names(tmp_path)
    written(tmp_path)
    assert set(before) - {'.state.json.x.part'} < set(names(tmp_path))


def test_no_kill_leaves_a_torn_file(tmp_path: Path) -> None:
    path, rng = written(tmp_path), np.random.default_rng(1)
    state = json.dumps({'x': list(range(20_000))})
    before_ns = SAVED.saved_ns
    begin_s = time.monotonic()
    CheckpointFile(path).write(replace(SAVED, state=state))
    longest_s = max(0.03, 3.0 * (time.monotonic() - begin_s))  # long enough for a write
    for _ in range(40):
        child = os.fork()
        if child == 0:
            file = CheckpointFile(path)
            for k in range(1_000_000):
                file.write(replace(SAVED, saved_ns=before_ns + k, state=state))
        time.sleep(float(rng.uniform(0.0, longest_s)))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = CheckpointFile(path).read(LEARNED)
        assert found is not None
        assert found.saved_ns >= before_ns
        before_ns = found.saved_ns
        assert names(tmp_path) == ['state.json']
    assert before_ns > SAVED.saved_ns


@pytest.mark.parametrize('code', [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    path = written(tmp_path)

    def fail(_handle: int) -> None:
        raise OSError(code, os.strerror(code))

    file = CheckpointFile(path)
    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', fail)
        with pytest.raises(InputError, match=f'state.json: checkpoint cannot be written: {os.strerror(code)}'):
            file.write(replace(SAVED, saved_ns=13))
    assert CheckpointFile(path).read(LEARNED) == SAVED
    assert names(tmp_path) == ['state.json']
    file.write(replace(SAVED, saved_ns=14))


def test_a_folder_that_takes_the_place_of_the_file_is_not_removed(tmp_path: Path) -> None:
    file = CheckpointFile(written(tmp_path))
    (tmp_path / 'state.json').unlink()
    (tmp_path / 'state.json').mkdir()
    with pytest.raises(InputError, match=r'state\.json: was written by another node'):
        file.write(SAVED)
    assert names(tmp_path) == ['state.json']


OTHERS: list[tuple[Callable[[Provenance], Provenance], str]] = [
    (lambda p: replace(p, version='99.0'), 'was written by version 0.1.0 of trainid_ros, this is 99.0'),
    (lambda p: replace(p, algorithm='filter-bank'), 'is of V-MILS, not of filter-bank'),
    (
        lambda p: replace(p, values={**p.values, 'train.mass': 582000.0}),
        'is of another train or other settings: train.mass = 194000.0, here 582000.0$',
    ),
    (
        lambda p: replace(p, values={'train.mass': 194000.0}),
        'is of another train or other settings: line.gradient = ab, here None',
    ),
]


@pytest.mark.parametrize(('change', 'reason'), OTHERS)
def test_a_checkpoint_learned_with_something_else_is_refused(
    tmp_path: Path, change: Callable[[Provenance], Provenance], reason: str
) -> None:
    path = written(tmp_path)
    with pytest.raises(InputError, match=f'state.json: checkpoint {reason}'):
        CheckpointFile(path).read(change(LEARNED))


def test_a_checkpoint_of_another_node_is_never_overwritten(tmp_path: Path) -> None:
    path = written(tmp_path)
    with pytest.raises(
        ForeignFileError, match='is a checkpoint of V-MILS: each node needs a checkpoint file of its own'
    ):
        CheckpointFile(path).read(replace(LEARNED, estimate='brake_rate'))


def test_many_differences_are_counted(tmp_path: Path) -> None:
    path = written(tmp_path, replace(SAVED, provenance=replace(LEARNED, values=dict.fromkeys('abcdef', 1.0))))
    with pytest.raises(InputError, match=r'a = 1.0, here 2.0; .*, and 3 more$'):
        CheckpointFile(path).read(replace(LEARNED, values=dict.fromkeys('abcdef', 2.0)))


def test_any_flipped_bit_and_any_cut_is_refused() -> None:
    content = bytearray(SAVED.text().encode())
    rng = np.random.default_rng(3)
    for bit in rng.integers(0, 8 * len(content), 300).tolist():
        content[bit // 8] ^= 1 << bit % 8
        with pytest.raises(InputError):
            parse_checkpoint(content.decode(errors='replace'), 'x')
        content[bit // 8] ^= 1 << bit % 8
    for length in range(len(content)):
        with pytest.raises(InputError):
            parse_checkpoint(content[:length].decode(), 'x')
    assert parse_checkpoint(content.decode(), 'x') == SAVED


@pytest.mark.parametrize(
    'text',
    [
        '{}',
        '[]',
        'mass: 3',
        pytest.param('[' * 100_000, id='deep'),
        '{"name": "other", "sha256": "ab"}',
        '{"package": "numpy"}',
    ],
)
def test_a_file_that_is_something_else_is_neither_read_nor_overwritten(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'x.json'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(ForeignFileError, match=r'x\.json: is not a checkpoint of this package'):
        CheckpointFile(path)
    assert path.read_text(encoding='utf-8') == text


def test_paths_that_can_be_no_checkpoint_are_refused(tmp_path: Path) -> None:
    (tmp_path / 'link.json').symlink_to(tmp_path / 'train.yaml')
    for name in ('state', 'link.json'):
        reason = rf"checkpoint_file = '.*{name}' must end in \.json, and so must what it links to"
        with pytest.raises(InputError, match=reason):
            CheckpointFile(tmp_path / name)
    for name in ('folder.json', 'pipe.json'):
        path = tmp_path / name
        path.mkdir() if name == 'folder.json' else os.mkfifo(path)
        with pytest.raises(ForeignFileError, match=f'{name}: is not a file'):
            CheckpointFile(path)


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('', 'is damaged'),
        ('\0' * 500, 'is damaged'),
        (
            '{\n "format": 2,\n "package": "trainid_ros",\n "version": "0.1.0"}',
            'of format 2, this version reads format 14',
        ),
    ],
)
def test_empty_and_old_files_are_refused_as_checkpoints(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / 'x.json'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=f'x.json: checkpoint {reason}'):
        CheckpointFile(path).read(LEARNED)


def test_a_well_signed_file_without_its_fields_is_refused() -> None:
    text = replace(SAVED, saved_ns=1.5).text()  # type: ignore[arg-type]
    with pytest.raises(InputError, match='checkpoint is invalid: TypeError saved_ns is not a int'):
        parse_checkpoint(text, 'x')


def test_the_newest_refused_files_are_kept(tmp_path: Path) -> None:
    for k in range(1, 8):
        file = CheckpointFile(written(tmp_path, replace(SAVED, saved_ns=k)))
        assert file.set_aside() == tmp_path / f'state.refused-{k}.json'
    assert names(tmp_path) == [f'state.refused-{k}.json' for k in range(3, 8)]
    for k in range(3, 8):
        kept = CheckpointFile(tmp_path / f'state.refused-{k}.json').read(LEARNED)
        assert kept == replace(SAVED, saved_ns=k)


def test_a_refused_file_that_cannot_be_renamed_is_not_overwritten_and_renamed_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = CheckpointFile(written(tmp_path))

    def fail(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patch:
        patch.setattr(Path, 'rename', fail)
        assert file.set_aside() == tmp_path / 'state.json'
        with pytest.raises(InputError, match=r'state.json: was refused and cannot be renamed: Read-only file system'):
            file.write(replace(SAVED, saved_ns=13))
    assert CheckpointFile(tmp_path / 'state.json').read(LEARNED) == SAVED
    file.write(replace(SAVED, saved_ns=13))  # the folder can be written again
    assert names(tmp_path) == ['state.json', 'state.refused-1.json']
    assert CheckpointFile(tmp_path / 'state.refused-1.json').read(LEARNED) == SAVED


@pytest.mark.parametrize('exists', [True, False])
def test_a_link_stays_and_what_it_links_to_is_written(tmp_path: Path, *, exists: bool) -> None:
    (tmp_path / 'data').mkdir()
    target, link = tmp_path / 'data' / 'real.json', tmp_path / 'state.json'
    if exists:
        CheckpointFile(target).write(SAVED)
    link.symlink_to(target)
    CheckpointFile(link).write(replace(SAVED, saved_ns=13))
    assert link.readlink() == target
    assert not target.is_symlink()
    assert CheckpointFile(target).read(LEARNED) == CheckpointFile(link).read(LEARNED) == replace(SAVED, saved_ns=13)
    assert names(target.parent) == ['real.json']


def test_a_link_to_itself_is_refused_and_kept_aside(tmp_path: Path) -> None:
    link = tmp_path / 'state.json'
    link.symlink_to(link)
    file = CheckpointFile(link)
    with pytest.raises(InputError, match=r'state\.json: checkpoint cannot be read: Too many levels of symbolic links'):
        file.read(LEARNED)
    file.set_aside()
    file.write(SAVED)
    assert CheckpointFile(link).read(LEARNED) == SAVED


def test_two_writers_of_one_file_are_noticed(tmp_path: Path) -> None:
    first, second = CheckpointFile(tmp_path / 'state.json'), CheckpointFile(tmp_path / 'state.json')
    first.write(SAVED)
    with pytest.raises(InputError, match='each node needs a checkpoint file of its own'):
        second.write(SAVED)
    first.write(replace(SAVED, saved_ns=13))
    (tmp_path / 'state.json').unlink()
    first.write(replace(SAVED, saved_ns=14))


def test_provenance_is_that_of_the_values(metro: TrainFile) -> None:
    settings = EstimatorSettings()
    here = provenance_of('resistance', metro, settings)
    assert provenance_of('resistance', replace(metro), settings) == here
    stated = replace(metro, effects=(Effect('tunnel_drag', (('factor', 1.2),), provenance='a day'),))
    retold = replace(metro, effects=(Effect('tunnel_drag', (('factor', 1.2),), provenance='a night'),))
    learned = provenance_of('resistance', stated, settings)
    assert not learned.mismatch(provenance_of('resistance', retold, settings))
    others = (
        replace(metro, train=replace(metro.train, mass=3.0 * metro.train.mass)),
        replace(metro, line=replace(metro.line, gradient=((0.0, 1.0),))),
        stated,
    )
    for other, name in zip(others, ('train.mass', 'line.gradient', 'effects'), strict=True):
        assert f'settings: {name} = ' in here.mismatch(provenance_of('resistance', other, settings))


@pytest.mark.parametrize(('setting', 'value', 'matters'), [('step_a', 0.9, True), ('valid_std', 0.3, False)])
def test_settings_matter_that_change_the_model(metro: TrainFile, setting: str, value: float, matters: bool) -> None:
    changed = EstimatorSettings(resistance=RESISTANCE.choose('', **{setting: value}))
    here, there = (provenance_of('resistance', metro, item) for item in (EstimatorSettings(), changed))
    assert bool(here.mismatch(there)) is matters


@pytest.mark.parametrize(('now_ns', 'age_s'), [(12 + 3_000_000_000, 3.0), (12, 0.0), (5, None), (0, None)])
def test_the_age_is_unknown_after_a_clock_was_set_back(now_ns: int, age_s: float | None) -> None:
    assert SAVED.age_s(now_ns) == (None if age_s is None else pytest.approx(age_s))
    assert replace(SAVED, saved_ns=0).age_s(now_ns) is None


def test_the_default_path_follows_ros_home_and_the_namespace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert default_path('/train1/gsma') == tmp_path / 'trainid' / 'train1' / 'gsma.json'
    monkeypatch.delenv('ROS_HOME')
    monkeypatch.setenv('HOME', '/nowhere')
    assert default_path('/gsma') == Path('/nowhere/.ros/trainid/gsma.json')

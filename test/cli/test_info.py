# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import pytest

from trainid_ros.bag.types import message_from_record
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.main import main
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, SpeedRecord

STAMP = 1_700_000_000 * NS_PER_S


def write(path: Path, *, force: bool = True) -> Path:
    with BagWriter(path) as writer:
        for i in range(20):
            stamp = STAMP + i * NS_PER_S // 5
            writer.write_record(SpeedRecord(stamp, 5.0, float('nan')))
            if force:
                writer.write_record(ForceRecord(stamp, 1e5))
            writer.write_record(GradientRecord(stamp, 1.5, 0.0, tunnel=False))
            writer.write_record(BrakeRecord(stamp, 0.0, emergency=False))
    return path


def test_usable_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(write(tmp_path / 'bag'))]) == 0
    captured = capsys.readouterr()
    assert captured.err == ''
    rows = [line.split() for line in captured.out.splitlines()]
    assert ['ato/speed', 'trainid_msgs/msg/AtoSpeed', '20', '5', '0', '0', '0', '0', '0', '0.000'] in rows
    assert ['ato/force', 'force', '100000', '100000', 'N'] in rows
    assert captured.out.startswith(f'{tmp_path / "bag"}: usable; ')
    assert len({len(line) for line in captured.out.split('\n\n')[1].splitlines()}) == 1  # columns are aligned


def test_a_bag_of_others_is_pointed_to_a_mapping(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(Path(__file__).parents[2] / 'bags' / 'tiny_foreign')]) == 1
    assert capsys.readouterr().err.endswith('; --suggest-map proposes a mapping\n')


def test_bag_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / 'bag', force=False)
    assert main(['info', str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.err == f'trainid: error: {path}: cannot be used: no messages on ato/force\n'
    assert captured.out.startswith(f'{path}: not usable; ')
    path = tmp_path / 'x.mcap'
    path.write_bytes(b'')
    assert main(['info', str(path), '--json']) == 2
    assert capsys.readouterr() == ('', f'trainid: error: {path}: is empty\n')


@pytest.mark.parametrize(('force', 'code'), [(True, 0), (False, 1)])
def test_json_is_one_object_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], code: int, *, force: bool
) -> None:
    assert main(['info', str(write(tmp_path / 'bag', force=force)), '--json']) == code

    def reject(name: str) -> None:
        pytest.fail(f'{name} is not JSON')

    answer = json.loads(capsys.readouterr().out, parse_constant=reject)
    assert answer['usable'] is force
    assert answer['missing'] == ([] if force else ['ato/force'])
    positions = [item for item in answer['ranges'] if item['field'] == 'position']
    assert [item['low'] for item in positions] == [None]


def test_topic_names_of_a_bag_cannot_control_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = SpeedRecord(STAMP, 5.0, 0.0)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_message('/\x1b[2J\x9b', 'AtoSpeed', STAMP, message_from_record(record))
    for options in ([], ['--json']):
        assert main(['info', str(tmp_path / 'bag'), *options]) == 1
        captured = capsys.readouterr()
        assert captured.out.replace('\n', '').isprintable()
        assert '[2J' in captured.out
        assert captured.err.rstrip('\n').isprintable()


def test_chunks_above_the_limit_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / 'bag')
    assert main(['info', str(path), '--max-chunk', '1']) == 0
    for wrong in ('0', '4096', '-1', '1.5', 'x'):
        with pytest.raises(SystemExit, match='2'):
            main(['info', str(path), '--max-chunk', wrong])
    assert 'is not a whole number of MB from 1 to 4095' in capsys.readouterr().err

# SPDX-License-Identifier: Apache-2.0
"""Which files of a folder are read as a bag, and what is said of those that are none."""

from __future__ import annotations

import gzip
import shutil
from typing import TYPE_CHECKING

import pytest
import yaml
import zstandard

from trainid_ros.bag.bag_files import bags_below
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.interface.records import Record


def read(path: Path) -> tuple[list[Record], list[str]]:
    with BagReader(path) as reader:
        return list(reader.records()), reader.warnings


def error_of(path: Path) -> str:
    with pytest.raises(InputError) as caught, BagReader(path):
        pass
    return str(caught.value)


def change(bag: Path, **values: object) -> None:
    """Change what the metadata of a bag say."""
    path = bag / 'metadata.yaml'
    document = yaml.safe_load(path.read_text())
    document['rosbag2_bagfile_information'] |= values
    path.write_text(yaml.safe_dump(document))


def pack(path: Path) -> Path:
    """Replace a file by a compressed one, as ros2 bag does in mode file."""
    packed = path.with_name(f'{path.name}.zstd')
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()
    return packed


@pytest.fixture
def split(tmp_path: Path, records: list[Record]) -> Path:
    """Return a bag in three parts, of which its metadata list two."""
    folder = tmp_path / 'split'
    folder.mkdir()
    for number in range(3):
        with BagWriter(tmp_path / f'part_{number}') as writer:
            for record in records[number::3]:
                writer.write_record(record)
        shutil.copy(tmp_path / f'part_{number}' / f'part_{number}.mcap', folder / f'split_{number}.mcap')
    shutil.copy(tmp_path / 'part_0' / 'metadata.yaml', folder)
    listed = {'relative_file_paths': ['split_0.mcap', 'split_1.mcap'], 'message_count': 2 * len(records) // 3}
    change(folder, **listed)
    return folder


def test_a_part_that_the_metadata_do_not_list_is_read_with_a_warning(split: Path, records: list[Record]) -> None:
    found, warnings = read(split)
    assert found == records
    assert warnings == [f'{split / "split_2.mcap"}: not listed in metadata.yaml, read as a part of the bag']


@pytest.mark.parametrize('name', ['other_2.mcap', 'split_2.db3', 'split_copy.mcap'])
def test_a_file_of_another_name_is_no_part_of_the_bag(split: Path, records: list[Record], name: str) -> None:
    (split / 'split_2.mcap').rename(split / name)
    found, warnings = read(split)
    assert found == [record for k, record in enumerate(records) if k % 3 != 2]
    assert warnings == [f'{split / name}: not listed in metadata.yaml, not read']


def test_a_bag_of_one_file_has_no_other_parts(bag: Path, records: list[Record]) -> None:
    shutil.copy(bag / 'bag.mcap', bag / 'bag_1.mcap')
    found, warnings = read(bag)
    assert found == records
    assert warnings == [f'{bag / "bag_1.mcap"}: not listed in metadata.yaml, not read']


def test_suffixes_in_capitals_are_those_of_bags(bag: Path, records: list[Record]) -> None:
    (bag / 'metadata.yaml').unlink()
    (bag / 'bag.mcap').rename(bag / 'BAG.MCAP')
    assert read(bag)[0] == records
    assert bags_below(bag.parent) == [bag / 'BAG.MCAP']


def test_compression_of_whole_files_is_named(bag: Path) -> None:
    packed = pack(bag / 'bag.mcap')
    change(bag, compression_mode='FILE', relative_file_paths=[packed.name])
    assert "compression mode 'file' of ros2 bag is not supported" in error_of(bag)


def test_files_that_were_unpacked_by_hand_are_read(bag: Path, records: list[Record]) -> None:
    change(bag, compression_mode='FILE', relative_file_paths=['bag.mcap.zstd'])
    found, (warning,) = read(bag)
    assert found == records
    assert warning.endswith("metadata.yaml: compression mode 'file', but the files are unpacked, and were read")


def test_compression_of_messages_is_named(bag: Path) -> None:
    change(bag, compression_mode='MESSAGE')
    assert "compression mode 'message' of ros2 bag is not supported" in error_of(bag)


@pytest.mark.parametrize('has_metadata', [True, False])
def test_compressed_files_in_a_folder_are_named(bag: Path, *, has_metadata: bool) -> None:
    pack(bag / 'bag.mcap')
    if not has_metadata:
        (bag / 'metadata.yaml').unlink()
    hint = 'it is compressed by zstd, as ros2 bag does in mode file; unpack it with zstd -d'
    assert error_of(bag).endswith(f'; bag.mcap.zstd: {hint}')


@pytest.mark.parametrize(
    ('content', 'hint'),
    [
        (zstandard.compress(b'bag'), 'unpack it with zstd -d'),
        (gzip.compress(b'bag', mtime=0), 'unpack it with gunzip'),
        (b'#ROSBAG V2.0\n', 'it is a ROS 1 bag; convert it with rosbags-convert'),
        (b'version https://git-lfs.github.com/spec/v1\noid sha256:0\n', 'get the file with git lfs pull'),
    ],
    ids=['zstd', 'gzip', 'ROS 1', 'Git LFS'],
)
def test_other_files_get_a_hint(tmp_path: Path, content: bytes, hint: str) -> None:
    (tmp_path / 'x.mcap').write_bytes(content)
    text = error_of(tmp_path / 'x.mcap')
    assert text.startswith(f'{tmp_path / "x.mcap"}: is not an MCAP file: it is ')
    assert text.endswith(hint)

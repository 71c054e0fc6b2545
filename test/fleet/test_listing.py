# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from shutil import copy, copytree

import pytest

from trainid_ros.bag.mcap_file import McapFile
from trainid_ros.bag.reader import BagReader
from trainid_ros.fleet.plan import find_bags, label_rule, list_bags
from trainid_ros.interface.errors import InputError

TINY = 'bags/tiny'


@pytest.fixture
def depot(tmp_path: Path, tiny: Path) -> Path:
    """Return a folder with two bags, one of them a file, and one that is broken."""
    copytree(tiny, tmp_path / 'depot/T1/first')
    (tmp_path / 'depot/T2').mkdir()
    copy(next(tiny.glob('*.mcap')), tmp_path / 'depot/T2/second.mcap')
    (tmp_path / 'depot/T2/broken.mcap').write_text('no bag', encoding='utf-8')
    return tmp_path / 'depot'


def test_folders_patterns_and_bags_are_found_once(depot: Path) -> None:
    names = ['T1/first', 'T2/broken.mcap', 'T2/second.mcap']
    assert find_bags([depot]) == [depot / name for name in names]
    assert find_bags([depot / 'T*', depot / 'T1/first']) == [depot / name for name in names]
    for path, problem in ((depot / 'T3', 'no such bag or folder'), (depot / 'T3*', 'holds no bag')):
        with pytest.raises(InputError, match=problem):
            find_bags([path])


def test_paths_are_absolute(depot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(depot)
    assert find_bags([Path('T1')]) == [depot / 'T1/first']


def test_linked_folders_are_followed_once(depot: Path) -> None:
    (depot / 'night').mkdir()
    (depot / 'night/T1').symlink_to(depot / 'T1')
    (depot / 'T1/back').symlink_to(depot / 'night')
    assert find_bags([depot / 'night']) == [depot / 'night/T1/first']


def test_bags_are_listed_without_reading_their_messages(depot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with BagReader(depot / 'T1/first') as reader:
        span, count = reader.time_range(), reader.message_count
    assert span is not None

    def scan(_: McapFile) -> None:
        raise AssertionError

    monkeypatch.setattr(McapFile, '_scan', scan)
    first, broken, second = list_bags(find_bags([depot]), label_rule(None))
    assert (first.train, first.messages, first.error) == ('T1', count, '')
    assert first.start_s == second.start_s == pytest.approx(span[0] / 1e9)
    assert first.size == second.size == (depot / 'T2/second.mcap').stat().st_size
    assert second.train == 'T2'
    assert (broken.start_s, broken.messages) == (None, None)


def test_custom_data_of_the_recording_are_labels(depot: Path) -> None:
    metadata = depot / 'T1/first/metadata.yaml'
    text = metadata.read_text(encoding='utf-8')
    metadata.write_text(text.replace('custom_data: null', 'custom_data: {train: T9, weather: rain}'), encoding='utf-8')
    (first,) = list_bags([depot / 'T1/first'], label_rule(None))
    assert (first.train, first.weather) == ('T9', 'rain')


def test_a_bag_that_is_not_there_has_an_error(depot: Path) -> None:
    (bag,) = list_bags([depot / 'none'], label_rule(None))
    assert bag.error == f'{depot / "none"}: no such bag'

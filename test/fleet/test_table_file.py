# SPDX-License-Identifier: Apache-2.0
"""Tables as read and written; labels of bags, bags as found and listed, and what makes another row of a bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import copy, copytree

import pytest

from trainid_ros.bag.mcap_file import McapFile
from trainid_ros.bag.reader import BagReader
from trainid_ros.fleet.table_file import (
    COLUMNS,
    LABELS,
    PlannedBag,
    Row,
    Setup,
    check_table,
    day_of,
    empty_row,
    find_bags,
    label_rule,
    list_bags,
    make_plan,
    read_table,
    write_table,
)
from trainid_ros.interface.errors import InputError

PATH = Path('/depot/line7/T042/2026-01-31_rain')
BAG = PlannedBag('/depot/one', size=1, modified_ns=2, start_s=3.0, messages=4, train='T1', day='2026-01-31')


ALL = r'line(?P<line>\d+)/(?P<train>\w+)/(?P<day>[-\d]+)_(?P<weather>\w+)'


@pytest.mark.parametrize(
    ('pattern', 'namespace', 'custom', 'found'),
    [
        # Without a pattern the train is the folder, or the namespace, unless the recording says it.
        (None, '/', {}, {'train': 'T042'}),
        (None, '/', {'train': 'other', 'line': '7', 'driver': 'x'}, {'train': 'other', 'line': '7'}),
        (None, '/train_1', {'line': '7'}, {'train': 'train_1', 'line': '7'}),
        (None, '/train_1', {'train': 'T7'}, {'train': 'T7'}),
        # A pattern comes before what the recording says.
        (ALL, '/', {'train': 'other'}, {'train': 'T042', 'line': '7', 'weather': 'rain', 'day': '2026-01-31'}),
        (r'/(?P<train>T\d+)/', '/train_1', {'train': 'T7'}, {'train': 'T042'}),
        (r'line(?P<line>\d+)', '/train_1', {}, {'train': 'train_1', 'line': '7'}),
    ],
)
def test_labels_come_from_pattern_recording_namespace_and_folder(
    pattern: str | None, namespace: str, custom: dict[str, str], found: dict[str, str]
) -> None:
    assert label_rule(pattern, namespace)(PATH, custom) == {**dict.fromkeys(LABELS, ''), **found}


def test_a_path_is_matched_as_given_or_with_links_resolved(tmp_path: Path) -> None:
    (tmp_path / 'disk7/T042/bag').mkdir(parents=True)
    (tmp_path / 'depot').mkdir()
    link = tmp_path / 'depot/tram_5'
    link.symlink_to(tmp_path / 'disk7/T042')
    for pattern, train in ((r'depot/(?P<train>\w+)/', 'tram_5'), (r'disk7/(?P<train>\w+)/', 'T042')):
        assert label_rule(pattern)(link / 'bag', {})['train'] == train
    assert label_rule(None)(link / 'bag', {})['train'] == 'tram_5'


@pytest.mark.parametrize(
    ('pattern', 'problem'),
    [
        ('(', 'unterminated'),
        ('(?P<depot>x)', "a group 'depot'"),
        ('x', 'no named group'),
        (ALL, '/x: --label .* does not fit the path'),
    ],
)
def test_a_pattern_that_cannot_be_used_is_an_error(pattern: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        label_rule(pattern)(Path('/x'), {})


def test_days_have_one_form() -> None:
    assert day_of('20260131', None, PATH) == day_of('2026_01_31', 0.0, PATH) == '2026-01-31'
    assert day_of('', 86400.0, PATH) == '1970-01-02'
    assert day_of('', None, PATH) is None
    with pytest.raises(InputError, match="label day 'monday' is not a day"):
        day_of('monday', None, PATH)


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


def test_paths_are_absolute_and_linked_folders_followed_once(depot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(depot)
    assert find_bags([Path('T1')]) == [depot / 'T1/first']
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
    first, missing = list_bags([depot / 'T1/first', depot / 'none'], label_rule(None))
    assert (first.train, first.weather) == ('T9', 'rain')
    assert missing.error == f'{depot / "none"}: no such bag'


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
    return make_plan(setup, (BAG,)).key(BAG)


ABOUT = {'setup': {'train': 'T.yaml'}}


@pytest.fixture
def rows() -> list[Row]:
    full = {'text': 'Ä, "x"', 'float': 0.1 + 0.2, 'int': 3, 'time': 1.7e9 + 0.25}
    return [{column.name: full[column.kind] for column in COLUMNS}, empty_row()]


@pytest.mark.parametrize('name', ['t.parquet', 't.csv'])
def test_a_table_is_read_as_written(name: str, rows: list[Row], tmp_path: Path) -> None:
    write_table(rows, tmp_path / name, ABOUT)
    found, about = read_table(tmp_path / name)
    assert found == rows
    assert about == (ABOUT if name == 't.parquet' else {})
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_columns_state_their_units(rows: list[Row], tmp_path: Path) -> None:
    parquet = pytest.importorskip('pyarrow.parquet')
    write_table(rows, tmp_path / 't.parquet', ABOUT)
    schema = parquet.read_schema(tmp_path / 't.parquet')
    assert schema.field('w15').metadata[b'unit'] == b'N/kN'
    assert str(schema.field('start').type) == 'timestamp[us, tz=UTC]'


def test_other_files_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'ends with \.parquet or \.csv'):
        check_table(tmp_path / 't.xlsx')
    for name in ('t.csv', 't.parquet'):
        (tmp_path / name).write_text('a,b\n1,2\n', encoding='utf-8')
        with pytest.raises(InputError, match=f'{name}: is not a table'):
            read_table(tmp_path / name)
    with pytest.raises(InputError, match='cannot be read'):
        read_table(tmp_path / 'none.csv')

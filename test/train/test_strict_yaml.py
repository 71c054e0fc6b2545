# SPDX-License-Identifier: Apache-2.0
"""YAML files cost little whatever they contain, and numbers mean what they seem to."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from trainid_ros.interface.errors import InputError
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.fields import parse_yaml, read_text
from trainid_ros.train.strict_yaml import compose, load
from trainid_ros.train.train_file import load_train_file


def aliases(levels: int) -> str:
    """Return a text of which each level repeats the one before nine times."""
    names = 'abcdefghijklmnop'[:levels]
    later = [f'{name}: &{name} [{",".join([f"*{before}"] * 9)}]' for before, name in pairwise(names)]
    return '\n'.join(['a: &a [x,x,x,x,x,x,x,x,x]', *later])


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        (aliases(11), 'more than 100000 values'),
        ('x: [' + '0,' * 400_000 + '0]', 'more than 100000 values'),
        ('a: &a {x: 1}\nb: {<<: [' + ','.join(['*a'] * 150_000) + ']}', 'more than 100000 values'),
        ('\n'.join(f'k{i}: {i}' for i in range(80_000)), 'more than 100000 values'),
        ('\n'.join(f'k{i}: {"{a: " * 90}1{"}" * 90}' for i in range(2_000)), 'more than 100000 values'),
        ('{a: ' * 2000 + '}' * 2000, 'nested more than 100 deep'),
        ('[' * 1_000_000, 'nested more than 100 deep'),
        ('- ' * 500_000, 'nested more than 100 deep'),
        ('&a [*a]', "alias 'a' is not defined before"),
        ('[*b]', "alias 'b' is not defined before"),
    ],
)
def test_files_that_would_grow_are_rejected_at_little_cost(
    text: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[yaml.Event] = []
    parse = yaml.parse

    def note(*arguments: Any, **options: Any) -> Iterator[yaml.Event]:
        for event in parse(*arguments, **options):
            events.append(event)
            yield event

    monkeypatch.setattr(yaml, 'parse', note)
    memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=reason) as caught:
        load(text, 'T.yaml')
    assert str(caught.value).startswith('T.yaml: line ')
    # A collection has two events, and the text and its document one each before them.
    assert len(events) <= 2 * 100_000 + 3
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb < 200_000


def test_nodes_are_checked_as_values_are() -> None:
    for text in ('[' * 101, '&a [*a]', 'k: [' + '0,' * 100_000):
        errors = []
        for read in (load, compose):
            with pytest.raises(InputError) as caught:
                read(text, 'T.yaml')
            errors.append(str(caught.value))
        assert errors[0] == errors[1]


def test_aliases_that_repeat_little_are_read() -> None:
    assert load('a: &a [1, 2]\nb: [*a, *a]', 'T.yaml') == {'a': [1, 2], 'b': [[1, 2], [1, 2]]}


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('0', 0), ('-12', -12), ('194_000', 194000), ('1e5', 1e5), ('+1.5E-3', 0.0015), ('.5', 0.5), ('7.', 7.0),
        ('1:30:00', '1:30:00'), ('1:30.5', '1:30.5'), ('0777', '0777'), ('0x1F', '0x1F'), ('0b1', '0b1'), ('.', '.'),
    ],
)  # fmt: skip
def test_only_plain_decimal_numbers_are_numbers(text: str, value: object) -> None:
    found = load(text, 'T.yaml')
    assert (found, type(found)) == (value, type(value))


@settings(deadline=None)
@given(st.one_of(st.integers(-(10**15), 10**15), st.floats(allow_nan=False, allow_infinity=False)))
def test_every_number_written_as_yaml_reads_back(number: float) -> None:
    assert load(yaml.safe_dump(number), 'T.yaml') == number


@settings(deadline=None)
@given(st.text(st.sampled_from('ab:-[]{},&*!?|>%@`#"\'\n 01.')))
def test_any_text_is_read_or_rejected_in_one_line(text: str) -> None:
    try:
        parse_yaml(text, 'T.yaml')
    except InputError as error:
        assert str(error).startswith('T.yaml')
        assert '\n' not in str(error)


def test_only_regular_files_of_moderate_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    with (tmp_path / 'large').open('wb') as file:
        file.truncate(17 << 20)
    (tmp_path / 'binary').write_bytes(b'train\xff')
    for path, reason in (
        (tmp_path / 'pipe', 'cannot be read: is not a file'),
        (Path('/dev/zero'), 'cannot be read: is not a file'),
        (tmp_path / 'large', 'cannot be read: is larger than 16 MB'),
        (tmp_path, 'cannot be read: Is a directory'),
        (tmp_path / 'none', 'cannot be read: No such file or directory'),
        (tmp_path / 'binary', r'is not UTF-8 text \(byte 5\)'),
    ):
        for read in (read_text, load_train_file, load_truth):
            with pytest.raises(InputError, match=f'{path}: {reason}'):
                read(path)


@pytest.mark.parametrize('text', ['9' * 20_000, '9' * 20_000 + '.', '1' + '_' * 20_000, '9' * 20_000 + 'e'])
def test_a_long_scalar_that_may_be_a_number_costs_as_little_as_a_word(text: str) -> None:
    """CPU time, best of five in turn: where it grows with the square of the length, the ratio is above a thousand."""
    words = ('x' * len(text), text)
    times: dict[str, list[float]] = {word: [] for word in words}
    for word in 5 * words:
        begin = time.process_time()
        assert load(f'mass: {word}', 'train.yaml') == {'mass': word}
        times[word].append(time.process_time() - begin)
    usual, best = (min(times[word]) for word in words)
    assert best < 50.0 * usual

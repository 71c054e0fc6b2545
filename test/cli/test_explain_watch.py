# SPDX-License-Identifier: Apache-2.0
"""``trainid explain --watch``: complete bags are explained once, and only news is printed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.cli import explain
from trainid_ros.cli.explain_watch import news
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.interface.errors import NoAnswerError

Make = Callable[..., Explanation]


def moved(found: Explanation, by: float) -> Explanation:
    """Return an explanation whose first effect has another size."""
    effect = found.effects[0]
    values = dict(effect.parameters)
    return replace(found, effects=(replace(effect, parameters=tuple({**values, 'permille': 1.5 + by}.items())),))


def test_only_what_differs_is_news(make_explanation: Make) -> None:
    found, nothing = make_explanation(), make_explanation(verdict=Verdict.NO_GAP, effects=())
    assert news(None, found)[0].startswith('EXPLAINED: The current model lacks local_drag')
    assert news(found, found) == []
    assert [line[:30] for line in news(found, nothing)] == ['NO_GAP: The data do not tell w']
    assert news(found, moved(found, 0.14)) == []  # its standard deviation is 0.05, that of the difference 0.071
    (line,) = news(found, moved(found, 0.15))
    assert 'local_drag is now start' in line
    assert 'permille = 1.650' in line
    other = replace(found, effects=(replace(found.effects[0], name='headwind', parameters=(), std=()),))
    assert news(found, other) == ['local_drag is no longer found.', 'New: headwind, .']


def drive(
    monkeypatch: pytest.MonkeyPatch, looks: Iterable[Callable[[], object]], answers: Iterable[object]
) -> list[list[str]]:
    """Let each look at the folders be preceded by an action; return the names of the bags explained each time."""
    actions, left, explained = iter(looks), iter(answers), list[list[str]]()

    def sleep(_: float) -> None:
        if (action := next(actions, None)) is None:
            raise KeyboardInterrupt
        action()

    def answer(_args: object, bags: Sequence[Path], *_: object) -> object:
        explained.append([bag.name for bag in bags])
        found = next(left)
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr('trainid_ros.cli.explain_watch.time.sleep', sleep)
    monkeypatch.setattr(explain, 'explain_bags', answer)
    return explained


def test_complete_bags_are_explained_and_news_told(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    folder = tmp_path / 'bags'
    folder.mkdir()

    def add(name: str) -> None:
        shutil.copytree(driven_bag, folder / name)

    def grow() -> None:
        with (folder / 'b' / 'more.mcap').open('ab') as file:
            file.write(b'x')

    looks = (
        lambda: add('a'), lambda: None, lambda: add('b'), grow, grow, lambda: None, lambda: None, lambda: add('c'),
        lambda: None,
    )  # fmt: skip
    (folder / 'gone.mcap').symlink_to(tmp_path / 'nowhere')
    found = make_explanation()
    explained = drive(monkeypatch, looks, (found, NoAnswerError('b: damaged'), moved(found, 0.5)))
    command = ['explain', str(folder), '--train', str(driven_bag / 'train.yaml'), '--watch', '--json']
    assert main(command) == 130
    assert explained == [['a'], ['a', 'b'], ['a', 'b', 'c']]  # b not before it has ceased to grow
    out, err = capsys.readouterr()
    first, second = map(json.loads, out.splitlines())
    assert first['verdict'] == 'explained'
    assert [Path(bag).name for bag in second['bags']] == ['a', 'b', 'c']
    assert second['news'][0].startswith('local_drag is now')
    assert err == 'trainid: error: b: damaged\n'


def test_what_cannot_be_watched_is_an_error(tmp_path: Path, driven_bag: Path, one_error: Callable[[], str]) -> None:
    train = str(driven_bag / 'train.yaml')
    for bag, options, reason in (
        (tmp_path / 'none', (), 'is no folder to watch'),
        (tmp_path, ('--out', 'x'), '--watch writes no files'),
        (tmp_path, ('--propose', 'x'), '--watch writes no files'),
    ):
        assert main(['explain', str(bag), '--train', train, '--watch', *options]) == 2
        assert reason in one_error()


def test_a_damaged_bag_is_left_out_with_a_warning(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / 'a.mcap').write_bytes(b'no bag at all')
    shutil.copytree(driven_bag, tmp_path / 'b')
    explained = drive(monkeypatch, [lambda: None], [make_explanation()])
    assert main(['explain', str(tmp_path), '--train', str(driven_bag / 'train.yaml'), '--watch']) == 130
    assert explained == [['b']]
    out, err = capsys.readouterr()
    assert out.startswith('1 bag: EXPLAINED')
    assert 'a.mcap' in err
    assert err.count('\n') == 1

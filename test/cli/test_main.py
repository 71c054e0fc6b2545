# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from trainid_ros.cli import main as entry
from trainid_ros.errors import InputError, NoAnswerError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[argparse.Namespace], int]], None]:
    """Return a function that replaces the module of ``info``."""

    def install(run: Callable[[argparse.Namespace], int]) -> None:
        module = SimpleNamespace(configure=lambda parser: parser.add_argument('--x', type=int), run=run)
        monkeypatch.setattr(entry, 'import_module', lambda _name: module)

    return install


def raising(error: BaseException) -> Callable[[argparse.Namespace], int]:
    def run(_args: argparse.Namespace) -> int:
        raise error

    return run


@pytest.mark.parametrize(
    ('error', 'code', 'text'),
    [
        (InputError('bag: topic ato/x\nbroken'), 2, 'trainid: error: bag: topic ato/x broken\n'),
        (NoAnswerError('nothing moves'), 1, 'trainid: error: nothing moves\n'),
        (PermissionError(13, 'Permission denied', 'a.yaml'), 2, 'trainid: error: a.yaml: Permission denied\n'),
        (KeyboardInterrupt(), 130, ''),
    ],
)
def test_errors_become_one_line_and_a_code(
    verb: Callable[[Callable[[argparse.Namespace], int]], None],
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    code: int,
    text: str,
) -> None:
    verb(raising(error))
    assert entry.main(['info']) == code
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ('', text)


def test_programming_errors_are_not_hidden(verb: Callable[[Callable[[argparse.Namespace], int]], None]) -> None:
    verb(raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        entry.main(['info'])


def test_exit_code_and_arguments_are_passed_through(
    verb: Callable[[Callable[[argparse.Namespace], int]], None],
) -> None:
    verb(lambda args: int(args.x))
    assert entry.main(['info', '--x', '7']) == 7


@pytest.mark.parametrize('arguments', [[], ['nonsense'], ['info'], ['info', 'a', 'b'], ['info', 'a', '--nope']])
def test_usage_errors_are_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        entry.main(arguments)
    captured = capsys.readouterr()
    assert caught.value.code == 2
    assert captured.out == ''
    assert captured.err.startswith('trainid: error: ')
    assert captured.err.count('\n') == 1


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        entry.main(['--help'])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert all(verb.name in text and verb.help in text for verb in entry.VERBS)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        entry.main(['--version'])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith('trainid ')


def test_verbs_without_ros_import_no_ros() -> None:
    program = (
        'import sys\n'
        'from trainid_ros.cli.main import main\n'
        "code = main(['info', '/nonexistent'])\n"
        "loaded = {'rclpy', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        'sys.exit(f"{code} {sorted(loaded)}")\n'
    )
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines() == ['trainid: error: /nonexistent: no such bag', '2 []']


def test_closed_pipe_is_quiet(driven_bag: Path) -> None:
    program = 'import sys; from trainid_ros.cli.main import main; sys.exit(main(["info", sys.argv[1]]))'
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, '-c', program, str(driven_bag)]
    done = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, '')

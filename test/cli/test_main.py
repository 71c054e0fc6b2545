# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

import trainid_ros
from trainid_ros.cli import main as entry
from trainid_ros.cli.arguments import OPTIONS, VERBS, Verb, namespace
from trainid_ros.cli.live import Display
from trainid_ros.interface.errors import InputError, NoAnswerError

if TYPE_CHECKING:
    import argparse
    from pathlib import Path


Run = Callable[['argparse.Namespace'], int]
Install = Callable[[Run], None]


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that replaces ``info``."""

    def install(run: Run) -> None:
        monkeypatch.setattr(entry, 'VERBS', (Verb('info', 'for tests', '--x'),))
        monkeypatch.setitem(OPTIONS, '--x', {'type': int})
        monkeypatch.setattr(entry, 'import_module', lambda _name: SimpleNamespace(run=run))

    return install


def raising(error: BaseException) -> Run:
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
    verb: Install, capsys: pytest.CaptureFixture[str], error: BaseException, code: int, text: str
) -> None:
    verb(raising(error))
    assert entry.main(['info']) == code
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ('', text)


def test_programming_errors_are_not_hidden(verb: Install) -> None:
    verb(raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        entry.main(['info'])


def test_exit_code_and_arguments_are_passed_through(verb: Install) -> None:
    verb(lambda args: int(args.x))
    assert entry.main(['info', '--x', '7']) == 7


@pytest.mark.parametrize(
    ('arguments', 'hint'),
    [
        (['replya', 'bag'], "'replya'; did you mean 'replay'?"),
        (['train', 'shwo'], "'train shwo'; did you mean 'train show'?"),
        (['train'], "'train'; did you mean 'train show'?"),
        (['replay', 'bag', '--trian', 'T.yaml'], "--trian is no option; did you mean '--train'?"),
        (['fleet', 'report', 'T', '--explian=2'], "--explian is no option; did you mean '--explain'?"),
        (['simulate', 'bag', '--world', 'trams'], "'trams'; did you mean 'tram'?"),
        (['info', 'bag', '--foo'], '--foo is no option; known: --help, '),
    ],
)
def test_a_misspelt_word_is_answered_with_the_nearest(
    arguments: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        entry.main(arguments)
    assert caught.value.code == 2
    assert hint in capsys.readouterr().err


@pytest.mark.parametrize(
    'arguments', [[], ['nonsense'], ['info'], ['fit', 'a', 'b'], ['info', 'a', '--nope'], ['info', 'a', '--jobs', '-1']]
)
def test_usage_errors_are_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        entry.main(arguments)
    captured = capsys.readouterr()
    assert caught.value.code == 2
    assert captured.out == ''
    assert captured.err.startswith('trainid: error: ')
    assert captured.err.count('\n') == 1


@pytest.mark.parametrize('name', ['/a b', '7', 'a//b', 'a-b', 'é'])
def test_a_namespace_that_ros_does_not_allow_is_an_error(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match='2'):
        entry.main(['replay', 'missing', '--train', 'missing.yaml', '--namespace', name])
    assert f'{name!r} is no namespace' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['', '/', 'a', '/a_1/b/'])
def test_a_namespace_may_have_parts(name: str) -> None:
    assert namespace(name) == name


@pytest.mark.parametrize('option', ['--help', '--version'])
def test_help_lists_every_verb_and_the_version_is_known(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match='0'):
        entry.main([option])
    text = capsys.readouterr().out
    if option == '--version':
        assert text == f'trainid {trainid_ros.__version__}\n'
    else:
        assert all(verb.name in text and verb.help in text for verb in VERBS)


def imported_by(arguments: list[str]) -> set[str]:
    """Return the packages that a command has imported at its end, and the modules of this one."""
    program = (
        'import atexit, sys\n'
        'atexit.register(lambda: print(*sys.modules, sep="\\n", file=sys.stderr))\n'
        'from trainid_ros.cli.main import main\n'
        'sys.exit(main(sys.argv[1:]))\n'
    )
    command = [sys.executable, '-c', program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    names = done.stderr.split()
    return {name.partition('.')[0] for name in names} | {name for name in names if name.startswith('trainid_ros.')}


# Each takes 20 to 150 ms to import.
SLOW = {'importlib_metadata', 'matplotlib', 'multiprocessing', 'rclpy', 'rich', 'rosbags', 'scipy'}
HELP = [['--help'], ['--version'], *([verb.name, '--help'] for verb in VERBS if verb.name != 'simulate')]


@pytest.mark.parametrize('arguments', HELP, ids=' '.join)
def test_help_imports_nothing_slow(arguments: list[str]) -> None:
    found = imported_by(arguments)
    assert not found & (SLOW | {'numpy', 'mcap', 'trainid_ros.estimators.pipeline'})


def test_the_help_of_the_simulator_imports_only_what_it_names() -> None:
    assert not imported_by(['simulate', '--help']) & (SLOW | {'mcap', 'trainid_ros.estimators.pipeline'})


def test_verbs_import_only_what_they_need(driven_bag: Path) -> None:
    found = imported_by(['info', str(driven_bag)])
    assert 'trainid_ros.inspection.bag_info' in found
    assert not found & (SLOW | {'trainid_ros.estimators.pipeline', 'trainid_ros.sim.truth'})
    found = imported_by(['replay', str(driven_bag), '--train', str(driven_bag / 'train.yaml')])
    assert 'trainid_ros.estimators.pipeline' in found
    assert not found & (SLOW | {'trainid_lab', 'trainid_ros.bag.writer', 'trainid_ros.report.recording'})


def test_closed_pipe_is_quiet(driven_bag: Path) -> None:
    program = 'import sys; from trainid_ros.cli.main import main; sys.exit(main(["info", sys.argv[1]]))'
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, '-c', program, str(driven_bag)]
    done = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, '')


def ended_after(duration_s: float, found_s: float) -> tuple[float, int]:
    """Return when a display ends if a train is found after a time [s], and how often it was drawn."""
    now_s, drawn = 100.0, list[float]()
    display = Display(1.0, duration_s, lambda: drawn.append(now_s), lambda: now_s)
    for k in range(1, 81):
        if display.draw_if_due(has_found=now_s >= 100.0 + found_s):
            break
        now_s = 100.0 + 0.5 * k
    assert display.is_over == (k < 80)
    return now_s - 100.0, len(drawn)


@pytest.mark.parametrize(
    ('duration_s', 'found_s', 'ends_s', 'draws'),
    [
        (1.0, 2.0, 3.0, 4),
        (1.0, 1000.0, 4.0, 5),  # without a train it begins when discovery should be over
        (5.0, 0.0, 5.0, 6),
        (0.0, 0.0, 40.0, 40),  # without a duration it does not end
    ],
)
def test_the_duration_begins_when_a_train_is_found(
    duration_s: float, found_s: float, ends_s: float, draws: int
) -> None:
    assert ended_after(duration_s, found_s) == (ends_s, draws)

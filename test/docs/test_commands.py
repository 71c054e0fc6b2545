# SPDX-License-Identifier: Apache-2.0
"""Every command line of the documents is valid, and those that need no ROS graph and little time work."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from benchmarks.run import PARTS
from tools.documents import ROOT, Block, blocks, documents
from trainid_ros.cli.arguments import LIVE_NODES, VERBS, add_options
from trainid_ros.cli.main import main
from trainid_ros.cli.processes import free_domain, local_environment
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS

TRAINID = '.venv/bin/trainid'
LIVE = 'needs a ROS graph and runs until it is stopped; a test of its own runs those of LIVE_PAGES'
# Command lines that are only checked, by how they begin and with the reason.
NOT_RUN = {
    r'make |\.venv/bin/python benchmarks/': 'takes minutes or hours; make itself is checked by the test run',
    r'\.venv/bin/(trainid (run|monitor|play)|train_simulator)\b|\.venv/bin/python examples/python/closed_loop\.py$': (
        LIVE
    ),
    r'ros2 security |ros2 run .* --enclave ': 'needs DDS security, which the wheels are built without',
    r'ros2 (launch|run|service|topic|lifecycle) ': 'needs an installed workspace',
    r'cd |colcon |git |rosdep ': 'needs a workspace or a repository; see tools/colcon_smoke.py',
    r'\.venv/bin/trainid view bags/tiny$': 'opens a window',
    r'\.venv/bin/trainid fleet report .* --explain': 'needs the bags of weeks',
    r'\.venv/bin/trainid (simulate|fleet|fleet report) out/fleet\b': 'takes minutes; test/sim makes a few drives',
}
# Pages whose commands, taken together, or single commands that take longer than the inner loop should.
SLOW_PAGES = (
    'docs/algorithms.md', 'docs/explain.md', 'docs/parameters.md', 'docs/simulator.md', 'docs/tables.md',
    'docs/tutorial_autopilot.md', 'docs/tutorial_depot.md',
)  # fmt: skip
# Pages whose live commands are run too, those that do not end by themselves beside the others.
LIVE_PAGES = ('docs/tutorial_autopilot.md', 'docs/tutorial_integrator.md')
ENDLESS = re.compile(r'\.venv/bin/(trainid run|train_simulator)\b')
SLOW = ('replay bags/yizhuang_day', 'demo --only explain', '--report', '--params config/params.yaml')


class Command(NamedTuple):
    """A command line, without its comment."""

    page: str
    line: int
    text: str

    @property
    def reason(self) -> str | None:
        return next((reason for begin, reason in NOT_RUN.items() if re.match(begin, self.text)), None)

    @property
    def slow(self) -> bool:
        return self.page in SLOW_PAGES or any(part in self.text for part in SLOW)


class Page(NamedTuple):
    name: str
    blocks: tuple[Block, ...]


def pages() -> list[Page]:
    return [Page(p.relative_to(ROOT).as_posix(), tuple(blocks(p.read_text(encoding='utf-8')))) for p in documents()]


TITLES = {block.title for page in pages() for block in page.blocks}


def commands(page: Page, block: Block) -> list[Command]:
    lines = (line.split(' #', 1)[0].rstrip() for line in block.text.splitlines())
    return [Command(page.name, block.line + i, text) for i, text in enumerate(lines) if text]


def all_commands() -> list[Command]:
    return [
        item for page in pages() for block in page.blocks if block.language == 'sh' for item in commands(page, block)
    ]


def variable(text: str) -> tuple[str, str] | None:
    """Return name and value of an export."""
    found = re.fullmatch(r'export (\w+)=(\S+)', text)
    return (found[1], found[2]) if found else None


def check(text: str) -> None:
    """Check program, verb and options of one command without running it."""
    words = shlex.split(text.partition(' > ')[0])
    if words[0] == TRAINID and ' '.join(words[1:3]) in {verb.name for verb in VERBS}:
        check_verb(' '.join(words[1:3]), words[3:])
    elif words[0] == TRAINID:
        check_verb(words[1], words[2:])
    elif words[0] == 'make':
        (target,) = words[1:]
        assert re.search(rf'^{target}:', (ROOT / 'Makefile').read_text(encoding='utf-8'), re.MULTILINE), text
    elif words[0] == 'ros2':
        check_ros(words, text)
    elif words[0] == '.venv/bin/train_simulator':
        check_program('train_simulator', text)
    elif words[0] == '.venv/bin/python' and words[1] in TITLES:
        assert len(words) == 2
    elif words[0] == '.venv/bin/python' and words[1].startswith('examples/'):
        source = (ROOT / words[1]).read_text(encoding='utf-8')
        assert all(f"'{word}'" in source for word in words[2:] if word.startswith('--')), text
    elif words[0] == '.venv/bin/python':
        check_benchmark(words)
    else:
        assert words[0] in {'cd', 'git', 'colcon', '.', 'ln', 'rosdep'}, text


def check_ros(words: list[str], text: str) -> None:
    if words[1] == 'launch':
        assert words[2] == 'trainid_ros'
        source = (ROOT / 'launch' / words[3]).read_text(encoding='utf-8')
        for word in words[4:]:
            assert f"('{word.partition(':=')[0]}', " in source, word
    elif words[1] == 'run':
        assert words[2] == 'trainid_ros'
        check_program(words[3], text)
    elif words[1] in {'topic', 'lifecycle'}:
        check_name(words)
    elif words[1] == 'security':
        assert all((ROOT / word).exists() for word in words if word.startswith('config/')), text
    else:
        assert words[1:3] == ['service', 'call'], text
        service = words[3].rpartition('/')[2]
        assert f"'{service}': self." in (ROOT / 'trainid_ros/ros/estimator_node.py').read_text(encoding='utf-8')


def check_program(name: str, text: str) -> None:
    """Check that a program is installed, and knows the parameters given."""
    assert f"'{name} = " in (ROOT / 'setup.py').read_text(encoding='utf-8')
    sources = ROOT.glob('trainid_ros/ros/*.py'), ROOT.glob('trainid_ros/setup/*.py')
    code = ''.join(path.read_text(encoding='utf-8') for path in chain(*sources))
    for parameter in re.findall(r'-p (\w+):=', text):
        assert f"'{parameter}'" in code, parameter


def check_name(words: list[str]) -> None:
    """Check the topic or node of the first train, or of all, that ros2 is asked about."""
    topics = {topic.name for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)} | set(LIVE_NODES)
    (name,) = (word for word in words if word.startswith('/'))
    assert name == '/diagnostics' or name.removeprefix('/train_1/') in topics


def check_verb(name: str, arguments: list[str]) -> None:
    (verb,) = (verb for verb in VERBS if verb.name == name)
    parser = argparse.ArgumentParser(prog=name)
    add_options(verb, parser)
    parser.parse_args(arguments)
    for word in arguments:
        if word.startswith(('bags/', 'config/')):
            assert (ROOT / word).exists(), word


def check_benchmark(words: list[str]) -> None:
    assert words[1] == 'benchmarks/run.py'
    source = (ROOT / words[1]).read_text(encoding='utf-8')
    places = [place for place, word in enumerate(words) if word.startswith('--')]
    given = {words[start]: words[start + 1 : end] for start, end in pairwise([*places, len(words)])}
    assert len(given) == len(places)  # a second one of the same name replaces the first
    assert places[0] == 2
    for option, values in given.items():
        assert f"'{option}'" in source
        assert values
        assert option != '--only' or set(values) <= PARTS.keys()


@pytest.mark.parametrize(
    'command',
    [command for command in all_commands() if variable(command.text) is None],
    ids=lambda command: f'{command.page}:{command.line}',
)
def test_a_command_is_valid(command: Command) -> None:
    for part in command.text.split(' && '):
        check(part)  # asserts


@pytest.mark.parametrize(
    'text',
    [
        f'{TRAINID} guess bags/tiny',
        f'{TRAINID} info bags/none',
        f'{TRAINID} info bags/tiny --nope',
        'make nothing',
        'ros2 launch trainid_ros trainid.launch.py nope:=1',
        'ros2 run trainid_ros nope',
        '.venv/bin/train_simulator --ros-args -p nope:=1',
        'ros2 topic echo /train_1/trainid/nope',
        'ros2 service call /resistance_estimator/nope std_srvs/srv/Trigger',
        '.venv/bin/python benchmarks/run.py --only nope',
        '.venv/bin/python benchmarks/run.py --only cost --only live',
        '.venv/bin/python examples/python/nope.py',
        '.venv/bin/python examples/python/closed_loop.py --nope',
        'nope',
    ],
)
def test_an_invalid_command_is_found(text: str) -> None:
    with pytest.raises((AssertionError, OSError, SystemExit, ValueError)):
        check(text)


def test_the_list_of_commands_that_do_not_run_is_up_to_date() -> None:
    present = [command.text for command in all_commands()]
    assert all(any(re.match(begin, text) for text in present) for begin in NOT_RUN)
    assert all(part in ' '.join(present) for part in SLOW)


def workspace(folder: Path) -> None:
    """Give a folder what commands in the root of the repository find."""
    for name in ('bags', 'config', 'examples'):
        (folder / name).symlink_to(ROOT / name)
    (folder / '.venv').symlink_to(sys.prefix)


def run_page(page: Page, folder: Path, *, slow: bool) -> int:
    """Write the files of a page and run its commands in their order; return how many ran.

    Each line of a block ``output`` must be in what the commands before it printed.
    """
    workspace(folder)
    environment, count, said = dict(os.environ), 0, ''
    for block in page.blocks:
        write_titled(block, folder)
        if block.language == 'output' and slow == (page.name in SLOW_PAGES):
            assert [line for line in block.text.splitlines() if line not in said] == [], said
        for command in commands(page, block) if block.language == 'sh' else ():
            if named := variable(command.text):
                environment[named[0]] = named[1].replace('$PWD', str(folder))
            elif command.reason is None and command.slow == slow:
                said += run(command, folder, environment)
                count += 1
    return count


def write_titled(block: Block, folder: Path) -> None:
    """Write the file that a block shows, if any."""
    if block.title:
        path = folder / block.title
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, encoding='utf-8')


def run(command: Command, folder: Path, environment: dict[str, str]) -> str:
    """Run a command to its end; return what it printed."""
    text, _, target = command.text.partition(' > ')
    words = shlex.split(text)
    is_own = words[0] == TRAINID and command.reason is None
    code, out, err = (run_here if is_own else run_process)(words, folder, environment)
    assert code == 0, f'{command.page}:{command.line}: {command.text}\n{out}{err}'
    if target:
        (folder / target).write_text(out, encoding='utf-8')
    return out + err


def run_process(words: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str, str]:
    nothing = subprocess.DEVNULL
    done = subprocess.run(
        words, cwd=folder, env=environment, stdin=nothing, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


def run_here(words: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str, str]:
    """Run trainid in this process: a process of its own takes half a second to import what this one has."""
    assert (folder / words[0]).is_file()
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.chdir(folder)
        for name, value in environment.items():
            patch.setenv(name, value)
        code = main(words[1:])
    return code, out.getvalue(), err.getvalue()


def with_commands(*, slow: bool) -> list[Page]:
    run = (item for item in all_commands() if item.reason is None and variable(item.text) is None)
    wanted = {item.page for item in run if item.slow == slow}
    return [page for page in pages() if page.name in wanted]


@pytest.mark.parametrize('page', with_commands(slow=False), ids=lambda page: page.name)
def test_commands_work(page: Page, tmp_path: Path) -> None:
    assert run_page(page, tmp_path, slow=False)


@pytest.mark.long
@pytest.mark.parametrize('page', with_commands(slow=True), ids=lambda page: page.name)
def test_slow_commands_work(page: Page, tmp_path: Path) -> None:
    assert run_page(page, tmp_path, slow=True)


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.parametrize('name', LIVE_PAGES)
def test_live_commands_work(name: str, tmp_path: Path) -> None:
    """In a ROS domain of their own; those that do not end by themselves end with success at Ctrl-C."""
    workspace(tmp_path)
    domain = {'ROS_DOMAIN_ID': str(free_domain(os.getpid())), 'ROS_LOG_DIR': str(tmp_path)}
    environment = os.environ | local_environment(ROOT / 'config' / 'fastdds_localhost.xml') | domain
    (page,) = (page for page in pages() if page.name == name)
    endless: list[subprocess.Popen[bytes]] = []
    try:
        for command in (item for block in page.blocks if block.language == 'sh' for item in commands(page, block)):
            if ENDLESS.match(command.text):
                endless.append(subprocess.Popen(shlex.split(command.text), cwd=tmp_path, env=environment))
            elif command.reason == LIVE or '--prepare' in command.text:
                run(command, tmp_path, environment)
    finally:
        for process in endless:
            process.send_signal(signal.SIGINT)
        codes = [process.wait() for process in endless]
    assert codes
    assert set(codes) == {0}

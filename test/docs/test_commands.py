# SPDX-License-Identifier: Apache-2.0
"""Every command line of the documents is valid, and those that need no ROS graph and little time work."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from benchmarks.run import PARTS
from tools.documents import ROOT, Block, blocks, documents
from trainid_ros.cli.main import VERBS

TRAINID = '.venv/bin/trainid'
LIVE = 'needs a ROS graph and runs until it is stopped'
BUILT = 'needs an installed workspace'
SECURE = 'needs DDS security, which the wheels are built without'
WHOLE = 'takes minutes; make itself is checked by the test run'
# Command lines that are only checked, by page and with the reason.
NOT_RUN = {
    'README.md': {
        'make demo': WHOLE,
        'make test': WHOLE,
        'cd ws/src && git clone <this repository> trainid_ros && cd ..': 'needs the network',
        'colcon build --base-paths src src/trainid_ros/msg_defs && . install/setup.bash': 'see tools/colcon_smoke.py',
        'ros2 launch trainid_ros trainid.launch.py train_file:=$PWD/src/trainid_ros/config/trains/yizhuang.yaml': BUILT,
        '.venv/bin/trainid run --train config/trains/yizhuang.yaml': LIVE,
        '.venv/bin/trainid monitor': LIVE,
    },
    'CONTRIBUTING.md': {
        'make test-fast': WHOLE,
        'make test': WHOLE,
        'make test-long': 'takes minutes',
        'make docs': 'needs the network',
        'make golden': 'writes into the repository',
        'git diff --stat test/golden config/params.yaml docs/monitor.svg': 'needs a repository',
    },
    'SECURITY.md': {
        'ros2 security create_keystore keys': SECURE,
        'ros2 security generate_artifacts -k keys -p config/sros2_policy.xml': SECURE,
        (
            'ros2 run trainid_ros resistance_estimator --ros-args --enclave /trainid/resistance_estimator '
            '-p train_file:=/path/to/train.yaml'
        ): SECURE,
    },
    'docs/algorithms.md': {
        (
            '.venv/bin/trainid run --train config/trains/yizhuang.yaml --node resistance_estimator --ros-args '
            '-p algorithm:=V-MILS -r __node:=v_mils_estimator -r trainid/resistance:=trainid/v_mils/resistance '
            '-r trainid/last_valid/resistance:=trainid/v_mils/last_valid'
        ): LIVE,
    },
    'docs/controller.md': {
        'colcon build --base-paths src/trainid_ros/msg_defs src/trainid_ros/examples/cpp': 'needs a workspace',
    },
    'docs/controller_evidence.md': {
        '.venv/bin/trainid run --train day.yaml': LIVE,
        '.venv/bin/python examples/python/closed_loop.py': LIVE,
    },
    'docs/faults_evidence.md': {'.venv/bin/python benchmarks/run.py --only faults faults_live': 'takes minutes'},
    'docs/fleet.md': {
        '.venv/bin/trainid fleet report out/day.parquet --out out/report.html --explain 5': 'needs the bags of weeks',
    },
    'docs/mapping.md': {
        ('.venv/bin/trainid run --train bags/tiny/train.yaml --map map.yaml --ros-args -p use_sim_time:=true'): LIVE,
        '.venv/bin/trainid play bags/tiny_foreign --map map.yaml --wait 1': LIVE,
        (
            'ros2 launch trainid_ros trainid.launch.py train_file:=/path/to/train.yaml mapping_file:=/path/to/map.yaml'
        ): BUILT,
    },
    'docs/monitor.md': {
        '.venv/bin/trainid monitor': LIVE,
        '.venv/bin/trainid monitor --namespace /train_1': LIVE,
        '.venv/bin/trainid monitor --duration 60 > out/monitor.log': LIVE,
        '.venv/bin/trainid view bags/tiny': 'opens a window',
    },
    'docs/nodes.md': {
        '.venv/bin/trainid run --train config/trains/yizhuang.yaml': LIVE,
        '.venv/bin/trainid run --train config/trains/yizhuang.yaml --node resistance_estimator': LIVE,
        '.venv/bin/trainid play bags/yizhuang_day --rate 5': LIVE,
        'ros2 launch trainid_ros trainid.launch.py train_file:=/path/to/train.yaml params_file:=/path/to/params.yaml': (
            BUILT
        ),
        'ros2 launch trainid_ros replay.launch.py bag:=/path/to/bag train_file:=/path/to/train.yaml rate:=5.0': BUILT,
        'ros2 run trainid_ros resistance_estimator --ros-args -p train_file:=/path/to/train.yaml -p autostart:=true': (
            BUILT
        ),
        'ros2 service call /resistance_estimator/save_checkpoint std_srvs/srv/Trigger': BUILT,
    },
    'docs/parameters.md': {
        '.venv/bin/trainid run --train config/trains/yizhuang.yaml --ros-args --params-file out/params.yaml': LIVE,
        'ros2 launch trainid_ros trainid.launch.py train_file:=/path/to/train.yaml params_file:=/path/to/params.yaml': (
            BUILT
        ),
    },
    'docs/replay.md': {'.venv/bin/trainid play bags/yizhuang_day --rate 5 --start 600 --duration 900': LIVE},
    'docs/results.md': {
        'make bench': 'takes hours',
        '.venv/bin/python benchmarks/run.py --only liu2018 --seeds 60': 'takes minutes',
    },
    'docs/simulator.md': {
        'ros2 run trainid_ros train_simulator --ros-args -p world:=tram -p realism:=field -p autostart:=true': BUILT,
    },
}
# Pages whose commands, taken together, or single commands that take longer than the inner loop should.
SLOW_PAGES = ('docs/algorithms.md', 'docs/explain.md', 'docs/parameters.md', 'docs/simulator.md', 'docs/tables.md')
SLOW = ('replay bags/yizhuang_day', 'demo --only explain', '--report', '--params config/params.yaml')


class Command(NamedTuple):
    """A command line, without its comment."""

    page: str
    line: int
    text: str

    @property
    def reason(self) -> str | None:
        return NOT_RUN.get(self.page, {}).get(self.text)

    @property
    def slow(self) -> bool:
        return self.page in SLOW_PAGES or any(part in self.text for part in SLOW)


class Page(NamedTuple):
    name: str
    blocks: tuple[Block, ...]


def pages() -> list[Page]:
    return [Page(p.relative_to(ROOT).as_posix(), tuple(blocks(p.read_text(encoding='utf-8')))) for p in documents()]


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
    if words[:3] == [TRAINID, 'fleet', 'report']:
        check_verb('fleet report', words[3:])
    elif words[0] == TRAINID:
        check_verb(words[1], words[2:])
    elif words[0] == 'make':
        (target,) = words[1:]
        assert re.search(rf'^{target}:', (ROOT / 'Makefile').read_text(encoding='utf-8'), re.MULTILINE), text
    elif words[:2] == ['ros2', 'launch']:
        assert words[2] == 'trainid_ros'
        source = (ROOT / 'launch' / words[3]).read_text(encoding='utf-8')
        for word in words[4:]:
            assert f"('{word.partition(':=')[0]}', " in source, word
    elif words[:2] == ['ros2', 'run']:
        assert words[2] == 'trainid_ros'
        assert f"'{words[3]} = " in (ROOT / 'setup.py').read_text(encoding='utf-8')
        sources = ''.join(path.read_text(encoding='utf-8') for path in (ROOT / 'trainid_ros' / 'ros').glob('*.py'))
        for name in re.findall(r'-p (\w+):=', text):
            assert f"'{name}'" in sources, name
    elif words[:2] == ['ros2', 'security']:
        assert all((ROOT / word).exists() for word in words if word.startswith('config/')), text
    elif words[:3] == ['ros2', 'service', 'call']:
        service = words[3].rpartition('/')[2]
        assert f"'{service}': self." in (ROOT / 'trainid_ros/ros/estimator_node.py').read_text(encoding='utf-8')
    elif words[0] == '.venv/bin/python' and words[1].startswith('examples/'):
        source = (ROOT / words[1]).read_text(encoding='utf-8')
        assert all(f"'{word}'" in source for word in words[2:] if word.startswith('--')), text
    elif words[0] == '.venv/bin/python':
        check_benchmark(words)
    else:
        assert words[0] in {'cd', 'git', 'colcon', '.'}, text


def check_verb(name: str, arguments: list[str]) -> None:
    (configure,) = (verb.configure for verb in VERBS if verb.name == name)
    parser = argparse.ArgumentParser(prog=name)
    configure(parser)
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
    present = {(command.page, command.text) for command in all_commands()}
    assert {(page, text) for page, listed in NOT_RUN.items() for text in listed} <= present
    assert all(part in ' '.join(text for _, text in present) for part in SLOW)


def workspace(folder: Path) -> None:
    """Give a folder what commands in the root of the repository find."""
    for name in ('bags', 'config', 'examples'):
        (folder / name).symlink_to(ROOT / name)
    (folder / '.venv').symlink_to(sys.prefix)


def run_page(page: Page, folder: Path, *, slow: bool) -> int:
    """Write the files of a page and run its commands in their order; return how many ran."""
    workspace(folder)
    environment, count = dict(os.environ), 0
    for block in page.blocks:
        if block.title:
            path = folder / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding='utf-8')
        for command in commands(page, block) if block.language == 'sh' else ():
            if named := variable(command.text):
                environment[named[0]] = named[1].replace('$PWD', str(folder))
            elif command.reason is None and command.slow == slow:
                run(command, folder, environment)
                count += 1
    return count


def run(command: Command, folder: Path, environment: dict[str, str]) -> None:
    text, _, target = command.text.partition(' > ')
    done = subprocess.run(
        shlex.split(text),
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f'{command.page}:{command.line}: {command.text}\n{done.stdout}{done.stderr}'
    if target:
        (folder / target).write_text(done.stdout, encoding='utf-8')


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

# SPDX-License-Identifier: Apache-2.0
"""The systemd unit, the Dockerfile and the workflow are valid, and the commands in them are ours."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from trainid_ros.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / 'config' / 'deploy' / 'trainid.service'
DOCKERFILE = ROOT / 'config' / 'deploy' / 'Dockerfile'
WORKFLOW = ROOT / '.github' / 'workflows' / 'ros.yml'


def commands() -> dict[str, list[str]]:
    """Return the command of the unit and of the image, as words."""
    unit = UNIT.read_text(encoding='utf-8').replace('\\\n', ' ')
    image = re.findall(r'^CMD (.*)$', DOCKERFILE.read_text(encoding='utf-8'), re.MULTILINE)
    return {'unit': shlex.split(re.findall(r'^ExecStart=(.*)$', unit, re.MULTILINE)[0]), 'image': json.loads(image[0])}


@pytest.mark.parametrize('name', ['unit', 'image'])
def test_their_command_is_understood(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = commands()[name]
    place = next(k for k, word in enumerate(words) if word.endswith('/lib/trainid_ros/trainid'))
    got: list[argparse.Namespace] = []

    def run(args: argparse.Namespace) -> int:
        got.append(args)
        return 0

    monkeypatch.setattr('trainid_ros.cli.live.run_nodes', run)
    assert main(words[place + 1 :]) == 0
    assert got[0].record == Path('/var/lib/trainid/events')


@pytest.mark.skipif(shutil.which('systemd-analyze') is None, reason='no systemd here')
def test_the_unit_is_valid() -> None:
    done = subprocess.run(['systemd-analyze', 'verify', str(UNIT)], capture_output=True, text=True, check=False)
    assert (done.returncode, str(UNIT) in done.stderr) == (0, False), done.stderr


def test_shell_code_is_valid_and_finds_the_messages() -> None:
    steps = yaml.safe_load(WORKFLOW.read_text(encoding='utf-8'))['jobs']['colcon']['steps']
    image = DOCKERFILE.read_text(encoding='utf-8').replace('\\\n', ' ')
    codes = [*re.findall(r'^RUN (.*)$', image, re.MULTILINE), *(step['run'] for step in steps if 'run' in step)]
    assert sum('ln -s trainid_ros/msg_defs src/trainid_msgs' in code for code in codes) == 2
    for code in codes:
        plain = re.sub(r'\$\{\{.*?\}\}', 'x', code)
        done = subprocess.run(['bash', '-n', '-c', plain], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_the_workflow_names_the_distributions() -> None:
    matrix = yaml.safe_load(WORKFLOW.read_text(encoding='utf-8'))['jobs']['colcon']['strategy']['matrix']
    assert [item['distro'] for item in matrix['include']] == ['jazzy', 'kilted', 'rolling']

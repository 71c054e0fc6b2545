# SPDX-License-Identifier: Apache-2.0
"""Build the repository as a colcon workspace over the virtual environment and run one installed node.

The messages are those that `make setup` has built and installed; with --all they are built by colcon too.
Nothing is built inside the repository. The node runs from the installed workspace in an environment
that holds only what `install/setup.bash` sets, answers a lifecycle request from another process, and
must end with exit code 0 after an interrupt.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache
from importlib import import_module
from pathlib import Path

from trainid_ros.cli.processes import free_domain, local_environment

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / '.venv'
NODE = 'resistance_estimator'
PACKAGES = ('trainid_msgs', 'trainid_ros')
# Only a hang takes this long.
HANG_S = 1800.0
ANSWER_HANG_S = 600.0


class SmokeError(Exception):
    """A check failed; the message says which."""


@cache
def own_domain() -> int:
    """Return one unused domain for all processes of this run."""
    return free_domain(os.getpid())


def sourced(setup: Path, scratch: Path) -> dict[str, str]:
    """Return the environment of an empty shell that has sourced a set-up file; homes and logs go to ``scratch``.

    Raises:
        SmokeError: Sourcing fails or prints anything.

    """
    base = {
        'HOME': str(scratch),
        'PATH': os.environ.get('PATH', os.defpath),
        'LANG': 'C.UTF-8',
        'ROS_LOG_DIR': str(scratch / 'ros_log'),
        'ROS_DOMAIN_ID': str(own_domain()),
        **local_environment(ROOT / 'config' / 'fastdds_localhost.xml'),
        'ROS_PYTHON_CHECK_FIELDS': '1',
        'COLCON_LOG_PATH': str(scratch / 'log'),
        # As on a machine without mypyc, and nothing is built inside the repository.
        'TRAINID_COMPILED': '0',
    }
    command = ['bash', '--noprofile', '--norc', '-c', 'set -e; source "$0" 1>&2; env -0', str(setup)]
    done = subprocess.run(command, env=base, capture_output=True, check=False, stdin=subprocess.DEVNULL)
    message = done.stderr.decode(errors='replace').strip()
    if done.returncode or message:
        raise SmokeError(f'source {setup.name}: exit code {done.returncode}: {message}')
    pairs = (item.partition('=') for item in done.stdout.decode().split('\0') if item)
    return {name: value for name, _, value in pairs}


def build(scratch: Path, packages: tuple[str, ...]) -> None:
    """Run `colcon build` of packages of the repository into the scratch folder.

    Raises:
        SmokeError: A package is missing or does not build.

    """
    env = sourced(VENV / 'setup.bash', scratch)
    bases = ('--build-base', scratch / 'build', '--install-base', scratch / 'install')
    command = [VENV / 'bin' / 'colcon', 'build', *bases, '--packages-select', *packages, '--cmake-args', '-GNinja']
    log = scratch / 'colcon.txt'
    with log.open('wb') as output:
        done = subprocess.run(
            [str(word) for word in command],
            cwd=ROOT,
            env=env,
            timeout=HANG_S,
            check=False,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    missing = [name for name in packages if not (scratch / 'install' / name / 'share' / name / 'package.xml').is_file()]
    if done.returncode or missing:
        details = [file.read_text(errors='replace') for file in scratch.glob('log/latest_build/*/stderr.log')]
        text = '\n'.join([log.read_text(errors='replace'), *details])
        raise SmokeError(f'colcon build: exit code {done.returncode}, not installed: {missing}\n{text}')


def run_node(scratch: Path, packages: tuple[str, ...]) -> str:
    """Start the installed node of a built workspace, interrupt it; return the lifecycle state that it reported.

    Raises:
        SmokeError: The node does not answer or does not end cleanly.

    """
    env = sourced(scratch / 'install' / 'setup.bash', scratch)
    program = scratch / 'install' / 'trainid_ros' / 'lib' / 'trainid_ros' / NODE
    log = scratch / 'node.txt'
    with log.open('wb') as output:
        node = subprocess.Popen(
            [program], cwd=scratch, env=env, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            command = [str(VENV / 'bin' / 'python'), str(Path(__file__).resolve()), '--probe', *packages]
            probe = subprocess.run(
                command,
                cwd=scratch,
                env=env,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=HANG_S,
                check=False,
            )
            node.send_signal(signal.SIGINT)
            code = node.wait(timeout=HANG_S)
        except subprocess.TimeoutExpired as error:
            raise SmokeError(f'{NODE} or its probe does not end: {error}\n{log.read_text(errors="replace")}') from error
        finally:
            if node.poll() is None:
                node.kill()
                node.wait()
    if probe.returncode or code:
        raise SmokeError(
            f'{NODE}: probe exit code {probe.returncode}, node exit code {code}\n'
            f'{probe.stdout}{probe.stderr}{log.read_text(errors="replace")}'
        )
    return probe.stdout.strip()


def probe_node(packages: list[str]) -> int:
    """Check that the workspace's packages are in use and that the node answers; return the exit code."""
    import rclpy  # noqa: PLC0415 (needs the sourced workspace)
    from lifecycle_msgs.srv import GetState  # noqa: PLC0415

    for module in map(import_module, packages):
        if 'install' not in Path(str(module.__file__)).parts:
            print(f'{module.__name__} comes from {module.__file__}, not from the workspace')
            return 1
    rclpy.init()
    try:
        client_node = rclpy.create_node('colcon_smoke_probe')
        client = client_node.create_client(GetState, f'/{NODE}/get_state')
        if not client.wait_for_service(timeout_sec=ANSWER_HANG_S):
            print(f'no service /{NODE}/get_state; nodes: {client_node.get_node_names()}')
            return 1
        future = client.call_async(GetState.Request())
        rclpy.spin_until_future_complete(client_node, future, timeout_sec=ANSWER_HANG_S)
        if not future.done():
            print(f'/{NODE}/get_state does not answer')
            return 1
        print(future.result().current_state.label)
        client_node.destroy_node()
    finally:
        rclpy.shutdown()
    return 0


def main() -> int:
    """Build, run, report; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0] if __doc__ else None)
    parser.add_argument('--probe', nargs='+', help='only query a running node (used by the script itself)')
    parser.add_argument('--all', action='store_true', help='build the messages too, which takes most of the time')
    args = parser.parse_args()
    if args.probe:
        return probe_node(args.probe)
    packages = PACKAGES if args.all else PACKAGES[-1:]
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix='trainid_smoke_') as folder:
        try:
            build(Path(folder), packages)
            built = time.monotonic()
            state = run_node(Path(folder), packages)
        except (SmokeError, subprocess.TimeoutExpired) as error:
            print(f'colcon smoke: {error}', file=sys.stderr)
            return 1
    print(
        f'colcon smoke: {" and ".join(packages)} built in {built - began:.0f} s; '
        f'installed {NODE} answered "{state}" and ended cleanly'
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())

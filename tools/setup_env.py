# SPDX-License-Identifier: Apache-2.0
"""Make or refresh the project's virtual environment; started by tools/setup.

Every step is skipped while the content of the files it depends on has not changed, so that a second
run takes well under a second. The environment needs no sourcing: its Python finds ROS by itself. The
`setup.bash` in it serves cmake, colcon and the ros2 command line, as the one of /opt/ros/jazzy would.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import os
import platform
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import RLock

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / '.venv'
REQUIREMENTS = ROOT / 'tools' / 'requirements'
MESSAGES = ROOT / 'msg_defs'
TEMPLATES = ROOT / 'tools' / 'environment'
LAB = ROOT / 'research' / 'lab'
LOG = VENV / 'setup.log'
COMPILER_LOG = VENV / 'compiler.log'
STAMP = VENV / 'setup.stamp.json'
COMPILED = VENV / 'compiled'
BUILDS_KEPT = 8
INTERPRETER = f'python{sys.version_info.major}.{sys.version_info.minor}'
SITE = VENV / 'lib' / INTERPRETER / 'site-packages'
PYTHON = VENV / 'bin' / 'python'
PACKAGE_INPUTS = ('setup.py', 'setup.cfg', 'package.xml', 'research/lab/pyproject.toml')
SHARED = ('package.xml', 'bags', 'config', 'launch')
LOG_LINES_SHOWN = 15
STAMPING = RLock()
# Messages of pip if the index does not answer or its answer is empty.
NO_INDEX = ('NewConnectionError', 'NameResolutionError', '(from versions: none)')


class SetupError(Exception):
    """The set-up cannot continue; the message states what to do."""


def say(text: str) -> None:
    """Print one progress line."""
    print(f'setup: {text}\n', end='', flush=True)  # in one piece: two threads print


def fingerprint(paths: Iterable[Path], *extra: str) -> str:
    """Hash names and contents of files, and of all files below folders.

    Args:
        paths: Files and folders; missing ones count as empty.
        extra: Further text that belongs to the fingerprint.

    Returns:
        Hexadecimal digest.
    """
    digest = hashlib.sha256('\0'.join(extra).encode())
    for path in paths:
        files = sorted(item for item in path.rglob('*') if item.is_file()) if path.is_dir() else [path]
        for file in files:
            if file.is_file() and '__pycache__' not in file.parts:
                digest.update(f'\0{file.relative_to(ROOT)}\0'.encode())
                digest.update(file.read_bytes())
    return digest.hexdigest()


def run(
    command: Sequence[str | Path], failure: str, extra_env: dict[str, str] | None = None, log_file: Path = LOG
) -> None:
    """Run a command with its output in a log.

    Args:
        command: Program and arguments.
        failure: Error message if it fails.
        extra_env: Environment variables to add.
        log_file: The log, to which the output is appended.

    Raises:
        SetupError: If the command fails; carries the end of its output.
    """
    env = os.environ | {'PIP_DISABLE_PIP_VERSION_CHECK': '1', 'PIP_NO_INPUT': '1'} | (extra_env or {})
    with log_file.open('a', encoding='utf-8') as log:
        start = log.tell()
        done = subprocess.run(
            [str(word) for word in command],
            cwd=ROOT,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if done.returncode:
        with log_file.open(encoding='utf-8', errors='replace') as log:
            log.seek(start)
            lines = log.read().splitlines()
        if any(sign in line for line in lines for sign in NO_INDEX):
            failure = 'cannot reach the package index; a network connection or a pip mirror is needed'
        elif any('No space left' in line for line in lines):
            failure = 'the disk is full'
        tail = '\n'.join(line for line in lines if 'is ignored: it is neither' not in line)
        shown = '\n'.join(tail.splitlines()[-LOG_LINES_SHOWN:])
        raise SetupError(
            f'{shown}\nsetup: {failure} (exit code {done.returncode}, log in {log_file.relative_to(ROOT)})'
        )


def check_machine() -> None:
    """Check the prerequisites that cannot be installed from wheels.

    Raises:
        SetupError: A prerequisite is missing; the message names it.
    """
    if platform.machine() != 'x86_64':
        raise SetupError(
            f'setup: the ROS 2 wheels are for x86_64, not {platform.machine()}; use colcon and an installed ROS 2'
        )
    for variable, names in (('CC', ('cc', 'gcc', 'clang')), ('CXX', ('c++', 'g++', 'clang++'))):
        chosen = os.environ.get(variable)
        if not any(shutil.which(name) for name in ((chosen,) if chosen else names)):
            raise SetupError(f'setup: no C and C++ compiler found ({variable}); install gcc and g++ (build-essential)')
    header = Path(sysconfig.get_path('include')) / 'Python.h'
    if not header.is_file():
        raise SetupError(f'setup: {header} is missing; install {INTERPRETER}-dev')


def make_environment() -> None:
    """Create the virtual environment, and replace one of another interpreter or place."""
    marker = VENV / 'interpreter.txt'
    wanted = f'{sys.executable}\n{sys.version}\n{VENV}\n'
    if marker.is_file() and marker.read_text() == wanted and PYTHON.exists():
        return
    say(f'virtual environment with {sys.executable}')
    shutil.rmtree(VENV, ignore_errors=True)
    VENV.mkdir()
    run([sys.executable, '-m', 'venv', VENV], 'cannot create the virtual environment')
    marker.write_text(wanted)


def install_bootstrap() -> None:
    """Install the locked wheels that install others."""
    install('bootstrap', options=())


def install_libraries() -> None:
    """Install the locked wheels that trainid_ros and building its messages need."""
    tools = () if shutil.which('cmake') and shutil.which('ninja') else ('build',)
    install('runtime', *tools)


def install_development() -> None:
    """Install the locked wheels of what checks, tests and compiles."""
    install('dev')


def install_ros() -> None:
    """Install the locked wheels of ROS 2, then undo the build machine's paths in their CMake files."""
    install('ros')
    correct_paths()
    write_environment_files()


def install(*groups: str, options: tuple[str, ...] = ('--no-build-isolation',)) -> None:
    """Install the wheels of groups of requirements; Python compiles to byte code what is imported, and only that."""
    pip: list[str | Path] = [PYTHON, '-m', 'pip', 'install', '--quiet', '--progress-bar', 'off', '--no-compile']
    pip += ['--no-deps', '--require-hashes', *options]
    words = [word for group in groups for word in ('--requirement', REQUIREMENTS / f'{group}.lock')]
    run([*pip, *words], 'cannot install the locked packages')


def correct_paths() -> None:
    """Replace the include folders of the machine that built the wheels by this machine's."""
    python_include = sysconfig.get_path('include')
    numpy_include = str(SITE / 'numpy' / '_core' / 'include')
    baked = r'/opt/python/[\w-]+/'
    numpy_pattern = re.compile(baked + r'lib/python[\d.]+/site-packages/numpy/(_core|core)/include')
    python_pattern = re.compile(baked + r'include/python\d\.\d+')
    for file in (VENV / 'share').rglob('*.cmake'):
        text = file.read_text(encoding='utf-8')
        if '/opt/python/' in text:
            text = numpy_pattern.sub(lambda _: numpy_include, text)
            file.write_text(python_pattern.sub(lambda _: python_include, text), encoding='utf-8')


def write_environment_files() -> None:
    """Write the shell set-up files and the hook that lets this Python find its ROS packages."""
    text = (TEMPLATES / 'setup.sh.in').read_text(encoding='utf-8').replace('@PREFIX@', str(VENV))
    for shell in ('sh', 'bash', 'zsh'):
        for name in ('setup', 'local_setup'):
            (VENV / f'{name}.{shell}').write_text(text, encoding='utf-8')
    shutil.copy(TEMPLATES / 'trainid_ros_environment.py', SITE)
    (SITE / 'trainid_ros_environment.pth').write_text('import trainid_ros_environment\n', encoding='utf-8')


def build_messages() -> None:
    """Build the interface package and install it beside the ROS wheels."""
    build = VENV / 'build' / 'trainid_msgs'
    env = {
        'AMENT_PREFIX_PATH': str(VENV),
        'CMAKE_PREFIX_PATH': str(VENV),
        'VIRTUAL_ENV': str(VENV),
        'PATH': f'{VENV / "bin"}{os.pathsep}{os.environ.get("PATH", os.defpath)}',
    }
    failure = 'cannot build the messages of msg_defs'
    configure: list[str | Path] = [
        'cmake',
        '-S',
        MESSAGES,
        '-B',
        build,
        '-G',
        'Ninja',
        '-DCMAKE_BUILD_TYPE=Release',
    ]
    configure += [f'-DCMAKE_INSTALL_PREFIX={VENV}', '-DBUILD_TESTING=OFF', f'-DPython3_EXECUTABLE={PYTHON}']
    run(configure, failure, env)
    run(['cmake', '--build', build], failure, env)
    remove_old_messages()
    run(['cmake', '--install', build], failure, env)


def remove_old_messages() -> None:
    """Delete the messages installed before, so that removed messages do not remain."""
    for folder in (VENV / 'include', VENV / 'share', SITE):
        shutil.rmtree(folder / 'trainid_msgs', ignore_errors=True)
    for library in (VENV / 'lib').glob('libtrainid_msgs__*'):
        library.unlink()


def install_project() -> None:
    """Make trainid_ros and the algorithms of research/lab importable from the source tree and install their commands.

    An editable install leaves out the data files, so the ROS index and the share folder of the package
    are filled with links: edited configurations take effect at once.
    """
    pip: list[str | Path] = [PYTHON, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-build-isolation']
    failure = 'cannot install trainid_ros and research/lab into the environment'
    run([*pip, '--editable', ROOT, '--editable', LAB], failure, {'TRAINID_COMPILED': '0'})
    share = VENV / 'share' / 'trainid_ros'
    programs = VENV / 'lib' / 'trainid_ros'
    for folder in (share, programs):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    for name in existing_shared():
        link_shared(ROOT / name, share / name)
    marker = VENV / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'trainid_ros'
    shutil.copy(ROOT / 'resource' / 'trainid_ros', marker)
    (record,) = SITE.glob('trainid_ros-*.dist-info/entry_points.txt')
    for name in re.findall(r'^(\w+)\s*=', record.read_text(encoding='utf-8'), re.MULTILINE):
        (programs / name).symlink_to(VENV / 'bin' / name)


def link_shared(source: Path, link: Path) -> None:
    """Link a part of the source tree; the folder of launch files is made, since ``ros2 launch`` follows no links."""
    if source.name != 'launch':
        link.symlink_to(source)
        return
    link.mkdir()
    for path in source.glob('*.launch.py'):
        (link / path.name).symlink_to(path)


def compiled_sources() -> list[Path]:
    """List the sources of the compiled modules."""
    package = ROOT / 'trainid_ros'
    return [package / f'{name}.py' for name in runpy.run_path(str(package / 'compiled.py'))['MODULES']]


def compile_modules(stamp: str) -> None:
    """Compile modules of trainid_ros beside their sources, or take back what was compiled of the same sources before.

    Args:
        stamp: Fingerprint of the sources and of what compiles them.
    """
    remove_compiled()
    package = ROOT / 'trainid_ros'
    kept = COMPILED / stamp
    if not kept.is_dir():
        part = COMPILED / 'part'
        shutil.rmtree(part, ignore_errors=True)
        command: list[str | Path] = [PYTHON, 'setup.py', '--quiet', 'build_ext', '--build-lib', part]
        run(command, 'cannot compile trainid_ros', log_file=COMPILER_LOG)
        (part / 'trainid_ros').rename(kept)
        part.rmdir()
        for old in sorted(COMPILED.iterdir(), key=lambda path: path.stat().st_mtime)[:-BUILDS_KEPT]:
            shutil.rmtree(old)
    # The digest last: without it the sources run.
    for file in sorted(kept.rglob('*'), key=lambda path: path.suffix != '.so'):
        if file.is_file():
            shutil.copy2(file, package / file.relative_to(kept))


def remove_compiled() -> None:
    """Delete the compiled modules beside their sources, so that the sources run."""
    for pattern in ('modules.sha256', '*.cpython-*.so'):
        for file in (ROOT / 'trainid_ros').rglob(pattern):
            file.unlink()


def existing_shared() -> list[str]:
    """List the parts of the source tree that belong in the share folder of the package."""
    return [name for name in SHARED if (ROOT / name).exists()]


@dataclass(frozen=True)
class Step:
    """A step of the set-up, which is due while its inputs are not those of the last time."""

    name: str  # Name in the file of fingerprints
    stamp: str  # Fingerprint of its inputs
    action: Callable[[], None]  # What it does
    text: str  # What it is doing, for the user

    @property
    def is_due(self) -> bool:
        """True if it has to be done."""
        return stamps().get(self.name) != self.stamp

    def do(self) -> None:
        """Do it if it is due; until it has succeeded it remains so."""
        if self.is_due:
            say(self.text)
            keep_stamp(self.name, '')
            self.action()
            keep_stamp(self.name, self.stamp)


def stamps() -> dict[str, str]:
    """Return the fingerprints of the steps done."""
    with STAMPING:
        found: dict[str, str] = json.loads(STAMP.read_text()) if STAMP.is_file() else {}
    return found


def keep_stamp(name: str, stamp: str) -> None:
    """Store the fingerprint of a step; empty if it has to be done again."""
    with STAMPING:
        STAMP.write_text(json.dumps(stamps() | {name: stamp}))


def do_after(earlier: Future[None], *steps: Step) -> None:
    """Do steps in order, once an earlier one has succeeded."""
    earlier.result()
    for step in steps:
        step.do()


def refresh(*, whole: bool) -> bool:
    """Run the steps whose inputs have changed, those that need not wait for each other side by side.

    Args:
        whole: False to leave out development tools and compiler: the sources run where modules are not compiled.

    Returns:
        True if anything had to be done.
    """
    make_environment()
    packages = fingerprint([*sorted(REQUIREMENTS.glob('*.lock')), TEMPLATES, Path(__file__)])
    messages = fingerprint([MESSAGES], packages)
    launch_files = sorted(path.name for path in (ROOT / 'launch').glob('*.launch.py'))
    project = fingerprint([ROOT / name for name in PACKAGE_INPUTS], packages, *existing_shared(), *launch_files)
    compiled = fingerprint([*compiled_sources(), ROOT / 'setup.py', ROOT / 'pyproject.toml'], packages)
    bootstrap = Step('bootstrap', packages, install_bootstrap, 'pip and setuptools')
    libraries = Step('libraries', packages, install_libraries, 'Python packages')
    ros = Step('ros', packages, install_ros, 'ROS 2 Jazzy')
    interface = Step('messages', messages, build_messages, 'interface package trainid_msgs (about half a minute)')
    source_tree = Step('project', project, install_project, 'trainid_ros and research/lab, from the source tree')
    tools = Step('development', packages, install_development, 'development tools')
    compiler = Step(
        'compiled', compiled, lambda: compile_modules(compiled), 'compiled modules of trainid_ros (a minute)'
    )
    needed = (bootstrap, libraries, ros, interface, source_tree, *((tools, compiler) if whole else ()))
    worked = any(step.is_due for step in needed)
    bootstrap.do()
    if compiler.is_due:
        remove_compiled()
    with ThreadPoolExecutor() as pool:
        imported = pool.submit(libraries.do)
        compilation = pool.submit(do_after, imported, *((tools, compiler) if whole else ()))
        ros.do()
        do_after(imported, interface, source_tree)
        compilation.result()
    return worked


def main() -> int:
    """Bring the environment up to date; only one process at a time does so.

    Returns:
        Exit code.
    """
    parser = argparse.ArgumentParser(description='Make or refresh .venv.')
    parser.add_argument('--sources', action='store_true', help='leave out development tools and compiled modules')
    whole = not parser.parse_args().sources
    began = time.monotonic()
    lock = os.open(ROOT, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        check_machine()
        if refresh(whole=whole):
            say(f'.venv is ready ({time.monotonic() - began:.0f} s)')
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())

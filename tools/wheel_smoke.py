# SPDX-License-Identifier: Apache-2.0
"""Build a wheel with compiled modules and replay a bag with it in a clean environment.

It is built for the interpreter of the project's environment and takes over what `make setup` has compiled; with --all,
another is compiled for each other interpreter of Python 3.11 and 3.12 on this machine. Each wheel gets the oldest
manylinux tag that auditwheel finds it to satisfy. The replay must give the same numbers as the project's environment.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
VENV: Final = ROOT / '.venv'
REQUIREMENTS: Final = ROOT / 'tools' / 'requirements'
VERSIONS: Final = ('3.11', '3.12')
BAG: Final = ROOT / 'bags' / 'tiny'
# Large packages of extras without which a bag is replayed.
EXTRAS: Final = frozenset({'dask', 'distributed', 'pyarrow', 'rerun-sdk'})
REPLAY: Final = ('replay', str(BAG), '--train', str(BAG / 'train.yaml'), '--json')
# Prints the files of all modules that a wheel must have compiled.
PROBE: Final = """
from importlib import import_module
from trainid_ros.compiled import MODULES
print(*(import_module("trainid_ros." + name.replace("/", ".")).__file__ for name in MODULES))
"""


class SmokeError(Exception):
    """A check failed; the message says which."""


def main() -> int:
    """Build, try, report; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0] if __doc__ else None)
    parser.add_argument('--out', type=Path, help='keep the wheels in this folder')
    parser.add_argument('--all', action='store_true', help='for all interpreters, not only that of the environment')
    arguments = parser.parse_args()
    out = arguments.out
    pythons = interpreters() if arguments.all else [VENV / 'bin' / 'python']
    with tempfile.TemporaryDirectory(prefix='trainid_wheel_') as folder:
        scratch = Path(folder)
        try:
            expected = replayed(VENV / 'bin' / 'trainid')
            with ThreadPoolExecutor() as pool:
                wheels = list(pool.map(lambda python: checked(python, scratch, expected), pythons))
            if out:
                out.mkdir(parents=True, exist_ok=True)
                for wheel in wheels:
                    shutil.copy(wheel, out)
        except SmokeError as error:
            print(f'wheel smoke: {error}', file=sys.stderr)
            return 1
    return 0


def checked(python: Path, scratch: Path, expected: dict[str, object]) -> Path:
    """Build a wheel, try it and return it; see :func:`build` and :func:`try_out`."""
    began = time.monotonic()
    with ThreadPoolExecutor(1) as pool:
        clean = pool.submit(environment, python, scratch / f'clean{version_of(python)}', 'runtime', left_out=EXTRAS)
        wheel = build(python, scratch)
        try_out(clean.result(), wheel, scratch, expected)
    print(f'wheel smoke: {wheel.name} replays as the environment does ({time.monotonic() - began:.0f} s)', flush=True)
    return wheel


def interpreters() -> list[Path]:
    """Return the interpreters to build for, that of the project's environment first."""
    own = VENV / 'bin' / 'python'
    found = {version_of(own): own}
    for version in VERSIONS:
        on_path = shutil.which(f'python{version}')
        candidates = [Path(on_path)] if on_path else []
        for program in (*candidates, *Path.home().glob(f'.pyenv/versions/{version}.*/bin/python')):
            if version not in found and version_of(program) == version:
                found[version] = program
    missing = [version for version in VERSIONS if version not in found]
    if missing:
        print(f'wheel smoke: no Python {" and ".join(missing)} on this machine: left out')
    return list(found.values())


def version_of(python: Path) -> str:
    """Return the version of an interpreter, such as 3.11; empty if it does not run or cannot make environments."""
    program = 'import ensurepip, sys, venv; print("%d.%d" % sys.version_info[:2])'
    done = subprocess.run([python, '-c', program], capture_output=True, text=True, check=False)
    return done.stdout.strip() if not done.returncode else ''


def build(python: Path, scratch: Path) -> Path:
    """Build a wheel with a manylinux tag for an interpreter, in a scratch folder; return it.

    Raises:
        SmokeError: It cannot be built, or contains no compiled modules.

    """
    name = version_of(python)
    source, raw, tagged = (scratch / f'{part}{name}' for part in ('source', 'raw', 'tagged'))
    files = run(['git', '-C', ROOT, 'ls-files', '-z', '--cached', '--others', '--exclude-standard']).split('\0')
    for file in filter(None, files):
        if (ROOT / file).exists() and not file.startswith(('test/', 'benchmarks/', 'docs/')):
            (source / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, source / file, follow_symlinks=False)
    if python == VENV / 'bin' / 'python':
        take_over_compiled(source)
    else:
        python = environment(python, scratch / f'build{name}', 'bootstrap', 'runtime', 'dev')
    run([python, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation', '--wheel-dir', raw, source])
    (wheel,) = raw.glob('*.whl')
    tools = f'{python.parent}{os.pathsep}{os.environ.get("PATH", os.defpath)}'
    run([python, '-m', 'auditwheel', 'repair', '--wheel-dir', tagged, wheel], PATH=tools)
    (wheel,) = tagged.glob('*.whl')
    return wheel


def take_over_compiled(source: Path) -> None:
    """Copy what was compiled in the repository, with its times: what has not changed is not compiled again."""
    modules = ('modules__mypyc', *runpy.run_path(str(ROOT / 'trainid_ros' / 'compiled.py'))['MODULES'])
    suffix = sysconfig.get_config_var('EXT_SUFFIX')
    built = f'build/lib.{sysconfig.get_platform()}-{sys.implementation.cache_tag}'
    places = {path: path.relative_to(ROOT) for path in (ROOT / 'build').rglob('*') if path.suffix in {'.c', '.h'}}
    libraries = (Path('trainid_ros', f'{name}{suffix}') for name in modules)
    places |= {ROOT / library: built / library for library in libraries if (ROOT / library).exists()}
    for path, place in places.items():
        (source / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, source / place)


def try_out(clean: Path, wheel: Path, scratch: Path, expected: dict[str, object]) -> None:
    """Install a wheel into the clean environment of an interpreter and replay a bag there.

    Raises:
        SmokeError: It does not work, does not use its compiled modules, or gives something else.

    """
    run([clean, '-m', 'pip', 'install', '--quiet', '--no-deps', wheel])
    home = clean.parent.parent
    for place in run([clean, '-c', PROBE], cwd=scratch).split():
        if not (place.endswith('.so') and place.startswith(str(home))):
            raise SmokeError(f'{wheel.name}: uses {place}')
    found = replayed(next(home.rglob('bin/trainid')))
    if found != expected:
        raise SmokeError(f'{wheel.name}: trainid {" ".join(REPLAY)} gives\n{found}\nnot\n{expected}')


def replayed(program: Path) -> dict[str, object]:
    """Return what a replay prints, without the time it took."""
    result: dict[str, object] = json.loads(run([program, *REPLAY], Path(tempfile.gettempdir())))
    del result['wall_s']
    return result


def environment(python: Path, folder: Path, *locks: str, left_out: Collection[str] = ()) -> Path:
    """Make a virtual environment with locked packages but those left out; return its interpreter."""
    run([python, '-m', 'venv', folder])
    inside = folder / 'bin' / 'python'
    # A package is a line with its version and further lines with its hashes.
    text = ''.join((REQUIREMENTS / f'{lock}.lock').read_text('utf-8') for lock in locks)
    packages = re.split(r'^(?=\S)', text, flags=re.MULTILINE)
    chosen = folder / 'requirements.lock'
    chosen.write_text(''.join(item for item in packages if item.partition('==')[0] not in left_out), encoding='utf-8')
    requirements: list[str | Path] = ['--requirement', chosen]
    # Compiling all of them to byte code would take longer than the few that run.
    run([inside, '-m', 'pip', 'install', '--quiet', '--no-compile', '--no-deps', '--require-hashes', *requirements])
    return inside


def run(command: list[str | Path], cwd: Path = ROOT, **variables: str) -> str:
    """Run a command with variables set, without those of the project's own environment; return what it prints.

    Raises:
        SmokeError: It fails; carries its output.

    """
    hidden = {'PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'TRAINID_COMPILED'}
    env = {name: value for name, value in os.environ.items() if name not in hidden}
    words = [str(word) for word in command]
    pip = {'PIP_DISABLE_PIP_VERSION_CHECK': '1', 'PIP_NO_INPUT': '1'}
    done = subprocess.run(
        words, cwd=cwd, env=env | pip | variables, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        raise SmokeError(f'{" ".join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}')
    return done.stdout


if __name__ == '__main__':
    sys.exit(main())

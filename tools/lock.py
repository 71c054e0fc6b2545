# SPDX-License-Identifier: Apache-2.0
"""Write the hashed lock files of tools/requirements from the `.in` files beside them.

Needs the resolver `uv` on the path or in the environment variable UV. With names of groups, only these are
resolved again, against the pins in the locks of the groups before them. A lock lists only the wheels
that the project can use (CPython 3.11 to 3.13 on glibc Linux), and neither addresses nor paths.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

REQUIREMENTS = Path(__file__).resolve().parent / 'requirements'
GROUPS = ('bootstrap', 'ros', 'runtime', 'dev', 'build', 'peers', 'docs')
OLDEST_PYTHON = '3.11'
PYTHON_TAG = re.compile(r'^(py3|py2\.py3|py31[123]|cp311|cp312|cp313|cp3\d+-abi3)-')
PLATFORM_TAG = re.compile(r'(any|manylinux\w*_(x86_64|aarch64)|linux_(x86_64|aarch64))$')


def usable(wheel: str) -> bool:
    """Return whether a wheel file fits one of the supported interpreters and machines: it belongs in a lock."""
    python, abi, platform = wheel.removesuffix('.whl').split('-')[-3:]
    return bool(
        PYTHON_TAG.match(f'{python}-{abi}-')
        and not abi.endswith('t')
        and any(PLATFORM_TAG.search(tag) for tag in platform.split('.'))
    )


def resolve(group: str, scratch: Path, constraints: list[str]) -> list[dict[str, Any]]:
    """Return the packages of a group as the resolver's lock file describes them; ``constraints`` are earlier pins.

    Raises:
        subprocess.CalledProcessError: The resolver finds no solution.

    """
    limits = scratch / 'constraints.txt'
    limits.write_text('\n'.join(constraints))
    output = scratch / f'pylock.{group}.toml'
    command = [os.environ.get('UV', 'uv'), 'pip', 'compile', '--quiet', '--no-config', '--universal']
    command += ['--python-version', OLDEST_PYTHON, '--fork-strategy', 'fewest', '--format', 'pylock.toml']
    command += ['--constraints', str(limits), '--output-file', str(output)]
    if group == 'ros':
        command.append('--no-deps')
    subprocess.run([*command, str(REQUIREMENTS / f'{group}.in')], check=True)
    packages: list[dict[str, Any]] = tomllib.loads(output.read_text())['packages']
    return [item for item in packages if "sys_platform == 'win32'" not in str(item.get('marker', ''))]


def entry(package: dict[str, Any]) -> str:
    """Return the lines of a package in a lock: hashes of its usable wheels, or of its source if it has none at all.

    Raises:
        ValueError: The package has wheels, but none fits.

    """
    wheels = package.get('wheels', [])
    files = [wheel for wheel in wheels if usable(wheel['url'].rsplit('/', 1)[-1])]
    if not wheels:
        files = [package['sdist']]
    if not files:
        raise ValueError(f'{package["name"]} {package["version"]}: no wheel for the supported machines')
    digests = sorted(item['hashes']['sha256'] for item in files)
    lines = [f'{package["name"]}=={package["version"]}', *(f'--hash=sha256:{digest}' for digest in digests)]
    return ' \\\n    '.join(lines)


def pinned(group: str) -> list[str]:
    """Return the pins of an existing lock, `name==version`."""
    lines = (REQUIREMENTS / f'{group}.lock').read_text().splitlines()
    return [line.split()[0] for line in lines if '==' in line and not line.startswith('#')]


def main() -> int:
    """Resolve the named groups, or all groups, and write their locks; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('groups', nargs='*', default=GROUPS, metavar='GROUP', help=f'of {", ".join(GROUPS)}')
    wanted = parser.parse_args().groups
    if unknown := set(wanted) - set(GROUPS):
        parser.error(f'no such group: {", ".join(sorted(unknown))}')
    known: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        for group in GROUPS:
            if group not in wanted:
                known += pinned(group)
                continue
            packages = resolve(group, Path(scratch), known)
            new = [item for item in packages if f'{item["name"]}=={item["version"]}' not in known]
            known += [f'{item["name"]}=={item["version"]}' for item in new]
            text = '\n'.join(entry(item) for item in sorted(new, key=lambda item: str(item['name'])))
            header = f'# Made by tools/lock.py from {group}.in; change that file and run `make lock`.\n'
            (REQUIREMENTS / f'{group}.lock').write_text(f'{header}{text}\n')
            print(f'{group}.lock: {len(new)} packages')
    return 0


if __name__ == '__main__':
    sys.exit(main())

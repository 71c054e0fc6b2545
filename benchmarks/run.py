# SPDX-License-Identifier: Apache-2.0
"""All benchmarks, or some: ``python benchmarks/run.py [--only NAME ...] [--out FILE]``.

Every part prints its tables and takes its own section of the Markdown file; sections of parts that did not
run stay as they were.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from benchmarks.tables import Table

REPOSITORY: Final = Path(__file__).resolve().parents[1]
PARTS: Final = ('cost', 'live', 'replay', 'memory', 'accuracy')
_TITLE: Final = '# Results of the benchmarks\n\nMade by `make bench`; see `benchmarks/` for what each part measures.\n'
_SECTION: Final = '\n## '


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts asked for, print their tables and write them down."""
    parser = argparse.ArgumentParser(prog='benchmarks/run.py', description=__doc__.splitlines()[0])
    which = f'run only these: {", ".join(PARTS)}'
    parser.add_argument('--only', action='extend', nargs='+', choices=PARTS, metavar='NAME', help=which)
    parser.add_argument('--out', type=Path, metavar='FILE', default=REPOSITORY / 'benchmarks' / 'RESULTS.md')
    args = parser.parse_args(arguments)
    prepare()
    for name in PARTS:
        if args.only is None or name in args.only:
            _run(name, args.out)
    print(f'written to {args.out}')
    return 0


def prepare() -> None:
    """Let this process and its children find the benchmarks, and calculate in one thread each."""
    sys.path[0] = str(REPOSITORY)
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')


def _run(name: str, out: Path) -> None:
    # Imported only now, so that the number of threads is set before numpy loads.
    from benchmarks.tables import as_markdown, as_text  # noqa: PLC0415

    measure: Callable[[], Sequence[Table]] = import_module(f'benchmarks.{name}').measure
    before = os.getloadavg()[0]
    print(f'-- {name} (load {before:.1f} on {os.cpu_count()} cores)', flush=True)
    tables = measure()
    for table in tables:
        print(f'\n{as_text(table)}', flush=True)
    print()
    parts = [*(as_markdown(table) for table in tables), _circumstances(before)]
    text = '\n\n'.join(parts)
    _store(out, name, f'{name}\n\n{text}\n')


def _circumstances(load_before: float) -> str:
    python, libraries = platform.python_version(), ', '.join(f'{name} {version(name)}' for name in ('numpy', 'scipy'))
    load = f'load {load_before:.1f} before and {os.getloadavg()[0]:.1f} after'
    return f'Revision {_revision()}; Python {python}, {libraries}; {os.cpu_count()} cores, {load}.'


def _revision() -> str:
    """Return the revision measured; "-dirty" if files had been changed since."""
    command = ('git', 'describe', '--always', '--dirty')
    answer = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return answer.stdout.strip() or 'unknown'


def _store(out: Path, name: str, section: str) -> None:
    """Replace one section of the file; sections stand in the order of the parts."""
    old = out.read_text(encoding='utf-8').split(_SECTION)[1:] if out.is_file() else []
    sections = {text.split('\n', 1)[0]: text.rstrip() + '\n' for text in old} | {name: section}
    ordered = [sections[part] for part in PARTS if part in sections]
    out.write_text(_SECTION.join([_TITLE, *ordered]), encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())

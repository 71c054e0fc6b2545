# SPDX-License-Identifier: Apache-2.0
"""Run all or some benchmarks: ``python benchmarks/run.py [--only NAME ...] [--seeds N] [--budget MINUTES]``.

Each part prints its tables and writes them all to ``results/NAME.md`` beside the Markdown file, which is made anew from
these files and shows of each part the tables of its claims. Plots are written to ``plots`` beside it.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.tables import Plot, Table

    Results = Sequence[Table | Plot]

REPOSITORY: Final = Path(__file__).resolve().parents[1]
PARTS: Final = ('cost', 'live', 'replay', 'commands', 'memory', 'kills', 'soak', 'damage', 'faults_live', 'accuracy')
# Simulated real trains, and the discrepancy workflow on hidden cases: the number of drives or cases follows the seeds.
SEEDED: Final = (
    *('real_trains', 'unknowns', 'rates', 'brake_worlds', 'faults', 'integrity', 'explain', 'fleet'),
    *('closed_loop', 'drives'),
)
# Experiments of the four papers and comparisons with other libraries, repeated over seeds.
PAPERS: Final = ('liu2018', 'resistance', 'yuan2017', 'xia2023', 'zheng2015', 'peers')
_ALL: Final = (*PARTS, *SEEDED, *PAPERS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the selected parts, print their tables and write the Markdown file."""
    parser = argparse.ArgumentParser(prog='benchmarks/run.py', description=__doc__.splitlines()[0])
    which = f'run only these parts: {", ".join(_ALL)}'
    parser.add_argument('--only', action='extend', nargs='+', choices=_ALL, metavar='NAME', help=which)
    parser.add_argument('--out', type=Path, metavar='FILE', default=REPOSITORY / 'benchmarks' / 'RESULTS.md')
    parser.add_argument('--seeds', type=int, default=60, metavar='N', help='repetitions of seeded parts (default 60)')
    budget = 'begin no part after this time, and fail if parts are left (default: no limit)'
    parser.add_argument('--budget', type=float, default=float('inf'), metavar='MINUTES', help=budget)
    args = parser.parse_args(arguments)
    prepare()
    left = [name for name in _ALL if args.only is None or name in args.only]
    revision, end = _revision(), time.monotonic() + 60 * args.budget
    while left and time.monotonic() < end:
        if _revision() != revision:
            print(f'the sources are no longer those of {revision}: stopped', file=sys.stderr)
            break
        _run(left.pop(0), args.seeds, args.out)
    if left:
        print(f'not measured: {", ".join(left)}', file=sys.stderr)
    print(f'written to {args.out}')
    return 1 if left else 0


def prepare() -> None:
    """Make the benchmarks importable and limit numpy to one thread, in this process and its children."""
    sys.path[:1] = [str(REPOSITORY), str(REPOSITORY / 'examples' / 'python')]
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')


def _run(name: str, seeds: int, out: Path) -> None:
    # Imported here because the number of threads must be set before numpy loads.
    from benchmarks.tables import Table, as_text  # noqa: PLC0415

    before = os.getloadavg()[0]
    print(f'-- {name} (load {before:.1f} on {os.cpu_count()} cores)', flush=True)
    results = _measure(name, seeds)
    for item in results:
        if isinstance(item, Table):
            print(f'\n{as_text(item)}', flush=True)
    print()
    parts = [*(_written(item, out) for item in results), _circumstances(before)]
    text = '\n\n'.join(parts)
    _store(out, name, f'# {name}\n\n{text}\n')


def _measure(name: str, seeds: int) -> Results:
    if name in PAPERS:
        results: Results = import_module(f'research.{_folder(name)}.{name}').measure(seeds)
    elif name in SEEDED:
        results = import_module(f'benchmarks.{name}').measure(seeds)
    else:
        results = import_module(f'benchmarks.{name}').measure()
    return results


def _folder(name: str) -> str:
    return 'peers' if name == 'peers' else 'papers'


def _written(item: Table | Plot, out: Path) -> str:
    """Return the Markdown of a result; save a plot to its file."""
    from benchmarks.tables import Table, as_markdown  # noqa: PLC0415

    if isinstance(item, Table):
        return as_markdown(item)
    path = out.parent / 'plots' / f'{item.name}.svg'
    path.parent.mkdir(exist_ok=True)
    # Without the date, so that equal numbers give equal files.
    item.figure.savefig(path, metadata={'Date': None})
    return f'### {item.title}\n\n![{item.title}](../plots/{path.name})\n\n{item.note}'


def _circumstances(load_before: float) -> str:
    python, libraries = platform.python_version(), ', '.join(f'{name} {version(name)}' for name in ('numpy', 'scipy'))
    load = f'load {load_before:.1f} before and {os.getloadavg()[0]:.1f} after'
    return f'Revision {_revision()}; Python {python}, {libraries}; {os.cpu_count()} cores, {load}.'


def _revision() -> str:
    """Return the measured revision, with "-dirty" if files other than the results have uncommitted changes."""
    if not (revision := _git('describe', '--always')):
        return 'unknown'
    results = tuple(f':(exclude)benchmarks/{name}' for name in ('RESULTS.md', 'results', 'plots'))
    changed = _git('status', '--porcelain', '--untracked-files=no', '--', '.', *results)
    return f'{revision}-dirty' if changed else revision


def _git(*arguments: str) -> str:
    answer = subprocess.run(('git', *arguments), cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return answer.stdout.strip()


def _store(out: Path, name: str, text: str) -> None:
    """Write the full tables of one part, and the summary of all parts that have been measured."""
    from benchmarks.summary import summary  # noqa: PLC0415

    folder = out.parent / 'results'
    folder.mkdir(exist_ok=True)
    (folder / f'{name}.md').write_text(text, encoding='utf-8')
    out.write_text(summary(folder, _ALL), encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""All benchmarks, or some: ``python benchmarks/run.py [--only NAME ...] [--seeds N] [--out FILE]``.

Every part prints its tables and takes its own section of the Markdown file; sections of parts that did not
run stay as they were. Plots go to a folder beside the file.
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
    from collections.abc import Sequence

    from benchmarks.tables import Plot, Table

    Results = Sequence[Table | Plot]

REPOSITORY: Final = Path(__file__).resolve().parents[1]
PARTS: Final = ('cost', 'live', 'replay', 'memory', 'accuracy')
# The resistance on real trains, and the discrepancy workflow on hidden cases: more of them with more seeds.
SEEDED: Final = ('real_trains', 'unknowns', 'rates', 'brake_worlds', 'explain')
# Experiments of the four papers and comparisons with peers: modules of benchmarks.papers, repeated over seeds.
PAPERS: Final = ('liu2018', 'resistance', 'yuan2017', 'xia2023', 'zheng2015', 'peers')
_ALL: Final = (*PARTS, *SEEDED, *PAPERS)
_TITLE: Final = '# Results of the benchmarks\n\nMade by `make bench`; see `benchmarks/` for what each part measures.\n'
_SECTION: Final = '\n## '


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts asked for, print their tables and write them down."""
    parser = argparse.ArgumentParser(prog='benchmarks/run.py', description=__doc__.splitlines()[0])
    which = f'run only these: {", ".join(_ALL)}'
    parser.add_argument('--only', action='extend', nargs='+', choices=_ALL, metavar='NAME', help=which)
    parser.add_argument('--out', type=Path, metavar='FILE', default=REPOSITORY / 'benchmarks' / 'RESULTS.md')
    parser.add_argument('--seeds', type=int, default=60, metavar='N', help='repetitions of seeded parts (default 60)')
    args = parser.parse_args(arguments)
    prepare()
    for name in _ALL:
        if args.only is None or name in args.only:
            _run(name, args.seeds, args.out)
    print(f'written to {args.out}')
    return 0


def prepare() -> None:
    """Let this process and its children find the benchmarks, and calculate in one thread each."""
    sys.path[0] = str(REPOSITORY)
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')


def _run(name: str, seeds: int, out: Path) -> None:
    # Imported only now, so that the number of threads is set before numpy loads.
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
    _store(out, name, f'{name}\n\n{text}\n')


def _measure(name: str, seeds: int) -> Results:
    if name in PAPERS:
        results: Results = import_module(f'benchmarks.papers.{name}').measure(seeds)
    elif name in SEEDED:
        results = import_module(f'benchmarks.{name}').measure(seeds)
    else:
        results = import_module(f'benchmarks.{name}').measure()
    return results


def _written(item: Table | Plot, out: Path) -> str:
    """Return the Markdown of a result; a plot is drawn into its file."""
    from benchmarks.tables import Table, as_markdown  # noqa: PLC0415

    if isinstance(item, Table):
        return as_markdown(item)
    path = out.parent / 'plots' / f'{item.name}.svg'
    path.parent.mkdir(exist_ok=True)
    # Without date and random names, so that the same numbers make the same file.
    item.figure.savefig(path, metadata={'Date': None})
    return f'### {item.title}\n\n![{item.title}](plots/{path.name})\n\n{item.note}'


def _circumstances(load_before: float) -> str:
    python, libraries = platform.python_version(), ', '.join(f'{name} {version(name)}' for name in ('numpy', 'scipy'))
    load = f'load {load_before:.1f} before and {os.getloadavg()[0]:.1f} after'
    return f'Revision {_revision()}; Python {python}, {libraries}; {os.cpu_count()} cores, {load}.'


def _revision() -> str:
    """Return the revision measured; "-dirty" if files other than the results had been changed since."""
    if not (revision := _git('describe', '--always')):
        return 'unknown'
    results = (':(exclude)benchmarks/RESULTS.md', ':(exclude)benchmarks/plots')
    changed = _git('status', '--porcelain', '--untracked-files=no', '--', '.', *results)
    return f'{revision}-dirty' if changed else revision


def _git(*arguments: str) -> str:
    answer = subprocess.run(('git', *arguments), cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return answer.stdout.strip()


def _store(out: Path, name: str, section: str) -> None:
    """Replace one section of the file; sections stand in the order of the parts."""
    old = out.read_text(encoding='utf-8').split(_SECTION)[1:] if out.is_file() else []
    sections = {text.split('\n', 1)[0]: text.rstrip() + '\n' for text in old} | {name: section}
    ordered = [sections[part] for part in _ALL if part in sections]
    out.write_text(_SECTION.join([_TITLE, *ordered]), encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Run all or some benchmarks: ``python benchmarks/run.py [--only NAME ...] [--seeds N] [--budget MINUTES]``.

Each part prints its tables and writes them all to ``results/NAME.md`` beside the Markdown file, which is made anew from
these files and shows of each part the tables of its claims. Plots are written to ``plots`` beside it.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from benchmarks.tables import Plot, Table

    Results = Sequence[Table | Plot]

REPOSITORY: Final = Path(__file__).resolve().parents[1]


class Part(NamedTuple):
    measure: str  # Module and function that measure it
    seeds: int  # Number of seeds, or of what else it repeats, if no other is asked for; 0 if it has no such number
    minutes: float  # Time expected with these on two idle cores [min]; 0 if the whole run leaves it out


PARTS: Final[Mapping[str, Part]] = {
    # Computing time and memory.
    'cost': Part('benchmarks.cost:measure', 0, 0.5),
    'live': Part('benchmarks.live:measure', 0, 4.0),
    'replay': Part('benchmarks.replay:measure', 0, 1.5),
    'commands': Part('benchmarks.cost:commands', 0, 1.5),
    'memory': Part('benchmarks.memory:measure', 0, 1.0),
    # Running nodes and damaged files; of kills, soak [min] and damage the number is not of seeds. With the peers they
    # may be of another revision than the other parts.
    'kills': Part('benchmarks.kills:measure', 30, 2.5),
    'soak': Part('benchmarks.soak:measure', 2, 4.5),
    'damage': Part('benchmarks.damage:measure', 100, 1.0),
    'faults_live': Part('benchmarks.faults_live:measure', 0, 9.5),
    # Simulated drives.
    'accuracy': Part('benchmarks.scenario_parts:accuracy', 12, 9.0),
    'real_trains': Part('benchmarks.scenario_parts:real_trains', 4, 4.0),
    'unknowns': Part('benchmarks.scenario_parts:unknowns', 1, 4.0),
    'rates': Part('benchmarks.scenario_parts:rates', 2, 1.0),
    'brake_worlds': Part('benchmarks.scenario_parts:brake_worlds', 3, 3.0),
    # Not of the revision of the others until all are measured anew: 8 minutes.
    'brake_fit': Part('benchmarks.brake_fit:measure', 210, 0.0),
    'faults': Part('benchmarks.fault_matrix:measure', 1, 13.0),
    'healthy': Part('benchmarks.healthy:measure', 6, 2.0),
    'integrity': Part('benchmarks.scenario_parts:integrity', 12, 5.0),
    'explain': Part('benchmarks.explain:measure', 12, 2.5),
    'fleet': Part('benchmarks.fleet:measure', 1, 4.0),
    'closed_loop': Part('benchmarks.closed_loop:measure', 6, 7.0),
    'drives': Part('benchmarks.drives:measure', 1, 1.0),
    # Not in the whole run of the revision of the others.
    'prediction': Part('benchmarks.prediction:measure', 2, 0.0),
    'hazard': Part('benchmarks.hazard:measure', 6, 0.0),
    # Experiments of the four papers, and comparisons with other libraries.
    'liu2018': Part('research.papers.liu2018:measure', 3, 1.0),
    'resistance': Part('research.papers.resistance:measure', 3, 0.5),
    'yuan2017': Part('research.papers.yuan2017:measure', 3, 1.5),
    'xia2023': Part('research.papers.xia2023:measure', 3, 1.0),
    'zheng2015': Part('research.papers.zheng2015:measure', 3, 0.5),
    'peers': Part('research.peers.peers:measure', 2, 4.0),
    'explain_of_runs': Part('benchmarks.explain_of_runs:measure', 8, 0.0),
    'rivals': Part('benchmarks.explain_rivals:measure', 10, 0.0),
    'slides': Part('benchmarks.slides:measure', 3, 0.0),
    'mutation': Part('benchmarks.mutation:measure', 300, 0.0),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the selected parts, print their tables and write the Markdown file."""
    parser = argparse.ArgumentParser(
        prog='benchmarks/run.py',
        description=__doc__.splitlines()[0],
        epilog=_table(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--only', action='extend', nargs='+', choices=PARTS, metavar='NAME', help='run only these parts'
    )
    parser.add_argument('--out', type=Path, metavar='FILE', default=REPOSITORY / 'benchmarks' / 'RESULTS.md')
    parser.add_argument('--seeds', type=int, metavar='N', help='repetitions of all parts that have a number of them')
    budget = 'begin no part after this time, and fail if parts are left (default: no limit)'
    parser.add_argument('--budget', type=float, default=float('inf'), metavar='MINUTES', help=budget)
    args = parser.parse_args(arguments)
    prepare()
    left = [name for name, part in PARTS.items() if (part.minutes if args.only is None else name in args.only)]
    revision, end = _revision(), time.monotonic() + 60 * args.budget
    while left and time.monotonic() < end:
        if _revision() != revision:
            print(f'the sources are no longer those of {revision}: stopped', file=sys.stderr)
            break
        name = left.pop(0)
        _run(name, args.seeds or PARTS[name].seeds, args.out)
    if left:
        print(f'not measured: {", ".join(left)}', file=sys.stderr)
    print(f'written to {args.out}')
    return 1 if left else 0


def _table() -> str:
    """Return the parts with their defaults as text."""
    rows = [
        f'{name:14}{part.seeds or "":>5}  {part.minutes or "not in the whole run"!s:>5}' for name, part in PARTS.items()
    ]
    whole = sum(part.minutes for part in PARTS.values())
    return '\n'.join(('part          seeds  minutes on two idle cores', *rows, f'{"all":14}{whole:12.0f}'))


def prepare() -> None:
    """Make the benchmarks importable and limit numpy to one thread, in this process and its children."""
    added = [str(REPOSITORY), str(REPOSITORY / 'examples' / 'python')]
    sys.path[:1] = added
    # Child processes do not inherit sys.path where they are commands.
    os.environ['PYTHONPATH'] = os.pathsep.join((*added, *filter(None, [os.environ.get('PYTHONPATH')])))
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
    module, _, function = PARTS[name].measure.partition(':')
    measure = getattr(import_module(module), function)
    results: Results = measure(seeds) if PARTS[name].seeds else measure()
    return results


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
    folder = out.parent / 'results'
    folder.mkdir(exist_ok=True)
    (folder / f'{name}.md').write_text(text, encoding='utf-8')
    out.write_text(summary(folder, [*PARTS]), encoding='utf-8')


# Columns of tables that answer a claim, with its target or verdict.
_CLAIM: Final = re.compile(r'^\|.*\| *(met\?|target|verdict) *\|', re.MULTILINE)
# A part without such a table shows its first table if it is at most this long.
_SHORT: Final = 40
_REVISION: Final = re.compile(r'^Revision ([^;\s]+);.*$', re.MULTILINE)
# PART: its claims in RESULTS.md; results/PART: its full tables.
_QUOTE: Final = re.compile(r'<!-- quoted from (results/)?(\w+) -->\n+(.*?)(?:\n\n|\Z)', re.DOTALL)
_FIGURE: Final = re.compile(r'\d*\.?\d+')
# Code, targets of links and separators of thousands.
_NO_FIGURE: Final = re.compile(r'`[^`]*`|\]\([^)]*\)|(?<=\d)[,\u202f](?=\d{3})')


def summary(folder: Path, names: Sequence[str]) -> str:
    """Return the text of RESULTS.md from the files of the parts that have been measured."""
    texts = {name: path.read_text('utf-8') for name in names if (path := folder / f'{name}.md').is_file()}
    parts = '\n'.join(_part(name, text) for name, text in texts.items())
    found = sorted(set(revisions('\n'.join(texts.values()))))
    state = f'All parts: revision {found[0]}.' if len(found) == 1 else f'The parts are of {len(found)} revisions.'
    head = (
        'Generated by `make bench` from the full tables in `results/`; see `benchmarks/` for what each part measures.'
    )
    return f'# Results of the benchmarks\n\n{head}\n{state}\n\n{parts}'


def revisions(text: str) -> list[str]:
    """Return the revision of each part, in order."""
    return _REVISION.findall(text)


def missing_quotes(document: str, results: str, folder: Path) -> list[str]:
    """Return the figures in blocks marked ``<!-- quoted from PART -->`` that no figure of the part rounds to.

    A block ends at a blank line. ``results`` is the text of RESULTS.md; for blocks marked ``<!-- quoted from
    results/PART -->`` the full tables in a folder count.
    """
    return [
        f'{name}: {figure}'
        for full, name, block in _QUOTE.findall(document)
        for text in [(folder / f'{name}.md').read_text('utf-8') if full else _section(results, name)]
        for figure in _figures(block)
        if not any(_rounds_to(own, figure) for own in _figures(text))
    ]


def _part(name: str, text: str) -> str:
    tables = re.findall(r'^### .*?(?=^### |^Revision |\Z)', text, re.MULTILINE | re.DOTALL)
    claims = [table for table in tables if _CLAIM.search(table)]
    shown = claims or [table for table in tables[:1] if table.count('\n') <= _SHORT]
    revision = _REVISION.search(text)
    last = revision.group() if revision else 'Revision unknown; see the full tables.'
    plots_here = ''.join(shown).replace('](../plots/', '](plots/')
    return f'## {name}\n\n{plots_here}{last}\n[All tables](results/{name}.md).\n'


def _section(results: str, name: str) -> str:
    found = re.search(rf'^## {name}\n(.*?)(?=^## |\Z)', results, re.MULTILINE | re.DOTALL)
    return found.group(1) if found else ''


def _figures(text: str) -> list[str]:
    return _FIGURE.findall(_NO_FIGURE.sub('', text))


def _rounds_to(own: str, figure: str) -> bool:
    decimals = len(figure.partition('.')[2])
    return f'{float(own):.{decimals}f}' == figure


if __name__ == '__main__':
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Run the discrepancy workflow on hidden cases: ``python -m benchmarks.explain --generator A --cases 60 --seed 3``.

Prints one line per case, then the tables. The workflow gets the bags and the assumed train file; only the scoring
reads the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

# Must be set before numpy loads, here and in child processes.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from benchmarks.explain_cases import GENERATORS, Generator, draw_specs
from benchmarks.explain_plots import gap_plot, visibility_plot
from benchmarks.explain_score import (
    acceptable,
    alarmed,
    both,
    exact,
    parameter_errors,
    visible,
    within_two,
)
from benchmarks.explain_tables import tables_of, targets
from benchmarks.explain_trial import outcomes
from benchmarks.tables import as_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.explain_trial import Outcome
    from benchmarks.tables import Plot, Table

_SEED: Final = 7001
_CASES_PER_SEED: Final[dict[Generator, float]] = {'A': 5.0, 'B': 2.5}
_JOBS: Final = 2
_PROGRESS_EVERY: Final = 10


def measure(seeds: int) -> list[Table | Plot]:
    """Score five cases of generator A and 2.5 of generator B per seed."""
    by_generator = {generator: _scored(generator, round(each * seeds)) for generator, each in _CASES_PER_SEED.items()}
    everything = [outcome for of_one in by_generator.values() for outcome in of_one]
    tables: list[Table | Plot] = [targets(everything, 'both generators')]
    for generator, of_one in by_generator.items():
        title = f'generator {generator}'
        tables += [targets(of_one, title), *tables_of(of_one, title)]
    return [*tables, visibility_plot(everything), gap_plot(everything)]


def _scored(generator: Generator, count: int) -> list[Outcome]:
    done: list[Outcome] = []
    for outcome in outcomes(draw_specs(generator, _SEED, count), _JOBS):
        done.append(outcome)
        if not len(done) % _PROGRESS_EVERY:
            print(f'generator {generator}: {len(done)} of {count} cases', file=sys.stderr, flush=True)
    # Sorted by name and seed, so that the tables do not depend on the order of completion.
    return sorted(done, key=lambda outcome: (outcome.spec.name, outcome.spec.seed))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the selected cases."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.explain', description=__doc__.splitlines()[0])
    parser.add_argument('--generator', choices=GENERATORS, default='A')
    parser.add_argument('--cases', type=int, default=60, metavar='N')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--names', default='', metavar='A,B', help='effect names to use in turn; pairs joined by +')
    parser.add_argument(
        '--jobs', type=int, default=_JOBS, metavar='N', help='number of processes; 1 runs in this process'
    )
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all outcomes to this file')
    args = parser.parse_args(arguments)
    specs = draw_specs(args.generator, args.seed, args.cases, tuple(filter(None, args.names.split(','))))
    done = []
    for outcome in outcomes(specs, args.jobs):
        done.append(outcome)
        print(f'{len(done)}/{len(specs)} {line_of(outcome)}', flush=True)
    title = f'generator {args.generator}'
    for table in (*tables_of(done, title), targets(done, title)):
        print(f'\n{as_text(table)}')
    if args.json:
        args.json.write_text(json.dumps([asdict(outcome) for outcome in done], indent=1) + '\n', encoding='utf-8')
    return 0


def line_of(outcome: Outcome) -> str:
    """Return a one-line summary of a case."""
    answer = outcome.answer
    found = ' + '.join(
        f'{one.name}[{one.evidence:.0f}]' + ''.join(f'~{twin}' for twin in one.twins) for one in outcome.found
    )
    gap = ' '.join(f'{1e3 * value:.0f}' for value in outcome.gap) if outcome.gap else '-'
    parts = [
        mark(outcome),
        f'{outcome.spec.name} {outcome.spec.seed} vis {"/".join(f"{one.visible:.0f}" for one in answer.effects)} %',
        f'{outcome.verdict}: {found or "-"}',
        f'gap {gap} (floor {1e3 * answer.floor:.0f}) mm/s',
        f'{outcome.align_s:.1f} + {outcome.explain_s:.1f} s for {outcome.runs} runs',
        ' '.join([*(('one_way',) if answer.one_way else ()), *answer.contamination, *answer.flags]) or '-',
        ' '.join(f'{name.partition(".")[2]} {error:+.1f}' for name, error in parameter_errors(outcome)),
    ]
    if outcome.verdict not in {'no_gap', 'explained', 'ambiguous'}:
        parts.append(outcome.remaining)
    return ' | '.join(parts)


def mark(outcome: Outcome) -> str:
    """Return the mark of an outcome: right, set (truth among two names), WRONG or ALARM; in brackets if not visible."""
    kind = outcome.answer.kind
    if kind == 'none':
        return 'ALARM' if alarmed(outcome) else 'right'
    if kind == 'outside':
        result = 'right' if acceptable(outcome) else 'WRONG'
    elif exact(outcome) or (kind == 'pair' and both(outcome)):
        result = 'right'
    else:
        result = 'set' if within_two(outcome) else 'WRONG'
    return result if visible(outcome) else f'({result.lower()})'


if __name__ == '__main__':
    raise SystemExit(main())

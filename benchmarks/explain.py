# SPDX-License-Identifier: Apache-2.0
"""The discrepancy workflow on hidden cases: ``python -m benchmarks.explain --generator A --cases 60 --seed 3``.

Prints a line for each case and the tables. The workflow gets bags and the believed train file; only the scoring
opens the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

# Set before numpy loads, here and in the processes that are started.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from benchmarks.explain_cases import GENERATORS, Generator, draw_specs
from benchmarks.explain_plots import gap_plot, visibility_plot
from benchmarks.explain_score import (
    alarmed,
    both,
    exact,
    honest,
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
    """Score five cases of the first generator and two and a half of the second for each seed."""
    told = {generator: _scored(generator, round(each * seeds)) for generator, each in _CASES_PER_SEED.items()}
    everything = [outcome for of_one in told.values() for outcome in of_one]
    tables: list[Table | Plot] = [targets(everything, 'both generators')]
    for generator, of_one in told.items():
        title = f'generator {generator}'
        tables += [targets(of_one, title), *tables_of(of_one, title)]
    return [*tables, visibility_plot(everything), gap_plot(everything)]


def _scored(generator: Generator, count: int) -> list[Outcome]:
    told: list[Outcome] = []
    for outcome in outcomes(draw_specs(generator, _SEED, count), _JOBS):
        told.append(outcome)
        if not len(told) % _PROGRESS_EVERY:
            print(f'generator {generator}: {len(told)} of {count} cases', file=sys.stderr, flush=True)
    # In the order of names and seeds, so that the tables do not depend on which process was faster.
    return sorted(told, key=lambda outcome: (outcome.spec.name, outcome.spec.seed))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that the arguments ask for."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.explain', description=__doc__.splitlines()[0])
    parser.add_argument('--generator', choices=GENERATORS, default='A')
    parser.add_argument('--cases', type=int, default=60, metavar='N')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--names', default='', metavar='A,B', help='only these, in turn; pairs joined by +')
    parser.add_argument('--jobs', type=int, default=_JOBS, metavar='N', help='processes; 1 stays in this one')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all outcomes down')
    args = parser.parse_args(arguments)
    specs = draw_specs(args.generator, args.seed, args.cases, tuple(filter(None, args.names.split(','))))
    told = []
    for outcome in outcomes(specs, args.jobs):
        told.append(outcome)
        print(f'{len(told)}/{len(specs)} {line_of(outcome)}', flush=True)
    title = f'generator {args.generator}'
    for table in (*tables_of(told, title), targets(told, title)):
        print(f'\n{as_text(table)}')
    if args.json:
        args.json.write_text(json.dumps([asdict(outcome) for outcome in told], indent=1) + '\n', encoding='utf-8')
    return 0


def line_of(outcome: Outcome) -> str:
    """Return one case in a line."""
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
    """Return how an outcome fared: right, set (among two), part (one of two), (unseen) where too small, WRONG."""
    kind = outcome.answer.kind
    if kind == 'none':
        return 'ALARM' if alarmed(outcome) else 'right'
    if kind == 'outside':
        fared = 'right' if honest(outcome) else 'WRONG'
    elif exact(outcome) or (kind == 'pair' and both(outcome)):
        fared = 'right'
    else:
        fared = 'set' if within_two(outcome) else 'WRONG'
    return fared if visible(outcome) else f'({fared.lower()})'


if __name__ == '__main__':
    raise SystemExit(main())

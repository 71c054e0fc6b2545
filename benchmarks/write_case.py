# SPDX-License-Identifier: Apache-2.0
"""Write a hidden case to disk: ``python -m benchmarks.write_case --effect tunnel_drag --seed 7 --out DIR``."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import hidden_cases, hidden_cases_b
from trainid_ros.bag.writer import BagWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_MAKERS: dict[str, Callable[[str, int], hidden_cases.Case | hidden_cases_b.Case]] = {
    'A': hidden_cases.make_case,
    'B': hidden_cases_b.make_case,
}


def write_case(case: hidden_cases.Case | hidden_cases_b.Case, out: Path) -> tuple[Path, ...]:
    """Write assumed.yaml, truth.json and the bags (bag1, ...) to a folder; return the bags."""
    out.mkdir(parents=True, exist_ok=True)
    (out / 'assumed.yaml').write_text(case.train_yaml, encoding='utf-8')
    truth = {'name': case.name, 'seed': case.seed, **asdict(case.truth)}
    (out / 'truth.json').write_text(json.dumps(truth, indent=1) + '\n', encoding='utf-8')
    paths = tuple(out / f'bag{k}' for k in range(1, len(case.bags) + 1))
    for path, records in zip(paths, case.bags, strict=True):
        with BagWriter(path) as writer:
            for record in records:
                writer.write_record(record)
    return paths


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the selected case."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.write_case', description=__doc__.splitlines()[0])
    parser.add_argument('--generator', choices=_MAKERS, default='A')
    parser.add_argument('--effect', required=True, metavar='NAME', help='none, an effect, or some joined by +')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--out', type=Path, required=True, metavar='DIR')
    args = parser.parse_args(arguments)
    write_case(_MAKERS[args.generator](args.effect, args.seed), args.out)
    print(f'written to {args.out}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())

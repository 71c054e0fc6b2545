# SPDX-License-Identifier: Apache-2.0
"""Write a case to disk: ``python -m benchmarks.hidden_cases_b.write --effect tunnel_drag --seed 7 --out DIR``."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.hidden_cases_b.case import make_case
from trainid_ros.bag.writer import BagWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.hidden_cases_b.case import Case


def write_case(case: Case, out: Path) -> tuple[Path, ...]:
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
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.hidden_cases_b.write', description='Write a hidden case.'
    )
    parser.add_argument('--effect', required=True, metavar='NAME', help='none, an effect, or some joined by +')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--out', type=Path, required=True, metavar='DIR')
    args = parser.parse_args(arguments)
    write_case(make_case(args.effect, args.seed), args.out)
    print(f'written to {args.out}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())

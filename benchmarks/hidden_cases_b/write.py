# SPDX-License-Identifier: Apache-2.0
"""Write a case to disk: bags, the believed train file, and the truth apart from both."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from benchmarks.hidden_cases_b.case import Case
from trainid_ros.bags.writer import BagWriter


def write_case(case: Case, folder: Path, truth_folder: Path | None = None) -> tuple[list[Path], Path]:
    """Write bags ``run00``, ... and ``believed.yaml`` into ``folder``, the truth only into ``truth_folder``.

    Returns:
        Paths of the bags, and of the train file.

    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k, records in enumerate(case.bags):
        path = folder / f'run{k:02d}'
        with BagWriter(path) as bag:
            for record in records:
                bag.write_record(record)
        paths.append(path)
    believed = folder / 'believed.yaml'
    believed.write_text(case.train_yaml, encoding='utf-8')
    if truth_folder is not None:
        truth_folder.mkdir(parents=True, exist_ok=True)
        hidden = {'name': case.name, 'seed': case.seed, **dataclasses.asdict(case.truth)}
        (truth_folder / f'{folder.name}.json').write_text(json.dumps(hidden, indent=1), encoding='utf-8')
    return paths, believed

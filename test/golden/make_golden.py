# SPDX-License-Identifier: Apache-2.0
"""Write the expected outputs: estimates of the default algorithms and V-MILS over two simulated runs, every 5 s.

Usage: python test/golden/make_golden.py [DIRECTORY]; the default is the directory of this script.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.yizhuang_day import yizhuang_day
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Output
from trainid_ros.setup.pipelines import (
    RESISTANCE,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.sim.scenario import simulate
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

HERE: Final = Path(__file__).resolve().parent
TRAIN_FILE: Final = HERE.parents[1] / 'config' / 'trains' / 'yizhuang.yaml'
SEED: Final = 2026
RUNS: Final = 2
EVERY_S: Final = 5
Rows = list[dict[str, str]]


def outputs() -> dict[str, Rows]:
    """Return the rows of each estimate by name."""
    train_file = load_train_file(TRAIN_FILE)
    simulation = simulate(yizhuang_day(train_file, runs=RUNS), np.random.default_rng(SEED))
    settings = EstimatorSettings()
    pipelines: dict[str, EstimatorPipeline[Any]] = {
        'resistance': resistance_pipeline(train_file, settings),
        'resistance_vmils': resistance_pipeline(train_file, replace(settings, resistance=RESISTANCE.choose('V-MILS'))),
        'speed_model': speed_model_pipeline(train_file, settings),
        'brake_rate': brake_rate_pipeline(train_file, settings),
    }
    rows: dict[str, Rows] = {name: [] for name in pipelines}
    start_ns = simulation.records[0].stamp_ns
    due = dict.fromkeys(pipelines, 0)
    for record in simulation.records:
        for name, pipeline in pipelines.items():
            for output in pipeline.push(record):
                if output.stamp_ns - start_ns >= due[name]:
                    rows[name].append(_row(output))
                    due[name] += EVERY_S * NS_PER_S
    return rows


def _row(output: Output[Any]) -> dict[str, str]:
    row = {'stamp_ns': str(output.stamp_ns), 'status': output.status.name}
    row |= {'used': str(output.used), 'rejected': str(output.rejected)}
    for item in fields(output.estimate):
        value = getattr(output.estimate, item.name)
        if item.name == 'covariance':
            size = round(len(value) ** 0.5)
            row |= {f'variance_{i}': repr(float(value[i * (size + 1)])) for i in range(size)}
        else:
            row[item.name] = repr(value) if isinstance(value, bool) else repr(float(value))
    return row


def main(arguments: Sequence[str]) -> int:
    """Write one file for each estimate."""
    folder = Path(arguments[0]) if arguments else HERE
    for name, rows in outputs().items():
        with (folder / f'{name}.csv').open('w', encoding='utf-8', newline='') as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator='\n')
            writer.writeheader()
            writer.writerows(rows)
        print(f'{name}.csv: {len(rows)} rows')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))

# SPDX-License-Identifier: Apache-2.0
"""How many files and Python calls a sample passes from its records to the published estimates, on the sources."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import islice
from operator import methodcaller
from pathlib import Path
from statistics import median
from types import CodeType, FrameType
from typing import Any

import trainid_ros
from trainid_ros.bag.reader import BagReader
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.results import Output
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
from trainid_ros.train.train_file import load_train_file

PACKAGE = Path(trainid_ros.__file__).parent
BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
# Records before those counted, and number of these: half a run.
FIRST, COUNT = 1000, 1500
MAX_FILES = 30
# The checks of the inputs take about 95 of them, the hypotheses of the filter bank two each: about 45.
MAX_CALLS = 550


def count() -> tuple[float, float]:
    """Return files of the package and Python calls that a sample takes in three estimators, medians over a run."""
    train_file = load_train_file(BAG / 'train.yaml')
    with BagReader(BAG) as reader:
        records = list(reader.records())
    group = PipelineGroup([kind.pipeline(train_file, EstimatorSettings()) for kind in KINDS])
    outputs: list[Output[Any]] = []
    files: list[int] = []
    calls: list[int] = []
    called: list[CodeType] = []

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if len(outputs) == len(KINDS):  # all estimates of a sample are published
            files.append(len({code.co_filename for code in called if code.co_filename.startswith(str(PACKAGE))}))
            calls.append(len(called))
            called.clear()
            outputs.clear()
        if event == 'call':
            called.append(frame.f_code)

    rows = map(methodcaller('row'), records)
    group.push_rows(islice(rows, FIRST))
    sys.setprofile(note)
    try:
        group.push_rows(islice(rows, COUNT), outputs.append)
    finally:
        sys.setprofile(None)
    return median(files), median(calls)


def test_a_sample_passes_few_files_and_calls() -> None:
    done = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | {'TRAINID_COMPILED': '0'},
        capture_output=True,
        text=True,
        check=True,
    )
    files, calls = map(float, done.stdout.split())
    print(f'a sample passes {files:.0f} files and {calls:.0f} calls')
    assert files <= MAX_FILES
    assert calls <= MAX_CALLS


if __name__ == '__main__':
    print(*count())

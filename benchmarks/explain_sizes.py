# SPDX-License-Identifier: Apache-2.0
"""Sizes of noise and nuisances that :mod:`trainid_ros.explain.likelihood` finds where nothing is hidden.

Its priors were compared with them: at a right prior the mean of the logs found is that of the prior. Run it by
``python -m benchmarks.explain_sizes``; it takes minutes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from benchmarks.explain import Generator, draw_specs, open_case, runs_of
from trainid_ros.explain.dataset import Array
from trainid_ros.explain.model import Model
from trainid_ros.train.train_file import parse_train_file

NAMES: Final = ('speed m/s', 'gust N/kN', 'gust time s', 'jitter s', 'payload', 'brake', 'map per mille')
_SEEDS: Final[dict[Generator, int]] = {'A': 529165, 'B': 529166, 'C': 529167}
_DRAWN: Final = 100
_CASES: Final = 12


def logs_of(generator: Generator, seed: int, count: int) -> Array:
    """Return the logs found on those of the first ``count`` cases without a hidden effect that are weighed, (n, 7)."""
    clean = [spec for spec in draw_specs(generator, seed, _DRAWN) if spec.name == 'none'][:count]
    found: list[Array] = []
    for spec in clean:
        case = open_case(spec)
        assumed = parse_train_file(case.train_yaml, 'assumed train file')
        model = Model.of(runs_of(case.bags, assumed), assumed)
        if model.weighed:
            found.append(model.evidence().maximise()[1])
    return np.array(found)


def rows(logs: Array) -> list[str]:
    """Return one line for each size: its name, the median found, and the std of its log."""
    sizes = zip(NAMES, np.exp(np.median(logs, axis=0)), logs.std(axis=0), strict=True)
    return [f'{name:14}{median:8.3g}{spread:8.2f}' for name, median, spread in sizes]


def main() -> None:
    """Print the sizes of each generator."""
    for generator, seed in _SEEDS.items():
        print(f'\n{generator:14}  median  std of log')
        print('\n'.join(rows(logs_of(generator, seed, _CASES))))


if __name__ == '__main__':
    main()

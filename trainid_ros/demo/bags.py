# SPDX-License-Identifier: Apache-2.0
"""The bags of the demo: a folder with the bag, its train file and, if known, its truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trainid_ros.package_files import shared_path
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile

TRAIN_FILE: Final = 'train.yaml'
TRUTH_FILE: Final = 'truth.yaml'
STOCK: Final = {'altrios': 'altrios_manifest', 'yizhuang': 'yizhuang_day'}
_TITLES: Final = {
    'altrios_manifest': 'Freight train on a real route, from an independent simulator',
    'yizhuang_day': 'A day on the Beijing Yizhuang line',
}


@dataclass(frozen=True, slots=True)
class DemoBag:
    """A bag with its title, train file and, if known, truth."""

    path: Path
    title: str
    train_path: Path
    train_file: TrainFile
    truth: Truth | None


def load_demo_bag(path: Path) -> DemoBag:
    """Load the train file and, if there is one, the truth in the folder of a bag.

    Raises:
        InputError: There is no train file in it, or a file cannot be used.
    """
    train_path, truth_path = path / TRAIN_FILE, path / TRUTH_FILE
    train_file = load_train_file(train_path)
    truth = load_truth(truth_path) if truth_path.is_file() else None
    return DemoBag(path, _TITLES.get(path.name, path.name), train_path, train_file, truth)


def stock_bag(name: str) -> Path:
    """Return the folder of a stock bag, in the source tree or in the installed share directory.

    Raises:
        InputError: It is in neither.
    """
    return shared_path(f'bags/{STOCK[name]}')

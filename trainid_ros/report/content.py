# SPDX-License-Identifier: Apache-2.0
"""What a report says: chapters of traces with the numbers that belong to them."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Final

from trainid_ros import __version__

if TYPE_CHECKING:
    from trainid_ros.core.results import BrakeRateEstimate, Reason, ResistanceEstimate, SpeedModelEstimate
    from trainid_ros.estimators.pipeline import Output
    from trainid_ros.report.traces import Traces
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile

_LIBRARIES: Final = ('numpy', 'scipy', 'rclpy')


@dataclass(frozen=True, slots=True)
class RejectionCounts:
    """Why records and samples were not used by one estimator: (reason, how often)."""

    estimator: str
    counts: tuple[tuple[Reason, int], ...]


@dataclass(frozen=True, slots=True)
class Chapter:
    """One drive in a report.

    Attributes:
        title: Heading.
        bag: Name of the bag.
        train_file_name: Name of the train file.
        train_file: What was believed before.
        how: How it was run, in words.
        traces: What to plot.
        resistance: Last output of the resistance.
        speed_model: Last output of AM-VFF-RLS.
        brake_rate: Last output of GSMA.
        rejections: Why samples were not used, by estimator.
        truth: What was true, None if nobody knows.
        notes: Further sentences, such as the outcome of a comparison.

    """

    title: str
    bag: str
    train_file_name: str
    train_file: TrainFile
    how: str
    traces: Traces
    resistance: Output[ResistanceEstimate]
    speed_model: Output[SpeedModelEstimate]
    brake_rate: Output[BrakeRateEstimate]
    rejections: tuple[RejectionCounts, ...]
    truth: Truth | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Report:
    """A report: title and chapters."""

    title: str
    chapters: tuple[Chapter, ...]


def versions() -> tuple[str, ...]:
    """Return names and versions of what computed the numbers; libraries that are not installed are left out."""
    found = [f'trainid_ros {__version__}', f'Python {platform.python_version()}']
    for library in _LIBRARIES:
        try:
            found.append(f'{library} {version(library)}')
        except PackageNotFoundError:
            continue
    return tuple(found)

# SPDX-License-Identifier: Apache-2.0
"""Content of a report: chapters of traces with their estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import Replay
    from trainid_ros.interface.results import BrakeRateEstimate, Output, Reason, ResistanceEstimate, SpeedModelEstimate
    from trainid_ros.report.traces import Traces
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class RejectionCounts:
    """Records and samples that one estimator did not use."""

    estimator: str  # Name of the estimator
    counts: tuple[tuple[Reason, int], ...]  # Number by reason


@dataclass(frozen=True, slots=True)
class Chapter:
    """One drive in a report."""

    title: str  # Heading
    bag: str  # Name of the bag
    train_file_name: str  # Name of the train file
    train_file: TrainFile  # The train file, whose values are the priors
    how: str  # How the estimators were run, as text
    traces: Traces  # Time series to plot
    resistance: Output[ResistanceEstimate]  # Last output of the resistance estimator
    speed_model: Output[SpeedModelEstimate]  # Last output of AM-VFF-RLS
    brake_rate: Output[BrakeRateEstimate]  # Last output of GSMA
    rejections: tuple[RejectionCounts, ...]  # Rejected samples by estimator
    truth: Truth | None = None  # True parameters, None if unknown
    notes: tuple[str, ...] = ()  # Further sentences, such as the outcome of a comparison


@dataclass(frozen=True, slots=True)
class Report:
    """A report: title and chapters."""

    title: str
    chapters: tuple[Chapter, ...]


def chapter_of(
    outcome: Replay,
    traces: Traces,
    *,
    title: str,
    bag: str,
    train_file_name: str,
    train_file: TrainFile,
    how: str,
    truth: Truth | None = None,
    notes: tuple[str, ...] = (),
) -> Chapter:
    """Return the chapter of a replay; see :class:`Chapter` for the arguments."""
    return Chapter(
        title=title,
        bag=bag,
        train_file_name=train_file_name,
        train_file=train_file,
        how=how,
        traces=traces,
        resistance=outcome.resistance.output,
        speed_model=outcome.speed_model.output,
        brake_rate=outcome.brake_rate.output,
        rejections=(
            RejectionCounts('resistance', outcome.resistance.rejections),
            RejectionCounts('speed model', outcome.speed_model.rejections),
            RejectionCounts('brake rate', outcome.brake_rate.rejections),
        ),
        truth=truth,
        notes=notes,
    )

# SPDX-License-Identifier: Apache-2.0
"""Content of a report: chapters of traces with their estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import Replay
    from trainid_ros.report.traces import Traces
    from trainid_ros.results import BrakeRateEstimate, Output, Reason, ResistanceEstimate, SpeedModelEstimate
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class RejectionCounts:
    """Records and samples that one estimator did not use.

    Attributes:
        estimator: Name of the estimator.
        counts: Number by reason.

    """

    estimator: str
    counts: tuple[tuple[Reason, int], ...]


@dataclass(frozen=True, slots=True)
class Chapter:
    """One drive in a report.

    Attributes:
        title: Heading.
        bag: Name of the bag.
        train_file_name: Name of the train file.
        train_file: The train file, whose values are the priors.
        how: How the estimators were run, as text.
        traces: Time series to plot.
        resistance: Last output of the resistance estimator.
        speed_model: Last output of AM-VFF-RLS.
        brake_rate: Last output of GSMA.
        rejections: Rejected samples by estimator.
        truth: True parameters, None if unknown.
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

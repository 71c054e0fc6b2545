# SPDX-License-Identifier: Apache-2.0
"""Make a chapter of a report from a replay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.report.content import Chapter, RejectionCounts

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import Replay
    from trainid_ros.report.traces import Traces
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile


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

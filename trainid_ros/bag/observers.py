# SPDX-License-Identifier: Apache-2.0
"""An observer of a replay that collects traces for plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.report.traces import TraceRecorder

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.bag.reader import LoggedRecord
    from trainid_ros.report.traces import Traces


class TraceObserver:
    """Collects traces for a report."""

    def __init__(self) -> None:
        self._recorder = TraceRecorder()

    def on_record(self, entry: LoggedRecord) -> None:
        """Trace an input."""
        self._recorder.on_record(entry.record)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002 - plots use the stamps
        """Trace an output."""
        self._recorder.on_output(output)

    def finish(self) -> Traces:
        """Return what was collected."""
        return self._recorder.finish()

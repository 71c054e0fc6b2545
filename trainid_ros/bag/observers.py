# SPDX-License-Identifier: Apache-2.0
"""Observers of a replay: a bag that records everything, and traces for plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.report.traces import TraceRecorder

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.bag.reader import LoggedRecord
    from trainid_ros.bag.writer import BagWriter
    from trainid_ros.report.traces import Traces


class BagRecorder:
    """Writes inputs and estimates to a bag, logged when they arrived or would have been published."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer

    def on_record(self, entry: LoggedRecord) -> None:
        """Write an input with its own log time, so that the new bag replays in the same order."""
        self._writer.write_record(entry.record, entry.log_ns)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        """Write an estimate, and its latched copy if it is valid."""
        self._writer.write_estimate(output, log_ns)


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

# SPDX-License-Identifier: Apache-2.0
"""Several pipelines that take in the same records share the streams that would give the same samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from trainid_ros.estimators.contradiction import Contradiction
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.errors import TrainIdError
from trainid_ros.interface.records import Row
from trainid_ros.interface.results import Output
from trainid_ros.interface.scalars import seconds
from trainid_ros.stream.sample_stream import SampleStream, StreamEvent
from trainid_ros.stream.samples import Sample


def share_streams(pipelines: Iterable[EstimatorPipeline[Any]]) -> tuple[SampleStream, ...]:
    """Let pipelines whose streams are new and would give the same samples share one; return the streams."""
    streams: list[SampleStream] = []
    for pipeline in pipelines:
        equal = [stream for stream in streams if stream.equals(pipeline.stream)]
        if equal:
            pipeline.stream = equal[0]
        else:
            streams.append(pipeline.stream)
    return tuple(streams)


class SharedRecord:
    """One record for several pipelines: it goes once into each of their streams, as they are at that time."""

    def __init__(self, row: Row) -> None:
        self._row = row
        self._streams: list[SampleStream] = []
        self._events: list[list[StreamEvent] | None] = []

    def events(self, stream: SampleStream) -> list[StreamEvent]:
        """Return what a stream makes of the record; TrainIdError if it has failed for another pipeline."""
        for k in range(len(self._streams)):
            if self._streams[k] is stream:
                events = self._events[k]
                if events is None:
                    raise TrainIdError('the stream that it shares with another estimator has failed')
                return events
        self._streams.append(stream)
        self._events.append(None)  # until it has succeeded
        topic, stamp_ns, x, y, flag = self._row
        events = self._events[-1] = stream.push_row(topic, stamp_ns, x, y, flag)
        return events


class PipelineGroup:
    """Pipelines that take in the same records; those whose streams would give the same samples share one."""

    def __init__(self, pipelines: Sequence[EstimatorPipeline[Any]]) -> None:
        share_streams(pipelines)
        self._pipelines, self.contradiction = list(pipelines), Contradiction()  # of the inputs of the first
        self._first_ns = self._newest_ns = self._before_ns = 0

    @property
    def covered_s(self) -> float:
        """Time covered by the samples [s]; where stamps jump back the time before counts too."""
        return seconds(self._before_ns + self._newest_ns - self._first_ns)

    def push_rows(self, rows: Iterable[Row], publish: Callable[[Output[Any]], object] | None = None) -> int:
        """Take in rows of records; return their number. For ``publish`` see :meth:`EstimatorPipeline.take`."""
        count = 0
        for row in rows:
            record = SharedRecord(row)
            for event in record.events(self._pipelines[0].stream):  # the others have the same stamps
                if isinstance(event, Sample):
                    self._cover(event.stamp_ns)
                    self.contradiction.follow(self._pipelines[0].stream.finding, self.covered_s)
            for pipeline in self._pipelines:
                pipeline.take(record.events(pipeline.stream), publish)
            count += 1
        return count

    def _cover(self, stamp_ns: int) -> None:
        if stamp_ns < self._newest_ns:
            self._before_ns += self._newest_ns - self._first_ns
            self._first_ns = stamp_ns
        self._first_ns = self._first_ns or stamp_ns
        self._newest_ns = stamp_ns

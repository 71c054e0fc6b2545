# SPDX-License-Identifier: Apache-2.0
"""The estimators over a bag: records in the order of the log go into the pipelines of the live nodes.

Nothing is computed here; a replay is deterministic and equals what nodes that miss no message publish.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain, islice
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol

from trainid_ros.bag.reader import PROGRESS_EVERY, BagReader, LoggedRecord, require_topics
from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineGroup
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, Row, record_of
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    EstimateT,
    Output,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
)
from trainid_ros.setup.pipelines import (
    BrakeRatePipeline,
    EstimatorSettings,
    ResistancePipeline,
    SpeedModelPipeline,
    brake_findings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from trainid_ros.estimators.consistency import Consistency
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.stream.sample_stream import Contradiction
    from trainid_ros.train.train_file import TrainFile

AnyOutput = Output[ResistanceEstimate] | Output[SpeedModelEstimate] | Output[BrakeRateEstimate]


class Observer(Protocol):
    """Receives all inputs and outputs of a replay, in order."""

    def on_record(self, entry: LoggedRecord) -> None:
        """Receive an input before the estimators do."""

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        """Receive an output and the log time [ns] of the input that completed its sample."""


@dataclass(frozen=True, slots=True)
class Result(Generic[EstimateT]):
    """State of one estimator at the end of a replay."""

    prior: EstimateT  # Estimate before the first record
    output: Output[EstimateT]  # Last output
    samples: int  # Aligned samples since the last reset
    # Why records and samples were not used, with their counts, the most frequent reason first
    rejections: tuple[tuple[Reason, int], ...]
    statuses: tuple[int, ...]  # Number of outputs by status since the last reset
    resets: int  # Number of resets after a backward jump of the stamps
    consistency: Consistency  # Whether errors agree with the stated uncertainty, over the last samples used
    # Why the estimate is CONVERGING although its standard deviation is small enough, else empty
    why_converging: str = ''


@dataclass(frozen=True, slots=True)
class Replay:
    """The outcome of a replay."""

    records: int  # Number of inputs read
    duration_s: float  # Time covered by the samples
    resistance: Result[ResistanceEstimate]
    speed_model: Result[SpeedModelEstimate]
    brake_rate: Result[BrakeRateEstimate]
    contradiction: Contradiction  # The last contradiction between the inputs, if there was one
    brake_findings: tuple[str, ...] = ()  # What is wrong with the brake of the train file

    def why_no_resistance(self) -> str:
        """Return why nothing was learned of the resistance, with the most frequent rejection; '' if it was."""
        result = self.resistance
        output = result.output
        if output.used and output.estimate.speed_max > 0.0:
            return ''
        text = f'nothing was learned of the resistance: {result.samples} samples, {output.used} used'
        if self.contradiction.finding:
            return f'{text}; {self.contradiction.text}'
        if result.rejections:
            reason, count = result.rejections[0]
            text += f', most often rejected: {reason.name} ({count} times), last: {output.last_rejection}'
        return text


class Pipelines(NamedTuple):
    """The three estimators, before the first record."""

    resistance: ResistancePipeline
    speed_model: SpeedModelPipeline
    brake_rate: BrakeRatePipeline


def replay(
    reader: BagReader,
    train_file: TrainFile,
    settings: EstimatorSettings,
    progress: Callable[[float], None] | None = None,
    observers: Sequence[Observer] = (),
    *,
    duration_s: float = math.inf,
) -> Replay:
    """Run the three estimators over an open bag, or the first ``duration_s`` of it by log time [s].

    ``progress`` is called with the number of inputs read since its last call. Observers receive inputs and outputs;
    nothing else is kept, so memory does not grow with the bag.

    Raises:
        InputError: A required topic has no messages, or a message cannot be read.
    """
    pipelines = Pipelines(
        resistance_pipeline(train_file, settings),
        speed_model_pipeline(train_file, settings),
        brake_rate_pipeline(train_file, settings),
    )
    return replay_through(pipelines, reader, progress, observers, duration_s=duration_s)


def replay_through(
    pipelines: Pipelines,
    reader: BagReader,
    progress: Callable[[float], None] | None = None,
    observers: Sequence[Observer] = (),
    *,
    duration_s: float = math.inf,
) -> Replay:
    """Run estimators that may each have settings of their own; see :func:`replay`."""
    require_topics(reader)
    resistance, speed_model, brake_rate = pipelines
    group, records, log_ns = PipelineGroup(pipelines), 0, 0
    priors = (resistance.current().estimate, speed_model.current().estimate, brake_rate.current().estimate)
    start_ns, _ = reader.time_range() or (0, 0)
    end_ns = math.inf if math.isinf(duration_s) else start_ns + round(duration_s * NS_PER_S)

    def observed() -> Iterator[Row]:
        """Yield the rows, each after the observers have received it."""
        nonlocal log_ns
        for log_ns, row in reader.rows(end_ns):
            entry = LoggedRecord(log_ns, INPUT_TOPICS[row[0]].name, record_of(*row))
            for observer in observers:
                observer.on_record(entry)
            yield row

    def publish(output: AnyOutput) -> None:
        for observer in observers:
            observer.on_output(output, log_ns)

    rows = observed() if observers else chain.from_iterable(table.rows() for table in reader.tables(end_ns))
    while count := group.push_rows(islice(rows, PROGRESS_EVERY), publish if observers else None):
        records += count
        if progress is not None:
            progress(count)
    group.contradiction.finding = reader.mapping.named(group.contradiction.finding)
    return Replay(
        records,
        group.covered_s,
        _result(resistance, priors[0], reader.mapping),
        _result(speed_model, priors[1], reader.mapping),
        _result(brake_rate, priors[2], reader.mapping),
        group.contradiction,
        tuple(reader.mapping.named(finding) for finding in brake_findings(brake_rate)),
    )


def _result(pipeline: EstimatorPipeline[EstimateT], prior: EstimateT, mapping: Mapping) -> Result[EstimateT]:
    return Result(
        prior,
        pipeline.current(),
        pipeline.samples,
        tuple(pipeline.rejections.most_common()),
        tuple(pipeline.statuses),
        pipeline.resets,
        pipeline.consistency,
        mapping.named(pipeline.why_converging),
    )

# SPDX-License-Identifier: Apache-2.0
"""Read the runs of several bags on one time scale; long bags are read in parallel, each in its own process."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from trainid_ros.bag.mcap_file import MAX_CHUNK
from trainid_ros.bag.reader import BagReader, in_two, require_topics
from trainid_ros.bag.worker_pool import each_bag, killed_message, processors
from trainid_ros.explain.dataset import BRAKING, Run, RunCollector, numbered
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason
from trainid_ros.interface.text import listed
from trainid_ros.stream.alignment import AlignmentConfig, TimeJump
from trainid_ros.stream.input_faults import InputFaults
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import STANDING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.train.train_file import TrainFile

POOL_FROM: Final = 100_000  # inputs from which worker processes pay for the second that they take to start
_MAX_CONTRADICTORY: Final = 0.25  # share of contradictory samples above which findings are not to be trusted [1]
# Share of the samples by which those with a wrong unit or sign may outnumber those with any other contradiction [1]. In
# 2900 bags of hidden cases effects look like it by 0.02 or less, and by 0.07 for 12 s of one short bag; faults from the
# middle of a bag on by 0.1 to 0.5.
_MAX_MISREAD: Final = 0.1
_LEAST_MISREAD: Final = 150  # samples, 30 s: the check keeps a finding for 10 s at least, even a wrong one


@dataclass(frozen=True, slots=True)
class _Reading:
    """Runs of one bag, in seconds since its first sample at ``origin_ns`` (0: none), and what reading found wrong."""

    runs: tuple[Run, ...]
    origin_ns: int
    warnings: tuple[str, ...]
    contradiction: str = ''  # Which input has a wrong unit or sign, is stuck, or has two publishers; empty if none


def survey(
    paths: Sequence[Path],
    namespace: str = '/',
    max_chunk: int = MAX_CHUNK,
    inputs: Callable[[], MappedInputs] | None = None,
    advance: Callable[[float], None] = lambda _: None,
) -> tuple[list[int], list[str]]:
    """Check that all bags can be used; ``advance`` is called with the number of bags opened since.

    Return the number of input messages in each, and faults that do not prevent reading. InputError if one is given
    twice, cannot be read, or lacks a required topic.
    """
    places = [path.resolve() for path in paths]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise InputError(f'{paths[i]}: given twice; its data would count twice')
    counts, warnings = list[int](), list[str]()
    for path in paths:
        opening, rest = in_two(advance, opening_share=1.0)
        with BagReader(path, namespace, max_chunk, inputs, opening=opening) as reader:
            require_topics(reader)
            counts.append(reader.input_count)
            warnings += reader.warnings
        rest(1.0)
    return counts, warnings


def read_runs(
    paths: Sequence[Path],
    train_file: TrainFile,
    namespace: str = '/',
    max_chunk: int = MAX_CHUNK,
    inputs: Callable[[], MappedInputs] | None = None,
    *,
    workers: int = 1,
    advance: Callable[[float], None] = lambda _: None,
    warn: Callable[[str], None] = lambda _: None,
) -> list[Run]:
    """Return the runs of all bags, numbered by their places in ``paths``, in seconds since the earliest sample of all.

    ``namespace``, ``max_chunk`` and ``inputs`` are those of :class:`BagReader`. One worker reads in this process.
    ``advance`` is called with the number of inputs read since its last call, ``warn`` with each fault that only reading
    shows, such as messages that cannot be read. InputError if a bag cannot be read, or the process that read it was
    killed. NoAnswerError, naming bag and topic, if inputs contradict each other as no train does: by units, signs, a
    stuck speed or two publishers.
    """

    def killed(item: tuple[int, Path]) -> _Reading:
        raise InputError(killed_message(item[1]))

    work = partial(_read, train_file, (namespace, max_chunk, inputs))
    readings = [reading for _, reading in sorted(each_bag(work, list(enumerate(paths)), workers, advance, killed))]
    for reading in readings:
        for line in reading.warnings:
            warn(line)
    if contradictions := [reading.contradiction for reading in readings if reading.contradiction]:
        raise NoAnswerError(
            f'{listed(contradictions, 3)}; correct what publishes it, or state its unit and sign with --map'
        )
    known = [reading for reading in readings if reading.origin_ns]
    first_ns = min((reading.origin_ns for reading in known), default=0)
    return numbered(
        replace(run, time=run.time + (reading.origin_ns - first_ns) / NS_PER_S)
        for reading in known
        for run in reading.runs
    )


def worker_count(inputs: Sequence[int]) -> int:
    """Return the number of processes for reading bags with these numbers of inputs."""
    return 1 if sum(inputs) < POOL_FROM else min(len(inputs), processors())


def _read(
    train_file: TrainFile,
    how: tuple[str, int, Callable[[], MappedInputs] | None],
    item: tuple[int, Path],
    advance: Callable[[float], None],
) -> _Reading:
    bag, path = item
    # The train file itself may be wrong, so it must not decide which samples are used.
    known_force, collector = KnownForce(train_file), RunCollector(train_file, bag)
    faults = InputFaults(known_force)
    samples = contradictory = 0
    misread = Counter[str]()  # Samples by what is wrong
    # Samples of a train that brakes, by whether the last command that was not 0 was positive.
    braked, is_positive = [0, 0], False
    with BagReader(path, *how) as reader:
        config = StreamConfig(train_file, reader.mapping.alignment(AlignmentConfig()), rejects_faults=False)
        stream = SampleStream(config)
        known = len(reader.warnings)
        for _, event in reader.events(stream, advance):
            if isinstance(event, Sample):
                collector.add(event)
                faults.take(event)
                samples += 1
                contradictory += faults.finding != ''
                if said := faults.misread:
                    misread[said] += 1
                is_positive = is_positive and not event.brake_command < 0.0
                braked[is_positive] += known_force.traction(event.force, event) < BRAKING
            elif isinstance(event, TimeJump):
                collector.start_over()
            elif event.reason is Reason.OUT_OF_RANGE and event.limit == 0.0:  # speeds below it, brake commands above it
                is_positive = is_positive or event.value > 0.0
                is_negative = event.value < -STANDING
                samples += is_negative
                misread['ato/speed has the wrong sign: it is negative'] += is_negative
        warnings = reader.warnings[known:]

    def told(share: float, said: str, of: str = 'time') -> str:
        return f'{path}: inputs contradict each other for {share:.0%} of the {of}: {reader.mapping.named(said)}'

    contradiction = ''
    if braked[True] > _MAX_CONTRADICTORY * sum(braked):
        said = 'ato/brake_command has the wrong sign: it is positive while ato/force brakes'
        contradiction = told(braked[True] / sum(braked), said, 'braking')
    elif 2 * misread.total() - contradictory > max(_MAX_MISREAD * samples, _LEAST_MISREAD):
        contradiction = told(misread.total() / samples, misread.most_common(1)[0][0])
    elif contradictory > _MAX_CONTRADICTORY * samples:
        warnings.append(told(contradictory / samples, faults.last_finding))
    elif warning := faults.brake_rate.finding or faults.brake_warning:
        warnings.append(f'{path}: {warning}')
    collector.end_run()
    return _Reading(tuple(collector.runs), collector.origin_ns, tuple(warnings), contradiction)

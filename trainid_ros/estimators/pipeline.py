# SPDX-License-Identifier: Apache-2.0
"""One pipeline for every driver: records in, outputs out.

Live nodes, bag replay and fleets push the same records into the same pipelines and copy their outputs; no number is
computed elsewhere. Pipelines that take in the same records share the streams that would give the same samples.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from statistics import NormalDist
from typing import Any, ClassVar, Final, Generic

from trainid_ros.estimators.algorithm_registry import Estimator
from trainid_ros.interface.errors import InputError, TrainIdError, check_settings, setting
from trainid_ros.interface.records import NS_PER_S, Record, Row
from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    EstimateT,
    Output,
    Reason,
    Rejection,
    Status,
)
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, encode, restore, several, stored, unknown
from trainid_ros.interface.vectors import vec
from trainid_ros.stream.alignment import TimeJump
from trainid_ros.stream.input_faults import InputFaults, Trust
from trainid_ros.stream.sample_stream import Contradiction, SampleStream, StreamEvent, TimeJumpPolicy, is_reset_by
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange

WINDOW: Final = 200
"""Number of updates whose innovations are judged: 40 s of driving at 5 Hz."""
# Updates from which on there is a verdict: the mean of fewer varies too much.
_MIN_UPDATES: Final = 30
# Normal quantile of a two-sided band of 99 % [std].
_QUANTILE: Final = NormalDist().inv_cdf(0.995)
# Limit of a single normalised innovation [std]; it also keeps the running sums accurate.
_MAX_Z: Final = 10.0


class ConsistencyVerdict(Enum):
    """Result of testing the innovations against their stated variances."""

    UNKNOWN = 'unknown'  # too few innovations
    CONSISTENT = 'consistent'  # variances are as stated
    OPTIMISTIC = 'optimistic'  # errors are larger than stated
    PESSIMISTIC = 'pessimistic'  # errors are smaller than stated


@dataclass(frozen=True, slots=True)
class Consistency:
    """Outcome of the check of the published uncertainty."""

    verdict: ConsistencyVerdict
    # Mean of squared innovation over stated variance [1]; 1 if that is correct, NaN before the first update
    ratio: float
    low: float  # Lower end of the 99 % band of the ratio if the variances are correct [1]
    high: float  # Upper end of the band [1]
    updates: int  # Number of updates in the window
    consecutive: int  # Number of consecutive updates with the verdict optimistic

    @property
    def is_alarm(self) -> bool:
        """True if the verdict has been optimistic for a full window, which is not a chance event."""
        return self.consecutive >= WINDOW

    def __str__(self) -> str:
        """Return verdict and numbers as text."""
        if not self.updates:
            return f'{self.verdict.value} (no innovation with a stated variance)'
        band = f'99 % band {self.low:.2f} to {self.high:.2f}, {self.updates} updates'
        text = f'{self.verdict.value} (squared innovations {self.ratio:.2f} times the stated variance; {band})'
        return f'{text}: {self.advice}' if self.advice else text

    @property
    def advice(self) -> str:
        """What a wrong uncertainty means for its use; empty if it is right or unknown."""
        missed = f'predictions miss by {math.sqrt(self.ratio):.2f} times the stated std'
        if self.verdict is ConsistencyVerdict.OPTIMISTIC:
            return f'{missed}, so allow for errors as much larger'
        if self.verdict is ConsistencyVerdict.PESSIMISTIC:
            return f'{missed}, so the stated one is safe, but wider than it need be'
        return ''


class ConsistencyMonitor:
    """Compares squared innovations of the last :data:`WINDOW` updates with the variances stated for them.

    If the stated variance is correct, the normalised innovation squared (NIS) has mean 1. Over N updates N times the
    mean NIS has a chi-squared distribution with N degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).
    Autocorrelated innovations carry less information: with the correlation rho between neighbours, and rho^k at lag k,
    the mean of squares varies like that of N (1 - rho^2) / (1 + rho^2) independent ones.
    """

    STATE: ClassVar[State] = declare(
        '_z', '_updates', '_newest', '_squares', '_products', unknown('_innovation'), unknown('_variance'),
        '_consecutive',
    )  # fmt: skip

    def __init__(self) -> None:
        self._z = vec[float]([0.0] * WINDOW)  # a ring of normalised innovations
        self._updates = self._newest = self._consecutive = 0
        self._squares = self._products = 0.0  # sums of squares, and of products of neighbours
        self._innovation = self._variance = 0.0

    def add(self, innovation: float, variance: float, *, used: bool) -> None:
        """Take in the innovation that an estimate reports for its last update, see ``Estimator.innovation``.

        Those of a sample that was not ``used`` do not count: outliers beyond a gate are not noise.
        """
        # Samples without an update repeat the pair of the last one.
        if innovation == self._innovation and variance == self._variance:
            return
        self._innovation, self._variance = innovation, variance
        if not (used and 0.0 < variance < math.inf and abs(innovation) < math.inf):
            return
        z = min(max(innovation / math.sqrt(variance), -_MAX_Z), _MAX_Z)
        following = self._newest + 1 if self._newest + 1 < WINDOW else 0
        if self._updates:
            self._products += self._z[self._newest] * z
        oldest, self._z[following], self._newest = self._z[following], z, following
        self._squares += z * z
        if self._updates < WINDOW:
            self._updates += 1
        else:
            following = following + 1 if following + 1 < WINDOW else 0
            self._squares -= oldest * oldest
            self._products -= oldest * self._z[following]
        optimistic = self._updates >= _MIN_UPDATES and self._squares / self._updates > self._band()[1]
        self._consecutive = self._consecutive + 1 if optimistic else 0

    def _band(self) -> tuple[float, float]:
        return nis_band(self._updates, self._products / self._squares if self._squares > 0.0 else 0.0)

    @property
    def refuted(self) -> bool:
        """True if errors have been more than twice as large as stated for a full window: the model does not hold."""
        return self._consecutive >= WINDOW and self._squares / self._updates > 4.0

    def current(self) -> Consistency:
        """Return the current outcome."""
        if not self._updates:
            return Consistency(ConsistencyVerdict.UNKNOWN, math.nan, math.nan, math.nan, 0, 0)
        ratio, (low, high) = self._squares / self._updates, self._band()
        if self._updates < _MIN_UPDATES:
            verdict = ConsistencyVerdict.UNKNOWN
        elif self._consecutive:
            verdict = ConsistencyVerdict.OPTIMISTIC
        else:
            verdict = ConsistencyVerdict.PESSIMISTIC if ratio < low else ConsistencyVerdict.CONSISTENT
        return Consistency(verdict, ratio, low, high, self._updates, self._consecutive)


def nis_band(count: int, correlation: float = 0.0) -> tuple[float, float]:
    """Return the 99 % band of the mean NIS of consistent updates with a correlation of neighbours [1].

    The chi-squared quantiles are approximated by Wilson and Hilferty (1931), within 1 % from ten degrees of freedom.
    The correlation of noise is below 0.9, and some degrees of freedom must remain.
    """
    rho = min(abs(correlation), 0.9)
    freedom = max(1.0, count * (1.0 - rho * rho) / (1.0 + rho * rho))
    spread = 2.0 / (9.0 * freedom)
    reach = _QUANTILE * math.sqrt(spread)
    return max(0.0, 1.0 - spread - reach) ** 3, max(0.0, 1.0 - spread + reach) ** 3


# Time in motion between snapshots [s]; a contradiction of the inputs is found within this time.
_SNAPSHOT_S: Final = 120.0
# Time in motion within which a fault is suspected [s]: a newer snapshot may hold what was wrong.
_SUSPECTED_S: Final = 20.0
# Time in motion for which a passing suspicion makes an estimator go back [s]: after a longer one it has learned more.
_PASSING_S: Final = 60.0
# Age of a command that a brake has followed whatever its dead time and lag, which are seconds [ns].
_FOLLOWED_NS: Final = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class PipelineConfig:
    """Settings shared by all pipelines."""

    stale_after: float = setting(
        0.8, 'inputs missing this long make an estimate stale; 2.5 intervals of a slower topic', 's', 0.1, 60.0
    )
    time_jump_policy: TimeJumpPolicy = TimeJumpPolicy.RESET  # response to stamps that jump back


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What an estimator had learned, and whether its uncertainty was true."""

    estimator: str  # State of the estimator as text
    consistency: str  # Innovations of the updates before, as text


@dataclass(slots=True)
class Snapshots:
    """Saved states of an estimator, taken at intervals of motion, to go back to when inputs were wrong."""

    before: Snapshot  # The state to go back to; it is older than it takes to find a contradiction
    newest: Snapshot
    moved_s: float = 0.0  # Time in motion since the newest [s]
    # The state before the last step of the stamps forward, None if there was none
    before_step: Snapshot | None = stored(None, kind=Snapshot)  # noqa: RUF009 - makes a field


class EstimatorPipeline(Generic[EstimateT]):
    """One estimator at the end of a stream of samples: its status, its counters, whether its uncertainty is true.

    Pipelines may share a stream; one whose records are to be forgotten continues with a stream of its own.

    Attributes:
        prior: Estimate before the first record.
        stale_ns: Time for which inputs may be missing [ns]; longer for a slow topic.
    """

    STATE: ClassVar[State] = declare(
        'estimator', 'stream', '_snapshots', '_consistency', '_status', 'used', 'samples', 'resets',
        several('rejections', Reason), '_rejected', several('last_rejection', Rejection), '_speed', '_sample_ns',
        '_is_found', '_suspected_s', '_has_gap', several('_skipped', BrakeCommandChange),
    )  # fmt: skip

    def __init__(self, estimator: Estimator[EstimateT], stream: SampleStream, config: PipelineConfig) -> None:
        check_settings(config)
        self.estimator = estimator
        self.stream = stream
        self.config = config
        self.stale_ns = round(config.stale_after * NS_PER_S)
        self.resets = 0
        self._clear()
        self.prior = self._published

    def set_stale_after(self, stale_after: float) -> None:
        """Change how long inputs may be missing [s]."""
        self.config = replace(self.config, stale_after=stale_after)
        self.stale_ns = round(stale_after * NS_PER_S)

    def _clear(self) -> None:
        self.rejections: Counter[Reason] = Counter()
        self._rejected = 0
        self.used = 0
        self.samples = 0
        self.statuses = [0] * len(Status)  # number of outputs by status
        self.last_rejection: Rejection | None = None
        self._speed = 0.0
        self._sample_ns = 0
        self._consistency = ConsistencyMonitor()
        prior = self._snapshot()
        self._snapshots = Snapshots(prior, prior)
        self._is_found = False  # Whether inputs of this estimator are known to be wrong
        self._suspected_s = 0.0  # Time in motion for which they have been suspected to be [s]
        # Whether the next sample follows a gap for the estimator, and the brake commands missed since then.
        self._has_gap = False
        self._skipped = list[BrakeCommandChange]()
        self._status = Status.UNINITIALIZED
        # The estimate at the newest sample, None until somebody asks for it, and the last one published.
        self._estimate: EstimateT | None = None
        self._published = self.estimator.estimate(self._speed)
        self._adhesion: AdhesionEstimate | None = None  # At the newest sample, None before the first
        self._is_brake_rate = isinstance(self._published, BrakeRateEstimate)

    def _start_over(self) -> None:
        self.estimator.reset()
        self._clear()
        self.resets += 1

    def reset(self) -> None:
        """Go back to the prior and forget all records and counters."""
        self.stream = self.stream.successor()
        self._start_over()

    def interrupt(self) -> None:
        """Expect that the next record may be of any time, as after a restore; the drive continues."""
        self.stream = self.stream.successor(continues=True)

    @property
    def status(self) -> Status:
        """Status of the newest output."""
        return self._status

    @property
    def trust(self) -> Trust:
        """What is wrong with the inputs that the estimator uses."""
        faults = self.stream.faults
        return faults.brake_rate if self._is_brake_rate else faults.resistance

    @property
    def consistency(self) -> Consistency:
        """Whether errors are as large as the estimates state, over recent samples."""
        return self._consistency.current()

    @property
    def why_converging(self) -> str:
        """Why the estimate is CONVERGING although its standard deviation is small enough; empty otherwise."""
        if self._status is not Status.CONVERGING or not self.estimator.converged:
            return ''
        return 'errors exceed the stated uncertainty by far' if self._consistency.refuted else self.trust.doubt

    @property
    def newest_ns(self) -> int:
        """Newest stamp on any topic; 0 before the first."""
        return self.stream.newest_ns

    def timeout_ns(self, topic: int) -> int:
        """Return how long a required topic may be missing [ns]; longer for a slow one."""
        return self.stream.timeout_ns(topic, self.stale_ns)

    def push(self, record: Record) -> list[Output[EstimateT]]:
        """Take in one record; return an output for each sample it completes, without the adhesion."""
        outputs: list[Output[Any]] = []
        self.take(self.stream.push(record), outputs.append)
        return [output for output in outputs if not isinstance(output.estimate, AdhesionEstimate)]

    def take(self, events: list[StreamEvent], publish: Callable[[Output[Any]], object] | None = None) -> None:
        """Take in what :meth:`SampleStream.push` made of one record.

        ``publish`` is called with each output. That of a brake rate is followed by the adhesion.
        """
        for event in events:
            if isinstance(event, Sample):
                self._step(event)
                self.statuses[self._status] += 1
                if publish is not None:
                    self.publish(publish)
            elif isinstance(event, Rejection):
                self._count(event)
            else:
                self._follow_jump(event)
        if self._status not in (Status.STALE, Status.FAULT) and self._is_input_missing():
            self._status = Status.STALE
            self.statuses[Status.STALE] += 1
            if publish is not None:
                self.publish(publish)

    def publish(self, publish: Callable[[Output[Any]], object]) -> None:
        """Publish the output at the newest sample, and with a brake rate the adhesion."""
        publish(self.current())
        if self._is_brake_rate:
            publish(self.adhesion())

    def _is_input_missing(self) -> bool:
        return self.stream.behind_ns > self.stale_ns and self.stream.is_input_missing(self.stale_ns)

    def _follow_jump(self, jump: TimeJump) -> None:
        """Start over where another drive begins; forget what was learned, and aged, by stamps that were wrong."""
        if is_reset_by(jump, self.stream.config.time_jump_policy):
            self._start_over()
        elif jump.is_step_forward:
            self._snapshots.before_step = self._snapshot()
        elif jump.undoes_step and self._snapshots.before_step is not None:
            self._snapshots.newest = self._snapshots.before_step
            self._go_back()

    def mark_stale(self) -> Output[EstimateT]:
        """Mark the estimate as stale because inputs are missing; its value stays."""
        self._status = Status.STALE
        return self.current()

    def fail(self) -> Output[EstimateT]:
        """Mark the estimator as failed; the estimate published last stays until a reset or a restore."""
        self._status = Status.FAULT
        return self.current()

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(self)

    def restore(self, text: str, age_s: float = 0.0) -> None:
        """Continue from a saved state, possibly on another drive; InputError if it does not fit.

        All outputs are equal to those without the interruption where no record was lost. The estimate until the next
        sample covers what may have changed in ``age_s`` [s], the time since the state was saved; from then on the
        estimators take that time from the stamps.
        """
        shared, self.stream = self.stream, self.stream.successor()
        try:
            restore(self, text)
        except InputError:
            self.stream = shared
            raise
        if self._status is Status.FAULT:
            self._status = Status.UNINITIALIZED
        self._estimate = None
        if age_s > 0.0 and self.samples:
            now = self.estimator.save()
            self.estimator.idle(age_s)
            self._published = self._estimate = self.estimator.estimate(self._speed)
            if self._status.is_usable and not self.estimator.converged:
                self._status = Status.CONVERGING
            self.estimator.restore(now)

    def current(self) -> Output[EstimateT]:
        """Return the output at the newest sample."""
        if self._estimate is None and self._status is not Status.FAULT:
            self._published = self._estimate = self.estimator.estimate(self._speed)
        used, rejected = self.used, self._rejected
        return Output(self._sample_ns, self._published, self._status, used, rejected, self.last_rejection)

    def adhesion(self) -> Output[AdhesionEstimate]:
        """Return adhesion and slip at the newest sample; the pipeline of the brake rate publishes them."""
        found, status = self.stream.adhesion, self._status
        if status in (Status.CONVERGING, Status.VALID, Status.HOLDING):
            last, holds = found.last_rejection, Status.VALID
            if last is not None and last.stamp_ns == self._sample_ns:
                holds = Status.HOLDING
            status = holds if found.is_confirmed and not self.trust.finding else Status.CONVERGING
        estimate = self._adhesion or found.estimate()
        return Output(self._sample_ns, estimate, status, found.used, found.rejected, found.last_rejection)

    def _step(self, sample: Sample) -> None:
        self._estimate, self._adhesion = None, sample.adhesion
        rejection = sample.brake_rejection if self._is_brake_rate else sample.rejection
        is_stale = self._is_input_missing()
        if is_stale and rejection is None:
            rejection = Rejection(sample.stamp_ns, Reason.LATE, seconds(self.stream.behind_ns), seconds(self.stale_ns))
        trust = self.trust
        self._keep_snapshots(sample, trust)
        if rejection is None:
            rejection = self.estimator.step(self._resumed(sample) if self._has_gap else sample)
        else:
            self._skip(sample)
        self.samples += 1
        self._speed = sample.speed
        self._sample_ns = sample.stamp_ns
        if rejection is None:
            self.used += 1
        else:
            self._count(rejection)
        # The consistency of this sample counts from the next one on.
        self._status = self._judge(rejection, trust, is_stale=is_stale)
        innovation, variance = self.estimator.innovation
        self._consistency.add(innovation, variance, used=rejection is None)

    def _skip(self, sample: Sample) -> None:
        """Keep the changes of the brake command in a rejected sample, as long as the last of them may still act."""
        self._has_gap = True
        self._skipped.extend(sample.brake_changes)
        since_ns = sample.stamp_ns - _FOLLOWED_NS
        while len(self._skipped) > 1 and self._skipped[1].stamp_ns <= since_ns:
            del self._skipped[0]

    def _resumed(self, sample: Sample) -> Sample:
        """Return a sample that follows a gap, with all changes of the brake command since then, and that in force."""
        changes = (*self._skipped, *sample.brake_changes)
        if is_finite(sample.brake_command):
            changes = (*changes, BrakeCommandChange(sample.stamp_ns, sample.brake_command))
        self._has_gap, self._skipped = False, []
        return replace(sample, dt=math.nan, brake_changes=changes, brake_gap=True)

    def _keep_snapshots(self, sample: Sample, trust: Trust) -> None:
        """Go back to an earlier state once a fault of the inputs is found, or a suspicion has passed."""
        snapshots, confirmed = self._snapshots, trust.is_fault_confirmed
        moved_s = sample.dt if sample.dt > 0.0 and sample.speed > 0.0 else 0.0
        snapshots.moved_s += moved_s
        if confirmed:
            if not self._is_found:
                snapshots.newest = snapshots.before
                self._go_back()
                self._has_gap, self._suspected_s = True, 0.0
        elif trust.suspicion:
            if self._suspected_s == 0.0 and snapshots.moved_s < _SUSPECTED_S:
                snapshots.newest = snapshots.before  # the newest may hold what was wrong already
            self._suspected_s += moved_s
        elif not trust.finding:
            if 0.0 < self._suspected_s < _PASSING_S:
                self._go_back()
                self._has_gap = True
            elif trust.is_full and snapshots.moved_s >= _SNAPSHOT_S:
                snapshots.before, snapshots.newest, snapshots.moved_s = snapshots.newest, self._snapshot(), 0.0
            self._suspected_s = 0.0
        self._is_found = confirmed

    def _snapshot(self) -> Snapshot:
        return Snapshot(self.estimator.save(), encode(self._consistency))

    def _go_back(self) -> None:
        self.estimator.restore(self._snapshots.newest.estimator)
        restore(self._consistency, self._snapshots.newest.consistency)

    def _judge(self, rejection: Rejection | None, trust: Trust, *, is_stale: bool) -> Status:
        if self._status is Status.FAULT:
            return Status.FAULT
        if is_stale:
            return Status.STALE
        if not (self.estimator.converged and trust.is_full) or self._consistency.refuted:
            return Status.CONVERGING
        return Status.VALID if rejection is None else Status.HOLDING

    def _count(self, rejection: Rejection) -> None:
        if rejection.reason is Reason.THINNED:  # nothing is wrong with a topic faster than the period
            return
        self.rejections[rejection.reason] += 1
        self._rejected += 1
        self.last_rejection = rejection


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
        self._made: list[tuple[SampleStream, list[StreamEvent] | None]] = []

    def events(self, stream: SampleStream) -> list[StreamEvent]:
        """Return what a stream makes of the record; TrainIdError if it has failed for another pipeline."""
        for known, made in self._made:
            if known is stream:
                if made is None:
                    raise TrainIdError('the stream that it shares with another estimator has failed')
                return made
        self._made.append((stream, None))  # until it has succeeded
        topic, stamp_ns, x, y, flag = self._row
        events = stream.push_row(topic, stamp_ns, x, y, flag)
        self._made[-1] = stream, events
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
        # Those that were reset have streams of their own since then.
        streams = list(dict.fromkeys(pipeline.stream for pipeline in self._pipelines))
        members = [(pipeline, streams.index(pipeline.stream)) for pipeline in self._pipelines]
        count = 0
        for topic, stamp_ns, x, y, flag in rows:
            made = [stream.push_row(topic, stamp_ns, x, y, flag) for stream in streams]
            for event in made[0]:  # the others have the same stamps
                if isinstance(event, Sample):
                    self._follow(event.stamp_ns, streams[0].faults)
            for pipeline, k in members:
                if made[k] or pipeline.stream.behind_ns > pipeline.stale_ns:
                    pipeline.take(made[k], publish)
            count += 1
        return count

    def _follow(self, stamp_ns: int, faults: InputFaults) -> None:
        if stamp_ns < self._newest_ns:
            self._before_ns += self._newest_ns - self._first_ns
            self._first_ns = stamp_ns
        self._first_ns = self._first_ns or stamp_ns
        self._newest_ns = stamp_ns
        self.contradiction.follow(faults, self.covered_s)

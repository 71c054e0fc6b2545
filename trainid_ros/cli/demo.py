# SPDX-License-Identifier: Apache-2.0
"""``trainid demo``: play bags through the three live nodes, compare with replay and truth, and find a hidden effect."""

from __future__ import annotations

import math
import shutil
import signal
import sys
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

import yaml

from trainid_ros.cli.arguments import DEMO_BAGS, DEMO_QUICK_S, EXPLAIN_CHAPTER
from trainid_ros.cli.output import EXIT_NO_ANSWER, for_output, prepare_page, print_json, progress, show
from trainid_ros.cli.processes import ProcessGroup, isolate
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.files import shared_path
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS, stamp_of, status_of
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis, load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.bag.reader import LoggedRecord
    from trainid_ros.explain.result import Explanation
    from trainid_ros.report.chapter import AccuracyScore, Chapter
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile

    Say = Callable[[str], None]

HIDDEN: Final = 'local_drag:start=4500,end=5700,permille=1.5'
_HIDDEN_DAVIS: Final = Davis(1.74, 0.02, 0.0086)
_HIDDEN_RUNS, _HIDDEN_STOPS, _HIDDEN_SEED = 8, 5, 2017
_TITLES: Final = {
    'altrios_manifest': 'Freight train on a real route, from an independent simulator',
    'yizhuang_day': 'A day on the Beijing Yizhuang line',
}
LABELS: Final = {
    ResistanceEstimate: 'resistance w(v)',
    SpeedModelEstimate: 'speed model, mass factor',
    BrakeRateEstimate: 'brake rate',
}
_FIELDS: Final = {ResistanceEstimate: 'resistance', SpeedModelEstimate: 'speed_model', BrakeRateEstimate: 'brake_rate'}
_START_S: Final = 60.0
_QUIET_S: Final = 1.5
_POLL_S: Final = 0.05
_LINE_S: Final = 5.0
# More than the messages in any demo bag: a node that falls behind catches up at the end and loses none.
_DEPTH: Final = 40000


def run(args: argparse.Namespace) -> int:
    """Run the demo; return 0 only if live estimates equal the replayed ones and the effect was found.

    Raises:
        InputError: A bag, a train file or the output folder cannot be used.
        NoAnswerError: A process failed.
    """
    # Before anything starts: the optional packages for bags may be missing.
    import trainid_ros.bag.reader  # noqa: PLC0415
    import trainid_ros.bag.writer  # noqa: F401, PLC0415
    from trainid_ros.cli.explain import prepare_folder  # noqa: PLC0415

    def say(text: str) -> None:
        print(for_output(text), file=sys.stderr if args.json else sys.stdout, flush=True)

    start = time.monotonic()
    names = [name for name in DEMO_BAGS if args.only in (None, name)]
    bags = [load_demo_bag(path) for path in args.bag or map(stock_bag, names)]
    report = prepare_page(args.out / 'report.html') if bags else None
    hides, folder = not args.bag and args.only in (None, EXPLAIN_CHAPTER), args.out / EXPLAIN_CHAPTER
    if hides:
        prepare_folder(folder, _stated_path())
    with _interruptible():
        played = [] if report is None else _live(bags, args, report, say)
        found = _hidden(folder, say) if hides else None
    worked = all(one.worked for one in played) and (found is None or is_found(found))
    wall_s = time.monotonic() - start
    if args.json:
        print_json(_to_json(played, found, folder) | {'report': report, 'wall_s': wall_s, 'worked': worked})
    else:
        show(''.join(f'\n{one.summary()}\n' for one in played))
        show('' if found is None else describe_hidden(found, folder))
        show(f'\nreport: {report}' if report else '')
        print(f'{wall_s:.0f} s in total; {"all checks passed" if worked else "NOT all checks passed, see above"}')
    return 0 if worked else EXIT_NO_ANSWER


class DemoBag(NamedTuple):
    """A bag with its title, its train file and, if known, its truth."""

    path: Path
    title: str
    train_path: Path
    train_file: TrainFile
    truth: Truth | None


def stock_bag(name: str) -> Path:
    """Return the folder of a bag of the package; InputError if it is not there."""
    return shared_path(f'bags/{DEMO_BAGS[name]}')


def load_demo_bag(path: Path) -> DemoBag:
    """Load the train file and, if there is one, the truth in the folder of a bag.

    Raises:
        InputError: There is no train file in it, or a file cannot be used.
    """
    train, truth = path / 'train.yaml', path / 'truth.yaml'
    known = load_truth(truth) if truth.is_file() else None
    return DemoBag(path, _TITLES.get(path.name, path.name), train, load_train_file(train), known)


# Bags through the live nodes


@dataclass(frozen=True, slots=True)
class Played:
    """A bag that was played live and replayed."""

    chapter: Chapter  # For the report
    comparisons: dict[str, Comparison]  # Live against replay, by estimate
    scores: dict[str, AccuracyScore | None]  # Errors of w at the current speed [N/kN] and brake rate [1], if known
    rate: float  # Recorded seconds per second of the live run [1]

    @property
    def worked(self) -> bool:
        """True if every live estimate equals its replayed one."""
        return all(comparison.exact for comparison in self.comparisons.values())

    def summary(self) -> str:
        """Return the results as lines of text."""
        w, f = self.chapter.resistance, self.chapter.brake_rate
        lines = (
            self.chapter.title,
            f'{self.chapter.recording.duration_s / 60.0:.0f} min of driving, {self.chapter.how}',
            f'w(v) = {w.estimate.a:.3f} + {w.estimate.b:.4f} v + {w.estimate.c:.5f} v² N/kN, '
            f'{w.status.name}, {w.used} samples used, {w.rejected} rejected',
            f'brake rate {f.estimate.brake_rate:.3f} ± {f.estimate.brake_rate_std:.3f}, {f.status.name}',
            *(
                f'{name}, error against truth: rms {score.rms:.3f}, mean {score.bias:+.3f}, last {score.last:+.3f}; '
                f'truth within ±1 std {score.inside_68:.0%}, within ±1.96 std {score.inside_95:.0%} of the time'
                for name, score in self.scores.items()
                if score is not None
            ),
            *self.chapter.notes,
        )
        return '\n  '.join(lines)


def _live(bags: Iterable[DemoBag], args: argparse.Namespace, report: Path, say: Say) -> list[Played]:
    """Play all bags through the live nodes and write the report."""
    from trainid_ros.report.drive_report import write_report  # noqa: PLC0415

    logs: Path = args.out / 'log'
    logs.mkdir(parents=True, exist_ok=True)
    say(f'ROS 2 domain {isolate(logs)}, logs in {logs}')
    duration_s = DEMO_QUICK_S if args.quick else math.inf
    played = []
    for bag in bags:
        folder = logs / bag.path.name
        folder.mkdir(exist_ok=True)
        say(f'\n{bag.title}: {bag.path} at {args.rate:g} x real time')
        played.append(_conclude(bag, play_live(bag, args.rate, duration_s, folder, say), duration_s))
        for note in played[-1].chapter.notes:
            say(note)
    write_report('trainid demo', [one.chapter for one in played], report)
    return played


def play_live(bag: DemoBag, rate: float, duration_s: float, folder: Path, say: Say) -> LiveRun:
    """Play a bag to nodes in separate processes and collect what they publish.

    Args:
        bag: The bag.
        rate: Recorded seconds per second [1].
        duration_s: Length of the bag to play [s].
        folder: Where logs and parameters go; it must exist.
        say: Shows a line of text.

    Raises:
        InputError: The bag cannot be played.
        NoAnswerError: A process failed; the message gives the end of its log.
    """
    from trainid_ros.bag.reader import BagReader, require_topics  # noqa: PLC0415
    from trainid_ros.setup.jobs import JOBS  # noqa: PLC0415

    with BagReader(bag.path) as reader:
        require_topics(reader)
    parameters = folder / 'parameters.yaml'
    parameters.write_text(lossless_parameters(), encoding='utf-8')
    live = LiveRun(bag.truth, say)
    with ProcessGroup(folder) as group, _subscribed() as (node, subscriptions):
        for job in JOBS:
            start = ['run', '--node', job.node_name, '--train', str(bag.train_path)]
            group.start(job.node_name, [*start, '--ros-args', '--params-file', str(parameters.absolute())])
        deadline = time.monotonic() + _START_S
        while not all(node.count_publishers(topic.name) for topic in OUTPUT_TOPICS):
            group.check()
            if time.monotonic() > deadline:
                raise NoAnswerError(f'the nodes did not start within {_START_S:g} s')
            time.sleep(_POLL_S)
        # Without /clock: the nodes work by stamps, and simulated time would cost as much as the inputs.
        limit = ['--duration', repr(duration_s)] if math.isfinite(duration_s) else []
        play = ['play', str(bag.path), '--rate', repr(rate), '--wait', str(len(JOBS)), *limit]
        player = group.start('bag_player', [*play, '--ros-args', '-p', 'publish_clock:=false'])
        last_s = time.monotonic()
        while time.monotonic() < last_s + _QUIET_S:
            group.check(may_end=player)
            if live.take(subscriptions) or player.process.poll() is None:
                last_s = time.monotonic()
            time.sleep(_POLL_S)
        if killed := group.stop():
            raise NoAnswerError(f'{", ".join(child.name for child in killed)} did not stop on SIGTERM and was killed')
    return live


def lossless_parameters() -> str:
    """Return a ROS parameter file with QoS overrides: no message may be lost at any playback rate."""
    from trainid_ros.setup.jobs import JOBS  # noqa: PLC0415

    def overrides(output: str) -> dict[str, Any]:
        topics = [(topic.name, 'subscription') for topic in INPUT_TOPICS] + [(output, 'publisher')]
        lossless = {'history': 'keep_last', 'depth': _DEPTH, 'reliability': 'reliable'}
        return {'qos_overrides': {f'/{name}': {entity: dict(lossless)} for name, entity in topics}}

    return yaml.safe_dump({job.node_name: {'ros__parameters': overrides(job.topic.name)} for job in JOBS})


@contextmanager
def _subscribed() -> Iterator[tuple[Any, Mapping[type, Any]]]:
    """Yield a node in the place of an ATO controller, and its subscriptions by class of the estimate."""
    import rclpy  # noqa: PLC0415
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    from trainid_ros.ros.topics import message_class  # noqa: PLC0415

    context = rclpy.Context()
    rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node('ato_controller', context=context)
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        # Messages are polled, which costs far less than a wait set for each: the callback is never called.
        yield (
            node,
            {
                topic.estimate: node.create_subscription(message_class(topic), topic.name, lambda _: None, qos)
                for topic in OUTPUT_TOPICS
            },
        )
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


def _waiting(subscription: Any) -> Iterator[Any]:
    with subscription.handle:
        while (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
            yield taken[0]


class LiveRun:
    """What the nodes publish while a bag is played."""

    def __init__(self, truth: Truth | None, say: Say) -> None:
        from trainid_ros.report.recording import Recorder  # noqa: PLC0415

        self.estimates = Estimates()
        self.newest: dict[type, AnyOutput] = {}
        self.recorder = Recorder()
        self.first_s = self.last_s = 0.0
        self._truth, self._say, self._next_s = truth, say, 0.0

    def take(self, subscriptions: Mapping[type, Any]) -> int:
        """Take in what has arrived, show the newest values if the next line is due, and return the number."""
        count = 0
        for kind, subscription in subscriptions.items():
            for message in _waiting(subscription):
                count += self._receive(kind, message)
        if count:
            self.last_s = time.monotonic()
            self.first_s = self.first_s or self.last_s
        if self.newest and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _LINE_S
            self._say(line(self.newest, self._truth))
        return count

    def _receive(self, kind: type, message: Any) -> bool:
        stamp_ns, status = stamp_of(message), status_of(message)
        estimate = kind(**{item.name: _plain(getattr(message, item.name)) for item in fields(kind)})
        if not self.estimates.add(stamp_ns, estimate, status):
            return False
        output: Any = Output(stamp_ns, estimate, status, int(message.used), int(message.rejected), None)
        self.newest[kind] = output
        self.recorder.on_output(output)
        return True


def line(newest: Mapping[type, AnyOutput], truth: Truth | None) -> str:
    """Return the newest estimates as one line of text, each with its truth."""
    parts = []
    for output in newest.values():
        at, e = None if truth is None else truth.truth_at_ns(output.stamp_ns), output.estimate
        match e:
            case ResistanceEstimate():
                value = f'{3.6 * e.speed:5.1f} km/h  w {e.resistance:.3f} ± {e.resistance_std:.3f}'
                known = '' if at is None else f' (truth {davis(at.resistance, e.speed):.3f})'
            case BrakeRateEstimate():
                value = f'brake rate {e.brake_rate:.3f} ± {e.brake_rate_std:.3f}'
                known = '' if at is None or at.brake_rate is None else f' (truth {at.brake_rate:.3f})'
            case SpeedModelEstimate():
                value, known = f'mass factor {e.mass_factor:.3f}', ''
        parts.append(f'{value}{known} {output.status.name}, {output.used} used, {output.rejected} rejected')
    return '  '.join(parts)


# Live against replay


class Estimates:
    """Stamps and digests of the estimates published, by class, but for repeats that report missing input.

    A clock causes those, and a replay has none.
    """

    def __init__(self) -> None:
        self.of: dict[type, list[tuple[int, int]]] = {kind: [] for kind in LABELS}

    def add(self, stamp_ns: int, estimate: Any, status: Status) -> bool:
        """Take in an estimate; return False for a repeat."""
        found = self.of[type(estimate)]
        if status is Status.STALE and stamp_ns == (found[-1][0] if found else 0):
            return False
        values = (getattr(estimate, item.name) for item in fields(estimate))
        found.append((stamp_ns, hash(repr([_plain(value) for value in values]))))
        return True


def _plain(value: Any) -> Any:
    return tuple(map(float, value)) if hasattr(value, '__len__') else value


class Comparison(NamedTuple):
    """Live estimates against those of a replay."""

    replayed: int  # Estimates of the replay
    received: int  # Live estimates received
    equal: int  # Live estimates that equal the replayed ones to the bit
    missing: int  # Replayed estimates without a live one
    extra: int  # Live estimates without a replayed one

    @property
    def exact(self) -> bool:
        """True if every estimate of the replay was received, the same to the bit, and no other."""
        return self.equal == self.replayed == self.received

    def __str__(self) -> str:
        """Return the comparison in words."""
        if self.exact:
            return f'live equals replay to the bit: all {self.replayed} messages'
        return (
            f'live differs from replay: {self.equal} of {self.replayed} estimates are equal to the bit, '
            f'{self.missing} were missed, {self.extra} have no counterpart'
        )


def compare(received: list[tuple[int, int]], replayed: list[tuple[int, int]]) -> Comparison:
    """Compare stamps and digests of estimates, in whatever order."""
    equal = (Counter(received) & Counter(replayed)).total()
    stamps = (Counter(stamp for stamp, _ in received) & Counter(stamp for stamp, _ in replayed)).total()
    return Comparison(len(replayed), len(received), equal, len(replayed) - stamps, len(received) - stamps)


class _Replayed:
    """Observer of the replay: its estimates, and the inputs in the recording of the live run."""

    def __init__(self, live: LiveRun) -> None:
        self.estimates = Estimates()
        self._recorder = live.recorder

    def on_record(self, entry: LoggedRecord) -> None:
        self._recorder.on_record(entry)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002 - only stamps are compared
        self.estimates.add(output.stamp_ns, output.estimate, output.status)


def _conclude(bag: DemoBag, live: LiveRun, duration_s: float) -> Played:
    """Replay a bag off line, compare, and score what the nodes published."""
    from trainid_ros.bag.bag_replay import replay  # noqa: PLC0415
    from trainid_ros.bag.reader import BagReader  # noqa: PLC0415
    from trainid_ros.report.chapter import (  # noqa: PLC0415
        Chapter,
        RejectionCounts,
        score_brake_rate,
        score_resistance,
    )
    from trainid_ros.setup.pipelines import EstimatorSettings  # noqa: PLC0415

    replayed = _Replayed(live)
    with BagReader(bag.path) as reader, progress('replay for comparison') as advance:
        outcome = replay(reader, bag.train_file, EstimatorSettings(), advance, (replayed,), duration_s=duration_s)
    comparisons = {
        label: compare(live.estimates.of[kind], replayed.estimates.of[kind]) for kind, label in LABELS.items()
    }
    recording = live.recorder.finish()
    rate = recording.duration_s / (live.last_s - live.first_s) if live.last_s > live.first_s else math.nan
    results: dict[type, Any] = {kind: getattr(outcome, field) for kind, field in _FIELDS.items()}
    # A node that published nothing live still has its prior, which the replay shows too.
    newest: dict[str, Any] = {_FIELDS[kind]: live.newest.get(kind, result.output) for kind, result in results.items()}
    chapter = Chapter(
        title=bag.title,
        bag=str(bag.path),
        train_file_name=str(bag.train_path),
        train_file=bag.train_file,
        how=f'live over ROS 2 at {rate:.0f} x real time, then off line',
        recording=recording,
        **newest,
        rejections=tuple(RejectionCounts(LABELS[kind], result.rejections) for kind, result in results.items()),
        truth=bag.truth,
        notes=tuple(f'{label}: {comparison}' for label, comparison in comparisons.items()),
    )
    scores: dict[str, AccuracyScore | None] = {'resistance': None, 'brake_rate': None}
    if bag.truth is not None:
        scores = {
            'resistance': score_resistance(recording, bag.truth),
            'brake_rate': score_brake_rate(recording, bag.truth),
        }
    return Played(chapter, comparisons, scores, rate)


# A hidden effect


def _stated_path() -> Path:
    return stock_bag('yizhuang') / 'train.yaml'


def _hidden(folder: Path, say: Say) -> tuple[TrainFile, Explanation]:
    """Simulate runs with an effect that the train file lacks, explain the gap, and return that file and what is found.

    Raises:
        InputError: The train file of the package or the folder cannot be used.
    """
    import numpy as np  # noqa: PLC0415

    from trainid_ros.bag.run_reader import read_runs  # noqa: PLC0415
    from trainid_ros.bag.writer import BagWriter  # noqa: PLC0415
    from trainid_ros.cli.explain import explain_runs, write_all  # noqa: PLC0415
    from trainid_ros.sim.scenario import Scenario, simulate  # noqa: PLC0415
    from trainid_ros.train.effects import parse_effects  # noqa: PLC0415

    say(
        f'{_HIDDEN_RUNS} runs on the Yizhuang line, there and back; hidden: {HIDDEN}, and a, b, c unlike the train file'
    )
    full = load_train_file(_stated_path())
    stated = replace(full, line=replace(full.line, stops=full.line.stops[:_HIDDEN_STOPS]))
    true = replace(stated, resistance=_HIDDEN_DAVIS, effects=parse_effects([HIDDEN]))
    bag = folder / 'bag'
    shutil.rmtree(bag, ignore_errors=True)  # of an earlier demo
    with BagWriter(bag) as writer:
        for record in simulate(Scenario(true, runs=_HIDDEN_RUNS), np.random.default_rng(_HIDDEN_SEED)).records:
            writer.write_record(record)
    explanation = explain_runs(read_runs([bag], stated), stated, [bag])
    a, b, c = _HIDDEN_DAVIS.a, _HIDDEN_DAVIS.b, _HIDDEN_DAVIS.c
    notes = (f'Hidden in the simulation: {HIDDEN}; a = {a}, b = {b}, c = {c}.',)
    write_all(folder, explanation, stated, str(_stated_path()), [bag], notes)
    return stated, explanation


def is_found(found: tuple[TrainFile, Explanation]) -> bool:
    """Return whether the hidden effect is among those found."""
    return HIDDEN.partition(':')[0] in [effect.name for effect in found[1].effects]


def describe_hidden(found: tuple[TrainFile, Explanation], folder: Path) -> str:
    """Return the hidden and the found effects as text."""
    from trainid_ros.cli.explain import REPORT_HTML, describe  # noqa: PLC0415

    stated, explanation = found
    text = f'hidden: {HIDDEN}\n\n{describe(explanation, stated)}\n\nreport: {folder / REPORT_HTML}'
    return '\n'.join(('\nEffect missing from the train file', *(f'  {x}'.rstrip() for x in text.split('\n'))))


def _to_json(played: list[Played], found: tuple[TrainFile, Explanation] | None, folder: Path) -> dict[str, Any]:
    from trainid_ros.cli.explain import REPORT_HTML, to_json  # noqa: PLC0415

    return {
        'bags': [
            {
                'bag': one.chapter.bag,
                'duration_s': one.chapter.recording.duration_s,
                'rate': one.rate,
                'resistance': one.chapter.resistance,
                'speed_model': one.chapter.speed_model,
                'brake_rate': one.chapter.brake_rate,
                'scores': one.scores,
                'live_against_replay': {label: item._asdict() for label, item in one.comparisons.items()},
            }
            for one in played
        ],
        'explain': found and {'hidden': HIDDEN, 'found': to_json(found[1]), 'report': folder / REPORT_HTML},
    }


@contextmanager
def _interruptible() -> Iterator[None]:
    """Handle termination signals like Ctrl-C, so that child processes are stopped.

    A signal during a call into ROS can surface as a RuntimeError of that call; it still counts as an interruption.
    """
    received: list[int] = []

    def interrupt(number: int, _frame: object) -> NoReturn:
        received.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)
    try:
        yield
    except RuntimeError:
        if received:
            raise KeyboardInterrupt from None
        raise

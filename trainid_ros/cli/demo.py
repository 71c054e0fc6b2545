# SPDX-License-Identifier: Apache-2.0
"""``trainid demo``: play bags through the live nodes, compare with replay and truth, and find hidden effects.

The three nodes of the mission run with their default algorithms, that of the resistance with the filter bank. A fourth
node runs V-MILS beside it, under a name and on topics of its own. A chapter hides effects in simulated runs, each drawn
by a seed, and finds them again.
"""

from __future__ import annotations

import argparse
import math
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np
import yaml

from trainid_ros.bag.bag_replay import AnyOutput, Pipelines, replay_through
from trainid_ros.bag.reader import BagReader, LoggedRecord, require_topics
from trainid_ros.bag.run_reader import read_runs
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.arguments import DEMO_BAGS, DEMO_QUICK_S, EXPLAIN_CHAPTER
from trainid_ros.cli.explain import REPORT_HTML, explain_runs, prepare_folder, to_json, write_all
from trainid_ros.cli.output import EXIT_NO_ANSWER, for_output, prepare_page, print_json, progress, show, table
from trainid_ros.cli.processes import ProcessGroup, isolate
from trainid_ros.explain.result import Explanation
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.files import shared_path
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, stamp_of, status_of
from trainid_ros.interface.results import AdhesionEstimate, BrakeRateEstimate, Output, ResistanceEstimate, Status
from trainid_ros.monitor.trains import resistance_at
from trainid_ros.report import drive_report, words
from trainid_ros.report.recording import Recorder
from trainid_ros.report.verdict import SPEEDS, judge
from trainid_ros.setup.pipelines import KINDS, RESISTANCE, RESISTANCE_KIND, EstimatorKind, EstimatorSettings
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import Truth, load_truth
from trainid_ros.train.effects import EFFECTS, parse_effects
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis, TrainFile, load_train_file

Say = Callable[[str], None]

_TITLES: Final = {
    'altrios_manifest': 'Freight train on a real route, from an independent simulator',
    'yizhuang_day': 'A day on the Beijing Yizhuang line',
}
_MAX_START_S: Final = 60.0  # within which all nodes must publish [s]
_POLL_S: Final = 0.05
# More than the messages in any demo bag: a node that falls behind catches up at the end and loses none.
_DEPTH: Final = 40000
# Effects that half an hour on the line of the demo shows at any size drawn.
_HIDEABLE: Final = (
    'brake_delay', 'brake_scale', 'gradient_error', 'headwind', 'local_drag', 'mass_error', 'traction_scale',
    'wheel_diameter',
)  # fmt: skip


class Node(NamedTuple):
    """An estimator node of the demo."""

    key: str  # In the JSON output
    label: str  # For people
    kind: EstimatorKind[Any]
    name: str
    topic: str
    settings: EstimatorSettings = EstimatorSettings()


MISSION: Final = tuple(
    Node(kind.name, label, kind, kind.node_name, kind.topic.name)
    for label, kind in zip(('resistance w(v)', 'speed model, mass factor', 'brake rate'), KINDS, strict=True)
)
V_MILS: Final = Node(
    'v_mils',
    'resistance w(v) by V-MILS',
    RESISTANCE_KIND,
    'v_mils_estimator',
    'trainid/v_mils/resistance',
    EstimatorSettings(resistance=RESISTANCE.choose('V-MILS')),
)
NODES: Final = (*MISSION, V_MILS)


def run(args: argparse.Namespace) -> int:
    """Run the demo; return 0 only if live estimates equal the replayed ones and every hidden effect was found."""

    def say(text: str) -> None:
        print(for_output(text), file=sys.stderr if args.json else sys.stdout, flush=True)

    start = time.monotonic()
    names = [name for name in DEMO_BAGS if args.only in (None, name)]
    bags = [load_demo_bag(path) for path in args.bag or map(stock_bag, names)]
    report = prepare_page(args.out / 'report.html') if bags else None
    hides = not args.bag and args.only in (None, EXPLAIN_CHAPTER)
    folder, train = args.out / EXPLAIN_CHAPTER, shared_path('config/trains/yizhuang.yaml')
    hidden = {seed: folder / f'seed_{seed}' for seed in range(args.seed, args.seed + 3)} if hides else {}
    for place in hidden.values():
        prepare_folder(place, train)
    with _interruptible():
        played = [] if report is None else _live(bags, args, report, say)
        cases = [*run_cases(hidden, train, say)]
    worked = all(one.worked for one in played) and all(case.is_found for case in cases)
    wall_s = time.monotonic() - start
    if args.json:
        answer = {'bags': [one.answer for one in played], 'explain': [case.answer for case in cases]}
        print_json(answer | {'report': report, 'wall_s': wall_s, 'worked': worked})
    else:
        show(''.join(f'\n{one.summary()}\n' for one in played))
        show(f'\n{describe_cases(cases)}' if cases else '')
        show(f'\nreport: {report}' if report else '')
        print(f'{wall_s:.0f} s in total; {"all checks passed" if worked else "NOT all checks passed, see above"}')
    return 0 if worked else EXIT_NO_ANSWER


class DemoBag(NamedTuple):
    """A bag of the demo."""

    path: Path
    title: str
    train_path: Path
    train_file: TrainFile
    truth: Truth | None  # None if unknown


def stock_bag(name: str) -> Path:
    """Return the folder of a bag in the source tree; InputError, with what to do instead, if it is not there."""
    try:
        return shared_path(f'bags/{DEMO_BAGS[name]}')
    except InputError as error:
        hint = f'trainid demo SOURCE/bags/{DEMO_BAGS[name]}, or run trainid demo --only {EXPLAIN_CHAPTER}'
        raise InputError(
            f'{error}: bags are not installed; get the source tree of trainid_ros and run {hint}'
        ) from None


def load_demo_bag(path: Path) -> DemoBag:
    """Load the train file and, if there is one, the truth in the folder of a bag; InputError if one is unusable."""
    train, truth = path / 'train.yaml', path / 'truth.yaml'
    known = load_truth(truth) if truth.is_file() else None
    return DemoBag(path, _TITLES.get(path.name, path.name), train, load_train_file(train), known)


def _live(bags: list[DemoBag], args: argparse.Namespace, report: Path, say: Say) -> list[Played]:
    """Play all bags through the live nodes and write the report."""
    logs: Path = args.out / 'log'
    logs.mkdir(parents=True, exist_ok=True)
    say(f'ROS 2 domain {isolate(logs)}, logs in {logs}')
    played = []
    for bag in bags:
        folder = logs / bag.path.name
        folder.mkdir(exist_ok=True)
        say(f'\n{bag.title}: {bag.path} at {args.rate:g} x real time')
        played.append(_play(bag, args.rate, DEMO_QUICK_S if args.quick else math.inf, folder, say))
        for note in played[-1].chapter.notes:
            say(note)
    drive_report.write_report('trainid demo', [one.chapter for one in played], report)
    return played


def _play(bag: DemoBag, rate: float, duration_s: float, folder: Path, say: Say) -> Played:
    """Play a bag to nodes in separate processes, collect what they publish, and compare it with a replay.

    Nodes that are slower than the playback catch up at its end, while the bag is replayed and after. Logs and
    parameters go to a folder. InputError if the bag cannot be played, NoAnswerError if a process fails.
    """
    with BagReader(bag.path) as reader:
        require_topics(reader)
    parameters = folder / 'parameters.yaml'
    parameters.write_text(node_parameters(), encoding='utf-8')
    live = Live(bag.truth, say)
    given = ('--train', str(bag.train_path), '--ros-args', '--params-file', str(parameters.absolute()))
    moved = {
        '__node': V_MILS.name,
        RESISTANCE_KIND.topic.name: V_MILS.topic,
        RESISTANCE_KIND.topic.last_valid: 'trainid/v_mils/last_valid',
    }
    remaps = [word for name, other in moved.items() for word in ('-r', f'{name}:={other}')]
    with ProcessGroup(folder) as group, _subscribed() as (listener, subscriptions):
        group.start('nodes', 'run', *given)
        group.start(V_MILS.name, 'run', '--node', RESISTANCE_KIND.node_name, *given, *remaps)
        deadline = time.monotonic() + _MAX_START_S
        while not all(listener.count_publishers(node.topic) for node in NODES):
            group.check()
            if time.monotonic() > deadline:
                raise NoAnswerError(f'the nodes did not start within {_MAX_START_S:g} s')
            time.sleep(_POLL_S)
        # Without /clock: the nodes work by stamps, and simulated time would cost as much as the inputs. The nodes of
        # one process share their subscriptions: each topic has two subscribers.
        limit = ('--duration', repr(duration_s)) if math.isfinite(duration_s) else ()
        play = ('play', str(bag.path), '--rate', repr(rate), '--wait', '2', *limit)
        player = group.start('bag_player', *play, '--ros-args', '-p', 'publish_clock:=false')
        while player.poll() is None:
            group.check(may_end='bag_player')
            live.take(subscriptions)
            time.sleep(_POLL_S)
        replayed = Replayed(bag, duration_s, live.recorder)
        last_s = time.monotonic()
        # Seconds of silence after which no estimate comes any more, or none that the replay does not have.
        while time.monotonic() < last_s + (15.0 if live.lacks(replayed) else 1.5):
            group.check(may_end='bag_player')
            if live.take(subscriptions):
                last_s = time.monotonic()
            time.sleep(_POLL_S)
        if killed := group.stop():
            raise NoAnswerError(f'{", ".join(killed)} did not stop on SIGTERM and was killed')
    return _conclude(bag, live, replayed)


def node_parameters() -> str:
    """Return a ROS parameter file with which no node loses a message at any playback rate."""

    def parameters(node: Node) -> dict[str, Any]:
        topics = [(topic.name, 'subscription') for topic in INPUT_TOPICS] + [(node.topic, 'publisher')]
        lossless: dict[str, Any] = {'history': 'keep_last', 'depth': _DEPTH, 'reliability': 'reliable'}
        qos = {f'/{name}': {entity: dict(lossless)} for name, entity in topics}
        # No estimate is dropped while the demo is busy with the replay.
        qos[f'/{node.topic}']['publisher']['lifespan'] = 3600 * NS_PER_S
        return {'algorithm': getattr(node.settings, node.kind.name).algorithm, 'qos_overrides': qos}

    return yaml.safe_dump({node.name: {'ros__parameters': parameters(node)} for node in NODES})


@contextmanager
def _subscribed() -> Iterator[tuple[Any, Mapping[Node, Any]]]:
    """Yield a node in the place of an ATO controller, and its subscriptions by the node that publishes."""
    import rclpy  # noqa: PLC0415 - the hidden effect is found without ROS
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    from trainid_ros.ros.topics import message_class  # noqa: PLC0415

    context = rclpy.Context()
    rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
    listener = rclpy.create_node('ato_controller', context=context)
    try:
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        # Messages are polled, which costs far less than a wait set for each: the callback is never called.
        subscribe = partial(listener.create_subscription, callback=lambda _: None, qos_profile=qos)
        yield listener, {node: subscribe(message_class(node.kind.topic), node.topic) for node in NODES}
    finally:
        listener.destroy_node()
        rclpy.try_shutdown(context=context)


class Published:
    """Digests of the outputs of a node or of its replay, and the newest output.

    Repeats that report missing input are left out: a clock causes those, and a replay has none.
    """

    def __init__(self) -> None:
        self.digests: list[tuple[int, int]] = []  # with stamps
        self.newest: Output[Any] | None = None

    def add(self, output: Output[Any]) -> bool:
        """Take in an output; return False for a repeat, and for the adhesion, which is not compared."""
        if isinstance(output.estimate, AdhesionEstimate):
            return False
        if output.status is Status.STALE and output.stamp_ns == (self.digests[-1][0] if self.digests else 0):
            return False
        self.digests.append((output.stamp_ns, hash(repr(_values(output.estimate, type(output.estimate))))))
        self.newest = output
        return True


def _values(source: Any, kind: type[Any]) -> dict[str, Any]:
    """Return the fields of an estimate, of which a message may hold some as arrays."""
    values = ((item.name, getattr(source, item.name)) for item in fields(kind))
    return {name: tuple(map(float, value)) if hasattr(value, '__len__') else value for name, value in values}


class Live:
    """What the nodes publish while a bag is played."""

    def __init__(self, truth: Truth | None, say: Say) -> None:
        self.published = {node: Published() for node in NODES}
        self.recorder, self.v_mils = Recorder(), Recorder()
        self.first_s = self.last_s = 0.0
        self._truth, self._say, self._next_s = truth, say, 0.0

    def take(self, subscriptions: Mapping[Node, Any]) -> int:
        """Take in what has arrived, show the newest values if the next line is due, and return the number."""
        count = 0
        for node, subscription in subscriptions.items():
            with subscription.handle:
                while (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                    count += self._receive(node, taken[0])
        if count:
            self.last_s = time.monotonic()
            self.first_s = self.first_s or self.last_s
        if self.first_s and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + 5.0
            newest = {node: one.newest for node, one in self.published.items() if one.newest is not None}
            self._say(line(newest, self._truth))
        return count

    def lacks(self, replayed: Replayed) -> bool:
        """Return whether a node has published fewer estimates than its replay."""
        return any(len(self.published[node].digests) < len(x.digests) for node, x in replayed.published.items())

    def _receive(self, node: Node, message: Any) -> bool:
        kind = node.kind.topic.estimate
        counts = int(message.used), int(message.rejected)
        output: Any = Output(stamp_of(message), kind(**_values(message, kind)), status_of(message), *counts, None)
        is_new = self.published[node].add(output)
        if is_new:
            (self.v_mils if node is V_MILS else self.recorder).on_output(output)
        return is_new


def line(newest: Mapping[Node, Output[Any]], truth: Truth | None) -> str:
    """Return the newest outputs of the nodes as one line of text, with the truth."""
    parts: list[str] = []
    for node, output in newest.items():
        at, e = None if truth is None else truth.truth_at_ns(output.stamp_ns), output.estimate
        known = ''
        if isinstance(e, ResistanceEstimate):
            name = 'w by V-MILS' if node is V_MILS else f'{3.6 * e.speed:5.1f} km/h  w'
            value = f'{name} {e.resistance:.3f} ± {e.resistance_std:.3f}'
            known = '' if at is None else f' (truth {davis(at.resistance, e.speed):.3f})'
        elif isinstance(e, BrakeRateEstimate):
            value = f'brake rate {e.brake_rate:.3f} ± {e.brake_rate_std:.3f}'
            known = '' if at is None or at.brake_rate is None else f' (truth {at.brake_rate:.3f})'
        else:
            value = f'mass factor {e.mass_factor:.3f}'
        parts.append(f'{value}{known} {output.status.name}, {output.used} used, {output.rejected} rejected')
    return '  '.join(parts)


class Comparison(NamedTuple):
    """Numbers of estimates: live ones against those of a replay."""

    replayed: int
    received: int
    equal: int  # To the bit
    missing: int  # Replayed ones without a live one
    extra: int  # Live ones without a replayed one

    @property
    def exact(self) -> bool:
        """True if every estimate of the replay was received, the same to the bit, and no other."""
        return self.equal == self.replayed == self.received

    def __str__(self) -> str:
        if self.exact:
            return f'live equals replay to the bit: all {self.replayed} messages'
        differ = f'live differs from replay: {self.equal} of {self.replayed} estimates are equal to the bit'
        return f'{differ}, {self.missing} were missed, {self.extra} have no counterpart'


def compare(received: list[tuple[int, int]], replayed: list[tuple[int, int]]) -> Comparison:
    """Compare stamps and digests of estimates, in whatever order."""
    equal = (Counter(received) & Counter(replayed)).total()
    stamps = (Counter(stamp for stamp, _ in received) & Counter(stamp for stamp, _ in replayed)).total()
    return Comparison(len(replayed), len(received), equal, len(replayed) - stamps, len(received) - stamps)


class Played(NamedTuple):
    """A bag that was played live and replayed: its chapter of the report, and its part of the JSON output."""

    chapter: drive_report.Chapter
    answer: dict[str, Any]
    worked: bool  # True if every live estimate equals its replayed one

    def summary(self) -> str:
        """Return the results as lines of text."""
        chapter, answer, f = self.chapter, self.answer, self.chapter.brake_rate
        true = chapter.final_truth()[0]
        lines = (
            chapter.title,
            f'{chapter.recording.duration_s / 60.0:.0f} min of driving, {chapter.how}',
            *describe_resistance(f'{RESISTANCE.default} (default)', chapter.resistance, true),
            *describe_resistance('V-MILS', answer['v_mils'], true),
            f'brake rate {f.estimate.brake_rate:.3f} ± {f.estimate.brake_rate_std:.3f}, {f.status.name}',
            *(
                f'{name}, error against truth: rms {score.rms:.3f}, mean {score.bias:+.3f}, last {score.last:+.3f}; '
                f'truth within ±1 std {score.inside_68:.0%}, within ±1.96 std {score.inside_95:.0%} of the time'
                for name, score in zip(('w', 'w by V-MILS', 'brake rate'), answer['scores'].values(), strict=True)
                if score is not None
            ),
            *chapter.notes,
        )
        return '\n  '.join(lines)


def describe_resistance(name: str, output: Output[ResistanceEstimate], true: Davis | None) -> tuple[str, str]:
    """Return a, b, c of an algorithm, and w at three speeds with its error if the truth is known, as two lines."""
    e = output.estimate
    values = []
    for v in SPEEDS:
        w, std = resistance_at(e, v)
        error = '' if true is None else f' (error {w - davis(true, v):+.3f})'
        values.append(f'w({v:g} m/s) = {w:.3f} ± {std:.3f}{error}')
    head = f'{name}: w(v) = {e.a:.3f} {e.b:+.4f} v {e.c:+.5f} v² N/kN'
    counts = f'{output.used} samples used, {output.rejected} rejected'
    return f'{head}, {output.status.name}, {counts}', f'  {", ".join(values)}'


class Replayed:
    """Replay of a bag: what each node should have published, and the outcome for those of the mission."""

    def __init__(self, bag: DemoBag, duration_s: float, recorder: Recorder) -> None:
        """Replay a bag up to a duration [s]; the inputs go to a recorder."""
        self.published = {node: Published() for node in NODES}
        self._v_mils = V_MILS.kind.pipeline(bag.train_file, V_MILS.settings)
        self._recorder = recorder
        pipelines = Pipelines.of(bag.train_file, EstimatorSettings())
        with BagReader(bag.path) as reader, progress('replay for comparison'):
            self.outcome = replay_through(pipelines, reader, observers=(self,), duration_s=duration_s)

    def on_record(self, entry: LoggedRecord) -> None:
        """Pass an input to V-MILS, and to the recorder."""
        self._recorder.add_record(entry.record)
        for output in self._v_mils.push(entry.record):
            self.published[V_MILS].add(output)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002 - an observer of a replay
        """Take in an output of a node of the mission."""
        for node in MISSION:
            if isinstance(output.estimate, node.kind.topic.estimate):
                self.published[node].add(output)


def _conclude(bag: DemoBag, live: Live, replayed: Replayed) -> Played:
    """Compare what the nodes published with the replay, and score it."""
    compared = {node: compare(live.published[node].digests, x.digests) for node, x in replayed.published.items()}
    # A node that published nothing live still has its prior.
    newest: dict[str, Any] = {
        node.key: live.published[node].newest or node.kind.pipeline(bag.train_file, node.settings).current()
        for node in NODES
    }
    recording, beside, truth = live.recorder.finish(), live.v_mils.finish(), bag.truth
    rate = recording.duration_s / (live.last_s - live.first_s) if live.last_s > live.first_s else math.nan
    chapter = drive_report.Chapter(
        bag.title,
        str(bag.path),
        str(bag.train_path),
        bag.train_file,
        f'live over ROS 2 at {rate:.0f} x real time, then off line',
        recording,
        **{node.key: newest[node.key] for node in MISSION},
        rejections={node.label: dict(getattr(replayed.outcome, node.key).rejections) for node in MISSION},
        truth=truth,
        notes=(
            *(f'{node.label}: {comparison}' for node, comparison in compared.items()),
            *drive_report.stop_sentences(drive_report.stop_errors(recording, truth, bag.train_file)[1]),
        ),
        others=(('V-MILS', beside.resistance),),
        verdict=judge(replayed.outcome, (None, None), str(bag.path), str(bag.train_path)),
    )
    answer = {
        'bag': chapter.bag,
        'duration_s': recording.duration_s,
        'rate': rate,
        **newest,
        'scores': {
            'resistance': truth and drive_report.score_resistance(recording, truth),
            'v_mils': truth and drive_report.score_resistance(beside, truth),
            'brake_rate': truth and drive_report.score_brake_rate(recording, truth),
        },
        'live_against_replay': {node.label: comparison._asdict() for node, comparison in compared.items()},
    }
    return Played(chapter, answer, all(comparison.exact for comparison in compared.values()))


@contextmanager
def _interruptible() -> Iterator[None]:
    """Handle signals like Ctrl-C, so that child processes are stopped; ROS may turn one into a RuntimeError."""
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


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect and what was found."""

    seed: int
    hidden: str  # Effect as for --effect
    explanation: Explanation
    folder: Path  # Of the report

    @property
    def is_found(self) -> bool:
        """Whether the hidden effect is among those found."""
        return self.hidden.partition(':')[0] in [effect.name for effect in self.explanation.effects]

    @property
    def answer(self) -> dict[str, Any]:
        """The case for ``--json``."""
        found, report = to_json(self.explanation), self.folder / REPORT_HTML
        return {'seed': self.seed, 'hidden': self.hidden, 'is_found': self.is_found, 'found': found, 'report': report}


def run_cases(folders: Mapping[int, Path], train: Path, say: Say) -> Iterator[Case]:
    """Simulate runs with an effect that the train file lacks, and explain the gap, for each seed in its folder."""
    full, runs = load_train_file(train), 8
    stated = replace(full, line=replace(full.line, stops=full.line.stops[:5]))
    for each, place in folders.items():
        rng = np.random.default_rng(each)
        hidden = draw_effect(rng, stated.line.stops[-1])
        a, b, c = (x * rng.uniform(0.8, 1.2) for x in (full.resistance.a, full.resistance.b, full.resistance.c))
        say(f'seed {each}: {runs} runs on the Yizhuang line, there and back; hidden: {hidden}, and other a, b and c')
        bag = place / 'bag'
        shutil.rmtree(bag, ignore_errors=True)  # of an earlier demo
        true = replace(stated, resistance=Davis(a, b, c), effects=parse_effects([hidden]))
        with BagWriter(bag) as writer:
            for record in simulate(Scenario(true, runs=runs), rng).records:
                writer.write_record(record)
        explanation = explain_runs(read_runs([bag], stated), stated, [bag])
        notes = (f'Hidden in the simulation: {hidden}; a = {a:.3g}, b = {b:.3g}, c = {c:.3g}.',)
        write_all(place, explanation, stated, str(train), [bag], notes)
        yield Case(each, hidden, explanation, place)


def draw_effect(rng: np.random.Generator, end: float) -> str:
    """Return an effect on a line from 0 to ``end`` [m], drawn at random, as for ``--effect``."""
    kind = EFFECTS[_HIDEABLE[rng.integers(len(_HIDEABLE))]]
    sign = kind.sign or rng.choice((-1, 1))
    parameters = {kind.amplitude: kind.neutral + sign * rng.uniform(1.0, 2.0) * kind.typical_size}
    if 'start' in kind.shape:
        length = rng.uniform(500.0, 3000.0)  # m
        start = rng.uniform(0.0, end - length)
        parameters |= {'start': round(start), 'end': round(start + length)}
    return f'{kind.name}:{",".join(f"{name}={value:.4g}" for name, value in parameters.items())}'


def describe_cases(cases: list[Case]) -> str:
    """Return what was hidden beside what was found, and the gap on runs left out, as text."""
    rows = [('seed', 'hidden', 'found', 'gap before -> after, m/s')]
    for case in cases:
        gap = case.explanation.gap
        found = [f'{effect.name}: {words.parameters_text(effect)}' for effect in case.explanation.effects]
        text = '; '.join(found) or case.explanation.verdict.value
        rows.append((str(case.seed), case.hidden, text, f'{gap.before:.3f} -> {gap.after:.3f}' if gap else words.DASH))
    reports = '\n'.join(f'report: {case.folder / REPORT_HTML}' for case in cases)
    return f'Effects missing from the train file\n{table(rows)}\n{reports}'

# SPDX-License-Identifier: Apache-2.0
"""Lifecycle nodes that play records at their recorded pace, mapped to a steady clock without drift.

``bag_player`` publishes the inputs of a bag and ``/clock``, in bag order, paced by log time. ``train_simulator``
publishes a simulated train in real time; without ``publish_clock`` its stamps are those of the present, as a real
train's would be.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeAlias

import numpy as np
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rosgraph_msgs.msg import Clock as ClockMessage

from trainid_ros.bag import missing_package_error
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, input_topic
from trainid_ros.interface.text import pluralise
from trainid_ros.ros.node import ManagedNode, NodeParameters, guarded, run_node
from trainid_ros.ros.topics import foreign_class, is_hash, message_class, message_from_record, source_qos, time_message
from trainid_ros.setup.params_file import AUTOSTART, SEED, TRAIN_FILE, on_configure
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.worlds import REALISMS, WORLDS, find_world, make_case, unknowns_of, world_train
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from trainid_ros.bag.types import StoredType
    from trainid_ros.interface.records import Record
    from trainid_ros.setup.params_file import ParameterSpec

# /clock also ticks through gaps, so that nodes on simulated time detect dropouts [ns].
_TICK_NS: Final = NS_PER_S // 20

Entry: TypeAlias = 'tuple[int, str, Record | bytes | None]'
"""Log time [ns], topic, and record or stored message of a foreign topic; without that only the clock ticks."""


@dataclass(frozen=True, slots=True)
class Timeline:
    """Records by time, which can be iterated any number of times."""

    first_ns: int  # Start time [ns]
    last_ns: int  # End time [ns]
    entries: Callable[[], Iterator[Entry]]  # Returns an iterator over the records from the start
    foreign: Mapping[str, StoredType] = field(default_factory=dict)  # Types of the foreign topics among them
    replaced: frozenset[str] = OWN.replaced  # Our own topics that are not among them
    close: Callable[[], object] = lambda: None  # Releases what it reads from

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (self.last_ns - self.first_ns) / NS_PER_S


_NOTHING: Final = Timeline(0, 0, lambda: iter(()))


def with_ticks(timeline: Timeline, start_s: float, duration_s: float) -> Iterator[Entry]:
    """Yield a part of a timeline with clock ticks in its gaps; start and duration in [s], a duration of 0 means all."""
    begin = timeline.first_ns + round(start_s * NS_PER_S)
    end = min(begin + round(duration_s * NS_PER_S), timeline.last_ns) if duration_s > 0.0 else timeline.last_ns
    clock = begin
    for entry in timeline.entries():
        time_ns = entry[0]
        if time_ns < begin:
            continue
        if time_ns > end:
            break
        while time_ns - clock > _TICK_NS:
            clock += _TICK_NS
            yield clock, '', None
        clock = time_ns
        yield entry
    yield end, '', None


@dataclass
class Pacer:
    """Maps recorded time to steady time, at a rate in recorded seconds per second [1]."""

    rate: float
    _anchor: tuple[int, int] | None = None

    def release(self) -> None:
        """Drop the anchor: the next entry is due at once."""
        self._anchor = None

    def due_ns(self, time_ns: int, steady_ns: int) -> int:
        """Return when an entry is due by the steady clock [ns], which now reads ``steady_ns``."""
        if self._anchor is None:
            self._anchor = (time_ns, steady_ns)
        due = self._anchor[1] + round((time_ns - self._anchor[0]) / self.rate)
        # Catching up on more than a second of the record at once could overflow the queues of the subscribers.
        if (steady_ns - due) * self.rate > NS_PER_S * max(self.rate, 1.0):
            self._anchor = (time_ns, steady_ns)
            return steady_ns
        return due


# Time between looks for subscribers [ns].
_POLL_NS: Final = NS_PER_S // 50
# Messages after which the player waits until all are acknowledged, and between two looks whether they are [1]: the
# publishers keep 10,000 of each topic, and a subscriber that falls further behind would lose the oldest.
_MAX_UNACKNOWLEDGED: Final = 4000
_LOOK_EVERY: Final = 64
# A subscriber discovered by this node may not have discovered it yet, and loses best-effort messages until then [ns].
_DISCOVERY_NS: Final = NS_PER_S // 2
# A longer wait for subscribers is logged, and again as what it waits for changes [ns].
_LONG_WAIT_NS: Final = 3 * NS_PER_S


def playback_parameters(*, live: bool) -> tuple[ParameterSpec, ...]:
    """Return the parameters of every playback node; if ``live``, records are stamped with the present by default."""
    return (
        on_configure('rate', 1.0, 'recorded seconds per second [1]', 0.01, 1000.0),
        on_configure('start', 0.0, 'where to start, after the beginning [s]', 0.0, 1e7),
        on_configure('duration', 0.0, 'how long to play, 0 = to the end [s]', 0.0, 1e7),
        on_configure('loop', False, 'start over at the end'),
        on_configure('wait', 0, 'subscribers to wait for on each topic', 0, 1000),
        on_configure('publish_clock', not live, 'publish recorded time on /clock'),
        on_configure('restamp', live, 'shift all stamps to the present; needs rate 1'),
        AUTOSTART,
    )


class PlaybackNode(ManagedNode):
    """Base class of bag player and simulator: activating it plays, deactivating it pauses.

    Attributes:
        NAME: Its usual name.
        SPECS: Its parameters.
        finished: True once all records have been played and delivered.
        position_ns: Recorded time of the last entry published [ns], 0 before the start.
        played: Number of records published.
    """

    NAME: ClassVar[str]
    SPECS: ClassVar[tuple[ParameterSpec, ...]]

    def __init__(self, arguments: Sequence[str] = (), **options: Any) -> None:
        """Declare all parameters; the ROS arguments of the process are searched for parameter files."""
        super().__init__(self.NAME, **options)
        self.parameters = NodeParameters(self, self.SPECS, arguments)
        self.parameters.report()
        self._outputs: dict[str, Any] = {}  # By topic
        self._clock_output: Any = None
        self._timer: Any = None
        self.timeline = _NOTHING
        self._release()

    def open_timeline(self) -> Timeline:
        """Return the timeline to play; called on configure. InputError if there is nothing to play."""
        raise NotImplementedError

    @guarded
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the timeline and create the publishers."""
        self.failure = ''
        self.parameters.check()
        rate, restamp = float(self.parameters.value('rate')), self.parameters.value('restamp')
        if restamp and rate != 1.0:
            raise InputError(f'restamp needs rate = 1, not {rate}')
        self.timeline = self.open_timeline()
        if restamp and self.timeline.foreign:
            raise InputError('restamp does not change messages of foreign topics: leave out restamp or mapping_file')
        for topic in INPUT_TOPICS:
            if topic.name not in self.timeline.replaced:
                kind = message_class(topic)
                self._outputs[topic.name] = self.create_lifecycle_publisher(kind, topic.name, source_qos())
        for name, stored in self.timeline.foreign.items():
            self._offer(name, stored)
        if self.parameters.value('publish_clock'):
            self._clock_output = self.create_lifecycle_publisher(ClockMessage, '/clock', source_qos())
        self._pacer = Pacer(rate)
        self._rewind()
        return super().on_configure(state)

    def _offer(self, name: str, kind: StoredType) -> None:
        """Create the publisher of a foreign topic; InputError if its type is not installed as in the bag."""
        publisher = self.create_lifecycle_publisher(foreign_class(kind.name), name, source_qos())
        self._outputs[name] = publisher
        for info in self.get_publishers_info_by_topic(publisher.topic_name):
            installed = str(info.topic_type_hash)
            if info.node_name == self.get_name() and is_hash(installed) and installed != kind.digest:
                raise InputError(f'topic {name}: {kind.name} in the bag is not the version that is installed here')

    @guarded
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start or resume playback."""
        result = super().on_activate(state)
        self._anchor()
        self._timer = self.create_timer(_POLL_NS / NS_PER_S, self._play, clock=self.steady_clock)
        return result

    def _pause(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def _release(self) -> None:
        self._pause()
        for publisher in (*self._outputs.values(), self._clock_output):
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        self.timeline.close()
        self._outputs = {}
        self._clock_output = None
        self._entries: Iterator[Entry] = iter(())
        self._next: Entry | None = None
        self._pacer = Pacer(1.0)
        self.timeline = _NOTHING
        self.finished = False
        self._complete_ns = self._waiting_ns = self._blocked_ns = self._acknowledged = 0
        self._said = ''
        self.position_ns = self.played = 0

    def _rewind(self) -> None:
        start, duration = float(self.parameters.value('start')), float(self.parameters.value('duration'))
        if start > self.timeline.duration_s:
            raise InputError(f'start = {start:g} s: what is played is {self.timeline.duration_s:.1f} s long')
        self._entries = with_ticks(self.timeline, start, duration)
        self._next = next(self._entries, None)
        self._anchor()

    def _anchor(self) -> None:
        """Make the next entry due now."""
        self._pacer.release()
        self._shift_ns: int | None = None

    def _play(self) -> None:
        if self.finished or self._is_waiting():
            return
        now = self.steady_ns()
        while self._next is not None:
            if self._is_too_far_ahead():
                return
            due = self._pacer.due_ns(self._next[0], now)
            if due > now:
                self._sleep(due - now)
                return
            self._publish(*self._next)
            self._next = next(self._entries, None)
        self._finish()

    def _is_waiting(self) -> bool:
        """Return True before the start while subscribers are missing or have only just been discovered."""
        wanted = int(self.parameters.value('wait'))
        if not wanted or self.position_ns:
            return False
        now = self.steady_ns()
        # With a mapping for its topics, which nodes subscribe to last; nobody may want the others.
        outputs = [self._outputs[name] for name in self.timeline.foreign or self._outputs]
        counts = {output.topic_name: output.get_subscription_count() for output in outputs}
        lacking = [f'{topic} has {count}' for topic, count in sorted(counts.items()) if count < wanted]
        if not lacking:
            self._complete_ns = self._complete_ns or now
            return now - self._complete_ns < _DISCOVERY_NS
        self._complete_ns, self._waiting_ns = 0, self._waiting_ns or now
        text = f'waiting for {pluralise(wanted, "subscriber")} on each topic: {", ".join(lacking)}'
        if now - self._waiting_ns >= _LONG_WAIT_NS and text != self._said:
            self._said = text
            self.get_logger().warning(text)
        return True

    def _sleep(self, pause_ns: int) -> None:
        self._timer.timer_period_ns = max(pause_ns, 1000)
        self._timer.reset()

    def _publish(self, time_ns: int, topic: str, content: Record | bytes | None) -> None:
        if self._clock_output is not None and time_ns != self.position_ns:
            self._clock_output.publish(ClockMessage(clock=time_message(time_ns)))
        self.position_ns = time_ns
        if content is None:
            return
        if not isinstance(content, bytes):
            if self.parameters.value('restamp'):
                if self._shift_ns is None:
                    self._shift_ns = self.now_ns() - time_ns
                content = replace(content, stamp_ns=content.stamp_ns + self._shift_ns)
            content = message_from_record(content)
        self._outputs[topic].publish(content)
        self.played += 1

    def _is_too_far_ahead(self) -> bool:
        """Return whether too many messages are not acknowledged; if so, look again later."""
        ahead = self.played - self._acknowledged
        if ahead % _LOOK_EVERY or not ahead:
            return False
        if not self._is_acknowledged(must_wait=ahead >= _MAX_UNACKNOWLEDGED):
            return ahead >= _MAX_UNACKNOWLEDGED
        self._acknowledged = self.played
        return False

    def _finish(self) -> None:
        if self.parameters.value('loop') and self.played:
            self._rewind()
            self._sleep(_POLL_NS)
            return
        if not self._is_acknowledged(must_wait=True):
            return
        time.sleep(0.3)  # best-effort subscribers take the last messages, and acknowledge none
        self._pause()
        self.finished = True
        self.get_logger().info(f'played {self.played} records')

    def _is_acknowledged(self, *, must_wait: bool) -> bool:
        """Return whether all messages are acknowledged; if waiting, look again later, and return True after long."""
        if all(output.wait_for_all_acked(Duration(nanoseconds=0)) for output in self._outputs.values()):
            self._blocked_ns = 0
            return True
        if not must_wait:
            return False
        now = self.steady_ns()
        self._blocked_ns = self._blocked_ns or now
        if now - self._blocked_ns > 30 * NS_PER_S:
            self._blocked_ns = 0
            return True
        # Signals are served between two looks.
        self._sleep(_POLL_NS)
        return False


class BagPlayer(PlaybackNode):
    """Lifecycle node that plays a bag."""

    NAME: ClassVar = 'bag_player'
    SPECS: ClassVar = (
        on_configure('bag', '', 'rosbag2 directory, .mcap or .db3 file'),
        on_configure('bag_namespace', '/', 'namespace of the topics in the bag'),
        on_configure('mapping_file', '', 'mapping file, whose topics are played'),
        on_configure('max_chunk', 64, 'largest chunk to unpack [MB]', 1, 4095),
        *playback_parameters(live=False),
    )

    def open_timeline(self) -> Timeline:
        """Open the bag; InputError if it cannot be read or has no inputs, or the packages for bags are missing."""
        path = str(self.parameters.value('bag'))
        if not path:
            raise InputError('no bag: give the parameter bag')
        # Imported here so that the node can name what is missing.
        try:
            from trainid_ros.bag.reader import BagReader  # noqa: PLC0415

            max_chunk = int(self.parameters.value('max_chunk')) << 20
            namespace = str(self.parameters.value('bag_namespace'))
            file = str(self.parameters.value('mapping_file'))
            mapping = load_mapping(Path(file).expanduser()) if file else OWN
            reader = BagReader(path, namespace, max_chunk, mapping=mapping).__enter__()
        except ModuleNotFoundError as error:
            raise missing_package_error(error) from None
        for warning in reader.warnings:
            self.get_logger().warning(warning)
        span = reader.time_range()
        if span is None or not reader.input_count:
            reader.close()
            raise InputError(f'{path}: no messages on the input topics')
        return Timeline(*span, reader.stored, reader.mapped_types(), reader.mapping.replaced, reader.close)


class TrainSimulator(PlaybackNode):
    """Lifecycle node that simulates on configure and publishes while active."""

    NAME: ClassVar = 'train_simulator'
    SPECS: ClassVar = (
        TRAIN_FILE,
        on_configure(
            'world',
            '',
            'type of railway, with its own train unless train_file is given, whose values are the stated ones, '
            'not true',
            choices=('', *WORLDS),
        ),
        on_configure(
            'realism',
            'clean',
            'with world only: clean, the train file is exact, or field, it has errors as on real trains',
            choices=tuple(REALISMS),
        ),
        on_configure('runs', 4, 'runs from stop to stop', 1, 1000),
        SEED,
        *playback_parameters(live=True),
    )

    def open_timeline(self) -> Timeline:
        """Simulate, and return the records; InputError if the train file is missing or cannot be simulated."""
        rng = np.random.default_rng(int(self.parameters.value('seed')))
        records = simulate(self._scenario(rng), rng).records
        entries = [(record.stamp_ns, input_topic(record).name, record) for record in records]
        return Timeline(entries[0][0], entries[-1][0], lambda: iter(entries))

    def _scenario(self, rng: np.random.Generator) -> Scenario:
        path, name = str(self.parameters.value('train_file')), str(self.parameters.value('world'))
        realism, runs = str(self.parameters.value('realism')), int(self.parameters.value('runs'))
        if not (path or name):
            raise InputError('no train: give the parameter train_file or world')
        given = load_train_file(Path(path).expanduser()) if path else None
        if not name and given:
            if realism != 'clean':
                raise InputError(f'realism = {realism!r} needs the parameter world')
            return Scenario(given, runs=runs)
        world = find_world(name)
        stated = given or world_train(world)
        return make_case(world, stated, unknowns_of(realism, (), stated), runs, rng.spawn(1)[0]).scenario


# The programs, each of which returns its exit code.
bag_player_main, train_simulator_main = partial(run_node, BagPlayer), partial(run_node, TrainSimulator)

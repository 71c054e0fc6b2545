# SPDX-License-Identifier: Apache-2.0
"""The estimator nodes: lifecycle, services, topics, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from trainid_msgs.msg import AtoSpeed, ResistanceEstimate, TrainMass

from trainid_ros.estimators.consistency import WINDOW
from trainid_ros.estimators.pipeline import EstimatorSettings
from trainid_ros.records import (
    INPUT_TOPICS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    InputTopic,
    Record,
    SpeedRecord,
)
from trainid_ros.results import Status
from trainid_ros.ros import brake_rate_node as brake_rate
from trainid_ros.ros import resistance_node as resistance
from trainid_ros.ros import speed_model_node as speed_model
from trainid_ros.ros.conversion import message_from_record, time_message

pytestmark = pytest.mark.ros

Graph: TypeAlias = Any  # the fixture of conftest.py
START_NS = 1_700_000_000 * NS_PER_S

FACTORIES = (resistance.make_node, speed_model.make_node, brake_rate.make_node)
SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)


def coasting(count: int, start_ns: int = START_NS, speed: float = 20.0) -> list[Record]:
    """Records of a coasting train, all topics on the same stamps, with a little noise."""
    rng = np.random.default_rng(5)
    records: list[Record] = []
    for k in range(count):
        stamp = start_ns + k * NS_PER_S // 5
        records += [
            ForceRecord(stamp, 0.0),
            GradientRecord(stamp, 0.0, 0.0, False),
            BrakeRecord(stamp, 0.0, False),
            SpeedRecord(stamp, speed - 0.0045 * k + 0.01 * float(rng.standard_normal()), 4.0 * k),
        ]
    return records


def shifted(records: Sequence[Record], seconds: float) -> list[Record]:
    """The same records at another time."""
    return [replace(record, stamp_ns=record.stamp_ns + round(seconds * NS_PER_S)) for record in records]


def topic_of(record: Record) -> InputTopic:
    return next(topic for topic in INPUT_TOPICS if topic.record is type(record))


def feed(node: Any, records: Sequence[Record]) -> None:
    """Hand records to a node as its subscriptions would."""
    for record in records:
        node.receive(topic_of(record), message_from_record(record))


class Published:
    """Collects the outputs that a node publishes."""

    def __init__(self, node: Any) -> None:
        self.messages: list[Any] = []
        publish = node._publish

        def collect(output: Any) -> None:
            self.messages.append(output)
            publish(output)

        node._publish = collect


def active(graph: Graph, train_file: str, factory: Any = resistance.make_node, **parameters: object) -> Any:
    node = graph.make(factory, train_file=train_file, **parameters)
    assert node.bring_up(), node.failure
    return node


@pytest.mark.parametrize('factory', FACTORIES)
def test_every_transition_works_twice_before_shutdown(graph: Graph, train_file: str, factory: Any) -> None:
    node = graph.make(factory, train_file=train_file)
    assert node.state == 'unconfigured'
    for _ in range(2):
        assert node.trigger_configure() == SUCCESS
        assert node.trigger_activate() == SUCCESS
        feed(node, coasting(60))
        assert node.pipeline.used + node.pipeline.rejections.total() > 50
        assert node.trigger_deactivate() == SUCCESS
        assert node.trigger_cleanup() == SUCCESS
        assert node.pipeline is None
        assert not [s for s in node.subscriptions if s.topic_name.startswith('/ato/')]
    assert node.trigger_shutdown() == SUCCESS
    assert node.state == 'finalized'


@pytest.mark.parametrize('steps', [(), ('configure',), ('configure', 'activate')])
def test_shutdown_works_from_every_state(graph: Graph, train_file: str, steps: tuple[str, ...]) -> None:
    node = graph.make(resistance.make_node, train_file=train_file)
    for step in steps:
        assert getattr(node, f'trigger_{step}')() == SUCCESS
    assert node.trigger_shutdown() == SUCCESS
    assert node.state == 'finalized'


def test_inputs_are_ignored_and_the_state_is_kept_while_inactive(graph: Graph, train_file: str) -> None:
    node = graph.make(resistance.make_node, train_file=train_file)
    node.trigger_configure()
    published = Published(node)
    records = coasting(200)
    feed(node, records[:100])
    assert (published.messages, node.pipeline.newest_ns) == ([], 0)
    node.trigger_activate()
    feed(node, records[100:400])
    before = node.pipeline.estimator.save()
    node.trigger_deactivate()
    feed(node, records[400:600])
    assert node.pipeline.estimator.save() == before
    node.trigger_activate()
    feed(node, records[600:])
    assert node.pipeline.estimator.save() != before
    assert node.pipeline.resets == 0


def test_an_invalid_transition_is_rejected_and_the_node_keeps_running(graph: Graph, train_file: str) -> None:
    node = graph.make(resistance.make_node, train_file=train_file)
    caller = graph.plain('caller')
    wrong = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
    assert not graph.call(caller, ChangeState, '/resistance_estimator/change_state', wrong).success
    right = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert graph.call(caller, ChangeState, '/resistance_estimator/change_state', right).success
    assert graph.call(caller, GetState, '/resistance_estimator/get_state').current_state.label == 'inactive'
    assert node.state == 'inactive'


def test_a_bad_train_file_fails_with_one_reason_and_the_node_stays_usable(
    graph: Graph, train_file: str, tmp_path: Path
) -> None:
    bad = tmp_path / 'bad.yaml'
    bad.write_text('train: {mass: -1.0}\nresistance: {a: 1, b: 0, c: 0}\n', encoding='utf-8')
    node = graph.make(resistance.make_node, train_file=str(bad))
    assert node.trigger_configure() == FAILURE
    assert node.state == 'unconfigured'
    assert 'bad.yaml: train.mass = -1 kg must be > 0' in node.failure
    node.set_parameters([Parameter('train_file', value=train_file)])
    assert node.bring_up(), node.failure


def test_an_unexpected_error_is_logged_and_leaves_the_node_unconfigured(
    graph: Graph, train_file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.make(resistance.make_node, train_file=train_file)

    def broken() -> None:
        msg = 'no such thing'
        raise KeyError(msg)

    with monkeypatch.context() as patch:
        patch.setattr(node, '_open', broken)
        assert node.trigger_configure() == ERROR
    assert (node.state, node.failure) == ('unconfigured', "KeyError: 'no such thing'")
    assert node.bring_up(), node.failure


def test_parameters_come_from_the_train_file_and_given_ones_override(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file, resistance__b=0.05)
    shown = {name: node.get_parameter(name).value for name in ('train.mass', 'resistance.a', 'resistance.b')}
    assert shown == {'train.mass': 194000.0, 'resistance.a': 1.5, 'resistance.b': 0.05}
    prior = node.pipeline.current().estimate
    assert (prior.a, prior.b, prior.c) == (1.5, 0.05, 0.0012)


def test_a_changed_train_file_is_read_on_the_next_configure(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file)
    text = Path(train_file).read_text(encoding='utf-8')
    Path(train_file).write_text(text.replace('a: 1.5', 'a: 1.9'), encoding='utf-8')
    node.trigger_deactivate()
    node.trigger_cleanup()
    node.trigger_configure()
    assert node.get_parameter('resistance.a').value == 1.9
    assert node.pipeline.current().estimate.a == 1.9


def test_setting_a_parameter_live_changes_nothing_until_the_next_configure(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file)
    feed(node, coasting(100))
    before = node.pipeline.estimator.save()
    assert node.set_parameters([Parameter('estimator.step_share_c', value=9.0)])[0].successful
    assert node.pipeline.estimator.save() == before
    assert node.pipeline.estimator.config.step_share_c == 0.2
    node.trigger_deactivate()
    node.trigger_cleanup()
    node.trigger_configure()
    assert node.pipeline.estimator.config.step_share_c == 9.0


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('estimator.step_share_c', float('nan')),
        ('estimator.step_share_c', float('inf')),
        ('estimator.min_age', 100000.0),
        ('resistance.b', float('nan')),
        ('time_jump_policy', 'panic'),
        ('autostart', True),
    ],
)
def test_invalid_parameters_are_rejected_with_a_reason_that_names_them(
    graph: Graph, train_file: str, name: str, value: object
) -> None:
    node = active(graph, train_file)
    before = node.get_parameter(name).value
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful
    assert name in result.reason
    assert node.get_parameter(name).value == before


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (('-p', 'alignment.perod:=0.3'), "unknown parameter 'alignment.perod': did you mean 'alignment.period'?"),
        (('-p', 'estimator.min_age:=2000.0'), r'estimator.min_age = 2000 is outside [0, 1000]'),
        (('-p', 'train.mass:=heavy'), "train.mass = 'heavy' must be a number"),
        (('-p', 'estimator.step_share_c:=.nan'), 'estimator.step_share_c = nan is outside'),
    ],
)
def test_invalid_parameters_at_start_are_named_and_prevent_configuring(
    graph: Graph, train_file: str, arguments: tuple[str, ...], reason: str
) -> None:
    node = graph.make(resistance.make_node, arguments=arguments, train_file=train_file)
    assert node.trigger_configure() == FAILURE
    assert reason in node.failure


def test_a_section_with_a_misspelt_node_name_is_reported(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text('resistence_estimator:\n  ros__parameters: {seed: 3}\n', encoding='utf-8')
    node = graph.make(resistance.make_node, arguments=('--params-file', str(path)), train_file=train_file)
    assert node.trigger_configure() == FAILURE
    assert "section '/resistence_estimator' does not apply" in node.failure


def test_a_whole_number_in_a_file_and_qos_overrides_are_accepted(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    train.mass: 200000\n'
        '    qos_overrides: {/ato/speed: {subscription: {reliability: reliable, depth: 7}}}\n',
        encoding='utf-8',
    )
    node = graph.make(resistance.make_node, arguments=('--params-file', str(path)), train_file=train_file)
    assert node.bring_up(), node.failure
    assert node.get_parameter('train.mass').value == 200000.0
    profiles = {s.topic_name: s.qos_profile for s in node.subscriptions}
    assert profiles['/ato/speed'].reliability == ReliabilityPolicy.RELIABLE
    assert profiles['/ato/speed'].depth == 7
    assert profiles['/ato/force'].reliability == ReliabilityPolicy.BEST_EFFORT


def test_services_reset_save_and_load_the_state(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'deep' / 'state.json'
    node = active(graph, train_file, checkpoint_file=str(path))
    caller = graph.plain('caller')
    prior = node.pipeline.estimator.save()
    feed(node, coasting(200))
    learned = node.pipeline.estimator.save()
    assert learned != prior
    saved = graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint')
    assert (saved.success, str(path) in saved.message) == (True, True)
    assert graph.call(caller, Trigger, '/resistance_estimator/reset').success
    assert (node.pipeline.estimator.save(), node.pipeline.resets) == (prior, 1)
    loaded = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert (loaded.success, node.pipeline.estimator.save()) == (True, learned)


def test_services_report_why_they_fail(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = str(tmp_path / 'state.json')
    first = active(graph, train_file, brake_rate.make_node, checkpoint_file=path)
    caller = graph.plain('caller')
    assert graph.call(caller, Trigger, f'/{first.get_name()}/save_checkpoint').success
    second = graph.make(resistance.make_node, train_file=train_file, checkpoint_file=path)
    early = graph.call(caller, Trigger, '/resistance_estimator/reset')
    assert (early.success, early.message) == (False, 'resistance_estimator is unconfigured: configure it first')
    second.bring_up()
    before = second.pipeline.estimator.save()
    wrong = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert not wrong.success
    assert 'is a checkpoint of GSMA, not of filter-bank' in wrong.message
    assert second.pipeline.estimator.save() == before


BROKEN = (
    ZeroDivisionError('float division'),
    ValueError('math domain error'),
    np.linalg.LinAlgError('Singular matrix'),
)


@pytest.mark.parametrize('error', BROKEN, ids=lambda error: type(error).__name__)
def test_a_numerical_error_in_a_step_is_a_fault_until_a_reset(
    graph: Graph, train_file: str, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    node = active(graph, train_file)
    published, records = Published(node), coasting(80)
    feed(node, records[:80])
    last = published.messages[-1].estimate

    def broken(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline.estimator, 'step', broken)
        patch.setattr(node.pipeline.estimator, 'estimate', broken)
        feed(node, records[80:160])
        node.publish_diagnostics()
    assert (published.messages[-1].status, published.messages[-1].estimate) == (Status.FAULT, last)
    feed(node, records[160:200])
    assert node.pipeline.status is Status.FAULT
    node.pipeline.reset()
    feed(node, records[200:])
    assert node.pipeline.current().status is Status.CONVERGING


def test_a_numerical_error_on_loading_is_reported_and_the_node_keeps_running(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = active(graph, train_file, checkpoint_file=str(tmp_path / 'state.json'))
    caller, published, records = graph.plain('caller'), Published(node), coasting(80)
    feed(node, records[:80])
    assert graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint').success

    def broken(*_: object) -> None:
        msg = 'math domain error'
        raise ValueError(msg)

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline.estimator, 'estimate', broken)
        answer = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
        node.publish_diagnostics()
    assert (answer.success, answer.message) == (False, 'ValueError: math domain error')
    assert node.pipeline.status is Status.FAULT
    assert graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint').success
    feed(node, records[80:])
    assert published.messages[-1].status is Status.CONVERGING


def test_a_late_joiner_gets_the_last_valid_estimate(graph: Graph, train_file: str) -> None:
    # A prior this narrow is fit to use at once.
    narrow = {'estimator__prior_std_a': 0.01, 'estimator__prior_std_b': 1e-5, 'estimator__prior_std_c': 1e-6}
    node = active(graph, train_file, **narrow, estimator__prior_share=0.0)
    published = Published(node)
    feed(node, coasting(150))
    valid = [output for output in published.messages if output.status is Status.VALID]
    assert valid
    listener = graph.plain('listener')
    got: list[Any] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
    listener.create_subscription(ResistanceEstimate, 'trainid/last_valid/resistance', got.append, latched)
    graph.until(lambda: got)
    assert got[0].header.stamp == time_message(valid[-1].stamp_ns)
    assert (got[0].a, got[0].status) == (valid[-1].estimate.a, Status.VALID)


def test_messages_over_the_graph_give_estimates(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file, stale_after=60.0)
    source = graph.plain('source')
    got: list[Any] = []
    source.create_subscription(ResistanceEstimate, 'trainid/resistance', got.append, 100)
    records = coasting(10)
    publishers = {}
    for record in records[:4]:
        kind = type(message_from_record(record))
        topic = {'AtoForce': 'force', 'TrackGradient': 'gradient', 'BrakeCommand': 'brake_command', 'AtoSpeed': 'speed'}
        publishers[kind] = source.create_publisher(kind, f'ato/{topic[kind.__name__]}', 20)
    graph.until(lambda: all(p.get_subscription_count() for p in publishers.values()))
    graph.until(node._estimates.get_subscription_count)
    for record in records:
        message = message_from_record(record)
        publishers[type(message)].publish(message)
    graph.until(lambda: len(got) >= len(records) // 4)
    assert [message.header.stamp for message in got] == [time_message(r.stamp_ns) for r in records[3::4]]


def test_a_backlog_is_processed_in_order_of_arrival(graph: Graph, train_file: str) -> None:
    # The queue of a slow topic spans more time than that of a fast one; emptied in turn it would run ahead.
    node = active(graph, train_file)
    source = graph.plain('source')
    taken: list[str] = []
    receive = node.receive

    def deliver(topic: InputTopic, message: Any) -> None:
        taken.append(topic.name)
        receive(topic, message)

    node._intake._deliver = deliver
    speed = source.create_publisher(AtoSpeed, 'ato/speed', 100)
    mass = source.create_publisher(TrainMass, 'ato/mass', 100)
    graph.until(lambda: speed.get_subscription_count() and mass.get_subscription_count())
    for _ in range(5):
        for _ in range(5):
            speed.publish(AtoSpeed())
        mass.publish(TrainMass())
    graph.until(lambda: len(taken) == 30)
    assert taken == (['ato/speed'] * 5 + ['ato/mass']) * 5


def test_missing_inputs_are_reported_once_after_the_timeout(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file)
    published = Published(node)
    feed(node, coasting(30))
    newest = published.messages[-1].stamp_ns
    count = len(published.messages)
    node._watch()
    assert node._watchdog_timer.timer_period_ns < 0.9 * NS_PER_S  # it checks again within a second of the last input
    graph.until(lambda: len(published.messages) > count)
    node._watch()
    assert [(output.status, output.stamp_ns) for output in published.messages[count:]] == [(Status.STALE, newest)]


def test_missing_inputs_are_reported_once_without_any_sample(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file, stale_after=0.1)
    published = Published(node)
    feed(node, coasting(1)[:3])  # no speed, no sample
    graph.until(lambda: published.messages)
    node._watch()
    assert [(message.status, message.stamp_ns) for message in published.messages] == [(Status.STALE, 0)]


class Diagnosed:
    """The newest diagnostics by name."""

    def __init__(self, graph: Graph) -> None:
        self.by_name: dict[str, Any] = {}
        graph.plain('diagnostics_listener').create_subscription(DiagnosticArray, '/diagnostics', self._note, 10)

    def _note(self, message: Any) -> None:
        self.by_name |= {status.name: status for status in message.status}

    def values(self, name: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.by_name[name].values}


def test_diagnostics_show_status_counts_and_inputs(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    # Nothing gets stale, however long the diagnostics take to arrive.
    node = graph.make(resistance.make_node, train_file=train_file, diagnostic_period=0.1, stale_after=60.0)
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name)
    assert (diagnosed.by_name[own].level, diagnosed.by_name[own].message) == (DiagnosticStatus.WARN, 'unconfigured')
    node.bring_up()
    feed(node, coasting(150))
    graph.until(lambda: diagnosed.values(own).get('used', '0') != '0')
    values = diagnosed.values(own)
    assert (values['status'], values['rejected.GAP'], values['resets']) == (node.pipeline.status.name, '1', '0')
    assert values['last rejection'].startswith('GAP')
    assert float(values['a prior [N/kN]']) == 1.5
    assert float(values['step time max [ms]']) > 0.0
    fit = values['status'] == 'VALID'
    assert diagnosed.by_name[own].level == (DiagnosticStatus.OK if fit else DiagnosticStatus.WARN)
    speed = 'resistance_estimator: input ato/speed'
    assert diagnosed.values(speed)['count'] == '150'
    # Made-up stamps are years old.
    assert diagnosed.by_name[speed].level == DiagnosticStatus.WARN
    assert 'use_sim_time?' in diagnosed.by_name[speed].message
    mass = diagnosed.by_name['resistance_estimator: input ato/mass']
    assert (mass.level, mass.message) == (DiagnosticStatus.OK, 'optional, not received; the parameter is used')


def test_diagnostics_show_consistency_and_observability(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = active(graph, train_file, diagnostic_period=0.1, stale_after=60.0)
    feed(node, coasting(150))
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and diagnosed.values(own).get('used', '0') != '0')
    values = diagnosed.values(own)
    assert values['consistency'] == str(node.pipeline.consistency)
    assert float(values['consistency ratio']) == pytest.approx(node.pipeline.consistency.ratio, abs=1e-3)
    assert values['observability'].endswith('m/s')
    assert 0.0 <= float(values['a prior variance removed']) <= 1.0
    assert float(values['resistance std at speeds seen, at most [N/kN]']) > 0.0
    assert 'errors exceed the stated uncertainty' not in diagnosed.by_name[own].message
    for k in range(2 * WINDOW):
        node.pipeline._consistency.see(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
    graph.until(lambda: 'errors exceed the stated uncertainty: optimistic' in diagnosed.by_name[own].message)
    assert diagnosed.by_name[own].level == DiagnosticStatus.WARN


def test_diagnostics_show_inputs_that_stopped(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = active(graph, train_file, diagnostic_period=0.1)
    feed(node, coasting(30))
    own, speed, mass = (f'resistance_estimator: {what}' for what in ('estimator', 'input ato/speed', 'input ato/mass'))
    graph.until(lambda: {own, speed, mass} <= diagnosed.by_name.keys())
    graph.until(lambda: diagnosed.by_name[own].level == DiagnosticStatus.STALE)
    graph.until(lambda: diagnosed.by_name[speed].level == DiagnosticStatus.STALE)
    assert 'no publisher' in diagnosed.by_name[speed].message
    assert diagnosed.by_name[mass].level == DiagnosticStatus.OK


def test_simulated_time_that_never_starts_is_reported(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    active(graph, train_file, diagnostic_period=0.1, use_sim_time=True)
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and diagnosed.values(own).get('status'))
    assert 'no /clock has arrived' in diagnosed.by_name[own].message


def test_stopped_simulated_time_is_reported(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = active(graph, train_file, diagnostic_period=0.1, use_sim_time=True)
    Simulated(graph, node).go(START_NS)
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and '/clock has stopped' in diagnosed.by_name[own].message)
    assert diagnosed.by_name[own].level == DiagnosticStatus.WARN


class Simulated:
    """Simulated clock that can be set to any time."""

    def __init__(self, graph: Graph, node: Any) -> None:
        self._graph, self._node = graph, node
        self._publisher = graph.plain('time').create_publisher(Clock, '/clock', 10)
        graph.until(self._publisher.get_subscription_count)

    def go(self, time_ns: int) -> None:
        self._publisher.publish(Clock(clock=time_message(time_ns)))
        self._graph.until(lambda: self._node.get_clock().now().nanoseconds == time_ns)
        assert self._node.get_clock().ros_time_is_active


def test_missing_input_is_measured_on_simulated_time(graph: Graph, train_file: str) -> None:
    # Longer than the test may take: only simulated time can have passed.
    node = active(graph, train_file, use_sim_time=True, stale_after=60.0)
    clock, published, records = Simulated(graph, node), Published(node), coasting(30)
    clock.go(records[-1].stamp_ns)
    feed(node, records)
    graph.until(lambda: published.messages)
    assert published.messages[-1].status is not Status.STALE
    clock.go(records[-1].stamp_ns + 70 * NS_PER_S)
    graph.until(lambda: published.messages[-1].status is Status.STALE)


@pytest.mark.parametrize(('policy', 'resets', 'rejected'), [('reset', 1, 0), ('ignore', 0, 0), ('refuse', 0, 4 * 189)])
def test_a_looped_bag_follows_the_policy(
    graph: Graph, train_file: str, policy: str, resets: int, rejected: int
) -> None:
    node = active(graph, train_file, use_sim_time=True, time_jump_policy=policy)
    clock, records = Simulated(graph, node), coasting(200)
    clock.go(START_NS)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    used = node.pipeline.used
    clock.go(START_NS)  # the bag starts over
    feed(node, records)
    pipeline = node.pipeline
    assert pipeline.resets == resets
    jumps = sum(count for reason, count in pipeline.rejections.items() if reason.name == 'STAMP_JUMP')
    if policy == 'reset':
        # The clock jumps before the stamps, so no record is lost and the second round repeats the first.
        assert (pipeline.used, jumps) == (used, 0)
    elif policy == 'ignore':
        assert (pipeline.used > used, jumps) == (True, rejected)
    else:
        # Stamps within max_jump_back of the end are late or duplicate, not a jump.
        assert (pipeline.used, jumps) == (used, rejected)


def test_stamps_that_jump_back_before_the_clock_reset_only_once(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    clock.go(records[-1].stamp_ns)
    feed(node, records)
    feed(node, records[:40])
    assert node.pipeline.resets == 1
    clock.go(START_NS)
    feed(node, records[40:])
    assert node.pipeline.resets == 1


def test_a_small_step_back_of_the_clock_changes_nothing(graph: Graph, train_file: str) -> None:
    node = active(graph, train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    clock.go(records[-1].stamp_ns - NS_PER_S)
    feed(node, shifted(records, 20.0))
    assert node.pipeline.resets == 0


def test_the_same_records_through_node_and_pipeline_are_equal_to_the_bit(graph: Graph, train_file: str) -> None:
    from trainid_ros.estimators.pipeline import brake_rate_pipeline  # noqa: PLC0415
    from trainid_ros.train.train_file import load_train_file  # noqa: PLC0415

    node = active(graph, train_file, brake_rate.make_node)
    published, records = Published(node), coasting(100)
    feed(node, records)
    pipeline = brake_rate_pipeline(load_train_file(train_file), EstimatorSettings())
    expected = [output for record in records for output in pipeline.push(record)]
    assert repr(published.messages) == repr(expected)


@pytest.mark.parametrize(
    ('field', 'factory'), [('resistance', resistance.make_node), ('brake_rate', brake_rate.make_node)]
)
def test_a_node_with_a_parameter_file_equals_a_replay_with_it_to_the_bit(
    graph: Graph, train_file: str, tmp_path: Path, field: str, factory: Any
) -> None:
    from trainid_ros.ros.offline import node_setups  # noqa: PLC0415
    from trainid_ros.train.train_file import load_train_file  # noqa: PLC0415

    path = tmp_path / 'params.yaml'
    path.write_text(
        '/**: {ros__parameters: {seed: 5, resistance: {a: 2}, alignment: {max_lag: 0.25}}}\n'
        '/**/resistance_estimator: {ros__parameters: {train.mass: 210e3, estimator: {min_age: 8, step_a: 0x6}}}\n'
        '/**/brake_rate_estimator: {ros__parameters: {train.mass: 190000, estimator: {prior_std: 1e-01}}}\n',
        encoding='utf-8',
    )
    node = graph.make(factory, arguments=('--params-file', str(path)), train_file=train_file)
    assert node.bring_up(), node.failure
    published, records = Published(node), coasting(150)
    feed(node, records)
    setups = {item.job.field: item for item in node_setups(load_train_file(train_file), train_file, path)}
    pipeline, plain = setups[field].pipeline(), node.job.pipeline(load_train_file(train_file), EstimatorSettings())
    expected, otherwise = ([o for r in records for o in p.push(r)] for p in (pipeline, plain))
    assert repr(published.messages) == repr(expected)
    assert repr(expected) != repr(otherwise)


@pytest.mark.parametrize('factory', FACTORIES)
def test_the_algorithm_is_a_parameter_and_an_unknown_name_is_reported_with_the_choices(
    graph: Graph, train_file: str, factory: Any
) -> None:
    names = graph.make(factory, train_file=train_file).job.algorithms.names
    for name in names:
        chosen = graph.make(factory, arguments=('-p', f'algorithm:={name}'), train_file=train_file)
        assert chosen.bring_up(), chosen.failure
        assert chosen.algorithm == name
        graph.drop()
    wrong = graph.make(factory, arguments=('-p', 'algorithm:=nonsense'), train_file=train_file)
    assert wrong.trigger_configure() == FAILURE
    assert wrong.failure == f"not configured: algorithm = 'nonsense' must be one of {', '.join(names)}"


@pytest.mark.parametrize('factory', FACTORIES)
def test_without_the_laboratory_a_node_runs_and_refuses_other_names(
    graph: Graph, train_file: str, factory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.make(factory, train_file=train_file)
    monkeypatch.setattr(node.job.algorithms, '_others', {})
    assert node.bring_up(), node.failure
    graph.drop()
    name = graph.make(factory, arguments=('-p', 'algorithm:=RLS'), train_file=train_file)
    assert name.trigger_configure() == FAILURE
    known = ', '.join(node.job.algorithms.built_in)
    assert name.failure == f"not configured: algorithm = 'RLS' must be one of {known}; others come with lab/"


def test_nothing_is_left_in_the_default_context() -> None:
    assert not rclpy.ok()

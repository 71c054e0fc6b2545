# SPDX-License-Identifier: Apache-2.0
"""The estimator nodes: lifecycle, services, topics, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from std_srvs.srv import Trigger
from trainid_msgs.msg import AtoSpeed, TrainMass

from test.ros.graph import START_NS, Changed, Graph, Simulated, coasting, collected, cycle, feed
from trainid_ros.interface.records import NS_PER_S, InputTopic, Record
from trainid_ros.interface.results import Reason, Status
from trainid_ros.ros.estimator_node import BRAKE_RATE, RESISTANCE, SPECS
from trainid_ros.setup.checkpoint import default_path
from trainid_ros.setup.params_file import node_setups
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.train.train_file import load_train_file

pytestmark = pytest.mark.ros


SUCCESS, FAILURE, ERROR = (getattr(TransitionCallbackReturn, name) for name in ('SUCCESS', 'FAILURE', 'ERROR'))


@pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)
def test_every_transition_works_twice_before_shutdown(graph: Graph, train_file: str, spec: Any) -> None:
    node = graph.make(spec, train_file=train_file)
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


@pytest.mark.parametrize('steps', [('configure',), ('configure', 'activate')])
def test_shutdown_works_from_every_state(graph: Graph, train_file: str, steps: tuple[str, ...]) -> None:
    node = graph.make(train_file=train_file)
    for step in (*steps, 'shutdown'):
        assert getattr(node, f'trigger_{step}')() == SUCCESS
    assert node.state == 'finalized'


def test_inputs_are_ignored_and_the_state_is_kept_while_inactive(graph: Graph, train_file: str) -> None:
    node = graph.make(train_file=train_file)
    node.trigger_configure()
    published = collected(node)
    records = coasting(200)
    feed(node, records[:100])
    assert (published, node.pipeline.newest_ns) == ([], 0)
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
    node = graph.make(train_file=train_file)
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
    node = graph.make(train_file=str(bad))
    assert node.trigger_configure() == FAILURE
    assert node.state == 'unconfigured'
    assert 'bad.yaml: train.mass = -1 kg must be >= 1' in node.failure
    bad.write_text(Path(train_file).read_text(encoding='utf-8'), encoding='utf-8')
    assert node.bring_up(), node.failure


def test_an_unexpected_error_is_logged_and_leaves_the_node_unconfigured(
    graph: Graph, train_file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.make(train_file=train_file)

    def broken() -> None:
        raise KeyError('no such thing')

    with monkeypatch.context() as patch:
        patch.setattr(node, '_open', broken)
        assert node.trigger_configure() == ERROR
    assert (node.state, node.failure) == ('unconfigured', "KeyError: 'no such thing'")
    assert node.bring_up(), node.failure


def test_parameters_come_from_the_train_file_and_given_ones_override(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, resistance__b=0.05)
    shown = {name: node.get_parameter(name).value for name in ('train.mass', 'resistance.a', 'resistance.b')}
    assert shown == {'train.mass': 194000.0, 'resistance.a': 1.5, 'resistance.b': 0.05}
    prior = node.pipeline.current().estimate
    assert (prior.a, prior.b, prior.c) == (1.5, 0.05, 0.0012)


def test_changes_of_train_file_and_parameters_apply_on_the_next_configure(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    feed(node, coasting(100))
    before = node.pipeline.estimator.save()
    text = Path(train_file).read_text(encoding='utf-8')
    Path(train_file).write_text(text.replace('a: 1.5', 'a: 1.9'), encoding='utf-8')
    assert node.set_parameters([Parameter('estimator.step_share_c', value=9.0)])[0].successful
    assert node.pipeline.estimator.save() == before
    assert node.pipeline.estimator.config.step_share_c == 0.2
    cycle(node)
    assert node.pipeline.estimator.config.step_share_c == 9.0
    assert node.get_parameter('resistance.a').value == node.pipeline.current().estimate.a == 1.9


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('estimator.step_share_c', float('nan')),
        ('estimator.step_share_c', float('inf')),
        ('estimator.min_age', 100000.0),
        ('resistance.b', float('nan')),
        ('time_jump_policy', 'panic'),
        ('autostart', True),
        ('train_file', '/another.yaml'),
        ('checkpoint_file', '/etc/passwd.json'),
        ('taken_from_train_file', 'train.mass=1.0'),
    ],
)
def test_invalid_parameters_are_rejected_with_a_reason_that_names_them(
    graph: Graph, train_file: str, name: str, value: object
) -> None:
    node = graph.active(train_file)
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
    node = graph.make(arguments=arguments, train_file=train_file)
    assert node.trigger_configure() == FAILURE
    assert reason in node.failure


def test_a_section_with_a_misspelt_node_name_is_reported(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text('resistence_estimator:\n  ros__parameters: {seed: 3}\n', encoding='utf-8')
    node = graph.make(arguments=('--params-file', str(path)), train_file=train_file)
    assert node.trigger_configure() == FAILURE
    assert "section '/resistence_estimator' does not apply" in node.failure


def test_a_whole_number_in_a_file_and_qos_overrides_are_accepted(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    train.mass: 200000\n'
        '    qos_overrides: {/ato/speed: {subscription: {reliability: reliable, depth: 7}}}\n',
        encoding='utf-8',
    )
    node = graph.active(train_file, arguments=('--params-file', str(path)))
    assert node.get_parameter('train.mass').value == 200000.0
    profiles = {s.topic_name: s.qos_profile for s in node.subscriptions}
    assert profiles['/ato/speed'].reliability == ReliabilityPolicy.RELIABLE
    assert profiles['/ato/speed'].depth == 7
    assert profiles['/ato/force'].reliability == ReliabilityPolicy.BEST_EFFORT


def test_a_backlog_is_processed_in_order_of_arrival(graph: Graph, train_file: str) -> None:
    # The queue of a slow topic spans more time than that of a fast one; emptied in turn it would run ahead.
    node = graph.active(train_file)
    source = graph.plain('source')
    taken: list[str] = []
    receive = node.shared.inputs.receive

    def deliver(topic: InputTopic, message: Any, received_ns: int) -> None:
        taken.append(topic.name)
        receive(topic, message, received_ns)

    node.shared.inputs.receive = deliver
    speed = source.create_publisher(AtoSpeed, 'ato/speed', 100)
    mass = source.create_publisher(TrainMass, 'ato/mass', 100)
    graph.until(lambda: speed.get_subscription_count() and mass.get_subscription_count())
    for _ in range(5):
        for _ in range(5):
            speed.publish(AtoSpeed())
        mass.publish(TrainMass())
    graph.until(lambda: len(taken) == 30)
    assert taken == (['ato/speed'] * 5 + ['ato/mass']) * 5


@pytest.mark.parametrize(('field', 'spec'), [('resistance', RESISTANCE), ('brake_rate', BRAKE_RATE)])
def test_a_node_with_a_parameter_file_equals_a_replay_with_it_to_the_bit(
    graph: Graph, train_file: str, tmp_path: Path, field: str, spec: Any
) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(
        '/**: {ros__parameters: {seed: 5, resistance: {a: 2}, alignment: {max_lag: 0.25}}}\n'
        '/**/resistance_estimator: {ros__parameters: {train.mass: 210e3, estimator: {min_age: 8, step_a: 0x6}}}\n'
        '/**/brake_rate_estimator: {ros__parameters: {train.mass: 190000, estimator: {prior_std: 1e-01}}}\n',
        encoding='utf-8',
    )
    node = graph.active(train_file, spec, arguments=('--params-file', str(path)))
    published, records = collected(node), coasting(150)
    feed(node, records)
    train = load_train_file(train_file)
    pipeline = {item.kind.name: item.pipeline() for item in node_setups(train, train_file, path)}[field]
    plain = node.shared.kind.pipeline(train, EstimatorSettings())
    expected, otherwise = list[Any](), list[Any]()
    for made, outputs in ((pipeline, expected), (plain, otherwise)):
        for record in records:
            made.take(made.stream.push(record), outputs.append)
    assert repr(published) == repr(expected)
    assert repr(expected) != repr(otherwise)


@pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)
def test_the_algorithm_is_a_parameter_and_an_unknown_name_is_reported_with_the_choices(
    graph: Graph, train_file: str, spec: Any
) -> None:
    names = graph.make(spec, train_file=train_file).shared.kind.algorithms.names
    for name in names:
        chosen = graph.active(train_file, spec, arguments=('-p', f'algorithm:={name}'))
        assert chosen.algorithm == name
        graph.drop()
    wrong = graph.make(spec, arguments=('-p', 'algorithm:=nonsense'), train_file=train_file)
    assert wrong.trigger_configure() == FAILURE
    assert wrong.failure == f"not configured: algorithm = 'nonsense' must be one of {', '.join(names)}"


@pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)
def test_without_the_laboratory_a_node_runs_and_rejects_other_names(
    graph: Graph, train_file: str, spec: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.make(spec, train_file=train_file)
    monkeypatch.setattr(node.shared.kind.algorithms, '_plug_ins', ({}, ''))
    assert node.bring_up(), node.failure
    graph.drop()
    name = graph.make(spec, arguments=('-p', 'algorithm:=RLS'), train_file=train_file)
    assert name.trigger_configure() == FAILURE
    known = ', '.join(node.shared.kind.algorithms.built_in)
    assert name.failure == f"not configured: algorithm = 'RLS' must be one of {known}; others come with research/lab"


def test_nothing_is_left_in_the_default_context() -> None:
    assert not rclpy.ok()


FAILING = """
from trainid_ros.train.effects import EffectKind, Parameter

EFFECT = EffectKind('bad', 'bad', 'w = ?', {'value': Parameter('', 0.0, 1.0)}, 'value', 1.0, lambda p, d, at: 1 / 0)
"""


def test_an_effect_that_raises_is_a_fault_with_its_reason(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'bad.py').write_text(FAILING, encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    train = tmp_path / 'T.yaml'
    effects = 'effects: [{name: bad, parameters: {value: 1.0}}]'
    train.write_text(f'train: {{mass: 1e5}}\nresistance: {{a: 1, b: 0, c: 0}}\n{effects}\n', encoding='utf-8')
    for spec in SPECS.values():
        node = graph.active(str(train), spec)
        published, fail = collected(node), node.fail
        reasons: list[str] = []

        def note(pipeline: Any, reason: str, fail: Any = fail, reasons: list[str] = reasons) -> Any:
            reasons.append(reason)
            return fail(pipeline, reason)

        monkeypatch.setattr(node, 'fail', note)
        feed(node, coasting(30))
        assert published[-1].status is Status.FAULT
        assert 'effect bad: its resistance cannot be evaluated: ZeroDivisionError' in reasons[0]


# Services


def test_services_reset_save_and_load_the_state(graph: Graph, train_file: str, tmp_path: Path) -> None:
    path = tmp_path / 'deep' / 'state.json'
    node = graph.active(train_file, checkpoint_file=str(path))
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
    first = graph.active(train_file, BRAKE_RATE, checkpoint_file=path)
    caller = graph.plain('caller')
    assert graph.call(caller, Trigger, f'/{first.get_name()}/save_checkpoint').success
    second = graph.make(train_file=train_file)
    early = graph.call(caller, Trigger, '/resistance_estimator/reset')
    assert (early.success, early.message) == (False, 'resistance_estimator is unconfigured: configure it first')
    second.bring_up()
    before = second.pipeline.estimator.save()
    default = default_path('/resistance_estimator')
    missing = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert (missing.success, missing.message) == (False, f'{default}: there is no checkpoint')
    default.parent.mkdir(parents=True, exist_ok=True)
    Path(path).rename(default)
    wrong = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
    assert not wrong.success
    assert 'is a checkpoint of GSMA: each node needs a checkpoint file of its own' in wrong.message
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
    node = graph.active(train_file)
    published, records = collected(node), coasting(80)
    feed(node, records[:80])
    last = published[-1].estimate

    def broken(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Changed(node.pipeline.estimator, step=broken, estimate=broken))
        feed(node, records[80:160])
        node._diagnostics.publish()
    assert (published[-1].status, published[-1].estimate) == (Status.FAULT, last)
    feed(node, records[160:200])
    assert node.pipeline.status is Status.FAULT
    node.pipeline.reset()
    feed(node, records[200:])
    assert node.pipeline.current().status is Status.CONVERGING


def test_a_numerical_error_on_loading_is_reported_and_the_node_keeps_running(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = graph.active(train_file, checkpoint_file=str(tmp_path / 'state.json'))
    caller, published, records = graph.plain('caller'), collected(node), coasting(80)
    feed(node, records[:80])
    assert graph.call(caller, Trigger, '/resistance_estimator/save_checkpoint').success

    def broken(*_: object) -> None:
        raise ValueError('math domain error')

    with monkeypatch.context() as patch:
        patch.setattr(node.pipeline, 'estimator', Changed(node.pipeline.estimator, estimate=broken))
        answer = graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint')
        node._diagnostics.publish()
    assert (answer.success, answer.message) == (False, 'ValueError: math domain error')
    assert node.pipeline.status is Status.FAULT
    assert graph.call(caller, Trigger, '/resistance_estimator/load_checkpoint').success
    feed(node, records[80:])
    assert published[-1].status is Status.CONVERGING


# Missing inputs, and jumps of stamps and clock


def shifted(records: Sequence[Record], seconds: float) -> list[Record]:
    """The same records at another time."""
    return [replace(record, stamp_ns=record.stamp_ns + round(seconds * NS_PER_S)) for record in records]


def test_missing_inputs_are_reported_after_the_timeout(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    published = collected(node)
    feed(node, coasting(30))
    newest = published[-1].stamp_ns
    count = len(published)
    node._watch()
    assert node._watchdog_timer.timer_period_ns < 0.9 * NS_PER_S  # it checks again within a second of the last input
    graph.until(lambda: len(published) > count)
    node._watch()
    assert [(output.status, output.stamp_ns) for output in published[count:]] == [(Status.STALE, newest)]


def test_missing_input_is_measured_on_simulated_time(graph: Graph, train_file: str) -> None:
    # Longer than the test may take: only simulated time can have passed.
    node = graph.active(train_file, use_sim_time=True, stale_after=60.0)
    clock, published, records = Simulated(graph, node), collected(node), coasting(30)
    clock.go(records[-1].stamp_ns)
    feed(node, records)
    graph.until(lambda: published)
    assert published[-1].status is not Status.STALE
    clock.go(records[-1].stamp_ns + 70 * NS_PER_S)
    graph.until(lambda: published[-1].status is Status.STALE)


def test_two_clocks_are_logged_once(graph: Graph, train_file: str, capfd: Any) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clocks = Simulated(graph, node), Simulated(graph, node)
    for k in range(5):
        clocks[0].go(START_NS + (8 + k) * NS_PER_S)
        clocks[1].go(START_NS + k * NS_PER_S)
        node.running_pipeline()
    log = capfd.readouterr().err
    assert log.count('clock jumped by') == 1
    assert '(time_jump_policy reset); 2 publishers of /clock: stop all but one' in log


@pytest.mark.parametrize(('policy', 'rejected'), [('reset', 0), ('ignore', 0), ('refuse', 4 * 189)])
def test_a_looped_bag_follows_the_policy(graph: Graph, train_file: str, policy: str, rejected: int) -> None:
    node = graph.active(train_file, use_sim_time=True, time_jump_policy=policy)
    clock, records = Simulated(graph, node), coasting(200)
    clock.go(START_NS)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    used = node.pipeline.used
    assert node.shared.since_ns >= START_NS
    clock.go(START_NS)  # the bag starts over
    assert node.running_pipeline() is node.pipeline
    assert node.shared.since_ns == 0
    feed(node, records)
    # A step of less than an hour loses nothing. Stamps within max_jump_back of the end are late, not a jump.
    assert (node.pipeline.resets, node.pipeline.rejections[Reason.STAMP_JUMP]) == (0, rejected)
    assert (node.pipeline.used > used) == (policy != 'refuse')


def test_stamps_that_jump_back_before_the_clock_reset_only_once(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    clock.go(records[-1].stamp_ns + 7200 * NS_PER_S)
    feed(node, shifted(records, 7200.0))
    feed(node, records[:40])
    assert node.pipeline.resets == 1
    clock.go(START_NS)
    feed(node, records[40:])
    assert node.pipeline.resets == 1


def test_a_small_step_back_of_the_clock_changes_nothing(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    clock.go(records[-1].stamp_ns - NS_PER_S)
    feed(node, shifted(records, 20.0))
    assert node.pipeline.resets == 0

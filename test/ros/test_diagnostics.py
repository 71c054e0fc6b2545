# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of a node: what is wrong, since when, and what to do."""

from __future__ import annotations

import math
import re
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeAlias

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64
from trainid_msgs.msg import AtoForce, AtoSpeed, BrakeCommand

from trainid_ros.estimators.consistency import WINDOW
from trainid_ros.interface.records import NS_PER_S, ForceRecord, SpeedRecord
from trainid_ros.interface.results import Status
from trainid_ros.ros.estimator_node import BRAKE_RATE, RESISTANCE, EstimatorNode
from trainid_ros.ros.input_monitor import clock_time
from trainid_ros.ros.topics import message_from_record
from trainid_ros.stream.brake_shape import ShapeChange

Graph: TypeAlias = Any  # the fixture of conftest.py
BEST_EFFORT = ReliabilityPolicy.BEST_EFFORT


class Diagnosed:
    """The newest diagnostics by name."""

    def __init__(self, graph: Graph) -> None:
        self.by_name: dict[str, Any] = {}
        graph.plain('diagnostics_listener').create_subscription(DiagnosticArray, '/diagnostics', self._note, 10)

    def _note(self, message: Any) -> None:
        self.by_name |= {status.name: status for status in message.status}

    def values(self, name: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.by_name[name].values}


@pytest.mark.ros
def test_diagnostics_show_status_counts_and_inputs(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    # Nothing gets stale, however long the diagnostics take to arrive.
    node = graph.make(
        partial(EstimatorNode, RESISTANCE), train_file=train_file, diagnostic_period=0.1, stale_after=60.0
    )
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name)
    assert (diagnosed.by_name[own].level, diagnosed.by_name[own].message) == (
        DiagnosticStatus.WARN,
        'unconfigured: configure and activate it',
    )
    node.bring_up()
    graph.feed(node, graph.coasting(150))
    graph.until(lambda: diagnosed.values(own).get('used', '0') != '0')
    # On a slow machine these records keep the node busy for more than a second.
    graph.until(lambda: 'this node was busy' not in diagnosed.by_name[own].message)
    values = diagnosed.values(own)
    assert (values['status'], values['rejected.GAP'], values['resets']) == (node.pipeline.status.name, '1', '0')
    assert values['last rejection'].startswith('GAP')
    assert float(values['a prior [N/kN]']) == 1.5
    assert float(values['step time max [ms]']) > 0.0
    assert 0.0 <= float(values['time in status [s]']) < 600.0
    fit = values['status'] == 'VALID'
    assert diagnosed.by_name[own].level == (DiagnosticStatus.OK if fit else DiagnosticStatus.WARN)
    speed = 'resistance_estimator: input ato/speed'
    assert diagnosed.values(speed)['count'] == '150'
    # Made-up stamps are years old.
    assert diagnosed.by_name[speed].level == DiagnosticStatus.WARN
    assert 'use_sim_time' in diagnosed.by_name[speed].message
    mass = diagnosed.by_name['resistance_estimator: input ato/mass']
    assert (mass.level, mass.message) == (DiagnosticStatus.OK, 'optional, not received; the parameter is used')


@pytest.mark.ros
def test_diagnostics_name_a_stall_of_the_node_and_not_its_inputs(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1)
    own, speed = 'resistance_estimator: estimator', 'resistance_estimator: input ato/speed'
    odometer = graph.plain('odometer').create_publisher(AtoSpeed, 'ato/speed', 10)
    graph.feed(node, graph.coasting(20))
    graph.until(lambda: own in diagnosed.by_name and odometer.get_subscription_count())
    time.sleep(1.2)
    odometer.publish(message_from_record(graph.coasting(21)[-1]))
    time.sleep(0.1)
    node._diagnostics.publish()
    graph.until(lambda: re.search(r'this node was busy or stopped for [1-9]', diagnosed.by_name[own].message))
    assert 'no message' not in diagnosed.by_name[speed].message
    graph.until(lambda: 'this node was busy' not in diagnosed.by_name[own].message)


@pytest.mark.ros
def test_diagnostics_show_consistency_and_observability(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    graph.feed(node, graph.coasting(150))
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
        node.pipeline._consistency.add(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
    graph.until(lambda: 'errors exceed the stated uncertainty: optimistic' in diagnosed.by_name[own].message)
    assert diagnosed.by_name[own].level == DiagnosticStatus.WARN


@pytest.mark.ros
def test_diagnostics_show_inputs_that_stopped(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1)
    graph.feed(node, graph.coasting(30))
    own, speed, mass = (f'resistance_estimator: {what}' for what in ('estimator', 'input ato/speed', 'input ato/mass'))
    graph.until(lambda: {own, speed, mass} <= diagnosed.by_name.keys())
    graph.until(lambda: diagnosed.by_name[own].level == DiagnosticStatus.STALE)
    graph.until(lambda: diagnosed.by_name[speed].level == DiagnosticStatus.STALE)
    assert 'no publisher' in diagnosed.by_name[speed].message
    assert diagnosed.by_name[mass].level == DiagnosticStatus.OK


@pytest.mark.ros
def test_a_stuck_speed_is_named_although_all_inputs_arrive(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    records = graph.coasting(120)
    records = [replace(item, speed=8.0) if isinstance(item, SpeedRecord) else item for item in records]
    graph.feed(node, [replace(item, force=2e5) if isinstance(item, ForceRecord) else item for item in records])
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and 'ato/speed is stuck' in diagnosed.by_name[own].message)
    assert diagnosed.by_name[own].level >= DiagnosticStatus.WARN
    assert diagnosed.values(own)['last rejection'].startswith('SPEED_STUCK')


@pytest.mark.ros
def test_an_input_whose_messages_cannot_be_used_is_named(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    records = graph.coasting(20)
    graph.feed(node, [replace(item, speed=math.nan) if isinstance(item, SpeedRecord) else item for item in records])
    node.announce(node.pipeline.mark_stale())
    own, speed, force = (
        f'resistance_estimator: {what}' for what in ('estimator', 'input ato/speed', 'input ato/force')
    )
    text = '20 of the last 20 messages not used: NOT_FINITE (nan)'
    graph.until(lambda: speed in diagnosed.by_name and diagnosed.by_name[speed].message.startswith(text))
    assert diagnosed.by_name[speed].level == DiagnosticStatus.ERROR
    graph.until(lambda: f'(ato/speed: {text})' in diagnosed.by_name[own].message)
    assert 'not used' not in diagnosed.by_name[force].message


@pytest.mark.ros
def test_simulated_time_that_never_starts_is_reported(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    graph.active(train_file, diagnostic_period=0.1, use_sim_time=True)
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and diagnosed.values(own).get('status'))
    assert 'no /clock has arrived' in diagnosed.by_name[own].message


@pytest.mark.ros
def test_stopped_simulated_time_is_reported(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.active(train_file, diagnostic_period=0.1, use_sim_time=True)
    graph.simulated(node).go(graph.start_ns)
    own = 'resistance_estimator: estimator'
    graph.until(lambda: own in diagnosed.by_name and '/clock has stopped' in diagnosed.by_name[own].message)
    assert diagnosed.by_name[own].level == DiagnosticStatus.WARN


class Changed:
    """An object with some of its attributes replaced."""

    def __init__(self, original: Any, **changes: object) -> None:
        self._original = original
        self.__dict__.update(changes)

    def __getattr__(self, name: str) -> Any:
        """Return what was not replaced."""
        return getattr(self._original, name)


@pytest.mark.ros
def test_each_problem_is_reported_with_its_own_begin_and_what_to_do(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.make(
        partial(EstimatorNode, RESISTANCE), train_file=train_file, use_sim_time=True, diagnostic_period=60.0
    )
    clock = graph.simulated(node)
    clock.go(graph.start_ns)
    node.bring_up()
    own = 'resistance_estimator: estimator'

    def clock_ns(seconds: int) -> int:
        return int(graph.start_ns + seconds * NS_PER_S)

    def message_at(seconds: int) -> str:
        clock.go(clock_ns(seconds))
        diagnosed.by_name.clear()
        node._diagnostics.publish()
        graph.until(lambda: own in diagnosed.by_name)
        return str(diagnosed.by_name[own].message)

    begins = [clock_time(clock_ns(seconds)) for seconds in (100, 200)]
    status = message_at(90)
    node.checkpoints.problem = 'disk is full'
    unsaved = f'not saved: disk is full, since {begins[0]}: make room on the disk, or correct checkpoint_file; '
    assert message_at(100) == unsaved + status
    for k in range(2 * WINDOW):
        node.pipeline._consistency.add(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
    message_at(200)
    message = message_at(300)
    assert message.startswith('errors exceed the stated uncertainty: optimistic')
    assert message.endswith(f', since {begins[1]}: compare train file and inputs with the train; {unsaved}{status}')
    node.checkpoints.problem = ''
    assert 'not saved' not in message_at(301)
    stale = Changed(node.pipeline.current(), status=Status.STALE)
    stream, original = SimpleNamespace(finding='ato/speed is in km/h'), node.pipeline
    finding = f'inputs contradict each other: ato/speed is in km/h, since {clock_time(clock_ns(400))}: check units'
    for found, said in ((stream.finding, 'nothing is learned'), ('', 'this estimate does not depend on it')):
        trust = SimpleNamespace(finding=found)
        node.shared.pipeline = Changed(original, stream=stream, trust=trust, current=lambda: stale)
        message = message_at(400)
        assert message.startswith(finding)
        assert said in message
        assert '; STALE: ' in message
        assert (diagnosed.by_name[own].level == DiagnosticStatus.ERROR) == bool(found)


@pytest.mark.ros
def test_a_wrong_brake_is_named_and_driving_on_is_not_advised(graph: Graph, train_file: str) -> None:
    diagnosed = Diagnosed(graph)
    node = graph.make(partial(EstimatorNode, BRAKE_RATE), train_file=train_file, diagnostic_period=60.0)
    node.bring_up()
    own, messages = 'brake_rate_estimator: estimator', []
    converging = Changed(node.pipeline.current(), status=Status.CONVERGING)
    node.shared.pipeline = Changed(node.pipeline, current=lambda: converging)
    shape = node.pipeline.stream.faults.shape
    shape.found = ShapeChange(least=0.5, most=-0.5, size=0.4, std=0.01)
    for is_wrong in (False, True):
        shape.is_wrong = is_wrong
        diagnosed.by_name.clear()
        node._diagnostics.publish()
        graph.until(lambda: own in diagnosed.by_name)
        messages.append(str(diagnosed.by_name[own].message))
    assert 'drive on' in messages[0]
    assert messages[1].startswith('from 0 to 22 m/s the brake rate falls by about 0.40 against brake.rate')
    assert 'drive on' not in messages[1]


@pytest.mark.ros
def test_publishers_that_are_not_heard_and_second_publishers_are_named_in_diagnostics_and_log(
    graph: Graph, train_file: str, capfd: pytest.CaptureFixture[str]
) -> None:
    # Within one participant a topic has one type.
    others = type(graph)(graph.domain)
    odometer, second = others.plain('odometer'), others.plain('second')
    odometer.create_publisher(Float64, 'ato/speed', 10)
    for publisher in (odometer, second):
        publisher.create_publisher(AtoForce, 'ato/force', 10)
    odometer.create_publisher(BrakeCommand, 'ato/brake_command', QoSProfile(depth=1, reliability=BEST_EFFORT))
    diagnosed = Diagnosed(graph)
    arguments = ('-p', 'qos_overrides./ato/brake_command.subscription.reliability:=reliable')
    node = graph.make(
        partial(EstimatorNode, RESISTANCE), arguments=arguments, train_file=train_file, diagnostic_period=0.1
    )
    node.bring_up()
    speed, force, brake = (f'resistance_estimator: input ato/{what}' for what in ('speed', 'force', 'brake_command'))
    wrong_type = '/odometer publishes std_msgs/msg/Float64 instead of trainid_msgs/msg/AtoSpeed'
    wrong_qos = '/odometer has an incompatible quality of service (Best effort publisher and reliable subscription)'
    graph.until(lambda: speed in diagnosed.by_name and wrong_type in diagnosed.by_name[speed].message)
    assert diagnosed.by_name[speed].level == DiagnosticStatus.ERROR
    graph.until(lambda: wrong_qos in diagnosed.by_name[brake].message)
    graph.feed(node, graph.coasting(1)[:1])
    text = '2 publishers, whose messages mix: /odometer, /second, since '
    graph.until(lambda: diagnosed.by_name[force].message.startswith(text))
    assert diagnosed.by_name[force].message.endswith(' UTC: stop all but one')
    assert {text[:7] for text in node._diagnostics._definitions.values()} == {'RIHS01_'}
    others.close()
    logged = capfd.readouterr().err
    for text in (
        f'/ato/speed: {wrong_type}',
        f'/ato/brake_command: {wrong_qos}',
        '/ato/force: more than one publisher',
    ):
        assert logged.count(text) == 1, logged

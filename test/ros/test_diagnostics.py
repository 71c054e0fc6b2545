# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of a node: what is wrong, since when, and what to do; see also benchmarks/faults_live."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TypeAlias

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64
from trainid_msgs.msg import AtoForce, AtoSpeed, BrakeCommand

from benchmarks.sender import Sending, write_rows
from test.ros.graph import OWN, START_NS, Changed, Diagnosed, Graph, Simulated, coasting, feed
from trainid_ros.estimators.pipeline import WINDOW
from trainid_ros.interface.records import NS_PER_S, ForceRecord, SpeedRecord
from trainid_ros.interface.results import Status
from trainid_ros.ros.diagnostics import clock_time
from trainid_ros.ros.estimator_node import BRAKE_RATE
from trainid_ros.ros.topics import message_from_record
from trainid_ros.stream.brake_shape import ShapeChange

pytestmark = pytest.mark.ros

SPEED, FORCE, BRAKE, MASS = (
    f'resistance_estimator: input ato/{name}' for name in ('speed', 'force', 'brake_command', 'mass')
)


def test_diagnostics_show_status_counts_and_inputs(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    # Nothing gets stale, however long the diagnostics take to arrive.
    node = graph.make(train_file=train_file, diagnostic_period=0.1, stale_after=60.0)
    graph.until(lambda: OWN in diagnosed.by_name)
    assert (diagnosed.level(OWN), diagnosed.message(OWN)) == (
        DiagnosticStatus.WARN,
        'unconfigured: configure and activate it',
    )
    node.bring_up()
    feed(node, coasting(150))
    graph.until(lambda: diagnosed.values(OWN).get('used', '0') != '0')
    # On a slow machine these records keep the node busy for more than a second.
    graph.until(lambda: 'this node was busy' not in diagnosed.message(OWN))
    values = diagnosed.values(OWN)
    assert (values['status'], values['rejected.GAP'], values['resets']) == (node.pipeline.status.name, '1', '0')
    assert values['last rejection'].startswith('GAP')
    assert float(values['a prior [N/kN]']) == 1.5
    assert float(values['step time max [ms]']) > 0.0
    assert 0.0 <= float(values['time in status [s]']) < 600.0
    fit = values['status'] == 'VALID'
    assert diagnosed.level(OWN) == (DiagnosticStatus.OK if fit else DiagnosticStatus.WARN)
    assert diagnosed.values(SPEED)['count'] == '150'
    # Made-up stamps are years old.
    assert diagnosed.level(SPEED) == DiagnosticStatus.WARN
    assert 'use_sim_time' in diagnosed.message(SPEED)
    assert diagnosed.message(MASS) == 'optional, not received; the parameter is used'
    assert diagnosed.level(MASS) == DiagnosticStatus.OK


def test_diagnostics_name_a_stall_of_the_node_and_not_its_inputs(
    graph: Graph, diagnosed: Diagnosed, train_file: str
) -> None:
    node = graph.active(train_file, diagnostic_period=0.1)
    odometer = graph.plain('odometer').create_publisher(AtoSpeed, 'ato/speed', 10)
    feed(node, coasting(20))
    graph.until(lambda: OWN in diagnosed.by_name and odometer.get_subscription_count())
    time.sleep(1.2)
    odometer.publish(message_from_record(coasting(21)[-1]))
    time.sleep(0.1)
    node._diagnostics.publish()
    graph.until(lambda: re.search(r'this node was busy or stopped for [1-9]', diagnosed.message(OWN)))
    assert 'no message' not in diagnosed.message(SPEED)
    graph.until(lambda: 'this node was busy' not in diagnosed.message(OWN))


def test_diagnostics_show_consistency_and_observability(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    feed(node, coasting(150))
    graph.until(lambda: diagnosed.values(OWN).get('used', '0') != '0')
    values = diagnosed.values(OWN)
    assert values['consistency'] == str(node.pipeline.consistency)
    assert float(values['consistency ratio']) == pytest.approx(node.pipeline.consistency.ratio, abs=1e-3)
    assert values['observability'].endswith('m/s')
    assert 0.0 <= float(values['a prior variance removed']) <= 1.0
    assert float(values['resistance std at speeds seen, at most [N/kN]']) > 0.0
    assert 'errors exceed the stated uncertainty' not in diagnosed.message(OWN)
    for k in range(2 * WINDOW):
        node.pipeline._consistency.add(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
    diagnosed.until(OWN, 'errors exceed the stated uncertainty: optimistic')
    assert diagnosed.level(OWN) == DiagnosticStatus.WARN


def test_diagnostics_show_inputs_that_stopped(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, diagnostic_period=0.1)
    feed(node, coasting(30))
    graph.until(lambda: diagnosed.level(OWN) == DiagnosticStatus.STALE)
    graph.until(lambda: diagnosed.level(SPEED) == DiagnosticStatus.STALE)
    assert 'no publisher' in diagnosed.message(SPEED)
    assert diagnosed.level(MASS) == DiagnosticStatus.OK


def test_a_stuck_speed_is_named_although_all_inputs_arrive(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    records = coasting(120)
    records = [replace(item, speed=8.0) if isinstance(item, SpeedRecord) else item for item in records]
    feed(node, [replace(item, force=2e5) if isinstance(item, ForceRecord) else item for item in records])
    diagnosed.until(OWN, 'ato/speed is stuck')
    assert diagnosed.level(OWN) >= DiagnosticStatus.WARN
    assert diagnosed.values(OWN)['last rejection'].startswith('SPEED_STUCK')


def test_a_sliding_axle_is_a_warning(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, BRAKE_RATE, diagnostic_period=0.1, stale_after=60.0)
    feed(node, coasting(20))
    own = 'brake_rate_estimator: estimator'
    assert 'slides' not in diagnosed.message(own)
    sliding = replace(node.pipeline.adhesion().estimate, slipping=True, slip=-0.12, adhesion=0.05, adhesion_std=0.01)
    node.pipeline._adhesion = sliding
    diagnosed.until(own, 'the measured axle slides (-12%); adhesion 0.050 ± 0.010')
    assert diagnosed.level(own) >= DiagnosticStatus.WARN


def test_a_parameter_that_does_not_act_yet_is_named(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    before = node.get_parameter('train.mass').value
    feed(node, coasting(20))
    node.set_parameters([Parameter('train.mass', value=before + 5e3), Parameter('diagnostic_period', value=0.2)])
    diagnosed.until(OWN, f'parameters were set that do not act yet: train.mass = {before + 5e3}')
    node.set_parameters([Parameter('train.mass', value=before)])
    graph.until(lambda: 'do not act yet' not in diagnosed.message(OWN))


def test_an_input_whose_messages_cannot_be_used_is_named(graph: Graph, diagnosed: Diagnosed, train_file: str) -> None:
    node = graph.active(train_file, diagnostic_period=0.1, stale_after=60.0)
    records = coasting(20)
    feed(node, [replace(item, speed=math.nan) if isinstance(item, SpeedRecord) else item for item in records])
    node.pipeline.mark_stale()
    node.announce(node.pipeline)
    text = '20 of the last 20 messages not used: NOT_FINITE (nan)'
    graph.until(lambda: diagnosed.message(SPEED).startswith(text))
    assert diagnosed.level(SPEED) == DiagnosticStatus.ERROR
    graph.until(lambda: f'(ato/speed: {text})' in diagnosed.message(OWN))
    assert 'not used' not in diagnosed.message(FORCE)


def test_simulated_time_that_never_starts_or_has_stopped_is_reported(
    graph: Graph, diagnosed: Diagnosed, train_file: str
) -> None:
    node = graph.active(train_file, diagnostic_period=0.1, use_sim_time=True)
    graph.until(lambda: diagnosed.values(OWN).get('status'))
    assert 'no /clock has arrived' in diagnosed.message(OWN)
    Simulated(graph, node).go(START_NS)
    diagnosed.until(OWN, '/clock has stopped')
    assert diagnosed.level(OWN) == DiagnosticStatus.WARN
    Simulated(graph, node)
    diagnosed.until(OWN, '2 publishers of /clock: /time (2 of this name): stop all but one')


def test_each_problem_is_reported_with_its_own_begin_and_what_to_do(
    graph: Graph, diagnosed: Diagnosed, train_file: str
) -> None:
    node = graph.make(train_file=train_file, use_sim_time=True, diagnostic_period=60.0)
    clock = Simulated(graph, node)
    clock.go(START_NS)
    node.bring_up()

    def clock_ns(seconds: int) -> int:
        return int(START_NS + seconds * NS_PER_S)

    def message_at(seconds: int) -> str:
        clock.go(clock_ns(seconds))
        diagnosed.by_name.clear()
        node._diagnostics.publish()
        return diagnosed.until(OWN, '')

    begins = [clock_time(clock_ns(seconds)) for seconds in (100, 200)]
    status = message_at(90)
    node.shared.unsaved = 'disk is full'
    unsaved = f'not saved: disk is full, since {begins[0]}: make room on the disk, or correct checkpoint_file; '
    assert message_at(100) == unsaved + status
    for k in range(2 * WINDOW):
        node.pipeline._consistency.add(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
    message_at(200)
    message = message_at(300)
    assert message.startswith('errors exceed the stated uncertainty: optimistic')
    assert message.endswith(f', since {begins[1]}: compare train file and inputs with the train; {unsaved}{status}')
    node.shared.unsaved = ''
    assert 'not saved' not in message_at(301)
    stale = Changed(node.pipeline.current(), status=Status.STALE)
    faults = SimpleNamespace(finding='ato/speed is in km/h', inputs=('ato/speed',), holds_back=('resistance',))
    stream, original = SimpleNamespace(finding=faults.finding, faults=faults), node.pipeline
    finding = f'inputs contradict each other: ato/speed is in km/h, since {clock_time(clock_ns(400))}: check units'
    for found, said in ((stream.finding, 'nothing is learned'), ('', 'this estimate does not depend on it')):
        trust = SimpleNamespace(finding=found)
        node.shared.pipeline = Changed(original, stream=stream, trust=trust, current=lambda: stale)
        message = message_at(400)
        assert message.startswith(finding)
        assert said in message
        assert '; STALE: ' in message
        assert (diagnosed.level(OWN) == DiagnosticStatus.ERROR) == bool(found)


def test_a_wrong_brake_is_named_and_driving_on_is_not_advised(
    graph: Graph, diagnosed: Diagnosed, train_file: str
) -> None:
    node = graph.active(train_file, BRAKE_RATE, diagnostic_period=60.0)
    own, messages = 'brake_rate_estimator: estimator', []
    converging = Changed(node.pipeline.current(), status=Status.CONVERGING)
    node.shared.pipeline = Changed(node.pipeline, current=lambda: converging)
    shape = node.pipeline.stream.faults.shape
    shape.found = ShapeChange(least=0.5, most=-0.5, size=0.4, std=0.01)
    for is_wrong in (False, True):
        shape.is_wrong = is_wrong
        diagnosed.by_name.clear()
        node._diagnostics.publish()
        messages.append(diagnosed.until(own, ''))
    assert 'drive on' in messages[0]
    assert messages[1].startswith('from 0 to 22 m/s the brake rate falls by about 0.40 against brake.rate')
    assert 'drive on' not in messages[1]


def test_publishers_that_are_not_heard_and_second_publishers_are_named_in_diagnostics_and_log(
    graph: Graph, diagnosed: Diagnosed, others: Graph, train_file: str, capfd: pytest.CaptureFixture[str]
) -> None:
    odometer, second = others.plain('odometer'), others.plain('second')
    odometer.create_publisher(Float64, 'ato/speed', 10)
    for publisher in (odometer, second):
        publisher.create_publisher(AtoForce, 'ato/force', 10)
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    odometer.create_publisher(BrakeCommand, 'ato/brake_command', best_effort)
    arguments = ('-p', 'qos_overrides./ato/brake_command.subscription.reliability:=reliable')
    node = graph.active(train_file, arguments=arguments, diagnostic_period=0.1)
    wrong_type = '/odometer publishes std_msgs/msg/Float64 instead of trainid_msgs/msg/AtoSpeed'
    wrong_qos = '/odometer has an incompatible quality of service (Best effort publisher and reliable subscription)'
    diagnosed.until(SPEED, wrong_type)
    assert diagnosed.level(SPEED) == DiagnosticStatus.ERROR
    diagnosed.until(BRAKE, wrong_qos)
    feed(node, coasting(1)[:1])
    text = '2 publishers, whose messages mix: /odometer, /second, since '
    graph.until(lambda: diagnosed.message(FORCE).startswith(text))
    assert diagnosed.message(FORCE).endswith(' UTC: stop all but one')
    assert {text[:7] for text in node._diagnostics._definitions.values()} == {'RIHS01_'}
    others.drop()
    logged = capfd.readouterr().err
    for text in (
        f'/ato/speed: {wrong_type}',
        f'/ato/brake_command: {wrong_qos}',
        '/ato/force: more than one publisher: /odometer, /second',
    ):
        assert logged.count(text) == 1, logged


Start: TypeAlias = Callable[[], 'subprocess.Popen[bytes]']


@pytest.fixture
def start(graph: Graph, tmp_path: Path) -> Iterator[Start]:
    """Starts an odometer that publishes speeds at 5 Hz."""
    begin_ns, path = time.time_ns(), tmp_path / 'speeds.json'
    stamps = [begin_ns + k * NS_PER_S // 5 for k in range(3000)]
    write_rows(path, [Sending(stamp_ns, SpeedRecord(stamp_ns, 20.0, 1.0).row()) for stamp_ns in stamps])
    started = []

    def start_one() -> subprocess.Popen[bytes]:
        command = [sys.executable, '-m', 'benchmarks.sender', str(os.getpid()), 'odometer', str(path)]
        started.append(subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}))
        return started[-1]

    yield start_one
    for process in started:
        process.kill()
        process.wait()


def test_a_publisher_killed_and_started_again_is_missed_but_never_called_two(
    graph: Graph, diagnosed: Diagnosed, train_file: str, start: Start
) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    odometer = start()
    graph.until(lambda: diagnosed.level(SPEED) == DiagnosticStatus.OK)
    odometer.kill()
    graph.until(lambda: diagnosed.level(SPEED) == DiagnosticStatus.STALE)
    start()
    graph.until(lambda: diagnosed.level(SPEED) != DiagnosticStatus.STALE)
    count = len(diagnosed.said)
    graph.until(lambda: len(diagnosed.said) > count + 100)
    # The killed one is still in the graph.
    assert not [text for text in diagnosed.said if SPEED in text and 'publishers' in text]


def test_two_publishers_of_one_name_are_named(
    graph: Graph, diagnosed: Diagnosed, train_file: str, start: Start
) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    start()
    start()
    # Those of other tests may still be in the graph.
    diagnosed.until(SPEED, 'publishers, whose messages mix: /odometer (')

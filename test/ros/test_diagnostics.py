# SPDX-License-Identifier: Apache-2.0
"""Input statistics, detection of missing input, and the diagnostics of a node."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, TypeAlias

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from trainid_ros.estimators.consistency import WINDOW
from trainid_ros.records import NS_PER_S, SPEED_TOPIC
from trainid_ros.ros.diagnostics import InputMonitor, Watchdog
from trainid_ros.ros.estimator_node import EstimatorNode
from trainid_ros.ros.estimator_nodes import RESISTANCE

Graph: TypeAlias = Any  # the fixture of conftest.py


def test_time_since_the_last_message_keeps_growing_after_the_rate_is_unknown() -> None:
    monitor = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False)
    assert math.isinf(monitor.missing_for_s(0))
    for i in range(20):
        monitor.arrived(i + 1, i * NS_PER_S // 5)
    last_ns = 19 * NS_PER_S // 5
    assert monitor.rate(last_ns) == pytest.approx(5.0)
    assert math.isnan(monitor.rate(last_ns + 60 * NS_PER_S))
    assert monitor.missing_for_s(last_ns + 60 * NS_PER_S) == pytest.approx(60.0)


LIMIT = 8 * NS_PER_S // 10


def at(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def test_missing_input_is_reported_once_and_again_after_new_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10.7), at(10.7))
    assert watchdog.is_missing(at(10.9), at(10.9))
    watchdog.saw(1, at(10.95), at(10.95))  # the same stamp again is not new input
    assert not watchdog.is_missing(at(12), at(12))
    watchdog.saw(2, at(12), at(12))
    assert not watchdog.is_missing(at(12.1), at(12.1))


def test_nothing_is_reported_before_the_first_record_and_after_a_restart() -> None:
    watchdog = Watchdog(LIMIT)
    assert not watchdog.is_missing(at(100), at(100))  # no record so far
    watchdog.saw(1, at(100), at(100))
    watchdog.restart()
    assert not watchdog.is_missing(at(200), at(200))
    watchdog.saw(1, at(200), at(200))  # after a restart the old stamp counts as new
    assert watchdog.is_missing(at(201), at(201))


def test_a_short_stall_at_a_high_replay_rate_is_not_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(12), at(10.1))  # 20 times real time, 0.1 s of stall
    assert watchdog.is_missing(at(16), at(10.3))


def test_input_is_not_missing_in_a_slow_replay_while_its_clock_moves() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    for tenth in range(1, 20):
        assert not watchdog.is_missing(at(10 + 0.01 * tenth), at(10 + 0.1 * tenth))


def test_a_stopped_clock_does_not_hide_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10), at(10.5))
    assert watchdog.is_missing(at(10), at(11.4))


def test_a_clock_that_never_started_does_not_hide_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, 0, at(10))
    assert watchdog.is_missing(0, at(10.9))


def test_the_next_check_is_due_when_the_limit_can_be_exceeded_and_not_before() -> None:
    watchdog = Watchdog(LIMIT)
    assert LIMIT < watchdog.pause_ns(at(5), simulated=False) < LIMIT + at(0.1)
    watchdog.saw(1, at(10), at(10))
    pause = watchdog.pause_ns(at(10.3), simulated=False)
    assert not watchdog.is_missing(at(10.3) + pause - at(0.02), at(10.3) + pause - at(0.02))
    assert watchdog.is_missing(at(10.3) + pause, at(10.3) + pause)
    # Simulated time may run fast, so it is polled often.
    assert watchdog.pause_ns(at(10.3), simulated=True) == at(0.1)


def test_a_longer_limit_applies_from_the_next_check_on() -> None:
    """The rate of slow topics is learned while the node runs."""
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    watchdog.limit_ns = 3 * LIMIT
    assert not watchdog.is_missing(at(10) + 2 * LIMIT, at(10) + 2 * LIMIT)
    assert watchdog.pause_ns(at(10) + 2 * LIMIT, simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    assert watchdog.is_missing(at(10.1) + 3 * LIMIT, at(10.1) + 3 * LIMIT)


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
    assert (diagnosed.by_name[own].level, diagnosed.by_name[own].message) == (DiagnosticStatus.WARN, 'unconfigured')
    node.bring_up()
    graph.feed(node, graph.coasting(150))
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
        node.pipeline._consistency.see(3.0 * (-1.0) ** k, 1.0 + 1e-9 * k, used=True)
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

# SPDX-License-Identifier: Apache-2.0
"""Trains from messages and times, arrivals on one topic, and numbers as a person reads them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import SimpleNamespace

import pytest

from test.monitor.conftest import MODEL, RESISTANCE, START_NS, feed
from trainid_ros.interface.records import NS_PER_S, RESISTANCE_TOPIC, output_values
from trainid_ros.interface.results import Output, Status
from trainid_ros.monitor.trains import (
    Arrivals,
    Level,
    Report,
    Trains,
    TrainView,
    duration,
    mass_factor,
    number,
    reference_speed,
    resistance_at,
    value_text,
)
from trainid_ros.resistance.davis_posterior import resistance_std

Driven = Callable[..., Trains]


def view(trains: Trains, now_s: float) -> TrainView:
    (shown,) = trains.views(now_s, START_NS + round(now_s * NS_PER_S))
    return shown


def test_inputs_have_rate_age_and_value(driven: Driven) -> None:
    shown = view(driven(), 9.9)
    speed, force, gradient, brake, mass = shown.inputs
    assert speed.rate == pytest.approx(5.0)
    assert speed.age_s == pytest.approx(0.15)
    assert speed.silent_s == pytest.approx(0.1)
    assert speed.publishers == ('/ato',)
    values = [item.value for item in (speed, force, gradient, brake)]
    assert values == ['68.5 km/h  196 m', '50.0 kN', '-4.0 ‰ tunnel', '-0.50 m/s²']
    assert mass.optional
    assert math.isinf(mass.silent_s)
    assert shown.speed_kmh == pytest.approx(68.47, abs=0.01)
    (other_clock,) = driven().views(10.0, START_NS + 40_000 * NS_PER_S)
    assert math.isnan(other_clock.inputs[0].age_s)


def test_estimates_have_the_values_and_stds_of_their_messages(driven: Driven) -> None:
    resistance, model, brake = view(driven(), 9.9).estimates
    speed = 45.0 / 3.6  # the middle of 5 to 20 m/s
    assert resistance.quantity == 'w at 45 km/h'
    assert resistance.value == pytest.approx(1.6 + 0.02 * speed + 0.001 * speed**2)
    assert resistance.std == pytest.approx(math.sqrt(0.04 + 1e-4 * speed**2 + 1e-6 * speed**4))
    assert resistance.reasons == (('STANDSTILL', 5), ('BRAKING', 3))
    assert (resistance.used, resistance.rejected) == (12, 8)
    assert model.value == 1.08
    assert model.std == pytest.approx(1.08 * 1e-4 / 0.002)  # the relative one of b1
    assert (brake.value, brake.std, brake.status) == (0.91, 0.05, Status.VALID)
    assert 15 <= len(brake.history) <= 20  # two points in a second
    assert brake.history[0].ago_s > brake.history[-1].ago_s


def message(status: Status) -> SimpleNamespace:
    return SimpleNamespace(**output_values(Output(START_NS, RESISTANCE, status, 12, 8, None)))


def test_time_in_a_status_starts_with_it(driven: Driven) -> None:
    trains = driven()
    feed(trains.by_namespace['/'], 10.0, 13.0, Status.HOLDING)
    brake = view(trains, 12.9).estimates[2]
    assert brake.status is Status.HOLDING
    assert brake.status_s == pytest.approx(2.9)
    feed(trains.by_namespace['/'], 3600.0, 3602.0)  # time without a node is no time in a status
    first = view(trains, 3601.9).estimates[0]
    assert (round(first.status_s, 1), first.is_longer) == (1.9, True)


def test_time_in_a_status_that_began_before_is_that_of_the_node_or_a_lower_bound(driven: Driven) -> None:
    trains = driven()
    first = view(trains, 9.9).estimates[0]
    assert (round(first.status_s, 1), first.is_longer) == (9.9, True)
    values = {'status': 'VALID', 'time in status [s]': '32.0'}
    trains.on_diagnostics('resistance_estimator: estimator', Report(Level.OK, 'VALID', values, 9.4))
    first = view(trains, 9.9).estimates[0]
    assert (round(first.status_s, 1), first.is_longer) == (32.5, False)
    feed(trains.by_namespace['/'], 10.0, 11.0, Status.HOLDING)
    first = view(trains, 10.9).estimates[0]  # its report is of the status before
    assert (round(first.status_s, 1), first.is_longer) == (0.9, False)
    values = {'status': 'HOLDING', 'time in status [s]': '0.0'}  # by a clock that stands still
    trains.on_diagnostics('resistance_estimator: estimator', Report(Level.OK, 'HOLDING', values, 10.9))
    assert round(view(trains, 10.9).estimates[0].status_s, 1) == 0.9


def test_a_node_that_is_not_active_is_not_said_to_have_ended(driven: Driven) -> None:
    trains = driven()
    report = Report(Level.WARN, 'inactive: activate it', {'state': 'inactive'}, 12.0)
    trains.on_diagnostics('resistance_estimator: estimator', report)
    sources = [(item.level, item.source) for item in view(trains, 12.1).findings]
    assert sources == [
        (Level.ERROR, 'brake_rate_estimator, speed_model_estimator'),
        (Level.WARN, 'resistance_estimator'),
    ]


def test_findings_with_other_numbers_are_apart_and_name_the_clock_of_the_stamps() -> None:
    trains = Trains()
    train = trains.add('/')
    feed(train, 0.0, 10.0)
    (shown,) = trains.views(16.0, START_NS + 70 * NS_PER_S)  # played ten times faster
    assert {item.text.partition(' UTC')[0] for item in shown.findings} == {'no estimate since 22:13:29'}
    train.on_estimate(RESISTANCE_TOPIC, message(Status.VALID), 14.0, START_NS + 14 * NS_PER_S)
    found = [(item.source, item.text[:30]) for item in view(trains, 16.0).findings]
    assert found == [
        ('brake_rate_estimator, speed_model_estimator', 'no estimate since 22:13:29 UTC'),
        ('resistance_estimator', 'no estimate since 22:13:34 UTC'),
    ]


def test_a_node_of_another_name_is_found_by_its_topic(driven: Driven) -> None:
    trains = driven()
    train = trains.by_namespace['/']
    train.on_publishers({RESISTANCE_TOPIC.name: ('/my_resist',)})
    counts = {'rejected.GAP': '8'}
    trains.on_diagnostics('my_resist: estimator', Report(Level.OK, 'VALID', counts, 9.8))
    assert view(trains, 9.9).estimates[0].reasons == (('GAP', 8),)
    train.on_publishers({RESISTANCE_TOPIC.name: ()})  # killed
    assert 'my_resist' in [name for item in view(trains, 12.0).findings for name in item.source.split(', ')]


def test_trains_that_ended_are_dropped_while_others_are_there(driven: Driven) -> None:
    trains = driven('/a', '/b')
    feed(trains.by_namespace['/b'], 60.0, 75.0)
    assert trains.drop_ended({'/a', '/b'}, 74.9) == []  # has publishers
    assert trains.drop_ended({'/b'}, 65.0) == []
    assert trains.drop_ended({'/b'}, 74.9) == ['/a']
    assert trains.drop_ended((), 200.0) == []  # the last one stays
    assert [item.namespace for item in trains.views(74.9, START_NS)] == ['/b']


def test_an_estimate_that_stops_is_reported_within_two_seconds(driven: Driven) -> None:
    trains = driven()
    assert not view(trains, 9.8 + 1.0).findings
    shown = view(trains, 9.8 + 1.5)
    assert all(item.is_silent for item in shown.estimates)
    (finding,) = shown.findings  # the same of all three
    assert finding.source == 'brake_rate_estimator, resistance_estimator, speed_model_estimator'
    assert finding.level is Level.ERROR
    assert finding.text == 'no estimate since 22:13:29 UTC: the node has ended or hangs, start it again'


def test_slow_estimates_are_not_silent_between_messages() -> None:
    trains = Trains()
    for k in range(5):
        feed(trains.add('/'), 2.0 * k, 2.0 * k + 0.2)
    assert [view(trains, 8.0 + later_s).estimates[0].is_silent for later_s in (1.9, 5.1)] == [False, True]


def test_an_input_is_named_once_as_the_node_that_takes_it_worst_says(driven: Driven) -> None:
    trains = driven('/train_1')
    for node, level, text in (
        ('brake_rate_estimator', Level.WARN, 'too slow'),
        ('resistance_estimator', Level.STALE, 'no message for 3.0 s'),
        ('speed_model_estimator', Level.OK, '5.0 Hz'),
    ):
        trains.on_diagnostics(f'train_1/{node}: input ato/force', Report(level, text, {}, 9.8))
    (finding,) = view(trains, 9.9).findings
    assert (finding.source, finding.level, finding.text) == ('ato/force', Level.STALE, 'no message for 3.0 s')
    assert not [item for item in view(trains, 9.8 + 4.0).findings if item.source == 'ato/force']  # node gone


def test_errors_come_first_and_inputs_before_estimators(driven: Driven) -> None:
    trains = driven()
    for name, level in (
        ('speed_model_estimator: estimator', Level.WARN),
        ('brake_rate_estimator: estimator', Level.ERROR),
        ('brake_rate_estimator: input ato/speed', Level.ERROR),
    ):
        trains.on_diagnostics(name, Report(level, name, {}, 9.8))
    sources = [item.source for item in view(trains, 9.9).findings]
    assert sources == ['ato/speed', 'brake_rate_estimator', 'speed_model_estimator']


def test_inputs_of_a_mapping_are_shown_as_the_nodes_report_them(driven: Driven) -> None:
    trains = driven()
    values = {'rate [Hz]': '9.98', 'age [s]': '0.04', 'time since last message [s]': '0.1', 'heard': '/odo'}
    for node in ('resistance_estimator', 'brake_rate_estimator'):
        trains.on_diagnostics(f'{node}: input /odo/twist', Report(Level.OK, '10.0 Hz', values, 9.8))
    trains.on_diagnostics('brake_rate_estimator: input ato/force', Report(Level.OK, '10.0 Hz', values, 9.8))
    force, odometer = view(trains, 9.9).inputs  # the other topics of the interface are not used
    assert (force.name, odometer.name) == ('ato/force', '/odo/twist')
    assert (odometer.rate, odometer.age_s, odometer.silent_s) == (9.98, 0.04, 0.1)
    assert odometer.publishers == ('/odo',)


def test_a_remapped_input_is_shown_under_both_names(driven: Driven) -> None:
    trains = driven('/train_1')
    values = {'rate [Hz]': '9.98', 'age [s]': '0.04', 'time since last message [s]': '0.1', 'heard': '/odo'}
    for name, topic in (('ato/speed', '/odo/speed'), ('ato/force', '/train_1/ato/force'), ('ato/mass', '/scale/mass')):
        report = Report(Level.OK, '10.0 Hz', values | {'topic': topic}, 9.8)
        trains.on_diagnostics(f'train_1/resistance_estimator: input {name}', report)
    inputs = {item.name: item for item in view(trains, 9.9).inputs}
    assert {'/odo/speed (ato/speed)', 'ato/force', '/scale/mass (ato/mass)'} <= set(inputs)
    assert inputs['/odo/speed (ato/speed)'].publishers == ('/odo',)
    assert inputs['/scale/mass (ato/mass)'].optional


def test_an_input_of_a_mapping_is_silent_when_its_count_stands_though_its_node_has_a_clock_that_stands(
    driven: Driven,
) -> None:
    trains = driven()
    values = {'rate [Hz]': '5.0', 'age [s]': '0.05', 'time since last message [s]': '0.05', 'count': '7'}
    for time_s in (9.8, 10.8, 11.8):
        report = Report(Level.OK, '5.0 Hz', values, time_s)
        trains.on_diagnostics('resistance_estimator: input /odo/twist', report)
    (odometer,) = view(trains, 12.0).inputs
    assert odometer.silent_s == pytest.approx(2.2)
    assert math.isnan(odometer.rate)
    (odometer,) = view(trains, 22.0).inputs  # and where the node has ended
    assert odometer.silent_s == pytest.approx(12.2)


def test_the_speed_is_that_of_the_estimates_where_it_has_another_topic() -> None:
    trains = Trains()
    train = trains.add('/')
    assert not trains.has_messages(9.8)
    for status, speed_kmh in ((Status.STALE, math.nan), (Status.VALID, 36.0)):
        train.on_estimate(RESISTANCE_TOPIC, message(status), 9.8, START_NS)
        assert trains.has_messages(9.8)
        assert view(trains, 9.9).speed_kmh == pytest.approx(speed_kmh, nan_ok=True)
    assert math.isnan(view(trains, 12.0).speed_kmh)


def test_an_old_speed_is_not_shown_as_present(driven: Driven) -> None:
    assert [math.isnan(view(driven(), now_s).speed_kmh) for now_s in (10.5, 11.5)] == [False, True]


def test_trains_are_apart_and_sorted(driven: Driven) -> None:
    trains = driven('/b', '/a')
    trains.on_diagnostics('a/brake_rate_estimator: estimator', Report(Level.WARN, 'text', {}, 9.8))
    first, second = trains.views(9.9, START_NS)
    assert (first.namespace, second.namespace) == ('/a', '/b')
    assert len(first.findings) == 1
    assert not second.findings
    for name in ('camera: driver', 'c/resistance_estimator: estimator', 'nonsense'):  # of others
        trains.on_diagnostics(name, Report(Level.ERROR, 'text', {}, 9.8))
    assert trains.views(9.9, START_NS) == (first, second)


def test_a_status_that_is_not_known_is_a_fault_and_such_a_level_an_error(driven: Driven) -> None:
    trains = driven()
    feed(trains.by_namespace['/'], 10.0, 11.0, status=77)
    assert view(trains, 11.0).estimates[0].status is Status.FAULT
    assert Level(9) is Level.ERROR


def test_counts_that_are_no_numbers_are_left_out(driven: Driven) -> None:
    trains = driven()
    odd = {'BRAKING': 'many', 'LOW_SPEED': '9' * 5000, 'STANDSTILL': '5', 'GAP': '-1', 'LATE': ''}
    counts = {f'rejected.{name}': count for name, count in odd.items()}
    trains.on_diagnostics('resistance_estimator: estimator', Report(Level.OK, 'VALID', counts, 9.6))
    resistance = view(trains, 9.9).estimates[0]
    assert resistance.reasons == (('STANDSTILL', 5),)
    assert resistance.rejected == 5  # what is shown adds up


def arrived(times: Iterable[float]) -> Arrivals:
    arrivals = Arrivals()
    for time in times:
        arrivals.add(time)
    return arrivals


@pytest.mark.parametrize(
    ('times', 'now_s', 'rate', 'tolerance'),
    [
        ([0.2 * k for k in range(50)], 9.8, 5.0, 0.05),
        ([0.2 * k for k in range(50)], 12.3, 2.5, 0.1),  # silent for half of five seconds
        ([0.2 * k for k in range(50)], 20.0, 0.0, 0.0),
        ([k + 0.001 * j for k in range(10) for j in range(5)], 9.5, 5.0, 1e-6),  # bursts
        ([0.0, 0.2, 0.4], 0.4, 5.0, 1e-6),  # known soon
        ([6.0 * k for k in range(4)], 19.0, 0.2, 1e-6),
        ([0.002 * k for k in range(5000)], 9.998, 500.0, 1e-6),
        ([], 1.0, math.nan, 0.0),
        ([0.0], 1.0, math.nan, 0.0),
    ],
)
def test_the_rate_is_the_count_over_five_seconds(
    times: list[float], now_s: float, rate: float, tolerance: float
) -> None:
    assert arrived(times).rate(now_s) == pytest.approx(rate, rel=tolerance, nan_ok=True)


def test_late_is_later_than_usual_and_silence_counts_from_the_last_message() -> None:
    assert not Arrivals().is_late(100.0)
    assert [arrived((0.0, 0.2, 0.4)).is_late(0.4 + silent) for silent in (1.3, 1.5)] == [False, True]
    assert [arrived((0.0, 2.0, 4.0)).is_late(4.0 + silent) for silent in (4.9, 5.1)] == [False, True]
    assert math.isinf(Arrivals().silent_s(1.0))
    assert arrived((1.0, 3.0)).silent_s(4.5) == 1.5


def test_an_error_is_the_worst_level() -> None:
    assert sorted(Level, key=lambda level: level.severity) == [Level.OK, Level.WARN, Level.STALE, Level.ERROR]


def test_numbers_and_times_are_short() -> None:
    times = {0.0: '0 s', 59.9: '59 s', 60.0: '1:00 min', 3599.0: '59:59 min', 7260.0: '2:01 h'}
    assert {seconds: duration(seconds) for seconds in times} == times
    assert duration(1.62, 1) == '1.6 s'
    assert [number(value) for value in (1.23456, math.nan, -math.inf, 1e12)] == ['1.235', '–', '–', '1.000e+12']
    assert value_text(((72.04, 'km/h', 1), (math.nan, 'm', 0))) == '72.0 km/h'


@pytest.mark.parametrize(
    ('low', 'high', 'shown_kmh'),
    [
        (18.0 / 3.6, 72.0 / 3.6, 45.0),  # the middle, in steps of 5 km/h
        (17.0 / 3.6, 70.0 / 3.6, 45.0),
        (math.nan, math.inf, 50.0),  # ranges that cannot be
        (-math.inf, math.inf, 50.0),
        (5.0, math.nan, 50.0),
        (20.0, 5.0, 50.0),
    ],
)
def test_resistance_is_shown_in_the_middle_of_the_speeds_learned_from(
    low: float, high: float, shown_kmh: float
) -> None:
    assert 3.6 * reference_speed(replace(RESISTANCE, speed_min=low, speed_max=high)) == pytest.approx(shown_kmh)


def test_stds_are_those_of_the_covariance_if_that_can_be() -> None:
    w, std = resistance_at(RESISTANCE, 10.0)
    assert w == pytest.approx(1.6 + 0.2 + 0.1)
    assert std == resistance_std(RESISTANCE.covariance, 10.0)
    for variance in (math.nan, math.inf, 1e308):
        assert math.isnan(resistance_at(replace(RESISTANCE, covariance=(variance,) * 9), 10.0)[1])
    assert math.isnan(mass_factor(replace(MODEL, b1=0.0))[1])

# SPDX-License-Identifier: Apache-2.0
"""Messages carry every field of records and estimates exactly; which publishers of a topic are heard."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_hash import TypeHash
from trainid_msgs.msg import AtoSpeed

from trainid_ros.bag.types import estimate_message as bag_message
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
    record_from_message,
)
from trainid_ros.interface.results import BrakeRateEstimate, Output, Reason, Rejection, ResistanceEstimate, Status
from trainid_ros.ros.topics import (
    NAMELESS,
    Publishers,
    estimate_message,
    input_qos,
    message_from_record,
    sort_publishers,
    time_message,
    type_name,
)

STAMP = 1_700_000_000_123_456_789
SPREAD = tuple(k / 7 for k in range(9))
ESTIMATE = ResistanceEstimate(
    0.1 + 0.2, -1e-17, 1 / 3, tuple(k / 7 for k in range(9)), 1.7, 0.2, 11.1, -0.3, 0.01, 2.5, 3.0, 19.0, 0.4
)
BRAKE = BrakeRateEstimate(0.93, 0.02, math.nan, 12.0, -0.5, -0.6, 77.5, True, 0.01, 0.002, 0.3)


@pytest.mark.parametrize(
    'record',
    [
        SpeedRecord(STAMP, 0.1 + 0.2, math.nan),
        ForceRecord(STAMP, -1e5 / 3),
        GradientRecord(STAMP, -12.5, 400.0, True),
        BrakeRecord(STAMP, -0.7, True),
        MassRecord(STAMP, 194e3),
    ],
)
def test_a_record_is_unchanged_by_conversion_to_a_message_and_back(record: Record) -> None:
    topic = next(topic for topic in INPUT_TOPICS if topic.record is type(record))
    back = record_from_message(topic, message_from_record(record))
    for item in fields(record):
        assert repr(getattr(back, item.name)) == repr(getattr(record, item.name))


def test_numpy_scalars_and_whole_numbers_are_cast() -> None:
    # A float32 stored in a float64 field without a cast would come out as 5e-315.
    record = SpeedRecord(STAMP, np.float32(1.5), 3)  # type: ignore[arg-type]
    message = message_from_record(record)
    assert (message.speed, message.position) == (1.5, 3.0)


@pytest.mark.parametrize('estimate', [ESTIMATE, BRAKE])
def test_an_output_fills_the_message_as_the_bag_writer_does(estimate: ResistanceEstimate) -> None:
    rejection = Rejection(STAMP, Reason.BRAKING, 0.5, 3.0)
    output = Output(STAMP, estimate, Status.HOLDING, 12, 34, rejection)
    message = estimate_message(output)
    expected = bag_message(output)
    for name in message.get_fields_and_field_types():
        if name == 'header':
            assert message.header.stamp == time_message(STAMP)
            continue
        assert np.array(getattr(message, name)).tobytes() == np.array(getattr(expected, name)).tobytes(), name
    assert (message.status, message.last_reject_reason) == (3, 12)
    assert message.last_reject_text == 'BRAKING (value 0.5, limit 3)'


@pytest.mark.parametrize('change', [{'a': math.nan}, {'covariance': (math.inf, *(0.0,) * 8)}])
def test_an_estimate_that_is_not_finite_is_a_fault(change: dict[str, float]) -> None:
    output = Output(STAMP, replace(ESTIMATE, **change), Status.VALID, 1, 0, None)  # type: ignore[arg-type]
    assert estimate_message(output).status == Status.FAULT


def test_an_unknown_position_is_not_a_fault() -> None:
    output = Output(STAMP, BRAKE, Status.VALID, 1, 0, None)
    assert estimate_message(output).status == Status.VALID


SPEED = 'trainid_msgs/msg/AtoSpeed'


OURS, THEIRS = (str(TypeHash(1, bytes([byte] * 32))) for byte in (1, 2))


def info(name: str, kind: str = SPEED, definition: str = OURS) -> Any:
    return SimpleNamespace(
        node_namespace='/',
        node_name=name,
        topic_type=kind,
        topic_type_hash=definition,
        qos_profile=QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
    )


def test_the_name_of_a_type_is_that_of_the_graph() -> None:
    assert type_name(AtoSpeed) == SPEED


@pytest.mark.parametrize(
    ('infos', 'definition', 'profile', 'expected'),
    [
        ([info('b'), info('a')], OURS, input_qos(), Publishers(('/a', '/b'))),
        (
            [info('a'), info('odo', 'std_msgs/msg/Float64')],
            OURS,
            input_qos(),
            Publishers(('/a',), (f'/odo publishes std_msgs/msg/Float64 instead of {SPEED}',)),
        ),
        (
            [info('a', definition=THEIRS), info('b', definition=str(TypeHash()))],
            OURS,
            input_qos(),
            Publishers(('/b',), (f'/a publishes another version of {SPEED}, whose messages are misread',)),
        ),
        ([info('a', definition=THEIRS), info('b', definition=OURS)], '', input_qos(), Publishers(('/a', '/b'))),
        (
            [info('a')],
            OURS,
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=1)),
            Publishers(
                (),
                (
                    '/a has an incompatible quality of service (Volatile publisher and transient local subscription, '
                    'Subscription has a deadline, but publisher does not)',
                ),
            ),
        ),
    ],
    ids=['heard', 'other type', 'other definition', 'unknown definition', 'all reasons of an incompatible QoS'],
)
def test_publishers_are_sorted_by_whether_they_are_heard(
    infos: list[Any], definition: str, profile: QoSProfile, expected: Publishers
) -> None:
    assert sort_publishers(infos, SPEED, definition, profile) == expected


def test_one_that_was_killed_counts_once_with_its_successor_which_has_no_name_at_first() -> None:
    found = sort_publishers([info('a'), info('a'), info('_NODE_NAME_UNKNOWN_')], SPEED, OURS, input_qos())
    assert (found.heard, found.at_a_time().heard) == (('/a', '/a', NAMELESS), ('/a',))
    assert Publishers((NAMELESS,)).at_a_time().heard == (NAMELESS,)

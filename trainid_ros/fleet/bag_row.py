# SPDX-License-Identifier: Apache-2.0
"""The row of one bag: replayed as by ``trainid replay``; a failure is a row with an error."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainid_ros.bag.bag_replay import Pipelines, Replay, replay_through
from trainid_ros.bag.opening_progress import in_two
from trainid_ros.bag.worker_pool import killed_message
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.errors import TrainIdError
from trainid_ros.estimators.observability import resistance_std
from trainid_ros.fleet.columns import SPEEDS, Row, empty_row, reason_column, share_column
from trainid_ros.fleet.labels import LABELS, day_of
from trainid_ros.fleet.odometer import OdometerReader
from trainid_ros.mapping.mapped_inputs import mapped_inputs
from trainid_ros.records import NS_PER_S
from trainid_ros.resistance.force_findings import force_findings
from trainid_ros.results import Status
from trainid_ros.ros.jobs import node_setups
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.fleet.plan import PlannedBag, Setup
    from trainid_ros.mapping.mapped_inputs import MappedInputs
    from trainid_ros.results import ResistanceEstimate
    from trainid_ros.ros.jobs import Setup as NodeSetup


def bag_row(setup: Setup, revision: str, bag: PlannedBag, advance: Callable[[float], None]) -> Row:
    """Return the row of a bag.

    Args:
        setup: How it is replayed.
        revision: What computes.
        bag: The bag as listed.
        advance: Called with the share done since its last call.

    """
    row = listed_row(bag, revision)
    if bag.error:
        advance(1.0)
        return row
    try:
        _replay(setup, bag, row, advance)
    except TrainIdError as error:
        row['error'] = str(error)
    except OSError as error:
        row['error'] = f'{error.filename or bag.path}: {error.strerror}'
    return row


def killed_row(revision: str, bag: PlannedBag) -> Row:
    """Return the row of a bag whose process was killed."""
    return listed_row(bag, revision) | {'error': killed_message(Path(bag.path))}


def listed_row(bag: PlannedBag, revision: str) -> Row:
    """Return what the list says of a bag."""
    row = empty_row() | {'bag': bag.path, 'start': bag.start_s, 'revision': revision}
    return row | labels_in_row(bag, bag.start_s) | {'error': bag.error or None}


def labels_in_row(bag: PlannedBag, start_s: float | None) -> Row:
    """Return the labels of a bag; ``start_s`` is the time of its first message [s], None if it is not known."""
    labels: Row = {name: getattr(bag, name) or None for name in LABELS}
    return labels | {'day': day_of(bag.day, start_s, Path(bag.path))}


@lru_cache(maxsize=1)
def _prepared(setup: Setup) -> tuple[tuple[NodeSetup, ...], Callable[[], MappedInputs] | None]:
    """Return setups of the nodes and what makes the inputs, read once in each process."""
    train_file = load_train_file(setup.train)
    setups = node_setups(train_file, str(setup.train), setup.params, namespace=setup.namespace)
    return setups, mapped_inputs(setup.mapping, setups[0].train_file)


def check_setup(setup: Setup) -> None:
    """Raise InputError if train file, parameters or mapping cannot be used."""
    _prepared(setup)


def _replay(setup: Setup, bag: PlannedBag, row: Row, advance: Callable[[float], None]) -> None:
    """Replay a bag and fill its row.

    Raises:
        InputError: It cannot be used.

    """
    setups, inputs = _prepared(setup)
    opening, reading = in_two(advance)
    with OdometerReader(Path(bag.path), setup.namespace, setup.max_chunk, inputs, opening=opening) as reader:
        pipelines = Pipelines(*(item.mapped(reader.mapping).pipeline() for item in setups))
        before = _dead_time(pipelines)
        count = max(reader.input_count, 1)
        outcome = replay_through(pipelines, reader, lambda amount: reading(amount / count))
        span = reader.time_range()
    if row['start'] is None and span is not None:  # the bag has no index
        row['start'] = span[0] / NS_PER_S
        row |= labels_in_row(bag, row['start'])
    row |= {'duration_s': outcome.duration_s, 'warnings': '; '.join(reader.warnings) or None}
    row |= _resistance(outcome) | _brake(outcome)
    for name in ('contradiction', 'finding'):
        row[name] = row[name] and reader.mapping.named(row[name])
    row['mass_factor'] = _known(outcome.speed_model.output.estimate.mass_factor)
    if before is not None and (learned := _dead_time(pipelines)) is not None and learned[1] < before[1]:
        row['dead_time'], row['dead_time_std'] = learned
    if (ratio := reader.odometer.ratio) is not None:
        row['wheel_ratio'], row['wheel_ratio_std'] = ratio


def _resistance(outcome: Replay) -> Row:
    result = outcome.resistance
    w = result.output.estimate
    findings = (*force_findings(w), *outcome.brake_findings)
    row: Row = {
        'status': result.output.status.name,
        'used': result.output.used,
        'rejected': result.output.rejected,
        'contradiction': outcome.contradiction.finding or None,
        'finding': '; '.join(findings) or None,
    }
    row |= {reason_column(reason): count for reason, count in result.rejections}
    outputs = max(1, sum(result.statuses))
    row |= {share_column(status): result.statuses[status] / outputs for status in Status}
    reason = outcome.why_no_resistance()
    return row | ({'error': reason} if reason else _davis(w))


def _davis(w: ResistanceEstimate) -> Row:
    row: Row = {'a': w.a, 'b': w.b, 'c': w.c, 'speed_min': w.speed_min, 'speed_max': w.speed_max}
    for i, name in enumerate('abc'):
        row[f'{name}_std'] = math.sqrt(max(0.0, w.covariance[4 * i]))
    for v in SPEEDS:
        row[f'w{v}'], row[f'w{v}_std'] = w.a + w.b * v + w.c * v * v, resistance_std(w.covariance, v)
    for name in ('force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'):
        row[name] = _known(getattr(w, name))
    return row


def _brake(outcome: Replay) -> Row:
    result = outcome.brake_rate
    if not result.output.used:
        return {'brake_status': result.output.status.name, 'brake_used': 0}
    return {
        'brake_rate': result.output.estimate.brake_rate,
        'brake_rate_std': result.output.estimate.brake_rate_std,
        'brake_status': result.output.status.name,
        'brake_used': result.output.used,
    }


def _dead_time(pipelines: Pipelines) -> tuple[float, float] | None:
    """Return dead time of the brake and its standard deviation [s], None of an estimator that does not have them."""
    estimator = pipelines.brake_rate.estimator
    if not isinstance(estimator, BrakeRateEstimator):
        return None
    return estimator.state.timing.delay, estimator.state.timing.delay_std


def _known(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None

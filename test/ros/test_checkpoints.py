# SPDX-License-Identifier: Apache-2.0
"""Nodes continue from their checkpoint: at start, after a cleanup, and beside a full disk or another train."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.time import Time

from test.ros.graph import NARROW, OWN, START_NS, Diagnosed, Graph, Simulated, coasting, collected, cycle, feed
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status
from trainid_ros.ros.estimator_node import BRAKE_RATE, SPECS
from trainid_ros.setup.checkpoint import CheckpointFile, default_path, parse_checkpoint

pytestmark = pytest.mark.ros


@pytest.mark.parametrize('spec', SPECS.values(), ids=SPECS)
def test_a_new_process_equals_one_that_never_stopped_to_the_bit(
    graph: Graph, train_file: str, tmp_path: Path, spec: Any
) -> None:
    path, records = str(tmp_path / 'state.json'), coasting(300)
    whole = graph.active(train_file, spec)
    expected = collected(whole)
    feed(whole, records)
    graph.drop()
    first = graph.active(train_file, spec, checkpoint_file=path)
    messages = collected(first)
    feed(first, records[:702])  # in the middle of a sample
    graph.end(first)
    second = graph.active(train_file, spec, checkpoint_file=path)
    assert second.pipeline.samples > 150
    rest = collected(second)
    feed(second, records[702:])
    assert repr(messages + rest) == repr(expected)


def test_a_loaded_estimate_is_latched_at_once_with_its_stamp_and_counters(
    graph: Graph, train_file: str, tmp_path: Path
) -> None:
    path = str(tmp_path / 'state.json')
    first = graph.active(train_file, checkpoint_file=path, **NARROW)
    feed(first, coasting(160))
    saved = first.pipeline.current()
    assert saved.status is Status.VALID
    graph.end(first)
    second = graph.active(train_file, checkpoint_file=path, **NARROW)
    got = graph.latched()
    graph.until(lambda: got)
    stamp_ns = got[0].header.stamp.sec * NS_PER_S + got[0].header.stamp.nanosec
    assert (got[0].status, stamp_ns, got[0].used) == (Status.VALID, saved.stamp_ns, saved.used)
    # In the short time since then hardly anything has changed.
    assert saved.estimate.resistance_std < got[0].resistance_std < 1.1 * saved.estimate.resistance_std
    published = collected(second)
    graph.until(lambda: published)  # no input comes
    assert published[0].status is Status.STALE


def test_the_age_of_a_checkpoint_widens_the_estimate(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = str(tmp_path / 'state.json')
    first = graph.active(train_file, checkpoint_file=path)
    feed(first, coasting(160))
    std = first.pipeline.current().estimate.resistance_std
    graph.end(first)
    stds = []
    for age_s in (0.0, 60.0, 3600.0):
        node = graph.make(train_file=train_file, checkpoint_file=path)
        now_ns = node.get_clock().now().nanoseconds + round(age_s * NS_PER_S)
        later = Time(nanoseconds=now_ns, clock_type=ClockType.ROS_TIME)
        monkeypatch.setattr(node.get_clock(), 'now', lambda later=later: later)
        assert node.trigger_configure().name == 'SUCCESS'
        stds.append(node.pipeline.current().estimate.resistance_std)
        graph.drop()
    assert std < stds[0] < stds[1] < stds[2]


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'train__mass': 582000.0}, 'is of another train or other settings: train.mass = 194000.0, here 582000.0'),
        ({'estimator__step_share_c': 0.9}, 'estimator.step_share_c = 0.2, here 0.9'),
        ({'algorithm': 'V-MILS'}, 'is of filter-bank, not of V-MILS'),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_kept_aside_and_the_node_starts_from_its_prior(
    graph: Graph, train_file: str, tmp_path: Path, change: dict[str, Any], reason: str, capfd: Any
) -> None:
    path = tmp_path / 'state.json'
    first = graph.active(train_file, checkpoint_file=str(path))
    feed(first, coasting(20))
    graph.end(first)
    content = path.read_bytes()
    second = graph.active(train_file, checkpoint_file=str(path), **change)
    assert second.pipeline.samples == 0
    assert reason in capfd.readouterr().err
    assert (tmp_path / 'state.refused-1.json').read_bytes() == content
    feed(second, coasting(20))
    second.trigger_deactivate()
    assert path.exists()


def test_a_checkpoint_with_a_value_out_of_range_is_named_with_its_file(
    graph: Graph, train_file: str, tmp_path: Path, capfd: Any
) -> None:
    path = tmp_path / 'state.json'
    first = graph.active(train_file, checkpoint_file=str(path))
    feed(first, coasting(20))
    graph.end(first)
    file = CheckpointFile(path)
    held = parse_checkpoint(path.read_text(encoding='utf-8'), str(path))
    state = json.loads(held.state)
    state['state']['used'] = 0.5
    file.write(replace(held, state=json.dumps(state)))
    second = graph.active(train_file, checkpoint_file=str(path))
    assert second.pipeline.samples == 0
    problem = 'saved EstimatorPipeline.used = 0.5 must be of type int'
    assert f'{path}: checkpoint is invalid: {problem}; starting from the prior' in capfd.readouterr().err


@pytest.mark.parametrize('name', ['train.yaml', 'notes.json'])
def test_a_node_overwrites_no_other_file(graph: Graph, train_file: str, tmp_path: Path, name: str) -> None:
    (tmp_path / 'notes.json').write_text('{}', encoding='utf-8')
    before = (tmp_path / name).read_bytes()
    node = graph.make(BRAKE_RATE, train_file=train_file, checkpoint_file=str(tmp_path / name))
    assert not node.bring_up()
    assert name in node.failure
    assert (node.state, (tmp_path / name).read_bytes()) == ('unconfigured', before)


def test_it_is_saved_at_intervals_and_only_when_something_has_changed(
    graph: Graph, train_file: str, tmp_path: Path
) -> None:
    path = tmp_path / 'state.json'
    node = graph.active(train_file, checkpoint_file=str(path), checkpoint_period=0.1, stale_after=60.0)
    records = coasting(40)
    feed(node, records[:80])
    graph.until(path.exists)
    graph.until(lambda: node.checkpoints._writing is None or node.checkpoints._writing.done())
    before = path.stat().st_mtime_ns
    for _ in range(10):
        graph.executor.spin_once(timeout_sec=0.05)
    assert path.stat().st_mtime_ns == before
    feed(node, records[80:])
    graph.until(lambda: path.stat().st_mtime_ns != before)
    assert [item.name for item in tmp_path.glob('*state*')] == ['state.json']


def test_without_the_parameter_nothing_is_saved(graph: Graph, train_file: str) -> None:
    folder = Path(os.environ['ROS_HOME'], 'trainid')
    before = set(folder.glob('*'))
    node = graph.active(train_file, checkpoint_period=0.1)
    feed(node, coasting(20))
    cycle(node)
    assert set(folder.glob('*')) == before


def test_a_full_disk_is_a_warning_once_and_never_more(
    graph: Graph, train_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    path = tmp_path / 'state.json'
    node = graph.active(train_file, checkpoint_file=str(path), checkpoint_period=0.1)
    diagnosed = Diagnosed(graph)

    def full(_handle: int) -> None:
        raise OSError(28, 'No space left on device')

    records = coasting(60)
    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', full)
        for k in range(0, 160, 4):
            feed(node, records[k : k + 4])
            graph.executor.spin_once(timeout_sec=0.02)
        graph.until(lambda: node.shared.unsaved)
        node._diagnostics.publish()
        message = diagnosed.until(OWN, 'not saved')
    assert diagnosed.level(OWN) >= DiagnosticStatus.WARN
    assert 'state.json: checkpoint cannot be written: No space left on device' in message
    feed(node, records[160:])
    node.trigger_deactivate()
    assert (node.shared.unsaved, path.exists()) == ('', True)
    log = capfd.readouterr().err
    assert log.count('No space left on device') == 1
    assert log.count('checkpoints are saved again') == 1


def test_of_two_nodes_with_one_file_the_first_saves_and_the_other_warns(
    graph: Graph, train_file: str, tmp_path: Path, capfd: Any
) -> None:
    path = tmp_path / 'state.json'
    names = [('-r', f'__node:={name}') for name in ('left', 'right')]
    left, right = (graph.active(train_file, arguments=name, checkpoint_file=str(path)) for name in names)
    feed(left, coasting(40))
    left.trigger_deactivate()
    content = path.read_bytes()
    feed(right, coasting(20))
    right.trigger_deactivate()
    assert (left.shared.unsaved, path.read_bytes()) == ('', content)
    reason = f'{path}: was written by another node: each node needs a checkpoint file of its own'
    assert right.shared.unsaved == reason
    assert f'[right]: {reason}; what is learned from now on would be lost' in capfd.readouterr().err


def test_saving_on_request_keeps_the_checkpoint_of_another_train(graph: Graph, train_file: str, capfd: Any) -> None:
    path = default_path('/resistance_estimator')
    for mass, count in ((194000.0, 40), (582000.0, 20)):
        node = graph.active(train_file, train__mass=mass)
        feed(node, coasting(count))
        before = path.read_bytes() if path.exists() else b''
        assert node.checkpoints.save_on_request(node.pipeline) == path
        graph.drop()
    aside = path.with_suffix('.refused-1.json')
    assert aside.read_bytes() == before
    assert path.read_bytes() not in {b'', before}
    assert f'train.mass = 194000.0, here 582000.0; this file is kept as {aside}' in capfd.readouterr().err


def test_a_cleanup_keeps_what_was_learned_where_it_still_fits(graph: Graph, train_file: str, capfd: Any) -> None:
    node = graph.active(train_file)
    feed(node, coasting(60))
    used = node.pipeline.used
    for name, value in (('stale_after', 2.0), ('checkpoint_period', 0.0), ('diagnostic_period', 5.0)):
        result = node.set_parameters([Parameter(name, value=value)])[0]
        assert result.successful
    assert 'takes effect' not in capfd.readouterr().err
    assert node.pipeline.timeout_ns(0) == 2 * NS_PER_S
    assert node._diagnostic_timer.timer_period_ns == 5 * NS_PER_S
    cycle(node)
    assert node.pipeline.used == used > 0
    assert node.set_parameters([Parameter('resistance.a', value=3.0)])[0].successful
    assert 'resistance.a = 3.0 takes effect on the next configure' in capfd.readouterr().err
    assert node.pipeline.used == used
    cycle(node)
    assert node.pipeline.used == 0


OTHER = 'train: {mass: 210000.0, length: 60.0}\nresistance: {a: 2.5, b: 0.02, c: 0.0012}\n'


def test_a_dump_of_the_parameters_does_not_mix_two_trains(
    graph: Graph, train_file: str, tmp_path: Path, capfd: Any
) -> None:
    node = graph.active(train_file, brake__rate=0.9)
    values = {name: parameter.value for name, parameter in node._parameters.items() if parameter.value is not None}
    dump = tmp_path / 'dump.yaml'
    dump.write_text(yaml.safe_dump({'/resistance_estimator': {'ros__parameters': values}}), encoding='utf-8')
    graph.drop()
    (tmp_path / 'other.yaml').write_text(OTHER, encoding='utf-8')
    capfd.readouterr()
    arguments = ('--params-file', str(dump), '-p', f'train_file:={tmp_path / "other.yaml"}')
    other = graph.up(arguments=arguments)
    names = ('train.mass', 'train.length', 'resistance.a', 'brake.rate')
    assert [other.shared.parameters.value(name) for name in names] == [210000.0, 60.0, 2.5, 0.9]
    log = capfd.readouterr().err
    assert (
        'values that a dump took from another train file are ignored: train.mass = 194000 (train file: 210000)' in log
    )
    assert 'parameters replace values of the train file: brake.rate = 0.9 (train file: 1)' in log


@pytest.mark.parametrize('by_clock', [True, False])
def test_a_jump_that_resets_the_estimator_leaves_a_good_checkpoint(
    graph: Graph, train_file: str, tmp_path: Path, by_clock: bool
) -> None:
    path, records = tmp_path / 'state.json', coasting(160)
    node = graph.active(train_file, checkpoint_file=str(path), use_sim_time=by_clock)
    clock = Simulated(graph, node) if by_clock else None
    if clock is not None:
        clock.go(records[-1].stamp_ns)
    feed(node, records)
    node.checkpoints.save(node.pipeline)
    good = path.read_bytes()
    early_ns = START_NS - 7200 * NS_PER_S
    if clock is not None:
        clock.go(early_ns)
        assert node.running_pipeline() is node.pipeline
    feed(node, coasting(20, start_ns=early_ns))
    assert (node.pipeline.resets, node.pipeline.status) == (1, Status.CONVERGING)
    cycle(node)
    assert path.read_bytes() == good
    assert node.pipeline.samples > 140  # from the file, not from what was kept of the short drive


def test_after_a_jump_it_is_saved_once_the_estimate_is_valid_or_when_asked_for(
    graph: Graph, train_file: str, tmp_path: Path
) -> None:
    path, early_ns = tmp_path / 'state.json', START_NS - 7200 * NS_PER_S
    node = graph.active(train_file, checkpoint_file=str(path), **NARROW)
    feed(node, coasting(20))
    early = coasting(160, start_ns=early_ns)
    feed(node, early[:20])
    node.checkpoints.save(node.pipeline)
    assert (node.pipeline.resets, path.exists()) == (1, False)
    node.reset_on_request(node.pipeline)
    node.checkpoints.save(node.pipeline)
    path.unlink()
    node.checkpoints.is_wiped = True
    feed(node, early)
    assert node.pipeline.status is Status.VALID
    node.checkpoints.save(node.pipeline)
    assert path.exists()

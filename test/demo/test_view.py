# SPDX-License-Identifier: Apache-2.0
"""Display of the running demo, and the parameters of its nodes."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import pytest
import yaml
from rich.console import Console

from trainid_ros.demo.bags import load_demo_bag, stock_bag
from trainid_ros.demo.live import KINDS, parameter_file
from trainid_ros.demo.view import Snapshot, View, line, render
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import BrakeRateEstimate, Output, Reason, ResistanceEstimate, Status
from trainid_ros.sim.truth import Truth

START_NS = 1_700_000_000 * NS_PER_S
RESISTANCE = ResistanceEstimate(1.6, 0.02, 0.001, (0.0,) * 9, 1.9, 0.2, 10.0, 0.1, 0.04, 0.02, 2.0, 20.0, 0.3)
BRAKE = BrakeRateEstimate(0.91, 0.05, 0.0, 10.0, 0.0, 0.0, 100.0, False, 0.01, 0.001, 0.01)
TRUTH = Truth(START_NS, ((0.0, 1.5, 0.02, 0.001),), ((0.0, 0.95),))


def snapshot(truth: Truth | None = TRUTH) -> Snapshot:
    shown = Snapshot('Trial', 40.0, START_NS, 600.0, truth)
    stamp = START_NS + 90 * NS_PER_S
    shown.newest[ResistanceEstimate] = Output(stamp, RESISTANCE, Status.VALID, 12, 8, None)
    shown.newest[BrakeRateEstimate] = Output(stamp, BRAKE, Status.HOLDING, 3, 17, None)
    shown.rejections[ResistanceEstimate] = {Reason.BRAKING: 5, Reason.STANDSTILL: 3}
    return shown


def drawn(item: Any) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(item)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_line_shows_estimates_truth_and_status() -> None:
    text = line(snapshot())
    for wanted in ('1:30/10:00', '36.0 km/h', 'w 1.900 ± 0.200 (truth 1.800) VALID', '0.910 ± 0.050 (truth 0.950)'):
        assert wanted in text


def test_line_without_truth_or_brake_rate() -> None:
    shown = snapshot(truth=None)
    del shown.newest[BrakeRateEstimate]
    assert 'truth' not in line(shown)
    assert 'brake' not in line(shown)


def test_table_shows_error_and_reasons() -> None:
    text = drawn(render(snapshot()))
    for wanted in ('+0.100', '-0.040', '8 (braking 5, standstill 3)', 'HOLDING', 'waiting', '36.0 km/h'):
        assert wanted in text


def test_without_a_terminal_lines_are_printed_at_intervals() -> None:
    console = Console(file=io.StringIO(), width=200, force_terminal=False)
    with View(console, line_every_s=3600.0) as view:
        for _ in range(5):
            view.show(snapshot())
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count('km/h') == 1


def test_parameters_make_every_topic_reliable() -> None:
    sections = yaml.safe_load(parameter_file())
    assert set(sections) == set(KINDS)
    for section in sections.values():
        topics = section['ros__parameters']['qos_overrides']
        inputs = [topic for topic, entities in topics.items() if 'subscription' in entities]
        assert {'/ato/speed', '/ato/force', '/ato/gradient', '/ato/brake_command', '/ato/mass'} == set(inputs)
        assert all(topics[topic]['subscription']['reliability'] == 'reliable' for topic in inputs)
        assert sum('publisher' in entities for entities in topics.values()) == 1


@pytest.mark.parametrize('name', ['altrios', 'yizhuang'])
def test_stock_bags_are_complete(name: str) -> None:
    bag = load_demo_bag(stock_bag(name))
    assert bag.truth is not None
    assert bag.title != bag.path.name


def test_bag_without_train_file_is_reported(tmp_path: Any) -> None:
    with pytest.raises(InputError, match=r'train\.yaml'):
        load_demo_bag(tmp_path)


def test_snapshot_values_follow_the_truth_in_time() -> None:
    truth = replace(TRUTH, brake_rate=((0.0, 1.0), (60.0, 0.8)))
    assert snapshot(truth).values(BrakeRateEstimate) == (0.91, 0.05, 0.8)

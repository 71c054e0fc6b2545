# SPDX-License-Identifier: Apache-2.0
"""What the demo refuses before it starts, what it shows, how it compares live and replay, and hides effects."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import yaml

from test.report import conftest as report
from trainid_ros.cli import demo
from trainid_ros.cli.demo import (
    MISSION,
    V_MILS,
    Case,
    Comparison,
    Published,
    compare,
    describe_cases,
    describe_resistance,
    draw_effect,
    line,
    run_cases,
)
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import shared_path
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Output, Status
from trainid_ros.report import HTML_START
from trainid_ros.sim.truth import Truth
from trainid_ros.train.effects import EFFECTS, parse_effects
from trainid_ros.train.train_file import Davis

START_NS = report.START_NS
RESISTANCE = replace(report.RESISTANCE, covariance=(0.0,) * 9)
BRAKE = replace(report.BRAKE, brake_rate=0.91, test_ratio=float('nan'))
HIDDEN = 'local_drag:permille=1.6,start=300,end=480'
TRUTH = Truth(START_NS, ((0.0, 1.5, 0.02, 0.001),), ((0.0, 1.0), (60.0, 0.95)))


@pytest.fixture
def _nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> NoReturn:
        pytest.fail('a chapter ran')

    monkeypatch.setattr(demo, '_live', fail)
    monkeypatch.setattr(demo, 'run_cases', fail)


ALL, EXPLAIN, PLAYED = (), ('--only', 'explain'), ('--only', 'yizhuang')


@pytest.mark.usefixtures('_nothing_runs')
@pytest.mark.parametrize(
    ('name', 'out', 'chapters', 'problem'),
    [
        *(('out', out, only, 'cannot be written') for out in ('out', 'out/deeper') for only in (ALL, EXPLAIN, PLAYED)),
        ('explain/seed_1/report.html', '', ALL, 'seed_1/report.html: exists and was not written'),
        (
            'explain/seed_1/report.html',
            '',
            EXPLAIN,
            'explain/seed_1/report.html: exists and was not written by trainid',
        ),
    ],
)
def test_a_file_of_somebody_else_is_refused_at_once(
    tmp_path: Path, one_error: Callable[[], str], name: str, out: str, chapters: tuple[str, ...], problem: str
) -> None:
    own = tmp_path / name
    own.parent.mkdir(parents=True, exist_ok=True)
    own.write_text('my own file', encoding='utf-8')
    assert main(['demo', *chapters, '--out', str(tmp_path / out)]) == 2
    assert problem in one_error()
    assert own.read_text(encoding='utf-8') == 'my own file'


@pytest.mark.usefixtures('_nothing_runs')
def test_only_the_chapters_played_need_their_folders(tmp_path: Path) -> None:
    (tmp_path / 'explain').write_text('my own file', encoding='utf-8')
    (tmp_path / 'report.html').write_text(f'{HTML_START}an earlier report', encoding='utf-8')
    with pytest.raises(pytest.fail.Exception, match='a chapter ran'):
        main(['demo', *PLAYED, '--out', str(tmp_path)])


def newest() -> dict[demo.Node, Output[Any]]:
    stamp = START_NS + 90 * NS_PER_S
    resistance, _, brake_rate = MISSION
    return {
        resistance: Output(stamp, RESISTANCE, Status.VALID, 12, 8, None),
        brake_rate: Output(stamp, BRAKE, Status.HOLDING, 3, 17, None),
        V_MILS: Output(stamp, replace(RESISTANCE, resistance=1.7), Status.CONVERGING, 2, 18, None),
    }


def test_line_shows_estimates_truth_and_status() -> None:
    text = line(newest(), TRUTH)
    for wanted in ('36.0 km/h', 'w 1.900 ± 0.200 (truth 1.800) VALID', '12 used, 8 rejected'):
        assert wanted in text
    assert 'brake rate 0.910 ± 0.050 (truth 0.950) HOLDING' in text  # the truth at that time
    assert 'w by V-MILS 1.700 ± 0.200 (truth 1.800) CONVERGING' in text
    without_rate = line(newest(), replace(TRUTH, brake_rate=()))
    assert '(truth 1.800) VALID' in without_rate
    assert 'brake rate 0.910 ± 0.050 HOLDING' in without_rate
    assert line({V_MILS: newest()[V_MILS]}, None) == 'w by V-MILS 1.700 ± 0.200 CONVERGING, 2 used, 18 rejected'


def test_the_resistance_of_an_algorithm_is_shown_with_its_error() -> None:
    covariance = (0.04, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    output = Output(START_NS, replace(RESISTANCE, covariance=covariance), Status.VALID, 12, 8, None)
    head, values = describe_resistance('V-MILS', output, Davis(1.5, 0.02, 0.001))
    assert head == 'V-MILS: w(v) = 1.600 +0.0200 v +0.00100 v² N/kN, VALID, 12 samples used, 8 rejected'
    assert 'w(10 m/s) = 1.900 ± 0.200 (error +0.100)' in values
    assert 'error' not in describe_resistance('V-MILS', output, None)[1]


def test_parameters_make_every_topic_reliable() -> None:
    sections = yaml.safe_load(demo.node_parameters())
    mission = {'resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator'}
    assert set(sections) == {*mission, 'v_mils_estimator'}
    algorithms = {name: section['ros__parameters']['algorithm'] for name, section in sections.items()}
    assert (algorithms['resistance_estimator'], algorithms['v_mils_estimator']) == ('filter-bank', 'V-MILS')
    for section in sections.values():
        topics = section['ros__parameters']['qos_overrides']
        inputs = [topic for topic, entities in topics.items() if 'subscription' in entities]
        assert {'/ato/speed', '/ato/force', '/ato/gradient', '/ato/brake_command', '/ato/mass'} == set(inputs)
        assert all(topics[topic]['subscription']['reliability'] == 'reliable' for topic in inputs)
        assert sum('publisher' in entities for entities in topics.values()) == 1


def test_stock_bags_are_complete_and_another_needs_a_train_file(tmp_path: Path) -> None:
    for name in ('altrios', 'yizhuang'):
        bag = demo.load_demo_bag(demo.stock_bag(name))
        assert bag.truth is not None
        assert bag.title != bag.path.name
    with pytest.raises(InputError, match=r'train\.yaml'):
        demo.load_demo_bag(tmp_path)


def published(estimate: Any) -> list[tuple[int, int]]:
    made = Published()
    assert made.add(Output(5, estimate, Status.VALID, 1, 0, None))
    return made.digests


def test_equal_estimates_have_equal_digests_whatever_holds_their_numbers() -> None:
    array: Any = tuple(np.zeros(9))
    for given, estimate in ((replace(RESISTANCE, covariance=array), RESISTANCE), (BRAKE, replace(BRAKE))):
        assert compare(published(given), published(estimate)) == Comparison(1, 1, 1, 0, 0)


@pytest.mark.parametrize(
    'change',
    [{'a': float(np.nextafter(1.6, 2.0))}, {'covariance': (1e-300,) + (0.0,) * 8}, {'resistance': float('nan')}],
)
def test_the_last_bit_counts(change: dict[str, Any]) -> None:
    found = compare(published(replace(RESISTANCE, **change)), published(RESISTANCE))
    assert (found, found.exact) == (Comparison(1, 1, 0, 0, 0), False)


def test_a_repeat_that_reports_missing_input_does_not_count() -> None:
    live = Published()
    cases = ((0, Status.STALE), (5, Status.VALID), (5, Status.STALE), (6, Status.STALE))  # first before any input
    counts = [live.add(Output(stamp, RESISTANCE, status, 1, 0, None)) for stamp, status in cases]
    assert counts == [False, True, False, True]


def test_missing_different_and_unexpected_messages_are_counted() -> None:
    same = [(1, 10), (2, 20), (3, 30)]
    assert compare(same, same).exact
    assert str(compare(same, same)) == 'live equals replay to the bit: all 3 messages'
    found = compare([(1, 10), (3, 31)], same)
    assert (found, found.exact) == (Comparison(3, 2, 1, 1, 0), False)
    assert '1 of 3' in str(found)
    assert '1 were missed' in str(found)
    assert compare([*same, (3, 30)], same).extra == 1
    assert not compare([*same, (3, 30)], same).exact


def test_effects_are_drawn_within_the_line_and_of_noticeable_size() -> None:
    drawn = [draw_effect(np.random.default_rng(seed), 8000.0) for seed in range(60)]
    assert len({text.partition(':')[0] for text in drawn}) == 8
    for (effect,) in map(parse_effects, ([text] for text in drawn)):
        kind, values = EFFECTS[effect.name], dict(effect.parameters)
        size = (values[kind.amplitude] - kind.neutral) / kind.typical_size
        assert 0.999 <= abs(size) <= 2.001
        assert kind.sign * size >= 0.0
        if 'start' in values:
            assert 0.0 <= values['start'] < values['end'] <= 8000.0
            assert 499.0 <= values['end'] - values['start'] <= 3001.0


def test_the_truth_stands_beside_the_answer(make_explanation: Callable[..., Explanation]) -> None:
    nothing = make_explanation(verdict=Verdict.NO_GAP, effects=(), gap=None)
    cases = [Case(7, HIDDEN, found, Path('out')) for found in (make_explanation(), nothing)]
    _, head, first, second, *reports = describe_cases(cases).splitlines()
    assert head.split()[:2] == ['seed', 'hidden']
    assert first.startswith(f'7     {HIDDEN}  local_drag: start = ')
    assert first.endswith('0.400 -> 0.050')
    assert second.startswith(f'7     {HIDDEN}  no_gap')
    assert reports == ['report: out/report.html'] * 2
    assert [case.is_found for case in cases] == [True, False]


@pytest.mark.slow
def test_a_hidden_effect_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[int] = []

    def first_case(folders: Mapping[int, Path], *rest: Any) -> Iterator[Case]:
        given.extend(folders)
        return run_cases({5: folders[5]}, *rest)

    monkeypatch.setattr(demo, 'run_cases', first_case)  # all three take three times as long
    (tmp_path / 'explain' / 'seed_5' / 'bag').mkdir(parents=True)  # of an earlier demo
    assert main(['demo', '--only', 'explain', '--seed', '5', '--out', str(tmp_path), '--json']) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert (answer['worked'], answer['bags'], given) == (True, [], [5, 6, 7])
    (case,) = answer['explain']
    folder = tmp_path / 'explain' / 'seed_5'
    assert (case['seed'], case['is_found']) == (5, True)
    assert case['found']['gap']['after'] < case['found']['gap']['before']
    assert case['hidden'] in err
    assert {path.name for path in folder.iterdir()} == {'bag', 'report.html', 'report.json', 'train.yaml'}
    assert case['hidden'] in (folder / 'report.html').read_text(encoding='utf-8')


@pytest.mark.usefixtures('_nothing_runs')
def test_without_the_source_tree_the_demo_says_what_to_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(relative: str) -> Path:
        if relative.startswith('bags/'):
            raise InputError(f'{relative}: not found')
        return shared_path(relative)

    monkeypatch.setattr(demo, 'shared_path', missing)
    assert main(['demo', '--out', str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'trainid demo SOURCE/bags/altrios_manifest, or run trainid demo --only explain' in line
    with pytest.raises(pytest.fail.Exception, match='a chapter ran'):
        main(['demo', '--only', 'explain', '--out', str(tmp_path)])

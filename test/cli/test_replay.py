# SPDX-License-Identifier: Apache-2.0
"""``trainid replay``: one JSON object of the agreed shape, exit codes, one-line errors, files written once."""

from __future__ import annotations

import csv
import io
import json
import math
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from pyarrow import parquet

from test.own_bag import messages_of
from trainid_ros import __version__
from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.main import main
from trainid_ros.inputs.times import date_time
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    SpeedRecord,
    stamp_of,
)
from trainid_ros.interface.results import Status
from trainid_ros.setup.checkpoint import Checkpoint, Provenance
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.stream.sample_stream import Contradiction
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from test.cli.conftest import Change

FINDING = ('input_finding', 'input_finding_begin_s', 'input_finding_end_s')
START_NS = 1_700_000_000 * NS_PER_S


def call(bag: Path, *options: str, train: Path | None = None) -> int:
    return main(['replay', str(bag), '--train', str(train or bag / 'train.yaml'), *options])


class Printed(NamedTuple):
    """What a replay prints, with ``--json`` and without."""

    out: str
    err: str
    text: str


@pytest.fixture(scope='module')
def printed(driven_bag: Path) -> Printed:
    out, err, text = io.StringIO(), io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        assert call(driven_bag, '--json') == 0
    with redirect_stdout(text), redirect_stderr(io.StringIO()):
        assert call(driven_bag) == 0
    return Printed(out.getvalue(), err.getvalue(), text.getvalue())


@pytest.fixture
def standing_bag(tmp_path: Path, driven_bag: Path) -> Path:
    path = tmp_path / 'standing'
    with BagWriter(path) as writer:
        for i in range(50):
            stamp = START_NS + i * NS_PER_S // 5
            for record in (
                SpeedRecord(stamp, 0.0, 100.0),
                ForceRecord(stamp, 0.0),
                GradientRecord(stamp, 0.0, 0.0, tunnel=False),
                BrakeRecord(stamp, -0.6, emergency=False),
            ):
                writer.write_record(record)
    (path / 'train.yaml').write_bytes((driven_bag / 'train.yaml').read_bytes())
    return path


def test_json_has_the_agreed_fields_and_nothing_else_is_printed(printed: Printed) -> None:
    answer = json.loads(printed.out)
    assert printed.out.count('\n') == 1
    assert printed.err == ''
    agreed = {'samples', 'duration_s', 'used', 'rejected', 'resistance', 'speed_model', 'brake_rate', 'wall_s'}
    more = {
        'adhesion',
        'algorithms',
        'verdict',
        'suggested_drive',
        'suggested_braking',
        'inputs',
        'holds_back',
        'wheel_ratio',
    }
    assert agreed | more | {*FINDING} == set(answer)
    assert (answer['inputs'], answer['holds_back']) == ([], [])
    assert [answer[key] for key in FINDING] == ['', None, None]
    assert answer['algorithms'] == {'resistance': 'filter-bank', 'speed_model': 'AM-VFF-RLS', 'brake_rate': 'GSMA'}
    known = {'a', 'b', 'c', 'std', 'status', 'speed_range', 'force_scale', 'force_delay', 'findings', 'why_converging'}
    assert known == set(answer['resistance'])
    assert {'a1', 'a2', 'b1', 'd0', 'status'} <= set(answer['speed_model'])
    assert {'value', 'std', 'status', 'findings'} <= set(answer['brake_rate'])
    assert answer['brake_rate']['findings'] == []
    assert len(answer['resistance']['std']) == 3
    assert answer['used'] + sum(answer['rejected'].values()) >= answer['samples'] > 300


def test_json_numbers_are_those_of_the_replay(driven_bag: Path, printed: Printed) -> None:
    answer = json.loads(printed.out)
    with BagReader(driven_bag) as reader:
        outcome = replay_through(Pipelines.of(load_train_file(driven_bag / 'train.yaml'), EstimatorSettings()), reader)
    w, f = outcome.resistance.output.estimate, outcome.brake_rate.output.estimate
    assert [answer['resistance'][name] for name in 'abc'] == [w.a, w.b, w.c]
    assert answer['resistance']['std'] == [math.sqrt(w.covariance[i]) for i in (0, 4, 8)]
    assert answer['resistance']['speed_range'] == [w.speed_min, w.speed_max]
    assert answer['resistance']['status'] == outcome.resistance.output.status.name
    assert (answer['brake_rate']['value'], answer['brake_rate']['std']) == (f.brake_rate, f.brake_rate_std)
    assert answer['rejected'] == {reason.name: count for reason, count in outcome.resistance.rejections}


def test_summary_shows_estimates_reasons_and_what_to_drive(printed: Printed) -> None:
    for wanted in (
        'x real time', 'brake rate', 'w at 15 m/s', 'N/kN', 'rejected: braking', 'used',
        'resistance by filter-bank: uncertainty', 'speeds seen', 'prior variance removed: a',
    ):  # fmt: skip
        assert wanted in printed.text
    answer = json.loads(printed.out)
    drive, fastest = answer['suggested_drive'], answer['resistance']['speed_range'][1]
    assert f'to learn more: {drive["text"]}' in printed.text
    least = drive['std'][drive['least_known']]
    assert least['then'] < least['now'] > least['wanted']
    assert drive['duration_s'] > 0.0 < drive['length_m']
    # Speeds outside those learned from are marked.
    lines = [line for line in printed.text.splitlines() if line.startswith('w at')]
    assert [('*' in line) for line in lines] == [speed > fastest for speed in (10.0, 15.0, 20.0)]


def test_parameters_of_the_nodes_hold(driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = tmp_path / 'params.yaml'
    params.write_text(
        '/**: {ros__parameters: {seed: 4}}\n'
        'resistance_estimator: {ros__parameters: {estimator: {min_speed: 49}}}\n'
        'brake_rate_estimator: {ros__parameters: {brake: {rate: 8e-1}, estimator: {min_speed: 49}}}\n',
        encoding='utf-8',
    )
    assert call(driven_bag, '--params', str(params), '--algorithm', 'GSMA', '--json') == 1
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert answer['used'] == 0
    assert answer['brake_rate']['value'] == pytest.approx(0.8, abs=1e-9)
    assert 'nothing was learned' in err


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        (('--algorithm', 'nonsense'), "algorithm 'nonsense' is unknown; there are resistance: filter-bank"),
        (('--algorithm', 'brake_rate=V-MILS'), "algorithm 'V-MILS' is unknown; there are brake_rate: GSMA"),
        (('--params', 'no/such.yaml'), 'no/such.yaml: cannot be read'),
    ],
)
def test_wrong_choices_are_named_in_one_line(
    driven_bag: Path, options: tuple[str, ...], reason: str, one_error: Callable[[], str]
) -> None:
    assert call(driven_bag, *options) == 2
    assert reason in one_error()


def test_out_is_a_bag_and_is_never_overwritten(
    driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], one_error: Callable[[], str]
) -> None:
    out = tmp_path / 'out'
    assert call(driven_bag, '--out', str(out)) == 0
    with BagReader(out) as reader:
        names = {topic.name for topic in reader.topics()}
    assert {'ato/speed', 'ato/mass', 'trainid/resistance', 'trainid/speed_model', 'trainid/brake_rate'} <= names
    before = sorted((item.name, item.stat().st_size) for item in out.iterdir())
    capsys.readouterr()
    assert call(driven_bag, '--out', str(out)) == 2
    assert one_error() == f'trainid: error: {out}: exists already and is not overwritten'
    assert sorted((item.name, item.stat().st_size) for item in out.iterdir()) == before


@pytest.mark.slow
def test_report_is_written_with_the_truth_of_the_bag(driven_bag: Path, tmp_path: Path) -> None:
    report = tmp_path / 'new' / 'report.html'
    assert call(driven_bag, '--report', str(report)) == 0
    assert 'error / std' in report.read_text(encoding='utf-8')


def test_a_contradiction_of_the_inputs_is_shown_with_its_times(
    driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(lambda item: replace(item, force=-item.force) if isinstance(item, ForceRecord) else item)
    call(path, '--json', train=driven_bag / 'train.yaml')
    answer = json.loads(capsys.readouterr().out)
    finding, begin_s, end_s = (answer[key] for key in FINDING)
    assert (finding, end_s) == ('ato/force has the wrong sign', None)
    assert 0.0 < begin_s < 40.0
    assert (answer['inputs'], answer['holds_back']) == (['ato/force'], ['resistance', 'speed_model', 'brake_rate'])
    call(path, train=driven_bag / 'train.yaml')
    first = capsys.readouterr().out.partition('\n')[0]
    assert first == answer['verdict']['text']
    assert first.startswith(f'Not usable: inputs contradict each other since {begin_s:.1f} s: {finding} (')
    past = Contradiction(finding, 12.34, 56.78)
    assert past.text == f'inputs contradicted each other from 12.3 to 56.8 s: {finding}'


def test_a_wrong_sign_of_the_brake_is_said(
    driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping, words = tmp_path / 'map.yaml', 'warning: ato/brake_command looks as if it had the wrong sign: all '
    for sign, is_said in ((-1, True), (1, False)):
        text = f'brake_command: {{topic: ato/brake_command, field: target_acceleration, sign: {sign}}}\n'
        mapping.write_text(text, encoding='utf-8')
        assert main(['replay', str(driven_bag), '--train', str(driven_bag / 'train.yaml'), '--map', str(mapping)]) == 0
        assert (words in capsys.readouterr().err) == is_said


def test_wrong_truth_is_reported_before_the_work(
    driven_bag: Path, tmp_path: Path, one_error: Callable[[], str]
) -> None:
    wrong = tmp_path / 'truth.yaml'
    wrong.write_text('start_ns: 0\n', encoding='utf-8')
    assert call(driven_bag, '--report', str(tmp_path / 'r.html'), '--truth', str(wrong)) == 2
    assert 'truth.yaml' in one_error()
    assert not (tmp_path / 'r.html').exists()


def test_standing_train_is_no_answer_and_says_why(standing_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(standing_bag, '--json') == 1
    out, err = capsys.readouterr()
    answer: dict[str, Any] = json.loads(out)
    assert (answer['used'], answer['resistance']['speed_range']) == (0, [None, None])
    assert err.count('\n') == 1
    assert all(wanted in err for wanted in ('nothing was learned', 'STANDSTILL'))


def test_what_is_missing_is_bad_input(driven_bag: Path, changed: Change, one_error: Callable[[], str]) -> None:
    blind, nothing = changed(lambda item: None if isinstance(item, GradientRecord) else item), driven_bag / 'nothing'
    assert call(blind, '--json', train=driven_bag / 'train.yaml') == 2
    assert 'changed: no messages on ato/gradient' in one_error()
    for bag, train in ((nothing, driven_bag / 'train.yaml'), (driven_bag, nothing)):
        assert call(bag, train=train) == 2
        assert str(nothing) in one_error()


def test_failed_replay_leaves_no_bag_behind(
    driven_bag: Path, tmp_path: Path, standing_bag: Path, changed: Change
) -> None:
    # No answer is an answer about the data: the bag is complete and stays.
    assert call(standing_bag, '--out', str(tmp_path / 'kept')) == 1
    assert (tmp_path / 'kept' / 'metadata.yaml').is_file()
    blind = changed(lambda item: None if isinstance(item, ForceRecord) else item)
    assert call(blind, '--out', str(tmp_path / 'gone'), train=driven_bag / 'train.yaml') == 2
    assert not (tmp_path / 'gone').exists()


def test_two_outputs_are_not_one_file(tmp_path: Path, driven_bag: Path, one_error: Callable[[], str]) -> None:
    report, link = tmp_path / 'report.html', tmp_path / 'link.html'
    link.symlink_to(report)
    for out in (report, tmp_path / 'folder' / '..' / 'report.html', link):
        assert call(driven_bag, '--out', str(out), '--report', str(report)) == 2
        assert f'{report}: is given for two outputs' in one_error()


def test_a_report_overwrites_no_input(tmp_path: Path, driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = tmp_path / 'T.yaml'
    train.write_bytes((driven_bag / 'train.yaml').read_bytes())
    notes = tmp_path / 'notes.html'
    notes.write_text('mine', encoding='utf-8')
    for report, reason in (
        (train, 'is an input and would be overwritten'),
        (notes, 'exists and was not written by trainid'),
        (driven_bag / 'metadata.yaml', 'exists and was not written by trainid'),
        (driven_bag, 'is an input and would be overwritten'),
    ):
        assert call(driven_bag, '--report', str(report), train=train) == 2
        error = capsys.readouterr().err
        assert error == f'trainid: error: {report}: {reason}; choose another name for the output\n'
    assert train.read_bytes() == (driven_bag / 'train.yaml').read_bytes()
    assert notes.read_text(encoding='utf-8') == 'mine'


def test_damage_is_said_and_the_rest_used(tmp_path: Path, driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / 'damaged'
    with BagReader(driven_bag) as reader, BagWriter(bag) as writer:
        for record, (log_ns, _) in zip(reader.records(), reader.rows(), strict=True):
            writer.write_record(record, log_ns)
            if log_ns % NS_PER_S == 0:
                writer._writer.storage.close_chunk()  # type: ignore[union-attr]
    path = bag / 'damaged.mcap'
    content = bytearray(path.read_bytes())
    zstd = content.index(b'\x28\xb5\x2f\xfd', len(content) // 3)
    content[zstd + 20] ^= 1
    path.write_bytes(content)
    assert call(bag, '--json', train=driven_bag / 'train.yaml') == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)['samples'] > 300
    lines = captured.err.splitlines()
    assert lines[0].startswith(f'trainid: warning: {path}: ')
    assert 'are lost: ' in lines[0]
    assert ' messages found' in lines[1]


@pytest.mark.parametrize(('share', 'warned'), [(0.002, True), (0.05, False)])
def test_a_mass_that_nobody_weighed_is_not_known_as_well(
    standing_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], share: float, warned: bool
) -> None:
    file, train = load_train_file(standing_bag / 'train.yaml'), tmp_path / 'train.yaml'
    train.write_text(dump_train_file(replace(file, train=replace(file.train, mass_std=share))), encoding='utf-8')
    call(standing_bag, train=train)
    assert ('ato/mass: no messages, so train.mass_std = 0.002' in capsys.readouterr().err) is warned


@pytest.fixture(scope='module')
def outputs(driven_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('outputs')
    for name in ('bag', 'e.parquet', 'e.csv'):
        assert call(driven_bag, '--out', str(folder / name)) == 0
    return folder


@pytest.fixture(scope='module')
def expected(outputs: Path) -> dict[int, Any]:
    """Return the resistances of the bag by stamp."""
    return {stamp_of(message): message for message in messages_of(outputs / 'bag', 'trainid/resistance')}


def test_parquet_holds_the_estimates_with_units_and_covariance(outputs: Path, expected: dict[int, Any]) -> None:
    table = parquet.read_table(outputs / 'e.parquet')
    assert table.schema.field('resistance_b').metadata == {b'unit': b'N/kN per m/s'}
    columns = ('resistance_a', 'resistance_covariance', 'resistance_status', 'resistance_used')
    rows = zip(table['time'].cast('int64').to_pylist(), *(table[name].to_pylist() for name in columns), strict=True)
    assert list(rows) == [
        (stamp_ns, message.a, message.covariance.tolist(), Status(message.status).name, message.used)
        for stamp_ns, message in expected.items()
    ]
    assert sum(column.null_count for column in table.columns) == 0


def test_csv_holds_the_estimates_with_units_in_its_header(outputs: Path, expected: dict[int, Any]) -> None:
    with (outputs / 'e.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    assert [stamp.ns for row in rows if (stamp := date_time(row['time']))] == list(expected)
    for row, message in zip(rows, expected.values(), strict=True):
        assert float(row['resistance_a [N/kN]']) == message.a
        assert float(row['resistance_a_std [N/kN]']) ** 2 == pytest.approx(message.covariance[0])
        assert row['resistance_status'] == Status(message.status).name


def test_a_checkpoint_must_be_there_and_fit(
    driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'resistance_estimator.json'
    other = Checkpoint(Provenance(__version__, 'resistance', 'V-MILS', {}), 0, 0, '{}')
    for text, problem in (('', 'there is no checkpoint such as'), (other.text(), 'is of V-MILS, not of filter-bank')):
        if text:
            path.write_text(text, encoding='utf-8')
        train = str(driven_bag / 'train.yaml')
        assert main(['replay', *[str(driven_bag)] * 2, '--train', train, '--checkpoint', str(tmp_path)]) == 2
        assert capsys.readouterr().err.count(problem) == 1

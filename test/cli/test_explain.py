# SPDX-License-Identifier: Apache-2.0
"""``trainid explain``: the agreed JSON, its three files, exit codes, and one-line errors; with --watch only news."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test.cli.conftest import Change
from trainid_ros import __version__
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.run_reader import read_runs
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli import explain
from trainid_ros.cli.explain import describe, explain_runs, news, prepare_folder, provenance, to_json
from trainid_ros.cli.main import main
from trainid_ros.explain.dataset import Run
from trainid_ros.explain.model import Model
from trainid_ros.explain.nuisances import DAVIS
from trainid_ros.explain.result import Explanation, Gap, Learned, Verdict
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import BrakeRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile, dump_train_file, load_train_file

Make = Callable[..., Explanation]
BAGS = Path(__file__).parents[2] / 'bags'
ALTRIOS = BAGS / 'altrios_manifest'  # a freight run of another simulator
KEYS = {'verdict', 'effects', 'gap', 'remaining', 'error', 'gradient_read_at', 'probabilities', 'learned', 'davis'}
EFFECT_KEYS = {'name', 'parameters', 'std', 'evidence', 'probability', 'where', 'indistinguishable_from'}
GAP_KEYS = {'metric', 'unit', 'before', 'after', 'noise_floor', 'runs_held_out', 'fitted', 'evidence'}
DRAG = 'local_drag:start=900,end=1900,permille=2.5'


def call(*bags: Path, train: Path, options: tuple[str, ...] = ()) -> int:
    return main(['explain', *map(str, bags), '--train', str(train), *options])


def test_json_has_the_agreed_fields(make_explanation: Make) -> None:
    explanation = make_explanation(ambiguous=True)
    answer = to_json(explanation)
    assert set(answer) == KEYS
    assert answer['verdict'] == 'ambiguous'
    (effect,) = answer['effects']
    assert set(effect) == EFFECT_KEYS
    assert effect['parameters'] == {'start': 300.0, 'end': 500.0, 'permille': 1.5}
    assert effect['std'] == {'start': 12.0, 'end': 9.0, 'permille': 0.05}
    assert effect['indistinguishable_from'] == ['gradient_error']
    of_two_runs = replace(explanation, effects=(replace(explanation.effects[0], runs=(2, 5)),))
    assert to_json(of_two_runs)['effects'][0] == {**effect, 'runs': [2, 5]}
    expected = {'before': 0.4, 'after': 0.05, 'noise_floor': 0.049, 'runs_held_out': 2, 'evidence': 25.0}
    fitted = {'before': 0.3, 'after': 0.04}
    assert answer['gap'] == {'metric': 'rms speed', 'unit': 'm/s', 'fitted': fitted, **expected}
    assert answer['davis'] == {'a': 1.61, 'b': 0.02, 'c': 0.0011, 'std': [0.12, 0.004, 0.0001], 'distance': 5.2}
    assert answer['error'] is None
    json.dumps(answer, allow_nan=False)


def test_verdicts_have_the_agreed_names_and_unknown_values_are_null(make_explanation: Make) -> None:
    verdicts = {to_json(make_explanation(verdict=verdict))['verdict'] for verdict in Verdict}
    assert verdicts == {'explained', 'no_gap', 'unexplained', 'ambiguous'}
    gap = to_json(make_explanation(gap=None))['gap']
    fitted = {'before': None, 'after': None}
    known = {'metric': 'rms speed', 'unit': 'm/s', 'runs_held_out': 0, 'fitted': fitted}
    assert gap == dict.fromkeys(GAP_KEYS) | known
    assert to_json(make_explanation(gap=Gap(float('nan'), 0.1, 0.1, 3, 0.1, 0.1, 0.0)))['gap']['before'] is None
    nothing = to_json(None, 'too little')
    assert set(nothing) == KEYS
    assert (nothing['verdict'], nothing['effects'], nothing['error']) == (None, [], 'too little')


def test_text_shows_effects_evidence_and_gap(make_explanation: Make, stated: TrainFile) -> None:
    text = describe(make_explanation(ambiguous=True), stated)
    for part in (
        'AMBIGUOUS: ', 'local_drag: drag at one place (physics)', 'permille = 1.500 ± 0.050 per mille', 'evidence 48',
        'where: position 300', 'could also be gradient_error; to distinguish: run <both> ways', '0.400 m/s',
        '0.049 m/s', '1.61 ± 0.12', 'What is left is noise.',
        'Next: The data should also contain 6 runs or more.',
    ):  # fmt: skip
        assert part in text
    bare = describe(make_explanation(verdict=Verdict.UNEXPLAINED, effects=()), stated)
    assert 'At 300 to 400 m: 1.50 ± 0.10 N/kN more resistance than modelled' in bare


def test_what_was_learned_is_in_json_text_and_folder(
    make_explanation: Make, make_learned: Callable[..., Learned], stated: TrainFile, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr('trainid_ros.report.explained.render_explained', lambda *_: '')
    learned = make_learned(twins=('the time',))
    found = make_explanation(verdict=Verdict.UNEXPLAINED, effects=(), remaining=learned.sentence, learned=learned)
    answer = to_json(found)['learned']
    assert answer == {
        'depends_on': 'brake-speed', 'text': 'the speed while braking', 'or': ['the time'], 'evidence': 90.0,
        'curve': {
            'x_unit': 'm/s', 'share_of': 'the brake force', 'x': [0.0, 5.0, 10.0, 15.0, 20.0],
            'value': pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2]), 'std': [0.002] * 5,
        },
        'function': '0.01 * x', 'effect': 'learned_brake_speed',
        'gap': {'before': 0.4, 'after': 0.05, 'noise_floor': 0.049, 'evidence': 25.0},
    }  # fmt: skip
    text = describe(found, stated)
    assert 'depends on the speed while braking or the time, and no effect of the library fits it: 0.01 * x of' in text
    assert 'With it as the effect learned_brake_speed the gap falls from 0.400 to 0.050 m/s' in text
    explain.write_all(tmp_path, found, stated, 'train.yaml', (), ())
    assert {path.name for path in (tmp_path / 'learned').iterdir()} == {'learned_brake_speed.py', 'train.yaml'}
    # A later explanation of the same folder that confirms nothing leaves nothing of it.
    rest = make_learned(is_confirmed=False, function='', effect='', source='', train_file=None)
    later = replace(found, learned=rest)
    assert to_json(later)['learned'].items() > {'function': None, 'effect': None}.items()
    assert 'That is not confirmed' in describe(later, stated)
    explain.write_all(tmp_path, later, stated, 'train.yaml', (), ())
    assert list((tmp_path / 'learned').iterdir()) == []


def test_provenance_names_version_bags_and_runs() -> None:
    day = f'trainid explain {__version__}, day1'
    assert provenance([Path('x/day1'), Path('day2.mcap')], 9) == f'{day}, day2.mcap, 9 runs'
    assert provenance([Path(f'd{k}') for k in range(5)], 9).endswith('d0, d1, d2 and 2 more, 9 runs')
    assert provenance([Path('day1')], 1).endswith('day1, 1 run')


def test_the_folder_is_created_and_no_train_file_is_overwritten(tmp_path: Path) -> None:
    train = tmp_path / 'train.yaml'
    train.write_text('x', encoding='utf-8')
    prepare_folder(tmp_path / 'a' / 'b', train)
    assert list((tmp_path / 'a' / 'b').iterdir()) == []
    (tmp_path / 'link').symlink_to(tmp_path)
    for folder in (tmp_path, tmp_path / 'link'):
        with pytest.raises(InputError, match='is the input train file'):
            prepare_folder(folder, train)
    with pytest.raises(InputError, match='not written by trainid explain'):
        prepare_folder(tmp_path, Path(__file__))
    (tmp_path / 'report.json').write_text('{}', encoding='utf-8')
    with pytest.raises(InputError, match=r'report\.json: exists and was not written by trainid'):
        prepare_folder(tmp_path, Path(__file__))
    (tmp_path / 'report.json').write_text('{\n  "verdict": null', encoding='utf-8')
    prepare_folder(tmp_path, Path(__file__))  # of an earlier explanation
    with pytest.raises(InputError, match=r'train\.yaml: cannot be written'):
        prepare_folder(train, train)


def test_bad_input_is_reported_before_the_work(
    tmp_path: Path, driven_bag: Path, changed: Change, one_error: Callable[[], str]
) -> None:
    train = driven_bag / 'train.yaml'
    blind = changed(lambda record: None if isinstance(record, GradientRecord) else record)
    for bags, stated, options, reason in (
        ([driven_bag], tmp_path / 'none.yaml', (), 'none.yaml'),
        ([tmp_path / 'nobag'], train, (), 'nobag'),
        ([driven_bag, driven_bag], train, (), 'given twice'),
        ([driven_bag], train, ('--out', str(driven_bag)), 'is the input train file'),
        ([driven_bag], train, ('--namespace', '/other'), 'ato/speed'),
        ([driven_bag, blind], train, (), 'changed: no messages on ato/gradient'),
    ):
        assert call(*bags, train=stated, options=options) == 2
        assert reason in one_error()


def test_without_runs_there_is_no_answer(tmp_path: Path, driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagReader(driven_bag) as reader, BagWriter(tmp_path / 'short') as writer:
        for record, _ in zip(reader.records(), range(120), strict=False):
            writer.write_record(record)
    assert call(tmp_path / 'short', train=driven_bag / 'train.yaml', options=('--json',)) == 1
    out, err = capsys.readouterr()
    assert json.loads(out)['verdict'] is None
    assert ('short: ' in err, err.count('\n')) == (True, 1)


@pytest.mark.parametrize(
    ('kind', 'field', 'factor', 'said'),
    [
        (SpeedRecord, 'speed', 3.6, 'ato/speed is in km/h'),
        (BrakeRecord, 'target_acceleration', -1.0, 'ato/brake_command has the wrong sign'),
    ],
)
def test_inputs_that_contradict_each_other_are_the_answer(
    tmp_path: Path, driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str], kind: type[Record],
    field: str, factor: float, said: str,
) -> None:  # fmt: skip
    wrong = changed(lambda r: replace(r, **{field: factor * getattr(r, field)}) if isinstance(r, kind) else r)
    options = ('--json', '--out', str(tmp_path / 'out'))
    assert call(driven_bag, wrong, train=driven_bag / 'train.yaml', options=options) == 1
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert set(answer) == KEYS
    assert (answer['verdict'], answer['effects'], answer['gap']['before']) == (None, [], None)
    assert answer['error'].startswith(f'{wrong}: inputs contradict each other')
    assert said in answer['error']
    assert err == f'trainid: error: {answer["error"]}\n'
    assert not (tmp_path / 'out').exists()


Stub = Callable[[Callable[[], Explanation]], None]


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    """Return a function that replaces the result of the workflow; no figures are drawn."""

    def put(answer: Callable[[], Explanation]) -> None:
        monkeypatch.setattr(explain, 'explain_runs', lambda *_: answer())
        monkeypatch.setattr('trainid_ros.report.explained.render_explained', lambda *_: '')

    return put


def test_outputs_are_written_before_a_closed_pipe_stops_printing(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, stub: Stub, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: Any) -> str:
        raise BrokenPipeError

    stub(make_explanation)
    monkeypatch.setattr(explain, 'describe', stop)
    monkeypatch.setattr('trainid_ros.cli.main._drop_output', lambda: None)
    assert call(driven_bag, train=driven_bag / 'train.yaml', options=('--out', str(tmp_path / 'a'))) == 141
    assert {path.name for path in (tmp_path / 'a').iterdir()} == {'report.html', 'report.json', 'train.yaml'}


def test_a_proposal_is_written_beside_the_train_file_if_that_is_new(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, stub: Stub, capsys: pytest.CaptureFixture[str],
    one_error: Callable[[], str],
) -> None:  # fmt: skip
    train, options = driven_bag / 'train.yaml', ('--propose', str(tmp_path))
    stub(make_explanation)
    assert call(driven_bag, train=train, options=options) == 0
    written = {'migration.md', 'test_train.py', 'report.html', 'report.json', 'train.yaml'}
    assert {path.name for path in tmp_path.iterdir()} == written
    assert 'proposal: ' in capsys.readouterr().out
    stub(partial(make_explanation, effects=(), train_file=load_train_file(train)))
    assert call(driven_bag, train=train, options=options) == 0
    assert {path.name for path in tmp_path.iterdir()} == written - {'migration.md', 'test_train.py'}
    assert 'no proposal: the train file stays as it is' in capsys.readouterr().out
    (tmp_path / 'migration.md').write_text('my own', encoding='utf-8')
    assert call(driven_bag, train=train, options=options) == 2
    assert 'migration.md: exists and was not written by trainid' in one_error()


@pytest.mark.parametrize(('error', 'code'), [(KeyboardInterrupt, 130), (NoAnswerError, 1)])
def test_folders_created_for_a_failed_run_are_removed(
    tmp_path: Path, driven_bag: Path, stub: Stub, error: type[BaseException], code: int
) -> None:
    def fail() -> Explanation:
        raise error

    stub(fail)
    (tmp_path / 'old' / 'empty').mkdir(parents=True)
    for out in ('new', 'old/new/new', 'old/empty'):
        assert call(driven_bag, train=driven_bag / 'train.yaml', options=('--out', str(tmp_path / out))) == code
    assert [path.name for path in sorted(tmp_path.rglob('*'))] == ['old', 'empty']


def test_gradients_of_one_point_are_reported_in_json_and_as_a_warning(
    driven_bag: Path, make_explanation: Make, stub: Stub, capsys: pytest.CaptureFixture[str]
) -> None:
    for point, warnings in (('middle', 1), (None, 0)):
        stub(partial(make_explanation, gradient_point=point))
        assert call(driven_bag, train=driven_bag / 'train.yaml', options=('--json',)) == 0
        out, err = capsys.readouterr()
        assert json.loads(out)['gradient_read_at'] == point
        assert err.count('warning: the gradients in the bags are those at the middle') == warnings


def test_warnings_of_the_bags_stand_in_the_report(
    driven_bag: Path, tmp_path: Path, make_explanation: Make, stub: Stub, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    line = f'{driven_bag}: inputs contradict each other'
    monkeypatch.setattr(explain, 'read_runs', lambda *_, warn, **__: warn(line))
    stub(make_explanation)
    monkeypatch.setattr('trainid_ros.report.explained.render_explained', lambda *content: repr(content[-1]))
    assert call(driven_bag, train=driven_bag / 'train.yaml', options=('--out', str(tmp_path / 'out'))) == 0
    assert (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8') == repr((f'Warning: {line}',))
    assert capsys.readouterr().err == f'trainid: warning: {line}\n'


def test_a_fault_that_leaves_no_motion_is_part_of_the_answer(
    driven_bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = f'{driven_bag}: ato/brake_command is stuck'

    def read(*_: object, warn: Callable[[str], None], **__: object) -> list[Run]:
        warn(line)
        return []

    monkeypatch.setattr(explain, 'read_runs', read)
    assert call(driven_bag, train=driven_bag / 'train.yaml', options=('--json',)) == 1
    error = json.loads(capsys.readouterr().out)['error']
    assert error.endswith(f'too little motion to compare; {line}')


@pytest.mark.slow
def test_a_ride_that_has_nothing_to_do_with_the_train_is_not_explained(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # The first eight minutes of it; all 42 runs take ten times as long to explain.
    monkeypatch.setattr(explain, 'read_runs', lambda *given, **options: read_runs(*given, **options)[:2])
    assert call(BAGS / 'ride', train=BAGS / 'tiny' / 'train.yaml', options=('--json',)) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)['verdict'] == 'unexplained'
    assert 'inputs contradict each other' in err


@pytest.fixture(scope='module')
def dragged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a bag of four runs there and back with a drag at one place, and the train file without."""
    folder = tmp_path_factory.mktemp('dragged')
    gradient = ((0.0, 0.0), (400.0, 8.0), (900.0, -6.0), (1500.0, 4.0), (2100.0, 0.0))
    train = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.004), line=Line((0.0, 2600.0), gradient))
    (folder / 't.yaml').write_text(dump_train_file(train), encoding='utf-8')
    true = replace(train, resistance=Davis(1.7, 0.02, 0.0035), effects=parse_effects([DRAG]))
    with BagWriter(folder / 'bag') as writer:
        for record in simulate(Scenario(true, runs=4), np.random.default_rng(8)).records:
            writer.write_record(record)
    return folder


@pytest.mark.slow
def test_a_hidden_drag_is_found_and_added(dragged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = dragged / 'out'
    before = (dragged / 't.yaml').read_text(encoding='utf-8')
    assert call(dragged / 'bag', train=dragged / 't.yaml', options=('--out', str(out), '--json')) == 0
    text, err = capsys.readouterr()
    assert (text.count('\n'), err) == (1, '')
    answer: dict[str, Any] = json.loads(text)
    assert set(answer) == KEYS
    assert set(answer['gap']) == GAP_KEYS
    effect = answer['effects'][0]
    assert set(effect) == EFFECT_KEYS
    assert effect['name'] == 'local_drag'
    assert sum(answer['probabilities'].values()) == pytest.approx(1.0)
    assert answer['probabilities']['local_drag'] == pytest.approx(effect['probability'], abs=0.05)
    assert effect['probability'] > 0.85
    assert effect['parameters']['permille'] == pytest.approx(2.5, abs=max(0.5, 4.0 * effect['std']['permille']))
    assert answer['gap']['after'] < 0.6 * answer['gap']['before']
    assert json.loads((out / 'report.json').read_text(encoding='utf-8')) == answer
    assert (out / 'report.html').read_text(encoding='utf-8').count('<svg') == 5
    found = load_train_file(out / 'train.yaml').effects[0]
    assert dict(found.parameters) == effect['parameters']
    assert found.provenance == f'trainid explain {__version__}, bag, 4 runs'
    assert (dragged / 't.yaml').read_text(encoding='utf-8') == before
    # The train file that was written can be used like any other, and leaves no gap.
    assert call(dragged / 'bag', train=out / 'train.yaml', options=('--json',)) == 0
    assert json.loads(capsys.readouterr().out)['verdict'] == 'no_gap'


def test_two_bags_are_explained_together(driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(driven_bag, tmp_path / 'copy')
    assert call(driven_bag, tmp_path / 'copy', train=driven_bag / 'train.yaml') == 0
    assert '2 runs in 2 bags' in capsys.readouterr().out


def explained(stated: TrainFile, every: int = 1) -> Explanation:
    return explain_runs(read_runs([ALTRIOS], stated)[::every], stated, [ALTRIOS])


def resistance_std(stated: TrainFile, speeds: tuple[float, ...]) -> list[float]:
    """Return standard deviations of the refitted w(v), including the correlations of a, b and c."""
    model = Model.of(read_runs([ALTRIOS], stated), stated)
    sizes, _ = model.evidence().maximise()
    _, covariance = model.posterior(sizes)
    powers = np.power.outer(np.array(speeds), np.arange(3.0))
    stds: list[float] = np.sqrt(np.diag(powers @ covariance[DAVIS, DAVIS] @ powers.T)).tolist()
    return stds


@pytest.mark.slow
def test_a_missing_curve_resistance_is_found() -> None:
    full = load_train_file(ALTRIOS / 'train.yaml')
    ((_, truth),) = full.effects[0].parameters
    found = explained(replace(full, effects=()), every=3)
    assert found.verdict is Verdict.EXPLAINED
    (effect,) = found.effects
    assert effect.name == 'curve_resistance'
    (_, coefficient), (_, std) = *effect.parameters, *effect.std
    assert abs(coefficient - truth) < 2.0 * std < 0.1 * truth
    assert found.gap is not None
    assert found.gap.before > 3.0 * found.gap.noise_floor
    assert found.gap.after <= 1.1 * found.gap.noise_floor


@pytest.mark.long
def test_a_missing_linear_term_is_absorbed_by_the_refitted_resistance() -> None:
    full = load_train_file(ALTRIOS / 'train.yaml')
    stated = replace(full, resistance=replace(full.resistance, b=0.0))
    truth = load_truth(ALTRIOS / 'truth.yaml').truth_at(0.0).resistance
    found = explained(stated)
    # a, b and c are always fitted along, so none of them can be missing.
    assert found.verdict is Verdict.NO_GAP
    assert found.effects == ()
    speeds = (7.0, 20.0)  # where the train drove; b alone cannot be determined from that
    stds = resistance_std(stated, speeds)
    for speed, std in zip(speeds, stds, strict=True):
        assert abs(davis(found.train_file.resistance, speed) - davis(truth, speed)) < 2.0 * std < 0.1
    assert abs(davis(stated.resistance, speeds[0]) - davis(truth, speeds[0])) > 5.0 * stds[0]


def moved(found: Explanation, by: float) -> Explanation:
    """Return an explanation whose first effect has another size."""
    effect = found.effects[0]
    values = dict(effect.parameters)
    return replace(found, effects=(replace(effect, parameters=tuple({**values, 'permille': 1.5 + by}.items())),))


def test_only_what_differs_is_news(make_explanation: Make) -> None:
    found, nothing = make_explanation(), make_explanation(verdict=Verdict.NO_GAP, effects=())
    assert news(None, found)[0].startswith('EXPLAINED: The current model lacks local_drag')
    assert news(found, found) == []
    assert [line[:30] for line in news(found, nothing)] == ['NO_GAP: The data do not tell w']
    assert news(found, moved(found, 0.14)) == []  # its standard deviation is 0.05, that of the difference 0.071
    (line,) = news(found, moved(found, 0.15))
    assert 'local_drag is now start' in line
    assert 'permille = 1.650' in line
    other = replace(found, effects=(replace(found.effects[0], name='headwind', parameters=(), std=()),))
    assert news(found, other) == ['local_drag is no longer found.', 'New: headwind, .']


def drive(
    monkeypatch: pytest.MonkeyPatch, looks: Iterable[Callable[[], object]], answers: Iterable[object]
) -> list[list[str]]:
    """Let each look at the folders be preceded by an action; return the names of the bags explained each time."""
    actions, left, explained = iter(looks), iter(answers), list[list[str]]()

    def sleep(_: float) -> None:
        if (action := next(actions, None)) is None:
            raise KeyboardInterrupt
        action()

    def answer(_args: object, bags: Sequence[Path], *_: object) -> object:
        explained.append([bag.name for bag in bags])
        found = next(left)
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr('trainid_ros.cli.explain.time.sleep', sleep)
    monkeypatch.setattr(explain, 'explain_bags', answer)
    return explained


def test_complete_bags_are_explained_and_news_told(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    folder = tmp_path / 'bags'
    folder.mkdir()

    def add(name: str) -> None:
        shutil.copytree(driven_bag, folder / name)

    def grow() -> None:
        with (folder / 'b' / 'more.mcap').open('ab') as file:
            file.write(b'x')

    looks = (
        lambda: add('a'), lambda: None, lambda: add('b'), grow, grow, lambda: None, lambda: None, lambda: add('c'),
        lambda: None,
    )  # fmt: skip
    (folder / 'gone.mcap').symlink_to(tmp_path / 'nowhere')
    found = make_explanation()
    explained = drive(monkeypatch, looks, (found, NoAnswerError('b: damaged'), moved(found, 0.5)))
    command = ['explain', str(folder), '--train', str(driven_bag / 'train.yaml'), '--watch', '--json']
    assert main(command) == 130
    assert explained == [['a'], ['a', 'b'], ['a', 'b', 'c']]  # b not before it has ceased to grow
    out, err = capsys.readouterr()
    first, second = map(json.loads, out.splitlines())
    assert first['verdict'] == 'explained'
    assert [Path(bag).name for bag in second['bags']] == ['a', 'b', 'c']
    assert second['news'][0].startswith('local_drag is now')
    assert err == 'trainid: error: b: damaged\n'


def test_what_cannot_be_watched_is_an_error(tmp_path: Path, driven_bag: Path, one_error: Callable[[], str]) -> None:
    train = str(driven_bag / 'train.yaml')
    for bag, options, reason in (
        (tmp_path / 'none', (), 'is no folder to watch'),
        (tmp_path, ('--out', 'x'), '--watch writes no files'),
        (tmp_path, ('--propose', 'x'), '--watch writes no files'),
    ):
        assert main(['explain', str(bag), '--train', train, '--watch', *options]) == 2
        assert reason in one_error()


def test_a_damaged_bag_is_left_out_with_a_warning(
    tmp_path: Path, driven_bag: Path, make_explanation: Make, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / 'a.mcap').write_bytes(b'no bag at all')
    shutil.copytree(driven_bag, tmp_path / 'b')
    explained = drive(monkeypatch, [lambda: None], [make_explanation()])
    assert main(['explain', str(tmp_path), '--train', str(driven_bag / 'train.yaml'), '--watch']) == 130
    assert explained == [['b']]
    out, err = capsys.readouterr()
    assert out.startswith('1 bag: EXPLAINED')
    assert 'a.mcap' in err
    assert err.count('\n') == 1

# SPDX-License-Identifier: Apache-2.0
"""``trainid explain``: find where model and data disagree and which effect is missing, and add it to the model.

With ``--watch`` it explains the bags of folders again whenever one is added, and tells only what is new.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final, NoReturn

from trainid_ros import __version__
from trainid_ros.bag.bag_files import bags_below
from trainid_ros.bag.run_reader import read_runs, survey, worker_count
from trainid_ros.cli.output import check_output, print_json, progress, show, table, to_plain, warn
from trainid_ros.explain.dataset import Run
from trainid_ros.explain.result import Explanation, Learned
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.files import write_text
from trainid_ros.interface.text import listed, pluralise, printable
from trainid_ros.report import HTML_START
from trainid_ros.train.train_file import TrainFile, dump_train_file, load_train_file

REPORT_JSON: Final = 'report.json'
REPORT_HTML: Final = 'report.html'
TRAIN_FILE: Final = 'train.yaml'
LEARNED: Final = 'learned'
NOTE: Final = 'migration.md'
NOTE_START: Final = '# Change of the train file'
TEST: Final = 'test_train.py'
TEST_START: Final = '"""The train file beside this test'
_NAMED_BAGS: Final = 3


def run(args: argparse.Namespace) -> int:
    """Explain the gap between bags and train file; NoAnswerError with too little motion, or wrong units or signs."""
    train_file = load_train_file(args.train)
    if args.watch:
        _watch(args, train_file)
    notes: list[str] = []
    args.out = args.propose or args.out
    with _outputs(args.out, args.train):
        if args.propose is not None:
            prepare_proposal(args.propose)
        try:
            explanation = explain_bags(args, args.bags, train_file, notes)
        except NoAnswerError as error:
            if args.json:
                print_json(to_json(None, str(error)))
            raise
        if args.out is not None:
            # Written before printing, which a closed pipe may interrupt.
            warnings = tuple(f'Warning: {line}' for line in notes)
            write_all(args.out, explanation, train_file, str(args.train), args.bags, warnings)
            if args.propose is not None:
                propose(args, explanation, train_file)
    if (point := explanation.gradient_point) is not None:
        warn(
            f'the gradients in the bags are those at the {point} of the train and were used as such here, but '
            'simulator and live estimators expect the mean under the train: correct the publisher of the gradient'
        )
    if args.json:
        print_json(to_json(explanation))
        return 0
    show(describe(explanation, train_file))
    if args.out is not None:
        show(f'\nreport: {args.out / REPORT_HTML}\ntrain file: {args.out / TRAIN_FILE}')
        if args.propose is not None:
            is_new = (args.out / NOTE).exists()
            show(f'proposal: {args.out / NOTE} and {TEST}' if is_new else 'no proposal: the train file stays as it is')
        if explanation.learned and explanation.learned.effect:
            show(f'effect learned and train file with it: {args.out / LEARNED}')
    return 0


def explain_bags(
    args: argparse.Namespace, bags: Sequence[Path], train_file: TrainFile, notes: list[str]
) -> Explanation:
    """Read bags and explain them; each fault of theirs is printed and added to ``notes``."""

    def note(line: str) -> None:
        warn(line)
        notes.append(line)

    inputs = mapped_inputs(args.map, train_file)
    name = bags[0].name if len(bags) == 1 else f'{len(bags)} bags'
    with progress(f'open {name}', total=len(bags)) as advance:
        counts, warnings = survey(bags, args.namespace, args.max_chunk, inputs, advance)
    for line in warnings:
        note(line)
    with progress(f'read {name}', total=sum(counts)) as advance:
        workers = worker_count(counts)
        runs = read_runs(
            bags, train_file, args.namespace, args.max_chunk, inputs, workers=workers, advance=advance, warn=note
        )
    try:
        return explain_runs(runs, train_file, bags)
    except NoAnswerError as error:
        raise NoAnswerError('; '.join((f'{name}: {error}', *notes))) from None


@contextmanager
def _outputs(folder: Path | None, train: Path) -> Iterator[None]:
    """Prepare the output folder, if one is given; remove the folders created for it if the work fails."""
    made = [] if folder is None else [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        if folder is not None:
            prepare_folder(folder, train)
        yield
    except BaseException:
        with suppress(OSError):  # stops at the first that is not empty
            for path in made:
                path.rmdir()
        raise


def prepare_folder(folder: Path, train: Path) -> None:
    """Create the output folder; InputError if it cannot be written to, or more than earlier outputs would be lost."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.{REPORT_JSON}.part'
        probe.write_text('', encoding='utf-8')
        probe.unlink()
    except OSError as error:
        raise InputError(f'{folder}: cannot be written ({error.strerror})') from None
    check_output(folder / REPORT_HTML, (train,), HTML_START)
    check_output(folder / REPORT_JSON, (train,), '{\n  "verdict":')
    target = folder / TRAIN_FILE
    if target.exists() and target.samefile(train):
        raise InputError(f'{target}: is the input train file and would be overwritten; choose another --out')
    if target.exists() and not (folder / REPORT_JSON).exists():
        raise InputError(f'{target}: exists and was not written by trainid explain; choose another --out')


def explain_runs(runs: Sequence[Run], train_file: TrainFile, bags: Sequence[Path]) -> Explanation:
    """Run the workflow, showing its steps on a terminal; NoAnswerError if there is too little motion."""
    from trainid_ros.explain.workflow import explain  # noqa: PLC0415

    run = partial(explain, runs, train_file, provenance=provenance(bags, len(runs)))
    if not sys.stderr.isatty():
        return run()
    from rich.console import Console  # noqa: PLC0415

    with Console(stderr=True).status('explain') as status:
        return run(advance=lambda text: status.update(f'explain: {text}'))


def provenance(bags: Sequence[Path], runs: int) -> str:
    """Return the provenance of an added effect."""
    names = [printable(bag.resolve().name) for bag in bags]
    return f'trainid explain {__version__}, {listed(names, _NAMED_BAGS)}, {pluralise(runs, "run")}'


def to_json(explanation: Explanation | None, reason: str = '') -> dict[str, Any]:
    """Return the object of ``--json``; without an explanation, ``reason`` says why there is none."""
    e, gap = explanation, explanation and explanation.gap
    plain: dict[str, Any] = to_plain(
        {
            'verdict': e and e.verdict.value,
            'effects': [
                {
                    'name': effect.name,
                    'parameters': dict(effect.parameters),
                    'std': dict(effect.std),
                    'evidence': effect.evidence,
                    'probability': effect.probability,
                    'where': effect.where,
                    **({'runs': [*effect.runs]} if effect.runs else {}),
                    'indistinguishable_from': [twin.name for twin in effect.twins],
                }
                for effect in (e.effects if e else ())
            ],
            'probabilities': dict(e.probabilities if e else ()),
            'davis': e and {**asdict(e.davis), 'std': e.davis_std, 'distance': e.davis_distance},
            'gap': {
                'metric': 'rms speed',
                'unit': 'm/s',
                **{name: gap and getattr(gap, name) for name in ('before', 'after', 'noise_floor')},
                'runs_held_out': gap.runs_held_out if gap else 0,
                'fitted': {'before': gap and gap.fitted_before, 'after': gap and gap.fitted_after},
                'evidence': gap and gap.evidence,
            },
            'remaining': e.remaining if e else reason,
            'error': None if e else reason,
            'gradient_read_at': e and e.gradient_point,
            'learned': e and e.learned and _learned_json(e.learned),
        }
    )
    return plain


def _learned_json(learned: Learned) -> dict[str, Any]:
    gap = learned.gap
    return {
        'depends_on': learned.name,
        'text': learned.text,
        'or': learned.twins,
        'evidence': learned.evidence,
        'curve': {
            'x_unit': learned.unit,
            'share_of': learned.of or None,
            **{name: getattr(learned, name).tolist() for name in ('x', 'value', 'std')},
        },
        'function': learned.function or None,
        'effect': learned.effect or None,
        'gap': gap and {name: getattr(gap, name) for name in ('before', 'after', 'noise_floor', 'evidence')},
    }


def describe(explanation: Explanation, prior: TrainFile) -> str:
    """Return the findings as text; ``prior`` is the train file that was explained."""
    from trainid_ros.report import words  # noqa: PLC0415

    head = f'{explanation.verdict.value.upper()}: {words.headline(explanation)}\n{words.drive_text(explanation)}'
    effects = [
        (
            f'{effect.name}: {effect.title} ({"sensor" if effect.origin == "sensor" else "physics"})',
            effect.equation,
            words.parameters_text(effect),
            words.how_sure(effect),
            f'where: {effect.where}',
            *(
                f'could also be {twin.name}; to distinguish: {twin.drive or "no drive is known"}'
                for twin in effect.twins
            ),
        )
        for effect in explanation.effects
    ]
    # Where the gap is if no effect explains it.
    parts = [] if effects else words.strongest(explanation)
    davis = [('value', 'train file', 'estimate ± std', 'unit'), *words.davis_rows(explanation, prior)]
    blocks = (
        head,
        *('\n  '.join(lines) for lines in effects),
        *filter(None, ['\n'.join(parts)]),
        f'Probability by cause, all causes together 100%: {words.causes_text(explanation)}.',
        words.gap_sentence(explanation),
        table(davis, numbers=(1,)),
        ' '.join(filter(None, (explanation.remaining, words.learned_sentence(explanation.learned)))),
        '\n'.join(f'Next: {step}' for step in words.next_steps(explanation)),
    )
    return '\n\n'.join(blocks)


def write_all(
    folder: Path, explanation: Explanation, prior: TrainFile, train: str, bags: Sequence[Path], notes: tuple[str, ...]
) -> None:
    """Write the outputs into a folder that exists; InputError if one cannot be written."""
    from trainid_ros.report.explained import render_explained  # noqa: PLC0415

    names = tuple(str(bag) for bag in bags)
    title = f'trainid explain: {", ".join(bag.name for bag in bags[:_NAMED_BAGS])}'
    text = json.dumps(to_json(explanation), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(f'{text}\n', folder / REPORT_JSON)
    write_text(dump_train_file(explanation.train_file), folder / TRAIN_FILE)
    learned, kept = explanation.learned, folder / LEARNED
    for old in kept.glob('learned_*.py'):  # of an earlier explanation
        old.unlink()
    (kept / TRAIN_FILE).unlink(missing_ok=True)
    if learned is not None and learned.train_file is not None:
        write_text(learned.source, kept / f'{learned.effect}.py')
        write_text(dump_train_file(learned.train_file), kept / TRAIN_FILE)
    write_text(render_explained(title, explanation, prior, train, names, notes), folder / REPORT_HTML)


def prepare_proposal(folder: Path) -> None:
    """Remove an earlier proposal from a folder; InputError if a file there is something else."""
    for path, start in ((folder / NOTE, NOTE_START), (folder / TEST, TEST_START)):
        check_output(path, (), start)
        path.unlink(missing_ok=True)


def propose(args: argparse.Namespace, explanation: Explanation, prior: TrainFile) -> None:
    """Write the note and the test of a train file that differs from the one explained, beside it."""
    from trainid_ros.report import proposal  # noqa: PLC0415

    if explanation.train_file == prior or explanation.gap is None:
        return
    bags = [str(bag.resolve()) for bag in args.bags]
    options = ['--namespace', args.namespace, '--max-chunk', str(args.max_chunk >> 20)]
    options += [] if args.map is None else ['--map', str(args.map.resolve())]
    write_text(proposal.migration_note(explanation, prior, str(args.train), bags), args.propose / NOTE)
    write_text(proposal.regression_test(explanation.gap, bags, options), args.propose / TEST)


def _watch(args: argparse.Namespace, train_file: TrainFile) -> NoReturn:
    """Explain and tell news until interrupted; InputError if there is no folder, or an option that writes files."""
    if args.out is not None or args.propose is not None:
        raise InputError('--watch writes no files; give --out or --propose without it')
    before: Explanation | None = None
    explained: dict[Path, int] = {}
    sizes: dict[Path, int] = {}
    while True:
        for folder in args.bags:
            if not folder.is_dir():
                raise InputError(f'{folder}: is no folder to watch')
        last, sizes = sizes, _sizes(args.bags)
        complete = {bag: size for bag, size in sizes.items() if last.get(bag) == size}
        if complete and complete != explained:
            explained = complete
            before = _tell(args, sorted(complete), train_file, before)
        time.sleep(5.0)  # [s]; a bag whose size has not changed in between is complete


def _sizes(folders: Sequence[Path]) -> dict[Path, int]:
    """Return all bags in folders with their size [bytes], but those that have just been removed."""
    found = {}
    for folder in folders:
        for bag in bags_below(folder):
            with suppress(OSError):
                found[bag] = sum(file.stat().st_size for file in (bag.rglob('*') if bag.is_dir() else [bag]))
    return found


def _tell(
    args: argparse.Namespace, bags: Sequence[Path], train_file: TrainFile, before: Explanation | None
) -> Explanation | None:
    """Explain bags and print what is new; return the explanation, the one before if the bags give none.

    Those that cannot be read are left out, each with a warning.
    """
    usable, inputs = [], mapped_inputs(args.map, train_file)
    for bag in bags:
        try:
            survey([bag], args.namespace, args.max_chunk, inputs)
            usable.append(bag)
        except InputError as error:
            warn(error)
    if not usable:
        return before
    try:
        now = explain_bags(args, usable, train_file, [])
    except (InputError, NoAnswerError) as error:  # a bag may be mended or removed
        warn(error, 'error')
        return before
    if found := news(before, now):
        if args.json:
            print_json({'bags': [str(bag) for bag in usable], 'news': found, **to_json(now)})
        else:
            show('\n  '.join((f'{pluralise(len(usable), "bag")}: {found[0]}', *found[1:])))
    return now


def news(before: Explanation | None, now: Explanation) -> list[str]:
    """Return as sentences what an explanation says that the one before did not."""
    from trainid_ros.fleet.analysis import are_equal  # noqa: PLC0415
    from trainid_ros.report import words  # noqa: PLC0415

    if before is None or before.verdict is not now.verdict:
        head = f'{now.verdict.value.upper()}: {words.headline(now)}'
        return [head, *(f'{effect.name}: {words.parameters_text(effect)}' for effect in now.effects)]
    old, new = ({effect.name: effect for effect in one.effects} for one in (before, now))
    found = [f'{name} is no longer found.' for name in old if name not in new]
    for name, effect in new.items():
        if name not in old:
            found.append(f'New: {name}, {words.parameters_text(effect)}.')
        elif not are_equal(old[name], effect, 2.0):
            found.append(f'{name} is now {words.parameters_text(effect)}, before {words.parameters_text(old[name])}.')
    return found

# SPDX-License-Identifier: Apache-2.0
"""``trainid explain``: find where model and data disagree and which effect is missing, and add it to the model."""

from __future__ import annotations

import json
import sys
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from trainid_ros import __version__
from trainid_ros.bag.run_reader import read_runs, survey, worker_count
from trainid_ros.cli.output import (
    check_output,
    print_json,
    progress,
    show,
    table,
    to_plain,
    warn,
)
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.text import pluralise, printable
from trainid_ros.report import HTML_START
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from trainid_ros.explain.dataset import Run
    from trainid_ros.explain.result import Explanation, FoundEffect, Gap
    from trainid_ros.train.train_file import TrainFile

REPORT_JSON: Final = 'report.json'
REPORT_HTML: Final = 'report.html'
TRAIN_FILE: Final = 'train.yaml'
_NAMED_BAGS: Final = 3
_JSON_START: Final = '{\n  "verdict":'


def run(args: argparse.Namespace) -> int:
    """Explain the gap between bags and train file, and print what was found.

    Raises:
        InputError: If a bag, the train file or the output folder cannot be used.
        NoAnswerError: If the bags hold too little motion.
    """
    train_file = load_train_file(args.train)
    notes: list[str] = []
    with _outputs(args.out, args.train):
        explanation = _explain(args, train_file, partial(_note, notes))
        if args.out is not None:
            # Written before printing, which a closed pipe may interrupt.
            write_all(args.out, explanation, train_file, str(args.train), args.bags, tuple(notes))
    if explanation.gradient_point is not None:
        warn(gradient_warning(explanation.gradient_point))
    if args.json:
        print_json(to_json(explanation))
        return 0
    show(describe(explanation, train_file))
    if args.out is not None:
        show(f'\nreport: {args.out / REPORT_HTML}\nmodel with the effects: {args.out / TRAIN_FILE}')
    return 0


def _note(notes: list[str], line: str) -> None:
    """Warn of a fault of the bags, and add it to the notes of the report."""
    warn(line)
    notes.append(f'Warning: {line}')


def _explain(args: argparse.Namespace, train_file: TrainFile, note: Callable[[str], None]) -> Explanation:
    """Read the bags and explain them; ``note`` is called with each fault of theirs.

    Raises:
        InputError: If a bag cannot be used.
        NoAnswerError: If the bags hold too little motion.
    """
    inputs = mapped_inputs(args.map, train_file)
    name = args.bags[0].name if len(args.bags) == 1 else f'{len(args.bags)} bags'
    with progress(f'open {name}', total=len(args.bags)) as advance:
        found = survey(args.bags, args.namespace, args.max_chunk, inputs, advance)
    for line in found.warnings:
        note(line)
    with progress(f'read {name}', total=sum(found.inputs)) as advance:
        workers = worker_count(found.inputs)
        runs = read_runs(
            args.bags, train_file, args.namespace, args.max_chunk, inputs, workers=workers, advance=advance, warn=note
        )
    try:
        return explain_runs(runs, train_file, args.bags)
    except NoAnswerError as error:
        if args.json:
            print_json(no_answer(str(error)))
        raise NoAnswerError(f'{name}: {error}') from None


def gradient_warning(point: str) -> str:
    """Return the warning that gradients of the bags are those at one point of the train."""
    return (
        f'the gradients in the bags are those at the {point} of the train and were used as such here, but simulator '
        'and live estimators expect the mean under the train: correct the publisher of the gradient'
    )


def _outputs(folder: Path | None, train: Path) -> AbstractContextManager[None]:
    return nullcontext() if folder is None else _output_folder(folder, train)


@contextmanager
def _output_folder(folder: Path, train: Path) -> Iterator[None]:
    """Prepare the output folder; remove the folders created for it if the work fails.

    Raises:
        InputError: As :func:`prepare_folder`.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        prepare_folder(folder, train)
        yield
    except BaseException:
        with suppress(OSError):  # stops at the first that is not empty
            for path in made:
                path.rmdir()
        raise


def prepare_folder(folder: Path, train: Path) -> None:
    """Create the output folder, and check that the outputs can be written.

    Raises:
        InputError: It cannot be created or written to, or a file that is not an earlier output would be overwritten.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.{REPORT_JSON}.part'
        probe.write_text('', encoding='utf-8')
        probe.unlink()
    except OSError as error:
        raise InputError(f'{folder}: cannot be written ({error.strerror})') from None
    check_output(folder / REPORT_HTML, (train,), HTML_START)
    check_output(folder / REPORT_JSON, (train,), _JSON_START)
    target = folder / TRAIN_FILE
    if not target.exists():
        return
    if target.samefile(train):
        raise InputError(f'{target}: is the input train file and would be overwritten; choose another --out')
    if not (folder / REPORT_JSON).exists():
        raise InputError(f'{target}: exists and was not written by trainid explain; choose another --out')


def explain_runs(runs: Sequence[Run], train_file: TrainFile, bags: Sequence[Path]) -> Explanation:
    """Run the workflow, showing its steps on a terminal.

    Raises:
        NoAnswerError: There is too little motion.
    """
    # Imported here: linear algebra takes long to load, and input errors should be reported without it.
    from trainid_ros.explain.workflow import explain  # noqa: PLC0415

    with _steps() as advance:
        return explain(runs, train_file, provenance=provenance(bags, len(runs)), advance=advance)


@contextmanager
def _steps() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the current step on standard error, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _text: None
        return
    from rich.console import Console  # noqa: PLC0415

    with Console(stderr=True).status('explain') as status:
        yield lambda text: status.update(f'explain: {text}')


def provenance(bags: Sequence[Path], runs: int) -> str:
    """Return the provenance of an added effect."""
    names = [printable(bag.resolve().name) for bag in bags]
    more = f' and {len(names) - _NAMED_BAGS} more' if len(names) > _NAMED_BAGS else ''
    return f'trainid explain {__version__}, {", ".join(names[:_NAMED_BAGS])}{more}, {pluralise(runs, "run")}'


def to_json(explanation: Explanation) -> dict[str, Any]:
    """Return the object of ``--json``."""
    e = explanation
    return _json(e.verdict.value, e.effects, e.gap, e.remaining, e.gradient_point)


def no_answer(reason: str) -> dict[str, Any]:
    """Return the object of ``--json`` if the data hold no answer."""
    return _json(None, (), None, reason, None)


def _json(
    verdict: str | None, effects: Sequence[FoundEffect], gap: Gap | None, remaining: str, gradient_point: str | None
) -> dict[str, Any]:
    plain: dict[str, Any] = to_plain(
        {
            'verdict': verdict,
            'effects': [
                {
                    'name': effect.name,
                    'parameters': dict(effect.parameters),
                    'std': dict(effect.std),
                    'evidence': effect.evidence,
                    'where': effect.where,
                    'indistinguishable_from': [twin.name for twin in effect.twins],
                }
                for effect in effects
            ],
            'gap': {
                'metric': 'rms speed',
                'unit': 'm/s',
                'before': None if gap is None else gap.before,
                'after': None if gap is None else gap.after,
                'noise_floor': None if gap is None else gap.noise_floor,
                'runs_held_out': 0 if gap is None else gap.runs_held_out,
            },
            'remaining': remaining,
            'gradient_read_at': gradient_point,
        }
    )
    return plain


def describe(explanation: Explanation, prior: TrainFile) -> str:
    """Return the findings as text; ``prior`` is the train file that was explained."""
    from trainid_ros.report.words import davis_rows, drive_text, gap_sentence, headline  # noqa: PLC0415

    head = f'{explanation.verdict.value.upper()}: {headline(explanation)}\n{drive_text(explanation)}'
    davis = [('value', 'train file', 'estimate ± std', 'unit'), *davis_rows(explanation, prior)]
    blocks = (
        head,
        *(_describe_effect(effect) for effect in explanation.effects),
        *_unnamed(explanation),
        gap_sentence(explanation),
        table(davis, numbers=(1,)),
        explanation.remaining,
    )
    return '\n\n'.join(blocks)


def _describe_effect(effect: FoundEffect) -> str:
    from trainid_ros.report.words import how_sure, parameters_text  # noqa: PLC0415

    what = 'sensor' if effect.origin == 'sensor' else 'physics'
    lines = [
        f'{effect.name}: {effect.title} ({what})',
        f'  {effect.equation}',
        f'  {parameters_text(effect)}',
        f'  {how_sure(effect)}',
        f'  where: {effect.where}',
    ]
    lines += [
        f'  could also be {twin.name}; to distinguish: {twin.drive or "no drive is known"}' for twin in effect.twins
    ]
    return '\n'.join(lines)


def _unnamed(explanation: Explanation) -> list[str]:
    """Return where the gap is if no effect explains it."""
    from trainid_ros.report.words import strong_text, strongest  # noqa: PLC0415

    strong = [] if explanation.effects else strongest(explanation)
    return ['\n'.join(strong_text(part) for part in strong)] if strong else []


def write_all(
    folder: Path, explanation: Explanation, prior: TrainFile, train: str, bags: Sequence[Path],
    notes: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Write the three outputs into a folder that exists.

    Raises:
        InputError: One cannot be written.
    """
    # Imported here because matplotlib takes long to load and only reports need it.
    from trainid_ros.report.explained import Explained, write_explained  # noqa: PLC0415

    names = tuple(str(bag) for bag in bags)
    title = f'trainid explain: {", ".join(bag.name for bag in bags[:_NAMED_BAGS])}'
    text = json.dumps(to_json(explanation), indent=2, allow_nan=False, ensure_ascii=False)
    _write(folder / REPORT_JSON, f'{text}\n')
    _write(folder / TRAIN_FILE, dump_train_file(explanation.train_file))
    write_explained(Explained(title, explanation, prior, train, names, notes), folder / REPORT_HTML)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding='utf-8', errors='backslashreplace')
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None

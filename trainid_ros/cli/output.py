# SPDX-License-Identifier: Apache-2.0
"""What the verbs share: output, opening a bag, and the same work on each of several bags.

Results go to standard output; progress and warnings go to standard error, so ``--json`` prints JSON only.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Mapping
from contextlib import ExitStack, contextmanager
from enum import Enum
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.worker_pool import each_bag, killed_message, processors
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.text import in_ascii, printable
from trainid_ros.report import HTML_START

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from trainid_ros.bag.reader import BagReader
    from trainid_ros.inputs.mapped_inputs import MappedInputs

    Work = Callable[[argparse.Namespace, Path, Callable[[float], None]], 'BagResult']

EXIT_NO_ANSWER: Final = 1
EXIT_BAD_INPUT: Final = 2


def print_json(value: Any) -> None:
    """Print one JSON object on standard output; see :func:`to_plain` for the permitted types."""
    plain = to_plain(value)
    text = json.dumps(plain, allow_nan=False, ensure_ascii=False)
    text = text if _is_shown(text) else json.dumps(plain, allow_nan=False)
    print(''.join(char if char.isprintable() else json.dumps(char)[1:-1] for char in text))


def show(text: str) -> None:
    """Print text on standard output; what would control the terminal, such as a name in a bag may, is escaped."""
    print(for_output(text))


def for_output(text: str) -> str:
    """Return printable text, in ASCII where the encoding of standard output lacks one of its characters."""
    shown = printable(text)
    return shown if _is_shown(shown) else in_ascii(shown)


def _is_shown(text: str) -> bool:
    try:
        text.encode(sys.stdout.encoding or 'utf-8')
    except UnicodeEncodeError:
        return False
    return True


def to_plain(value: Any) -> Any:
    """Return a value in JSON types; TypeError if it has none.

    Dataclasses and outputs become objects, enumerations their names, arrays lists, non-finite numbers None.
    """
    if hasattr(value, 'tolist'):  # array or number of NumPy
        value = value.tolist()
    if isinstance(value, (Enum, PurePath)):
        return value.name if isinstance(value, Enum) else str(value)
    if value is None or isinstance(value, (str, int)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key.name if isinstance(key, Enum) else str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(item) for item in value]
    from trainid_ros.interface.results import Output  # noqa: PLC0415

    if isinstance(value, Output):
        names = ['stamp_ns', 'estimate', 'status', 'used', 'rejected', 'last_rejection']
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [item.name for item in dataclasses.fields(value)]
    else:
        raise TypeError(f'{type(value).__name__} has no JSON form')
    return {name: to_plain(getattr(value, name)) for name in names}


def warn(text: object, kind: str = 'warning') -> None:
    """Print one line, a warning or of another kind such as 'error', on standard error."""
    print(f'trainid: {kind}: {printable(" ".join(str(text).split()))}', file=sys.stderr)


def check_output(path: Path, inputs: Iterable[Path | None], start: str) -> None:
    """Raise InputError if a file to write is an input, or exists and does not start as that of an earlier run does."""
    if not path.exists():
        return
    if any(given is not None and given.exists() and path.samefile(given) for given in inputs):
        raise InputError(f'{path}: is an input and would be overwritten; choose another name for the output')
    if not path.is_file():
        raise InputError(f'{path}: exists and is not a file; choose another name for the output')
    with path.open('rb') as file:
        head = file.read(len(start))
    if head and head != start.encode():
        raise InputError(f'{path}: exists and was not written by trainid; choose another name for the output')


def prepare_page(path: Path) -> Path:
    """Create the folder of a page and return its path; InputError if that fails, or the page is something else."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{path.parent}: cannot be written ({error.strerror})') from None
    check_output(path, (), HTML_START)
    return path


def table(rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return rows of cells as text, the headings first, with these columns of numbers aligned to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    aligns = ['>' if i in numbers else '<' for i in range(len(widths))]
    cells = ([f'{cell:{a}{w}}' for cell, a, w in zip(row, aligns, widths, strict=True)] for row in rows)
    return '\n'.join('  '.join(row).rstrip() for row in cells)


@contextmanager
def progress(text: str, total: float | None = None, unit: str = '') -> Iterator[Callable[[float], None]]:
    """Show progress on standard error while the block runs, if that is a terminal.

    Yields a function to call with the amount of work done since the last call, of a total if it is known. With the
    unit of these amounts, how many are done in a second is shown too.
    """
    if not sys.stderr.isatty():
        yield lambda _amount: None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.progress import Progress, ProgressColumn, Task  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            """Return the amount done in a second."""
            return Text('' if task.speed is None else f'{task.speed:.3g} {unit}/s')

    columns = (*Progress.get_default_columns(), *((Rate(),) if unit else ()))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(printable(text)), total=total)
        yield lambda amount: bar.advance(task, amount)


@contextmanager
def opened(
    args: argparse.Namespace, inputs: Callable[[], MappedInputs] | None = None, **more: Any
) -> Iterator[BagReader]:
    """Open ``args.bag``, with a progress bar as one without an index is read as a whole; see :class:`BagReader`."""
    from trainid_ros.bag.reader import BagReader  # noqa: PLC0415 - help needs no packages for bags

    with ExitStack() as stack:
        with progress(f'open {args.bag.name}', 1.0) as advance:
            reader = BagReader(args.bag, args.namespace, args.max_chunk, inputs, opening=advance, **more)
            stack.enter_context(reader)
        yield reader


@dataclasses.dataclass(frozen=True, slots=True)
class BagResult:
    """What a command says of one bag."""

    shown: Any  # JSON object with ``--json``, else text; None if the bag could not be used
    warnings: tuple[str, ...] = ()  # Faults that do not prevent an answer
    error: str = ''  # Why there is no answer, '' if there is one


def run_per_bag(args: argparse.Namespace, work: Work, text: str) -> int:
    """Do the work for each of ``args.bags``, ``args.jobs`` at once, print the results and return the exit code.

    ``work`` is a function of a module: it gets the arguments, a bag, and a function to call with the share done since
    its last call; InputError and OSError are reported as errors of the bag. ``text`` says what is being done.
    """
    bags: Sequence[Path] = args.bags
    name = bags[0].name if len(bags) == 1 else f'{len(bags)} bags'
    with progress(f'{text} {name}', total=len(bags)) as advance:
        finished = each_bag(
            partial(_attempt, work, args), bags, args.jobs or processors(), advance,
            killed=lambda bag: BagResult(None, error=killed_message(bag)),
        )  # fmt: skip
        results = [result for _, result in sorted(finished)]
    for line in dict.fromkeys(line for result in results for line in result.warnings):
        warn(line)
    shown = [result.shown for result in results if result.shown is not None]
    if len(bags) > 1 and args.json:
        answers = zip(bags, results, strict=True)
        print_json(
            [{'bag': bag, **(one.shown or {}), **({'error': one.error} if one.error else {})} for bag, one in answers]
        )
    elif shown and args.json:
        print_json(shown[0])
    elif shown:
        show('\n\n'.join(map(str, shown)))
    failed = [result for result in results if result.error]
    for result in failed:
        warn(result.error, 'error')
    return max((EXIT_BAD_INPUT if result.shown is None else EXIT_NO_ANSWER for result in failed), default=0)


def _attempt(work: Work, args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> BagResult:
    try:
        return work(args, bag, advance)
    except InputError as error:
        return BagResult(None, error=str(error))
    except OSError as error:
        return BagResult(None, error=f'{error.filename or bag}: {error.strerror}')

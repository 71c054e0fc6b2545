# SPDX-License-Identifier: Apache-2.0
"""Output functions shared by the commands.

Results go to standard output; progress and warnings go to standard error, so ``--json`` prints JSON only.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.text import in_ascii, printable
from trainid_ros.report import HTML_START

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path


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

    Dataclasses become objects, enumerations their names, arrays lists, non-finite numbers None.
    """
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return _compound_to_plain(value)


def _compound_to_plain(value: Any) -> Any:
    from trainid_ros.interface.results import Output  # noqa: PLC0415

    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: to_plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Output):
        names = ('stamp_ns', 'estimate', 'status', 'used', 'rejected', 'last_rejection')
        return {name: to_plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {key.name if isinstance(key, Enum) else str(key): to_plain(item) for key, item in value.items()}
    if hasattr(value, 'tolist'):  # array or number of NumPy
        return to_plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(item) for item in value]
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f'{type(value).__name__} has no JSON form')


def warn(text: str) -> None:
    """Print one warning line on standard error."""
    print(f'trainid: warning: {_on_one_line(text)}', file=sys.stderr)


def report_error(error: object) -> None:
    """Print an error as one line on standard error."""
    print(f'trainid: error: {_on_one_line(str(error))}', file=sys.stderr)


def _on_one_line(text: str) -> str:
    return printable(' '.join(text.split()))


def check_output(path: Path, inputs: Iterable[Path | None], start: str) -> None:
    """Check that writing a file destroys nothing else.

    Args:
        path: The file to write.
        inputs: Files that the command reads.
        start: How a file starts that was written by an earlier run and may be written over.

    Raises:
        InputError: The file is an input, or exists and is something else.
    """
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
    """Return rows of cells as aligned text.

    Args:
        rows: Rows of equal length, the headings first.
        numbers: Columns to align to the right.
    """
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    aligns = ['>' if i in numbers else '<' for i in range(len(widths))]
    lines = []
    for row in rows:
        cells = (f'{cell:{align}{width}}' for cell, align, width in zip(row, aligns, widths, strict=True))
        lines.append('  '.join(cells).rstrip())
    return '\n'.join(lines)


@contextmanager
def progress(text: str, total: float | None = None, unit: str = '') -> Iterator[Callable[[float], None]]:
    """Show progress on standard error while the block runs; show nothing if that is not a terminal.

    Args:
        text: What is being done.
        total: Amount of work, None if unknown.
        unit: Name of the amounts, to show how many are done in a second; '' shows none.

    Yields:
        A function to call with the amount done since the last call.
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

# SPDX-License-Identifier: Apache-2.0
"""Functions that the user writes, for what a mapping cannot say; they lie in files beside the mapping file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, Any

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.units import Unit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class UserFunction:
    """A function of arrays of numbers, all of shape (n,), that returns such an array."""

    path: Path  # The Python file
    name: str  # Name of the function in it
    unit: Unit  # Unit of what it returns

    def __str__(self) -> str:
        """Return file and name, as in a mapping."""
        return f'{self.path}:{self.name}'

    def load(self) -> Callable[..., object]:
        """Return the function; its file is run the first time.

        Raises:
            InputError: The file cannot be run, or has no such function.
        """
        function: Callable[..., object] | None = _names_of(self.path).get(self.name)
        if function is None or not callable(function):
            raise InputError(f'{self.path}: has no function {self.name}')
        return function

    def of_columns(self, columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the values of columns, each of shape (n,), in the unit of the interface.

        Raises:
            InputError: The function fails, or returns something else.
        """
        function = self.load()
        try:
            result = np.asarray(function(*columns), dtype=np.float64)
        except (Exception, SystemExit) as error:  # whatever its code raises
            raise InputError(f'{self} failed{_line(self.path, error)}: {type(error).__name__}: {error}') from error
        if result.shape != columns[0].shape:
            raise InputError(f'{self} returned shape {result.shape}, {columns[0].shape} expected: one number a row')
        return np.array([self.unit.convert(value) for value in result.tolist()], dtype=np.float64)

    def of_numbers(self, numbers: Sequence[float]) -> float:
        """Return the value of single numbers, as :meth:`of_columns`."""
        return float(self.of_columns([np.array([number]) for number in numbers])[0])


def user_function(folder: Path, text: str, unit: Unit) -> UserFunction:
    """Return the function that a mapping names.

    Args:
        folder: Folder of the mapping.
        text: File and function, such as ``force.py:wheel_force``.
        unit: Unit of what it returns.

    Raises:
        ValueError: The text is not of this form, or the file does not lie in the folder itself.
    """
    file, _, name = text.partition(':')
    if not (file.endswith('.py') and name.isidentifier()):
        raise ValueError('must be a Python file and a function in it, like force.py:wheel_force')
    path = (folder / file).resolve()
    if Path(file).name != file or path.parent != folder.resolve():
        raise ValueError('must lie in the folder of the mapping itself')
    if not path.is_file():
        raise ValueError(f'is not there: no file {path}')
    return UserFunction(path, name, unit)


@cache
def _names_of(path: Path) -> dict[str, Any]:
    """Run a file and return what it defines; unlike an import this writes no bytecode and finds no files beside it."""
    names: dict[str, Any] = {'__name__': path.stem, '__file__': str(path)}
    try:
        exec(compile(path.read_bytes(), path, 'exec'), names)
    except (Exception, SystemExit) as error:  # whatever its code raises
        raise InputError(f'{path}: cannot be run{_line(path, error)}: {type(error).__name__}: {error}') from error
    return names


def _line(path: Path, error: BaseException) -> str:
    """Return which line of a file raised an error, '' if none did."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f' in line {lines[-1]}' if lines else ''

# SPDX-License-Identifier: Apache-2.0
"""Functions that the user writes, for what a mapping cannot say; they lie in files beside the mapping file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.errors import InputError
from trainid_ros.mapping.units import Unit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class UserFunction:
    """A function of arrays of numbers, all of shape (n,), that returns such an array.

    Attributes:
        path: The Python file.
        name: Name of the function in it.
        unit: Unit of what it returns.

    """

    path: Path
    name: str
    unit: Unit

    def __str__(self) -> str:
        """Return file and name, as in a mapping."""
        return f'{self.path}:{self.name}'

    def load(self) -> Callable[..., object]:
        """Return the function; its file is run the first time.

        Raises:
            InputError: The file cannot be run, or has no such function.

        """
        function: Callable[..., object] | None = getattr(_module(self.path), self.name, None)
        if function is None or not callable(function):
            msg = f'{self.path}: has no function {self.name}'
            raise InputError(msg)
        return function

    def of_columns(self, columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the values of columns, each of shape (n,), in the unit of the interface.

        Raises:
            InputError: The function fails, or returns something else.

        """
        function = self.load()
        try:
            result = np.asarray(function(*columns), dtype=np.float64)
        except Exception as error:  # whatever its code raises
            msg = f'{self} failed: {type(error).__name__}: {error}'
            raise InputError(msg) from error
        if result.shape != columns[0].shape:
            msg = f'{self} returned shape {result.shape}, {columns[0].shape} expected: one number a row'
            raise InputError(msg)
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
        msg = 'must be a Python file and a function in it, like force.py:wheel_force'
        raise ValueError(msg)
    path = (folder / file).resolve()
    if Path(file).name != file or path.parent != folder.resolve():
        msg = 'must lie in the folder of the mapping itself'
        raise ValueError(msg)
    if not path.is_file():
        msg = f'is not there: no file {path}'
        raise ValueError(msg)
    return UserFunction(path, name, unit)


@cache
def _module(path: Path) -> ModuleType:
    spec = spec_from_file_location(f'trainid_mapping_{path.stem}', path)
    if spec is None or spec.loader is None:
        msg = f'{path}: is not a Python file'
        raise InputError(msg)
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever its code raises
        msg = f'{path}: cannot be run: {type(error).__name__}: {error}'
        raise InputError(msg) from error
    return module

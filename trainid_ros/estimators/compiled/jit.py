# SPDX-License-Identifier: Apache-2.0
"""Compile a kernel as it stands, with all kernels that it calls."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any, Final, TypeVar

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    Kernel = TypeVar('Kernel', bound=Callable[..., object])

_COMPILER: Final = 'numba'


def compiler_present() -> bool:
    """True if kernels can be compiled; does not load the compiler."""
    from importlib.util import find_spec  # noqa: PLC0415 (slow to load)

    return find_spec(_COMPILER) is not None


def require_compiler() -> None:
    """Load the compiler; InputError if it is missing or does not load."""
    try:
        import_module(_COMPILER)
    except Exception as error:  # a compiler that does not suit the rest raises anything
        reason = ' '.join(str(error).split())
        msg = f'compiled = 1 needs {_COMPILER}, which comes with trainid_ros[fast]: {type(error).__name__}: {reason}'
        raise InputError(msg) from error


def compiled(kernel: Kernel) -> Kernel:
    """Return a kernel in machine code, or the kernel itself where no compiler is installed.

    A kernel is a function of module level on floats, tuples of floats and arrays, which calls :mod:`math` and other
    kernels only. It is compiled when first called. Its operations and their order stay: no ``fastmath``, so no
    contraction of multiplication and addition and no regrouping of sums, and division by zero raises as it does
    without.

    """
    if not isinstance(kernel, FunctionType) or not compiler_present():
        return kernel
    machine_code: Kernel = _compiled(kernel)
    return machine_code


@cache
def _compiled(kernel: FunctionType) -> Any:
    from numba import njit  # noqa: PLC0415 (half a second)

    # A copy that sees the compiled forms of what it calls: the module itself stays as it is.
    names = dict(kernel.__globals__)
    packages = {name.partition('.')[0] for name in (kernel.__module__, __name__)}
    for name in kernel.__code__.co_names:
        called = names.get(name)
        if isinstance(called, FunctionType) and called.__module__.partition('.')[0] in packages:
            names[name] = _compiled(called)
    copy = FunctionType(kernel.__code__, names, kernel.__name__, kernel.__defaults__, kernel.__closure__)
    copy.__kwdefaults__ = kernel.__kwdefaults__
    copy.__module__ = kernel.__module__
    return njit(error_model='python', fastmath=False)(copy)

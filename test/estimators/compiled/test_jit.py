# SPDX-License-Identifier: Apache-2.0
"""Compiling: the same numbers, what is missing is done without, nothing loads before it is needed."""

from __future__ import annotations

import importlib.util
import random
import subprocess
import sys
from math import exp, log, sqrt
from pathlib import Path

import pytest

from trainid_lab.resistance.recursive import rls
from trainid_ros.errors import InputError
from trainid_ros.estimators.compiled.jit import compiled, compiler_present, require_compiler

needs_compiler = pytest.mark.skipif(not compiler_present(), reason='numba is not installed')


def half(x: float) -> float:
    return 0.5 * x


def contracts(a: float, b: float, c: float) -> float:
    """Differs in its last bit if multiplication and addition are fused."""
    return a * b + c


def sums(a: float, b: float, c: float, d: float) -> float:
    return ((a + b) + c) + d


def functions(x: float) -> tuple[float, float, float]:
    return exp(-half(x)), log(x), sqrt(x)


def inverse(x: float) -> float:
    return 1.0 / x


@needs_compiler
def test_rounding_is_that_of_python() -> None:
    rng = random.Random(20)
    fused, added, called = compiled(contracts), compiled(sums), compiled(functions)
    assert fused is not contracts
    for _ in range(20_000):
        a, b, c, d = (rng.uniform(-1.0, 1.0) * 10.0 ** rng.randint(-8, 8) for _ in range(4))
        assert fused(a, b, -a * b + 1e-9 * c) == contracts(a, b, -a * b + 1e-9 * c)
        assert added(a, b, c, d) == sums(a, b, c, d)
        assert called(abs(a)) == functions(abs(a))


@needs_compiler
def test_division_by_zero_raises_as_in_python() -> None:
    with pytest.raises(ZeroDivisionError):
        compiled(inverse)(0.0)


@needs_compiler
@pytest.mark.slow
def test_a_kernel_on_tuples_gives_the_same_numbers() -> None:
    fast, rng = compiled(rls), random.Random(21)
    plain = quick = ((0.0, 0.0, 0.0), (1e6, 0.0, 0.0, 1e6, 0.0, 1e6))
    for _ in range(300):
        v = rng.uniform(1.0, 22.0)
        phi, y = (1.0, v, v * v), rng.gauss(1.0, 1.0)
        plain, quick = rls(*plain, phi, y), fast(*quick, phi, y)
    assert plain == quick


def test_without_a_compiler_the_kernel_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('importlib.util.find_spec', lambda _: None)
    assert not compiler_present()
    assert compiled(half) is half


@pytest.mark.parametrize('trouble', ["ImportError('needs NumPy 2.3 or less')", "AttributeError('np.bool8')"])
def test_a_compiler_that_does_not_load_is_named_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, trouble: str
) -> None:
    (tmp_path / 'numba.py').write_text(f'raise {trouble}\n', encoding='utf-8')
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, 'numba', raising=False)
    with pytest.raises(InputError, match=r'fast\]: (ImportError: needs NumPy|AttributeError: np)'):
        require_compiler()


def test_the_compiler_loads_only_when_something_is_compiled() -> None:
    assert importlib.util.find_spec('trainid_ros.estimators.compiled.compiled_gsma')
    code = (
        'import sys; import trainid_ros.estimators.pipeline, trainid_ros.estimators.compiled.compiled_gsma, '
        'trainid_lab.compiled_streams; print("numba" in sys.modules)'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == 'False'

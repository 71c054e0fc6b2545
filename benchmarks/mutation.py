# SPDX-License-Identifier: Apache-2.0
"""Do the tests notice a changed line? A sample of mutants of the sources, each against the tests of its folder.

A mutant has one comparison, operator, constant, condition, returned value or statement changed. It is written into a
copy of the repository and tested there without compiled modules, until the first failure. All tests of the folder that
need no ROS graph, and the golden outputs, first have to pass without a mutant; that run also notes which functions each
test calls, by the hooks below as a plug-in of pytest. Those that call the changed function then run, the fastest first,
the slowest not at all. Other tests of the suite, such as those of the commands, are left out.
"""

from __future__ import annotations

import ast
import cProfile
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import CodeType
from typing import Any, Final

import pytest
from pytest import ExitCode

from benchmarks.tables import Table

# Folders by the name under which they are counted, and the least share of mutants that their tests should kill [%].
FOLDERS: Final = {
    'estimators': (('estimators', 'resistance', 'speed_model', 'brake_rate'), 80),
    'stream': (('stream',), 80),
    'client': (('client',), 95),
    'explain': (('explain',), 80),
    'bag': (('bag',), 80),
}
# Of its own: in a copy of the repository nothing else of it is imported.
REPOSITORY: Final = Path(__file__).resolve().parents[1]
_SEED: Final = 1
_JOBS: Final = 2
# Parts in which the tests of a folder run without a mutant.
_PARTS: Final = 6
# Longer tests are left out, with the calls noted: compiled they are fast, but each survivor would run them [s].
_MAX_TEST_S: Final = 20.0
# Tests of a mutant that take longer count as failed: CPU time of the imports [s], and times that of the tests without a
# mutant [1], which noting the calls about doubles. A mutant that only waits is stopped by the clock [s].
_IMPORT_S: Final = 60
_MAX_CPU_RATIO: Final = 2.0
_MAX_RUN_S: Final = 900.0
_OUT_OF_CPU: Final = 128 + signal.SIGXCPU
_SWAPS: Final[dict[type[ast.AST], Any]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div, ast.Pow: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of a file: the bytes between two places are replaced."""

    path: str
    line: int
    begin: int
    end: int
    before: str
    after: str

    def __str__(self) -> str:
        return f'{self.path}:{self.line}: {self.before} -> {self.after}'


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """Return all mutants of a file, in the order of their places."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node, new in _changes(ast.parse(source)):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        before, after = ' '.join(source[begin:end].decode().split()), ast.unparse(new)
        if isinstance(new, ast.expr):
            after = f'({after})'  # as part of a larger expression
        found.append(Mutant(path, node.lineno, begin, end, before, after))
    return sorted(set(found), key=lambda mutant: (mutant.begin, mutant.end, mutant.after))


def _changes(node: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, ast.AST]]:
    """Yield expressions and statements that do something, and what each may be replaced by."""
    children = list(ast.iter_child_nodes(node))
    match node:
        # Texts, messages, types and what is imported for types only are left alone.
        case ast.JoinedStr() | ast.Raise() | ast.Assert() | ast.If(test=ast.Name(id='TYPE_CHECKING')):
            return
        case ast.AnnAssign(value=value):
            children = [value] if value is not None else []
        case ast.ClassDef(body=body):  # no decorators: frozen classes and slots
            children = list(body)
        case ast.FunctionDef(body=body, args=arguments):
            children = [*arguments.defaults, *filter(None, arguments.kw_defaults), *body]
        case ast.expr() | ast.stmt():
            new = _replacement(node)
            if new is not None:
                yield node, new
    for child in children:
        yield from _changes(child)


def _replacement(node: ast.expr | ast.stmt) -> ast.AST | None:
    new: ast.AST | None = None
    match node:
        case ast.Compare(left=left, ops=[op], comparators=right):
            new = ast.Compare(left, [_SWAPS[type(op)]()], right)
        case ast.BinOp(left=left, op=op, right=other) if type(op) in _SWAPS:
            new = ast.BinOp(left, _SWAPS[type(op)](), other)
        case ast.AugAssign(target=target, op=op, value=value) if type(op) in _SWAPS:
            new = ast.AugAssign(target, _SWAPS[type(op)](), value)
        case ast.BoolOp(op=op, values=values):
            new = ast.BoolOp(_SWAPS[type(op)](), values)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            new = operand
        case ast.Constant(value=bool(value)):
            new = ast.Constant(not value)
        case ast.Constant(value=int(value)):
            new = ast.Constant(value + 1)
        case ast.Constant(value=float(value)):
            new = ast.Constant(2.0 * value or 1.0)
        case ast.Return(value=ast.expr() as value) if ast.unparse(value) != 'None':
            new = ast.Return(ast.Constant(None))
        case ast.Expr(value=ast.Call()):
            new = ast.Pass()
    return new


def sample(count: int, seed: int) -> dict[str, list[Mutant]]:
    """Return as many mutants of each folder; equal seeds give equal ones of equal sources."""
    chosen = {}
    for name, (parts, _) in FOLDERS.items():
        paths = [path for part in parts for path in (REPOSITORY / 'trainid_ros' / part).rglob('*.py')]
        texts = [(str(path.relative_to(REPOSITORY)), path.read_bytes()) for path in sorted(paths)]
        every = [mutant for path, source in texts for mutant in mutants_of(path, source)]
        chosen[name] = random.Random(f'{seed} {name}').sample(every, min(len(every), -(-count // len(FOLDERS))))
    return chosen


def tests_of(name: str) -> list[str]:
    """Return the test files of a folder by its name in ``FOLDERS``, and the golden outputs."""
    folders = [REPOSITORY / 'test' / part for part in (*FOLDERS[name][0], 'golden')]
    return sorted(str(path.relative_to(REPOSITORY)) for folder in folders for path in folder.rglob('test_*.py'))


def function_at(path: str, line: int) -> int:
    """Return the first line of the function of a file that holds a line; 0 outside of functions."""
    tree = ast.parse((REPOSITORY / path).read_bytes())
    found = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and line <= (node.end_lineno or 0)]
    # A function with decorators begins with the first of them.
    starts = [min((node.lineno, *(one.lineno for one in node.decorator_list))) for node in found]
    return max((start for start in starts if start <= line), default=0)


def order_of(mutant: Mutant, tests: Sequence[Called]) -> list[Called]:
    """Return the tests that call the changed function, all where none is known to; the fastest first."""
    line = function_at(mutant.path, mutant.line)
    direct = [test for test in tests if any(path == mutant.path and line in (0, at) for path, at in test.functions)]
    fast = [test for test in direct or tests if test.cpu_s < _MAX_TEST_S]
    return sorted(fast, key=lambda test: test.cpu_s)


@contextmanager
def _copied() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name) / 'copy'
        root.mkdir()
        for item in REPOSITORY.iterdir():
            if item.name in {'trainid_ros', 'test'}:
                shutil.copytree(item, root / item.name, ignore=shutil.ignore_patterns('*.so'))
            elif item.name != '.git':
                (root / item.name).symlink_to(item)
        yield root


def called(files: Sequence[str]) -> list[Called]:
    """Run tests on the unchanged sources; return what each calls.

    Raises:
        RuntimeError: Tests fail: they would fail on every mutant.

    """
    with _copied() as root:
        out = root.parent / 'called.jsonl'
        if output := failure_of(['-p', 'benchmarks.mutation', '--called', str(out), *files], root):
            raise RuntimeError(f'tests fail without a mutant: {" ".join(files)}\n{output}')
        return read_calls(out)


def is_killed(mutant: Mutant, tests: Sequence[str], cpu_s: float) -> bool:
    """Return whether one of the tests fails on a mutant; together they take a CPU time [s] without it."""
    if not tests:  # pytest would run all
        return False
    with _copied() as root:
        source = (REPOSITORY / mutant.path).read_bytes()
        changed = source[: mutant.begin] + mutant.after.encode() + source[mutant.end :]
        (root / mutant.path).write_bytes(changed)
        return bool(failure_of(tests, root, cpu_s))


def failure_of(arguments: Sequence[str], root: Path, cpu_s: float = math.inf) -> str:
    """Return what tests print that fail, cannot be imported or take too long; empty if they pass or none is selected.

    They run in a copy of the repository, and take a CPU time [s] without a mutant.

    Raises:
        RuntimeError: pytest itself fails, is interrupted or is called wrongly.

    """
    paths = (root, root / 'research' / 'lab', root / 'examples' / 'python')
    env = os.environ | {'TRAINID_COMPILED': '0', 'PYTHONPATH': os.pathsep.join(map(str, paths))}
    options = ('-q', '-x', '-p', 'no:cacheprovider', '-m', 'not ros and not long')
    limit = 'unlimited' if math.isinf(cpu_s) else str(round(_IMPORT_S + _MAX_CPU_RATIO * cpu_s))
    tests = [sys.executable, '-m', 'pytest', *options, *arguments]
    command = ['bash', '-c', 'ulimit -St "$0"; exec tools/with_test_env "$@"', limit, *tests]
    try:
        done = subprocess.run(command, cwd=root, env=env, capture_output=True, check=False, timeout=_MAX_RUN_S)
    except subprocess.TimeoutExpired:
        return f'longer than {_MAX_RUN_S:g} s'
    output = (done.stdout + done.stderr).decode(errors='replace')
    match done.returncode:
        case ExitCode.OK | ExitCode.NO_TESTS_COLLECTED:
            return ''
        case ExitCode.TESTS_FAILED:
            return output
        case _ if done.returncode == _OUT_OF_CPU:
            return f'more CPU time than {limit} s'
        case ExitCode.INTERRUPTED if 'during collection' in output:
            return output
        case ExitCode.USAGE_ERROR if 'while loading conftest' in output or 'not found: ' in output:
            return output  # the latter is a test whose parameters have changed
    raise RuntimeError(f'exit code {done.returncode}: {" ".join(command)}\n{output}')


def measure(mutants: int) -> tuple[Table, ...]:
    """Test a sample of mutants; return their number by folder, and those that no test noticed.

    Raises:
        RuntimeError: Tests fail without a mutant.

    """
    rows, survivors = [], []
    with ProcessPoolExecutor(_JOBS, mp_context=get_context('spawn')) as pool:
        for name, some in sample(mutants, _SEED).items():
            files = tests_of(name)
            parts = [part for k in range(_PARTS) if (part := files[k::_PARTS])]
            tests = [test for part in pool.map(called, parts) for test in part]
            killed = []
            orders = [order_of(mutant, tests) for mutant in some]
            names_of = [[test.name for test in order] for order in orders]
            times = [sum(test.cpu_s for test in order) for order in orders]
            for mutant, is_dead in zip(some, pool.map(is_killed, some, names_of, times), strict=True):
                killed.append(is_dead)
                print('killed  ' if is_dead else 'SURVIVED', mutant, file=sys.stderr, flush=True)
            share = 100.0 * sum(killed) / max(1, len(some))
            rows.append((name, str(sum(killed)), str(len(some)), f'{share:.0f} %', f'>= {FOLDERS[name][1]} %'))
            survivors += [(str(mutant),) for mutant, is_dead in zip(some, killed, strict=True) if not is_dead]
            print(*rows[-1], flush=True)
    note = f'Sample of seed {_SEED}; tests of the folder of each module and golden outputs, without ROS graph.'
    header = ('folder', 'killed', 'mutants', 'share', 'target')
    return Table('Mutants killed', header, tuple(rows), note), Table('Survivors', ('change',), tuple(survivors))


@dataclass(frozen=True, slots=True)
class Called:
    """A test, and what it calls; what a fixture calls counts for all tests of the file, which may share it."""

    name: str
    cpu_s: float
    functions: frozenset[tuple[str, int]]  # File and first line of each function


def read_calls(path: Path) -> list[Called]:
    """Read what the plug-in has written."""
    rows = [json.loads(line) for line in path.read_text(encoding='utf-8').splitlines()]
    by_fixtures = defaultdict[str, set[tuple[str, int]]](set)
    cpu_s, by_test = Counter[str](), defaultdict[str, set[tuple[str, int]]](set)
    for name, phase, seconds, found in rows:
        cpu_s[name] += seconds
        (by_fixtures[_file(name)] if phase == 'setup' else by_test[name]).update(map(tuple, found))
    return [Called(name, cpu_s[name], frozenset(by_test[name] | by_fixtures[_file(name)])) for name in cpu_s]


def _file(name: str) -> str:
    return name.partition('::')[0]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption('--called', type=Path, required=True, help='file in which to note what each test calls')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, None, None]:
    with _noted(item, 'setup'):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    with _noted(item, 'call'):
        yield


@contextmanager
def _noted(item: pytest.Item, phase: str) -> Iterator[None]:
    """Write a line on a phase of a test."""
    profile = cProfile.Profile(subcalls=False, builtins=False)
    begin = time.process_time()
    profile.enable()
    try:
        yield
    finally:
        profile.disable()
        codes = (entry.code for entry in profile.getstats())
        found = [place for code in codes if (place := _place(code, item.config.rootpath))]
        line = json.dumps([item.nodeid, phase, time.process_time() - begin, found])
        with item.config.getoption('--called').open('a', encoding='utf-8') as file:
            file.write(line + '\n')


def _place(code: CodeType | str, root: Path) -> tuple[str, int] | None:
    """Return file and first line of a function of the package, None of any other."""
    if isinstance(code, str):  # of an extension
        return None
    path = Path(code.co_filename)
    inside = path.is_relative_to(root / 'trainid_ros')
    return (str(path.relative_to(root)), code.co_firstlineno) if inside else None

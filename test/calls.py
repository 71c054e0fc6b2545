# SPDX-License-Identifier: Apache-2.0
"""Work counted in calls of functions, which do not depend on how fast the machine is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

# A folder of Python's own has the name of this one.
CODE = """
import runpy, sys, types
sys.modules['test'] = package = types.ModuleType('test')
package.__path__ = [{folder!r}]
from test.calls import count
print(*(count(work) for work in eval({works!r}, runpy.run_path({path!r}))))
"""


def count(work: Callable[[], object]) -> int:
    """Return how many functions a work calls, in Python or C; calls within compiled modules are not seen."""
    calls = 0

    def note(_frame: object, event: str, _argument: Any) -> None:
        nonlocal calls
        calls += event in {'call', 'c_call'}

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls


def count_in_sources(path: str, works: str) -> list[int]:
    """Return the calls of works in a process that runs the sources.

    Args:
        path: Test module.
        works: Expression for an iterable of functions without arguments, within the module.

    """
    code = CODE.format(folder=str(Path(__file__).parent), works=works, path=path)
    done = subprocess.run(
        [sys.executable, '-c', code],
        env=os.environ | {'TRAINID_COMPILED': '0'},
        capture_output=True,
        text=True,
        check=True,
    )
    return [int(word) for word in done.stdout.split()]

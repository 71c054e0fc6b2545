# SPDX-License-Identifier: Apache-2.0
"""Compiled modules: plain Python modules that mypyc also translates to C, with the same numbers to the bit.

The sources run where not all was compiled, where librt, the run-time library of mypyc, is missing, and where
``TRAINID_COMPILED=0`` is set: for debugging, coverage, and to compare both. In a source tree whose sources
were changed since the build they run too, with a warning.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, FileFinder, ModuleSpec, SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Final

PACKAGE: Final = 'trainid_ros'
SWITCH: Final = 'TRAINID_COMPILED'
DIGEST: Final = 'modules.sha256'
"""File in the folder of the package that states what its compiled modules were made of."""
_OFF: Final = frozenset({'0', 'no', 'off', 'false'})
MODULES: Final = (
    'brake_rate/brake_rate_estimator',
    'brake_rate/gsma',
    'brake_rate/m_algorithm',
    'brake_rate/motion_model',
    'client/stopping',
    'estimators/pipeline',
    'interface/results',
    'interface/scalars',
    'resistance/change_points',
    'resistance/davis_posterior',
    'resistance/filter_bank',
    'resistance/hypotheses',
    'resistance/vmils',
    'resistance/window_learner',
    'speed_model/am_vff_rls',
    'speed_model/speed_model_estimator',
    'stream/adhesion',
    'stream/alignment',
    'stream/brake_shape',
    'stream/fault_filter',
    'stream/fault_table',
    'stream/input_blocks',
    'stream/input_check',
    'stream/input_faults',
    'stream/known_force',
    'stream/message_check',
    'stream/sample_stream',
    'stream/samples',
    'stream/topic_track',
    'train/effect_terms',
    'train/forces',
)
"""The modules to compile, as paths below the package without suffix."""


def digest(folder: Path) -> str:
    """Return a digest of the sources of all modules to compile, in the folder of the package."""
    found = sha256()
    for name in MODULES:
        found.update((folder / f'{name}.py').read_bytes())
    return found.hexdigest()


@cache
def uses_sources() -> bool:
    """Return whether the sources of the compiled modules run."""
    folder = Path(__file__).parent
    if os.environ.get(SWITCH, '').lower() in _OFF:
        return True
    if not (_is_complete(folder) and _can_import('librt.vecs', 'mypy_extensions')):
        return True
    # Installed sources do not change.
    if not (folder.parent / 'setup.py').exists():
        return False
    if (folder / DIGEST).read_text(encoding='utf-8') == digest(folder):
        return False
    warnings.warn('sources differ from their compiled form and run instead: make setup', RuntimeWarning, stacklevel=2)
    return True


def _is_complete(folder: Path) -> bool:
    """Return whether all modules were compiled, for this interpreter; the digest is written last."""
    suffix = EXTENSION_SUFFIXES[0]
    return (folder / DIGEST).exists() and all(
        (folder / f'{name}{suffix}').exists() for name in ('modules__mypyc', *MODULES)
    )


def _can_import(*names: str) -> bool:
    """Return whether all modules can be found."""
    try:
        return all(find_spec(name) is not None for name in names)
    except ImportError:  # of the package of one
        return False


class _SourceFinder:
    """Finds the modules of this package by their sources, although compiled ones lie beside them."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of a module of this package, None for others."""
        if path is None or not name.startswith(f'{PACKAGE}.'):
            return None
        for folder in path:
            spec = FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES)).find_spec(name, target)
            if spec is not None:
                return spec
        return None


def choose_modules() -> None:
    """Let imports of this package find sources only, if compiled modules must not be used."""
    if uses_sources():
        sys.meta_path.insert(0, _SourceFinder)

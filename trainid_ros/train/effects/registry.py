# SPDX-License-Identifier: Apache-2.0
"""Registry of effects by name: modules in ``library`` and users' modules in the folders of ``TRAINID_EFFECTS``."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Final

from trainid_ros.errors import InputError
from trainid_ros.train.effects import library
from trainid_ros.train.effects.kind import EffectKind

FOLDERS_VARIABLE: Final = 'TRAINID_EFFECTS'
"""Environment variable listing folders of user effects, separated as in PATH; each ``*.py`` defines ``EFFECT``."""


class _Library(Mapping[str, EffectKind]):
    """Load the modules on first access, so that an invalid user file affects only code that uses effects."""

    def __getitem__(self, name: str) -> EffectKind:
        return _kinds(os.environ.get(FOLDERS_VARIABLE, ''))[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_kinds(os.environ.get(FOLDERS_VARIABLE, '')))

    def __len__(self) -> int:
        return len(_kinds(os.environ.get(FOLDERS_VARIABLE, '')))


EFFECTS: Final[Mapping[str, EffectKind]] = _Library()
"""All effects by name. Any access raises InputError, naming the file, if a user's module is invalid."""


@lru_cache(maxsize=8)
def _kinds(folders: str) -> Mapping[str, EffectKind]:
    found: dict[str, EffectKind] = {}
    for info in pkgutil.iter_modules(library.__path__):
        module = importlib.import_module(f'{library.__name__}.{info.name}')
        kind: EffectKind = module.EFFECT
        found[kind.name] = kind
    for path in _user_files(folders):
        kind = _user_kind(path)
        if kind.name in found:
            msg = f'{path}: effect {kind.name} already exists'
            raise InputError(msg)
        found[kind.name] = kind
    return MappingProxyType(found)


def _user_files(folders: str) -> list[Path]:
    files: list[Path] = []
    for folder in filter(None, folders.split(os.pathsep)):
        if not Path(folder).is_dir():
            msg = f'{FOLDERS_VARIABLE}: {folder} is not a folder'
            raise InputError(msg)
        files += sorted(path for path in Path(folder).glob('*.py') if not path.name.startswith('_'))
    return files


def _user_kind(path: Path) -> EffectKind:
    kind = getattr(_load(path), 'EFFECT', None)
    if not isinstance(kind, EffectKind):
        msg = f'{path}: must define EFFECT = EffectKind(...), see trainid_ros.train.effects'
        raise InputError(msg)
    return kind


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f'trainid_user_effect_{path.stem}', path)
    if spec is None or spec.loader is None:
        msg = f'{path}: is not a Python module'
        raise InputError(msg)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look up their module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        # Any exception raised by a user's file is reported as a file that cannot be loaded.
        msg = f'{path}: cannot be loaded: {type(error).__name__}: {error}'
        raise InputError(msg) from error
    return module

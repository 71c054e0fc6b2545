# SPDX-License-Identifier: Apache-2.0
"""The plan of a fleet: which bags are replayed, and how; a file beside the table."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import trainid_ros
from trainid_ros.fleet.files import write_whole
from trainid_ros.fleet.labels import LABELS
from trainid_ros.mapping.mapping import Signal
from trainid_ros.mapping.mapping_file import load_mapping

if TYPE_CHECKING:
    from collections.abc import Mapping

_FORMAT: Final = 1
_FILES: Final = ('train', 'params', 'mapping')


@dataclass(frozen=True, slots=True)
class PlannedBag:
    """One bag as listed.

    Attributes:
        path: The bag.
        size: Size of its files [bytes].
        modified_ns: When they were changed last [ns].
        start_s: Time of its first message [s], None if it has no index.
        messages: Number of messages, None if it has no index.
        train: Label of the train, '' if unknown; the other labels likewise.
        line: Line.
        weather: Weather.
        day: Day, YYYY-MM-DD.
        error: Why it cannot be used, '' if it can.

    """

    path: str
    size: int = 0
    modified_ns: int = 0
    start_s: float | None = None
    messages: int | None = None
    train: str = ''
    line: str = ''
    weather: str = ''
    day: str = ''
    error: str = ''


@dataclass(frozen=True, slots=True)
class Setup:
    """How all bags are replayed; files by their paths.

    Attributes:
        train: Train file.
        params: ROS parameter file, None for the defaults.
        mapping: Mapping file, None for our own topics.
        namespace: Namespace of the topics.
        max_chunk: Largest chunk of a bag to unpack [bytes].

    """

    train: Path
    params: Path | None
    mapping: Path | None
    namespace: str
    max_chunk: int


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done.

    Attributes:
        setup: How.
        hashes: SHA-256 of the files of the setup by name, '' for those not given.
        revision: What computes.
        bags: The bags.

    """

    setup: Setup
    hashes: dict[str, str]
    revision: str
    bags: tuple[PlannedBag, ...]

    def key(self, bag: PlannedBag) -> str:
        """Return a digest of all that determines the row of a bag but its labels: the same digest, the same numbers."""
        listed = {name: value for name, value in asdict(bag).items() if name not in LABELS}
        setup = (*sorted(self.hashes.items()), self.setup.namespace, self.setup.max_chunk, self.revision)
        return sha256(json.dumps([listed, *setup]).encode()).hexdigest()[:32]

    def to_json(self) -> dict[str, Any]:
        """Return the contents of the file."""
        setup = {name: None if value is None else str(value) for name, value in asdict(self.setup).items()}
        return {
            'format': _FORMAT,
            'revision': self.revision,
            'setup': {**setup, 'max_chunk': self.setup.max_chunk},
            'sha256': self.hashes,
            'bags': [asdict(bag) for bag in self.bags],
        }

    def write(self, path: Path) -> None:
        """Write the plan.

        Raises:
            InputError: It cannot be written.

        """
        write_whole(path, lambda part: part.write_text(json.dumps(self.to_json(), indent=1) + '\n', encoding='utf-8'))


def setup_of(plan: Mapping[str, Any]) -> Setup | None:
    """Return the setup of a plan as written, None if it holds none."""
    try:
        found = plan['setup']
        train, params, mapping = (None if found.get(name) is None else Path(found[name]) for name in _FILES)
        return Setup(train or Path(), params, mapping, str(found['namespace']), int(found['max_chunk']))
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def setup_in(path: Path) -> Setup | None:
    """Return the setup of a file with a plan, None without one."""
    try:
        return setup_of(json.loads(path.read_text(encoding='utf-8')))
    except (OSError, ValueError):
        return None


def bags_in(path: Path) -> frozenset[str]:
    """Return the paths of the bags in a file with a plan, none without one."""
    try:
        return frozenset(bag['path'] for bag in json.loads(path.read_text(encoding='utf-8'))['bags'])
    except (OSError, ValueError, KeyError, TypeError):
        return frozenset()


def make_plan(setup: Setup, bags: tuple[PlannedBag, ...]) -> Plan:
    """Return the plan of bags; OSError or InputError if a file of the setup cannot be read."""
    files: dict[str, Path | None] = {name: getattr(setup, name) for name in _FILES}
    read: dict[str, tuple[Path, ...]] = {name: () if path is None else (path,) for name, path in files.items()}
    if setup.mapping is not None:
        read['mapping'] = (setup.mapping, *_functions(setup.mapping))
    return Plan(setup, {name: _hash_of(paths) for name, paths in read.items()}, revision(), bags)


def _functions(mapping: Path) -> tuple[Path, ...]:
    """Return the files with the user functions of a mapping."""
    read = load_mapping(mapping)
    signals = (getattr(read, item.name) for item in fields(read))
    functions = (signal.function for signal in signals if isinstance(signal, Signal))
    return tuple(sorted({function.path for function in functions if function is not None}))


def _hash_of(paths: tuple[Path, ...]) -> str:
    """Return the digest of files, '' of none."""
    return sha256(b'\0'.join(path.read_bytes() for path in paths)).hexdigest() if paths else ''


def revision() -> str:
    """Return the version and a digest of all sources."""
    folder = Path(trainid_ros.__file__).parent
    total = sha256()
    for path in sorted(folder.rglob('*.py')):
        total.update(path.relative_to(folder).as_posix().encode() + b'\0' + path.read_bytes())
    return f'{trainid_ros.__version__}+{total.hexdigest()[:12]}'

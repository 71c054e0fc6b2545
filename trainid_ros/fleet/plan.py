# SPDX-License-Identifier: Apache-2.0
"""The plan of a fleet: which bags are replayed, from which train and day each is, and how; a file beside the table.

Bags are found in folders and by patterns, and listed from metadata and index: no message is decoded. Train, line,
weather and day of a bag come from its path or from the custom data that was recorded with it.
"""

from __future__ import annotations

import json
import re
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from datetime import UTC, date, datetime
from glob import glob, has_magic
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import trainid_ros
from trainid_ros.bag.bag_files import METADATA, SUFFIXES, bags_below, locate
from trainid_ros.bag.record_file import RecordFile
from trainid_ros.inputs.mapping import Signal, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_whole
from trainid_ros.interface.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from trainid_ros.fleet.table_file import Row

LABELS: Final = ('train', 'line', 'weather', 'day')
"""What is known of a bag besides its messages; columns of the table."""
# Without a pattern of the user and without a namespace, the train has the name of the folder that holds the bag.
_DEFAULT_PATTERN: Final = r'(?P<train>[^/]+)/[^/]+$'


@dataclass(frozen=True, slots=True)
class PlannedBag:
    """One bag as listed."""

    path: str  # The bag
    size: int = 0  # Size of its files [bytes]
    modified_ns: int = 0  # When they were changed last [ns]
    start_s: float | None = None  # Time of its first message [s], None if it has no index
    messages: int | None = None  # Number of messages, None if it has no index
    train: str = ''  # Label of the train, '' if unknown; the other labels likewise
    line: str = ''  # Line
    weather: str = ''  # Weather
    day: str = ''  # Day, YYYY-MM-DD
    error: str = ''  # Why it cannot be used, '' if it can


@dataclass(frozen=True, slots=True)
class Setup:
    """How all bags are replayed; files by their paths."""

    train: Path  # Train file
    params: Path | None  # ROS parameter file, None for the defaults
    mapping: Path | None  # Mapping file, None for our own topics
    namespace: str  # Namespace of the topics
    max_chunk: int  # Largest chunk of a bag to unpack [bytes]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done."""

    setup: Setup  # How
    hashes: dict[str, str]  # SHA-256 of the files of the setup by name, '' for those not given
    revision: str  # What computes
    bags: tuple[PlannedBag, ...]  # The bags

    def key(self, bag: PlannedBag) -> str:
        """Return a digest of all that determines the row of a bag but its labels: the same digest, the same numbers."""
        listed = {name: value for name, value in asdict(bag).items() if name not in LABELS}
        setup = (*sorted(self.hashes.items()), self.setup.namespace, self.setup.max_chunk, self.revision)
        return sha256(json.dumps([listed, *setup]).encode()).hexdigest()[:32]

    def to_json(self) -> dict[str, Any]:
        """Return the contents of the file."""
        setup = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self.setup).items()}
        return {
            'format': 1,
            'revision': self.revision,
            'setup': setup,
            'sha256': self.hashes,
            'bags': [asdict(bag) for bag in self.bags],
        }

    def write(self, path: Path) -> None:
        """Write the plan; InputError if it cannot be written."""
        write_whole(path, lambda part: part.write_text(json.dumps(self.to_json(), indent=1) + '\n', encoding='utf-8'))


class FleetRun(NamedTuple):
    """A row as read from a table, and how that was made, None if its plan is missing."""

    row: Row
    setup: Setup | None


def plan_file(table: Path) -> Path:
    """Return the path of the plan of a table."""
    return table.with_name(f'{table.name}.plan.json')


def read_plan(table: Path) -> dict[str, Any]:
    """Return the plan of a table as written, empty if there is none."""
    try:
        found = json.loads(plan_file(table).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def setup_of(plan: Mapping[str, Any]) -> Setup | None:
    """Return the setup of a plan as written, None if it holds none."""
    try:
        found = plan['setup']
        train, params, mapping = (found.get(name) and Path(found[name]) for name in ('train', 'params', 'mapping'))
        return Setup(train or Path(), params, mapping, str(found['namespace']), int(found['max_chunk']))
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def make_plan(setup: Setup, bags: tuple[PlannedBag, ...]) -> Plan:
    """Return the plan of bags; OSError or InputError if a file of the setup cannot be read."""
    functions: set[Path] = set()  # files with the user functions of the mapping
    if setup.mapping is not None:
        read = load_mapping(setup.mapping)
        signals = [getattr(read, item.name) for item in fields(read)]
        functions = {s.function.path for s in signals if isinstance(s, Signal) and s.function is not None}
    files = {'train': (setup.train,), 'params': (setup.params,), 'mapping': (setup.mapping, *sorted(functions))}
    contents = {name: [path.read_bytes() for path in paths if path is not None] for name, paths in files.items()}
    hashes = {name: sha256(b'\0'.join(found)).hexdigest() if found else '' for name, found in contents.items()}
    return Plan(setup, hashes, _revision(), bags)


def _revision() -> str:
    """Return the version and a digest of all sources."""
    folder = Path(trainid_ros.__file__).parent
    total = sha256()
    for path in sorted(folder.rglob('*.py')):
        total.update(path.relative_to(folder).as_posix().encode() + b'\0' + path.read_bytes())
    return f'{trainid_ros.__version__}+{total.hexdigest()[:12]}'


@dataclass(frozen=True, slots=True)
class LabelRule:
    """How labels are found."""

    # Regular expression that is searched in the absolute path as it is given, or else with links resolved; its named
    # groups are labels
    pattern: re.Pattern[str]
    is_given: bool  # True if the user gave it: then it comes before the custom data, else after
    # Namespace of the train, without the first slash; '' without one. It is the train unless the user's pattern or the
    # custom data name another; a folder may be that of several trains.
    namespace: str

    def labels(self, path: Path, custom: Mapping[str, str]) -> dict[str, str]:
        """Return the labels of a bag by name, '' where unknown.

        Raises:
            InputError: The pattern was given, but does not fit the path.
        """
        places = (path.absolute(), path.resolve())
        match = next(filter(None, (self.pattern.search(place.as_posix()) for place in places)), None)
        if match is None and self.is_given:
            raise InputError(f"{path}: --label '{self.pattern.pattern}' does not fit the path")
        found = {} if match is None else {name: text for name, text in match.groupdict().items() if text}
        if self.namespace:
            custom = {'train': self.namespace, **custom}
        both = {**custom, **found} if self.is_given else {**found, **custom}
        return {name: both.get(name, '') for name in LABELS}


def label_rule(pattern: str | None, namespace: str = '/') -> LabelRule:
    """Return the rule of a pattern, or the default without one, for the train in a namespace.

    Raises:
        InputError: The pattern is no regular expression, or has no group or another one than the labels.
    """
    try:
        compiled = re.compile(pattern or _DEFAULT_PATTERN)
    except re.error as error:
        raise InputError(f"--label '{pattern}': {error}") from None
    unknown = sorted(set(compiled.groupindex) - set(LABELS))
    if unknown or not compiled.groupindex:
        problem = f'has a group {unknown[0]!r}' if unknown else 'has no named group such as (?P<train>[^/]+)'
        raise InputError(f"--label '{pattern}': {problem}; the labels are " + ', '.join(LABELS))
    return LabelRule(compiled, is_given=pattern is not None, namespace=namespace.strip('/'))


def day_of(label: str, start_s: float | None, where: Path) -> str | None:
    """Return a day as YYYY-MM-DD: that of the label, or of the start [s] in UTC; None without either.

    Raises:
        InputError: The label is no day.
    """
    if label:
        try:
            return date.fromisoformat(label.replace('_', '-')).isoformat()
        except ValueError:
            raise InputError(f'{where}: label day {label!r} is not a day such as 2026-01-31') from None
    return None if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()


def find_bags(given: Sequence[Path]) -> list[Path]:
    """Return the absolute paths of the bags named, in a named folder or fitting a pattern; each once, in order of path.

    Raises:
        InputError: A path does not exist, or holds no bag.
    """
    found: dict[Path, Path] = {}
    for path in given:
        places = [path]
        if not path.exists():
            if not has_magic(str(path)):
                raise InputError(f'{path}: no such bag or folder')
            places = [Path(name) for name in glob(str(path), recursive=True)]  # noqa: PTH207 - may be absolute
        bags = sorted(bag for place in places for bag in bags_below(place))
        if not bags:
            raise InputError(f'{path}: holds no bag (neither {METADATA} nor a file {" or ".join(SUFFIXES)})')
        for bag in bags:
            found.setdefault(bag.resolve(), bag.absolute())  # a report may be made from another folder
    return list(found.values())


def list_bags(
    bags: Sequence[Path], rule: LabelRule, advance: Callable[[float], None] = lambda _: None
) -> tuple[PlannedBag, ...]:
    """Return the bags as they are listed in the plan; one that cannot be used has an error."""
    listed = []
    for bag in bags:
        listed.append(_list(bag, rule))
        advance(1.0)
    return tuple(listed)


def _list(path: Path, rule: LabelRule) -> PlannedBag:
    try:
        located = locate(path)
        stats = [file.stat() for file in located.files]
        size, modified_ns = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
        start_s, messages = _statistics(located.files)
        labels = rule.labels(path, dict(located.custom_data))
        labels['day'] = day_of(labels['day'], start_s, path) or ''
    except InputError as error:
        return PlannedBag(str(path), error=str(error))
    except OSError as error:
        return PlannedBag(str(path), error=f'{error.filename or path}: {error.strerror}')
    return PlannedBag(str(path), size, modified_ns, start_s, messages, **labels)


def _statistics(files: Iterable[Path]) -> tuple[float | None, int | None]:
    """Return time of the first message [s] and number of messages by the index of all files, None if it is missing."""
    first_ns, messages = [], 0
    for path in files:
        with closing(RecordFile(path)) as file:
            statistics = file.summary().statistics if file.is_closed else None
        if statistics is None:
            return None, None
        messages += statistics.message_count
        if statistics.message_count:
            first_ns.append(statistics.message_start_time)
    return (min(first_ns) / NS_PER_S if first_ns else None), messages

# SPDX-License-Identifier: Apache-2.0
"""The table of a fleet, one row per bag, as Parquet, with units, or as CSV; and its plan, in a file beside it.

The plan says which bags are replayed, from which train and day each is, and how. Bags are found in folders and by
patterns, and listed from metadata and index: no message is decoded. Train, line, weather and day of a bag come from its
path or from the custom data that was recorded with it.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from datetime import UTC, date, datetime
from glob import glob, has_magic
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, NamedTuple

import trainid_ros
from trainid_ros.bag.bag_files import METADATA, SUFFIXES, bags_below, locate
from trainid_ros.bag.mcap_file import RecordFile
from trainid_ros.inputs.mapping import Signal, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_whole
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Estimate,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
    parameters,
    quantities,
)

Row = dict[str, Any]
"""Values by name of the column; None where a value is not known. Times are in seconds since 1970 (UTC)."""

SPEEDS: Final = (10, 15, 20)
"""Speeds at which the resistance is stated [m/s]."""


class Column(NamedTuple):
    """One column."""

    name: str
    kind: str  # 'text', 'float', 'int' or 'time'
    unit: str  # Unit, '' for text; '1' for ratios and counts
    text: str  # What it is


def reason_column(reason: Reason) -> str:
    """Return the column with the number of rejections for a reason."""
    return f'rejected_{reason.name.lower()}'


def share_column(status: Status) -> str:
    """Return the column with the share of outputs that had a status."""
    return f'share_{status.name.lower()}'


_REASONS: Final = tuple(reason for reason in Reason if reason not in (Reason.NONE, Reason.THINNED))


def _field(kind: type[Estimate], *names: str) -> Iterator[Column]:
    known = quantities(kind)
    return (Column(name, 'float', known[name].unit, known[name].text) for name in names)


def _with_std(name: str, unit: str, text: str) -> tuple[Column, Column]:
    return Column(name, 'float', unit, text), Column(f'{name}_std', 'float', unit, f'standard deviation of {name}')


_DAVIS: Final = tuple(_field(ResistanceEstimate, *parameters(ResistanceEstimate)))
COLUMNS: Final = (
    Column('bag', 'text', '', 'absolute path of the bag'),
    Column('train', 'text', '', 'train, from --label, --namespace or the custom data of the bag'),
    Column('line', 'text', '', 'line, from --label or the custom data of the bag'),
    Column('day', 'text', '', 'day, YYYY-MM-DD: as line, or that of the start in UTC'),
    Column('weather', 'text', '', 'weather, as line'),
    Column('start', 'time', 's', 'log time of the first message'),
    Column('duration_s', 'float', 's', 'time covered by the samples'),
    Column('status', 'text', '', 'status of the resistance at the end; empty if the bag was not replayed'),
    Column('error', 'text', '', 'why there is no estimate'),
    *_DAVIS,
    *(column._replace(name=f'{column.name}_std', text=f'standard deviation of {column.name}') for column in _DAVIS),
    *(column for speed in SPEEDS for column in _with_std(f'w{speed}', 'N/kN', f'running resistance at {speed} m/s')),
    *_field(ResistanceEstimate, 'speed_min', 'speed_max'),
    *_field(BrakeRateEstimate, 'brake_rate', 'brake_rate_std'),
    Column('brake_status', 'text', '', 'status of the brake rate at the end'),
    *_with_std('dead_time', 's', 'dead time of the brake; empty where none was learned'),
    *_field(ResistanceEstimate, 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'),
    *_with_std('wheel_ratio', '1', 'distance by the speed over that by the position, from stop to stop'),
    *_field(SpeedModelEstimate, 'mass_factor'),
    Column('used', 'int', '1', 'samples that the resistance was learned from'),
    Column('brake_used', 'int', '1', 'samples that the brake rate was learned from'),
    Column('rejected', 'int', '1', 'records and samples that the resistance was not learned from'),
    *(Column(reason_column(reason), 'int', '1', f'of these: {reason.name}') for reason in _REASONS),
    *(Column(share_column(status), 'float', '1', f'share of outputs that were {status.name}') for status in Status),
    Column('contradiction', 'text', '', 'last contradiction between the inputs: no estimate of this run is compared'),
    Column('finding', 'text', '', 'errors of the force and of the brake that were found'),
    Column('warnings', 'text', '', 'faults of the bag that do not prevent reading'),
    Column('revision', 'text', '', 'version of trainid_ros and digest of the modules that compute'),
)
NAMES: Final = tuple(column.name for column in COLUMNS)


def empty_row() -> Row:
    """Return a row without values."""
    return dict.fromkeys(NAMES)


_META: Final = b'trainid_fleet'  # Key of the metadata that hold the plan


def check_table(path: Path) -> None:
    """Raise InputError if a table cannot be written to a path: its type is not known, or pyarrow is missing."""
    if path.suffix not in ('.parquet', '.csv'):
        raise InputError(f'{path}: a table ends with .parquet or .csv')
    if path.suffix == '.parquet':
        import pyarrow.parquet  # noqa: F401, PLC0415 - optional


def write_table(rows: Sequence[Row], path: Path, about: Mapping[str, Any]) -> None:
    """Write a table; ``about`` goes to the metadata of a Parquet file. InputError if it cannot be written."""
    if path.suffix == '.csv':
        write_whole(path, lambda part: _write_csv(rows, part))
    else:
        write_whole(path, lambda part: _write_parquet(rows, part, about))


def read_table(path: Path) -> tuple[list[Row], dict[str, Any]]:
    """Return the rows of a table and what its metadata say of the plan; missing columns are None.

    InputError if it cannot be read, or lacks the columns that every table has.
    """
    try:
        path.open('rb').close()  # pyarrow does not say why it cannot
        rows, about = _read_csv(path) if path.suffix == '.csv' else _read_parquet(path)
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror})') from None
    except ValueError as error:  # of pyarrow and csv
        raise InputError(f'{path}: is not a table of trainid fleet ({" ".join(str(error).split())[:200]})') from None
    return [empty_row() | row for row in rows], about


def _require(names: Sequence[str]) -> None:
    for name in ('bag', 'train', 'day', 'w15', 'w15_std'):
        if name not in names:
            raise ValueError(f'column {name} is missing')


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, NAMES)
        writer.writeheader()
        for row in rows:
            start = None if row['start'] is None else datetime.fromtimestamp(row['start'], UTC).isoformat()
            writer.writerow(row | {'start': start})


def _read_csv(path: Path) -> tuple[list[Row], dict[str, Any]]:
    convert: dict[str, Callable[[str], Any]] = {
        'text': str,
        'float': float,
        'int': int,
        'time': lambda text: datetime.fromisoformat(text).timestamp(),
    }
    kinds = {column.name: convert[column.kind] for column in COLUMNS}
    with path.open(encoding='utf-8', newline='') as file:
        reader = csv.DictReader(file)
        _require(reader.fieldnames or ())
        rows = [{name: kinds[name](text) for name, text in row.items() if name in kinds and text} for row in reader]
    return rows, {}


def _write_parquet(rows: Sequence[Row], path: Path, about: Mapping[str, Any]) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    kinds = {'text': pa.string(), 'float': pa.float64(), 'int': pa.int64(), 'time': pa.timestamp('us', tz='UTC')}
    fields = [
        pa.field(column.name, kinds[column.kind], metadata={'unit': column.unit, 'description': column.text})
        for column in COLUMNS
    ]
    schema = pa.schema(fields, metadata={_META: json.dumps(about).encode()})
    stored = [row | {'start': None if row['start'] is None else round(1e6 * row['start'])} for row in rows]
    columns = {name: [row[name] for row in stored] for name in NAMES}
    parquet.write_table(pa.table(columns, schema=schema), path, compression='zstd')


def _read_parquet(path: Path) -> tuple[list[Row], dict[str, Any]]:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    table = parquet.read_table(path)
    _require(table.column_names)
    kept = table.select([name for name in NAMES if name in table.column_names])
    if 'start' in kept.column_names:
        at = kept.column_names.index('start')
        kept = kept.set_column(at, 'start', kept['start'].cast(pa.timestamp('us', tz='UTC')).cast(pa.int64()))
    rows = kept.to_pylist()
    for row in rows:
        if row.get('start') is not None:
            row['start'] /= 1e6
    return rows, json.loads((table.schema.metadata or {}).get(_META, b'{}'))


LABELS: Final = ('train', 'line', 'weather', 'day')
"""What is known of a bag besides its messages; columns of the table."""


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
        bags = [asdict(bag) for bag in self.bags]
        return {'format': 1, 'revision': self.revision, 'setup': setup, 'sha256': self.hashes, 'bags': bags}

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


LabelRule = Callable[[Path, Mapping[str, str]], dict[str, str]]
"""Gives the labels of a bag by its path and its custom data, '' where unknown."""


def label_rule(pattern: str | None, namespace: str = '/') -> LabelRule:
    """Return the rule of a pattern or the default one, for the train in a namespace; InputError for a bad pattern.

    Groups of the pattern are labels, searched in the absolute path as given, else with links resolved. A pattern of the
    user comes before the custom data, the default one after. The namespace is the train unless they name another. The
    rule raises InputError if a pattern of the user does not fit the path.
    """
    try:
        # Without a pattern and a namespace, the train has the name of the folder that holds the bag.
        compiled = re.compile(pattern or r'(?P<train>[^/]+)/[^/]+$')
    except re.error as error:
        raise InputError(f"--label '{pattern}': {error}") from None
    unknown = sorted(set(compiled.groupindex) - set(LABELS))
    if unknown or not compiled.groupindex:
        problem = f'has a group {unknown[0]!r}' if unknown else 'has no named group such as (?P<train>[^/]+)'
        raise InputError(f"--label '{pattern}': {problem}; the labels are " + ', '.join(LABELS))

    def labels(path: Path, custom: Mapping[str, str]) -> dict[str, str]:
        places = (path.absolute(), path.resolve())
        match = next(filter(None, (compiled.search(place.as_posix()) for place in places)), None)
        if match is None and pattern is not None:
            raise InputError(f"{path}: --label '{compiled.pattern}' does not fit the path")
        found = {} if match is None else {name: text for name, text in match.groupdict().items() if text}
        if train := namespace.strip('/'):
            custom = {'train': train, **custom}
        both = {**custom, **found} if pattern is not None else {**found, **custom}
        return {name: both.get(name, '') for name in LABELS}

    return labels


def day_of(label: str, start_s: float | None, where: Path) -> str | None:
    """Return the day, YYYY-MM-DD, of a label or else of the start [s] in UTC; InputError if the label is none."""
    if not label:
        return None if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()
    try:
        return date.fromisoformat(label.replace('_', '-')).isoformat()
    except ValueError:
        raise InputError(f'{where}: label day {label!r} is not a day such as 2026-01-31') from None


def find_bags(given: Sequence[Path]) -> list[Path]:
    """Return the absolute paths of bags, those in folders and those that fit patterns, each once, in order of path.

    InputError if a path does not exist, or holds no bag.
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
        labels = rule(path, dict(located.custom_data))
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

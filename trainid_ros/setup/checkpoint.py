# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: the complete state of one estimator, its provenance, and a digest over both.

A file is replaced atomically, so that a process may be killed at any time. It is valid JSON in three lines: what the
state fits, the state, and the digest of both. What is being written is locked until it is complete: a temporary file
without a lock was left by a process that was killed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import stat
import tempfile
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from trainid_ros import __version__
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from _typeshed import DataclassInstance

    from trainid_ros.setup.pipelines import EstimatorSettings
    from trainid_ros.train.train_file import TrainFile

Values: TypeAlias = 'dict[str, int | float | str]'

SUFFIX: Final = '.json'
# Version of the format: it changes with the lines, or with the names in a state.
_FORMAT: Final = 14
# Marks at the begin of the first, second and third line.
_PACKAGE: Final = '"package": "trainid_ros"'
_STATE: Final = '"state": '
_END: Final = re.compile(r',\n"sha256": "([0-9a-f]{64})"\}\n')
# Length of begin and end by which a checkpoint, also a damaged one, is recognised [characters].
_HEAD: Final = 200
# Size of a file that certainly is none [bytes]; a checkpoint has some 100 kB.
_MAX_BYTES: Final = 64 * 2**20


def default_path(node: str) -> Path:
    """Return the default checkpoint path of a node, given its fully qualified name."""
    home = os.environ.get('ROS_HOME')
    base = Path(home) if home else Path.home() / '.ros'
    return base.joinpath('trainid', *node.strip('/').split('/')).with_suffix(SUFFIX)


class ForeignFileError(InputError):
    """A file is no checkpoint, or that of another node, and must not be overwritten."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """What a saved state was learned with, and so fits."""

    version: str  # Version of the package
    estimate: str  # What is estimated, as in EstimatorSettings
    algorithm: str  # Name of the algorithm
    values: Values  # Numbers of the train file and settings by name; a digest in place of a table

    def mismatch(self, other: Provenance) -> str:
        """Return in one sentence why a state of this provenance does not fit another one, empty if it does."""
        if self.version != other.version:
            return f'was written by version {self.version} of trainid_ros, this is {other.version}'
        if self.algorithm != other.algorithm:
            return f'is of {self.algorithm}, not of {other.algorithm}'
        names = [name for name in {**other.values, **self.values} if self.values.get(name) != other.values.get(name)]
        shown = [f'{name} = {self.values.get(name)}, here {other.values.get(name)}' for name in names[:3]]
        more = f', and {len(names) - 3} more' if len(names) > 3 else ''
        return f'is of another train or other settings: {"; ".join(shown)}{more}' if names else ''


def provenance_of(estimate: str, train_file: TrainFile, settings: EstimatorSettings) -> Provenance:
    """Return what a state is learned with: the train file with all overrides, and the settings."""
    choice = getattr(settings, estimate)
    effects = [(item.name, item.parameters, item.std) for item in train_file.effects]
    values: Values = {'effects': _brief(effects)}
    for section in ('train', 'resistance', 'brake', 'line'):
        values |= _named(section, getattr(train_file, section))
    values |= _named('alignment', settings.alignment) | _named('estimator', choice.config)
    for name in ('valid_std', 'valid_share'):  # they only decide the status of an estimate, and may differ
        values.pop(f'estimator.{name}', None)
    return Provenance(__version__, estimate, choice.algorithm, values)


def _named(section: str, values: DataclassInstance) -> Values:
    return {f'{section}.{item.name}': _brief(getattr(values, item.name)) for item in fields(values)}


def _brief(value: object) -> int | float | str:
    if isinstance(value, int | float | str):
        return value
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Saved state of an estimator."""

    provenance: Provenance  # What it was learned with
    saved_ns: int  # Node time at which it was saved [ns], 0 if there was none
    stamp_ns: int  # Stamp of the newest sample used [ns], 0 if there was none
    state: str  # State as returned by the pipeline's ``save``, JSON in one line

    def text(self) -> str:
        """Return the content of the file."""
        head = {'package': 'trainid_ros', 'format': _FORMAT, **asdict(self.provenance)}
        head |= {'saved_ns': self.saved_ns, 'stamp_ns': self.stamp_ns}
        content = f'{json.dumps(head)[:-1]},\n{_STATE}{self.state}'
        return f'{content},\n"sha256": "{_digest(content)}"}}\n'

    def age_s(self, now_ns: int) -> float | None:
        """Return the time since it was saved [s], by node time; None if unknown, as after a clock was set back."""
        return (now_ns - self.saved_ns) * 1e-9 if self.saved_ns and now_ns >= self.saved_ns else None


def _digest(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


def parse_checkpoint(text: str, source: str) -> Checkpoint:
    """Return the checkpoint in the content of a file; ForeignFileError if it is something else.

    InputError, which starts with the source, if it is damaged, or of another format.
    """
    end = _END.search(text, max(len(text) - _HEAD, 0))
    if not (_PACKAGE in text[:_HEAD] or end or not text.strip('\0 \n')):
        raise ForeignFileError(f'{source}: is not a checkpoint of this package')
    if (other := re.search(r'"format": (\d{1,9}),', text[:_HEAD])) and int(other[1]) != _FORMAT:
        raise InputError(f'{source}: checkpoint of format {other[1]}, this version reads format {_FORMAT}')
    if end is None or end.end() != len(text) or _digest(text[: end.start()]) != end[1]:
        raise InputError(f'{source}: checkpoint is damaged: its content does not match its sha256')
    head, _, state = text[: end.start()].partition(f',\n{_STATE}')
    kinds = {'version': str, 'estimate': str, 'algorithm': str, 'values': dict, 'saved_ns': int, 'stamp_ns': int}
    try:
        stated = json.loads(f'{head}}}')
        version, estimate, algorithm, values, saved_ns, stamp_ns = (stated[name] for name in kinds)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f'{source}: checkpoint is invalid: {type(error).__name__} {error}') from None
    for name, kind in kinds.items():
        if type(stated[name]) is not kind:
            raise InputError(f'{source}: checkpoint is invalid: TypeError {name} is not a {kind.__name__}')
    return Checkpoint(Provenance(version, estimate, algorithm, values), saved_ns, stamp_ns, state)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Return what a file holds, None if there is none; InputError if that is unusable, ForeignFileError if foreign."""
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise ForeignFileError(f'{path}: is not a file')
        if found.st_size > _MAX_BYTES:
            raise ForeignFileError(f'{path}: is not a checkpoint: {found.st_size} bytes, at most {_MAX_BYTES}')
        return parse_checkpoint(path.read_text(encoding='utf-8', errors='replace'), str(path))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f'{path}: checkpoint cannot be read: {error.strerror or error}') from error


class CheckpointFile:
    """One checkpoint file, which only one node may write.

    Attributes:
        path: Where it is; a link is followed, and stays.
    """

    def __init__(self, path: Path) -> None:
        """Prepare; InputError if this can be no checkpoint file, ForeignFileError if it is something else."""
        self.path = Path(os.path.realpath(path))
        if not path.suffix == self.path.suffix == SUFFIX:
            raise InputError(f'checkpoint_file = {str(path)!r} must end in {SUFFIX}, and so must what it links to')
        _remove_parts(self.path)
        self._seen = self._identity()
        self._unmoved = ''
        try:
            read_checkpoint(self.path)
        except ForeignFileError:
            raise
        except InputError:
            return  # to be reported when it is read

    def read(self, provenance: Provenance) -> Checkpoint | None:
        """Return the checkpoint; None if there is no file. ForeignFileError if it is that of another estimate.

        InputError, which says why, if the file cannot be read, is damaged or does not fit.
        """
        checkpoint = read_checkpoint(self.path)
        if checkpoint is None:
            return None
        if (found := checkpoint.provenance).estimate != provenance.estimate:
            raise ForeignFileError(
                f'{self.path}: is a checkpoint of {found.algorithm}: each node needs a checkpoint file of its own'
            )
        if reason := found.mismatch(provenance):
            raise InputError(f'{self.path}: checkpoint {reason}')
        return checkpoint

    def write(self, checkpoint: Checkpoint) -> None:
        """Replace the file once the new one is safely on disk; InputError if that fails, or another has written it."""
        if self._unmoved:
            self.set_aside()
        found = self._identity()
        if found is not None and found != self._seen:
            reason = self._unmoved or 'was written by another node: each node needs a checkpoint file of its own'
            raise InputError(f'{self.path}: {reason}')
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._seen = _replace(self.path, checkpoint.text().encode())
            with _opened(self.path.parent, os.O_DIRECTORY) as folder:
                os.fsync(folder)  # so that the renaming lasts
        except OSError as error:
            raise InputError(f'{self.path}: checkpoint cannot be written: {error.strerror or error}') from error

    def set_aside(self) -> Path:
        """Rename a file that was refused, so that it is not overwritten; return its new name.

        Only the newest five of such files are kept.
        """
        name = re.compile(rf'{re.escape(self.path.stem)}\.refused-([0-9]{{1,9}}){re.escape(SUFFIX)}')
        try:
            found = (name.fullmatch(item.name) for item in self.path.parent.iterdir())
            numbers = [int(match[1]) for match in found if match]
            aside = self._aside(max(numbers, default=0) + 1)
            self.path.rename(aside)
        except OSError as error:
            self._seen = None  # so that it is not overwritten either
            self._unmoved = f'was refused and cannot be renamed: {error.strerror or error}'
            return self.path
        self._unmoved = ''
        for number in sorted(numbers)[:-4]:
            with suppress(OSError):
                self._aside(number).unlink()
        return aside

    def _aside(self, number: int) -> Path:
        return self.path.with_suffix(f'.refused-{number}{SUFFIX}')

    def _identity(self) -> tuple[int, int] | None:
        try:
            return _identity_of(self.path.stat())
        except OSError:
            return None


def _identity_of(found: os.stat_result) -> tuple[int, int]:
    return found.st_ino, found.st_mtime_ns


def _replace(path: Path, content: bytes) -> tuple[int, int]:
    """Replace a file once the new one is safely on disk; return the identity of the new one."""
    handle, part = _locked_part(path)
    with os.fdopen(handle, 'wb') as file:
        try:
            file.write(content)
            file.flush()
            os.fsync(handle)
            identity = _identity_of(os.fstat(handle))
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    return identity


def _locked_part(path: Path) -> tuple[int, Path]:
    """Make a temporary file beside a file, which no other process removes; return its handle and its path."""
    while True:
        handle, name = tempfile.mkstemp('.part', f'.{path.name}.', path.parent)
        with suppress(OSError):  # this file system has no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:
            return handle, Path(name)
        os.close(handle)  # removed before it was locked


def _remove_parts(path: Path) -> None:
    """Remove the temporary files of a file that were left by processes which have ended."""
    with suppress(OSError):
        for part in path.parent.iterdir():
            if part.name.startswith(f'.{path.name}.') and part.name.endswith('.part'):
                with suppress(OSError), _opened(part, os.O_NOFOLLOW | os.O_NONBLOCK) as handle:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    part.unlink()


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        yield handle
    finally:
        os.close(handle)

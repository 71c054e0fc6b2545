# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: the complete state of one estimator, replaced atomically."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Final

from trainid_ros.errors import InputError

_FORMAT: Final = 2
_DIGEST: Final = 'state_sha256'


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Saved state of an estimator.

    Attributes:
        version: Version of the package that wrote it.
        estimator: Name of the estimator.
        saved_ns: Node time at which it was written [ns].
        stamp_ns: Stamp of the newest sample used [ns], 0 if there was none.
        state: State as returned by the estimator's ``save``.

    """

    version: str
    estimator: str
    saved_ns: int
    stamp_ns: int
    state: str


def default_path(node: str) -> Path:
    """Return the default checkpoint path of a node, given its fully qualified name."""
    home = os.environ.get('ROS_HOME')
    base = Path(home) if home else Path.home() / '.ros'
    return base.joinpath('trainid', *node.strip('/').split('/')).with_suffix('.json')


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; an existing file is replaced only once the new one is safely on disk.

    Raises:
        InputError: The file cannot be written.

    """
    data = {'format': _FORMAT, 'package': 'trainid_ros', **asdict(checkpoint), _DIGEST: _digest(checkpoint.state)}
    text = json.dumps(data, indent=1) + '\n'
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f'.{path.name}.', dir=path.parent)
        try:
            with os.fdopen(handle, 'w', encoding='utf-8') as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        msg = f'{path}: checkpoint cannot be written: {error.strerror or error}'
        raise InputError(msg) from error


def read_checkpoint(path: Path, estimator: str) -> Checkpoint:
    """Read the checkpoint of an estimator.

    Raises:
        InputError: The file cannot be read, is not a checkpoint, was modified or belongs to another estimator.

    """
    try:
        data = json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        msg = f'{path}: checkpoint cannot be read: {error.strerror or error}'
        raise InputError(msg) from error
    except (ValueError, RecursionError) as error:
        msg = f'{path}: is not a checkpoint: {error}'
        raise InputError(msg) from None
    if not isinstance(data, dict) or data.get('package') != 'trainid_ros' or data.get('format') != _FORMAT:
        msg = f'{path}: is not a checkpoint of this package (format {_FORMAT})'
        raise InputError(msg)
    kinds = {'version': str, 'estimator': str, 'saved_ns': int, 'stamp_ns': int, 'state': str}
    for item in fields(Checkpoint):
        if type(data.get(item.name)) is not kinds[item.name]:
            msg = f'{path}: checkpoint field {item.name} = {data.get(item.name)!r} is invalid'
            raise InputError(msg)
    checkpoint = Checkpoint(**{item.name: data[item.name] for item in fields(Checkpoint)})
    if data.get(_DIGEST) != _digest(checkpoint.state):
        msg = f'{path}: checkpoint is damaged: its state does not match {_DIGEST}'
        raise InputError(msg)
    if checkpoint.estimator != estimator:
        msg = f'{path}: is a checkpoint of {checkpoint.estimator}, not of {estimator}'
        raise InputError(msg)
    return checkpoint


def _digest(state: str) -> str:
    # JSON text may contain an unpaired surrogate, which strict UTF-8 rejects.
    return hashlib.sha256(state.encode('utf-8', 'surrogatepass')).hexdigest()

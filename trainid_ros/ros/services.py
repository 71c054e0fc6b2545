# SPDX-License-Identifier: Apache-2.0
"""Services of the estimator nodes, and checkpoint files: the complete state of one estimator, replaced atomically."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import traceback
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from numpy.linalg import LinAlgError
from std_srvs.srv import Trigger

from trainid_ros import __version__
from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.estimator_node import EstimatorNode

NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, LinAlgError)
"""What arithmetic on an invalid state raises; in old versions of numpy LinAlgError is not a ValueError."""
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


class EstimatorServices:
    """Services ``~/reset``, ``~/save_checkpoint`` and ``~/load_checkpoint``; each responds in every lifecycle state."""

    def __init__(self, node: EstimatorNode) -> None:
        self._node = node
        for name, serve in (('reset', self.reset), ('save_checkpoint', self.save), ('load_checkpoint', self.load)):
            node.create_service(Trigger, f'~/{name}', partial(self._answer, serve))

    def _answer(self, serve: Callable[[EstimatorPipeline[Any]], str], _request: Any, response: Any) -> Any:
        node, logger = self._node, self._node.get_logger()
        if node.pipeline is None:
            response.success, response.message = False, f'{node.get_name()} is {node.state}: configure it first'
            return response
        try:
            response.success, response.message = True, serve(node.pipeline)
        except InputError as error:
            response.success, response.message = False, str(error)
        except NUMERICAL_ERRORS as error:
            node.fail(node.pipeline, traceback.format_exc())
            response.success, response.message = False, f'{type(error).__name__}: {error}'
        # Two calls: rclpy does not allow one line of code to log with different severities.
        if response.success:
            logger.info(response.message)
        else:
            logger.error(response.message)
        return response

    def reset(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Reset the estimator to the prior."""
        pipeline.reset()
        self._node.watchdog.restart()
        return f'reset to the prior; resets so far: {pipeline.resets}'

    def save(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Write the estimator's state to the checkpoint file."""
        node = self._node
        path, stamp_ns = self._path(), pipeline.current().stamp_ns
        state, now_ns = pipeline.save(), int(node.get_clock().now().nanoseconds)
        write_checkpoint(path, Checkpoint(__version__, node.algorithm, now_ns, stamp_ns, state))
        return f'saved {node.algorithm} to {path}'

    def load(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Load the estimator's state from the checkpoint file."""
        path, estimator = self._path(), self._node.algorithm
        checkpoint = read_checkpoint(path, estimator)
        pipeline.restore(checkpoint.state)
        pipeline.current()  # An invalid state must raise here, not when it is published.
        return f'loaded {estimator} from {path} (version {checkpoint.version})'

    def _path(self) -> Path:
        path = str(self._node.parameters.value('checkpoint_file'))
        return Path(path).expanduser() if path else default_path(self._node.get_fully_qualified_name())

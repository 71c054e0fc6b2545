# SPDX-License-Identifier: Apache-2.0
"""The checkpoint of a node: loaded on configure, saved at intervals, and whenever the node pauses.

The state is taken directly after an estimate was published, when there is most time until the next message; another
thread writes it to disk. What a node has learned also survives a cleanup, if it still fits on the next configure.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Status
from trainid_ros.ros.diagnostics import NUMERICAL_ERRORS, shown_time
from trainid_ros.setup.checkpoint import (
    Checkpoint,
    CheckpointFile,
    ForeignFileError,
    Provenance,
    default_path,
    provenance_of,
)

if TYPE_CHECKING:
    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.diagnostics import NodeContext
    from trainid_ros.setup.pipelines import EstimatorSettings
    from trainid_ros.train.train_file import TrainFile


class Checkpoints:
    """Keeps the state of a node's pipeline.

    Attributes:
        is_due: Whether the period is over.
        saved_at: When it was last saved, or nothing had changed, by a steady clock [s].
        is_wiped: Whether a jump of the stamps or the clock has reset the state: until it is usable again, or a user
            requests a reset, a load or a save, the one in the file is the better one.
    """

    def __init__(self, context: NodeContext) -> None:
        self._context, self._node = context, context.node
        self.is_due = self.is_wiped = False
        self.saved_at = 0.0
        self._provenance = Provenance('', '', '', {})
        self._file: CheckpointFile | None = None
        self._kept: Checkpoint | None = None  # What the node had learned at the last cleanup
        self._timer: Any = None
        self._saved: object = None  # Mark of the state saved last
        self._writer = ThreadPoolExecutor(1, 'checkpoint')
        self._writing: Future[None] | None = None

    # Lifecycle

    def open(self, pipeline: EstimatorPipeline[Any], train_file: TrainFile, settings: EstimatorSettings) -> None:
        """Continue from what was learned before, if it fits; InputError if ``checkpoint_file`` cannot be used."""
        path = str(self._context.parameters.value('checkpoint_file'))
        self._provenance = provenance_of(self._context.kind.name, train_file, settings)
        self._file = CheckpointFile(Path(path).expanduser()) if path else None
        kept, self._kept, self._context.unsaved, self._saved, self.is_wiped = self._kept, None, '', None, False
        if kept is not None and not kept.provenance.mismatch(self._provenance):
            self._restore(pipeline, kept)
        elif self._file is not None:
            self._load_at_start(pipeline, self._file)

    def _load_at_start(self, pipeline: EstimatorPipeline[Any], file: CheckpointFile) -> None:
        logger = self._node.get_logger()
        try:
            checkpoint = file.read(self._provenance)
            age = None if checkpoint is None else self._load(pipeline, file, checkpoint)
        except ForeignFileError:
            raise
        except (InputError, *NUMERICAL_ERRORS) as error:
            why = str(error)
            if not isinstance(error, InputError):  # an estimate of the invalid state
                pipeline.reset()
                why = f'{file.path}: checkpoint is invalid: {error}'
            logger.warning(f'{why}; starting from the prior, the file is kept as {file.set_aside()}')
            return
        if age is None:
            logger.info(f'{file.path}: no checkpoint yet')
        else:
            self._saved = _mark(pipeline)
            logger.info(f'continues from {file.path}, saved {age}')

    def resume(self) -> None:
        """Save at intervals from now on."""
        period = float(self._context.parameters.value('checkpoint_period'))
        self._stop_timer()
        if self._file is not None and period > 0.0:
            self._timer = self._node.create_timer(period, self._tick, clock=self._node.steady_clock)

    def pause(self, *, running: bool) -> None:
        """Save no longer at intervals, but once more if the pipeline was running."""
        self._stop_timer()
        if self._context.pipeline is not None and running:
            self.save(self._context.pipeline)

    def close(self, *, running: bool) -> None:
        """Keep what was learned in memory too, for the next configure."""
        self.pause(running=running)
        if (pipeline := self._context.pipeline) is not None and pipeline.samples and self._is_worth_saving(pipeline):
            self._kept = self._checkpoint(pipeline)
        self._file = None

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer, self.is_due = None, False

    # At intervals

    def _tick(self) -> None:
        self.save_if_due()  # where nothing was published for a whole period
        self.is_due = True

    def save_if_due(self) -> None:
        """Begin to save if the period is over and the disk has finished the checkpoint before."""
        pipeline = self._context.pipeline
        if not self.is_due or pipeline is None or (self._writing is not None and not self._writing.done()):
            return
        self.is_due, self.saved_at = False, time.monotonic()
        self._report()
        self._begin(pipeline)

    def _begin(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Hand the state to the writer, if there is a file and the state is new."""
        if self._file is not None and (mark := _mark(pipeline)) != self._saved and self._is_worth_saving(pipeline):
            self._saved = mark
            self._writing = self._writer.submit(self._file.write, self._checkpoint(pipeline))

    def _is_worth_saving(self, pipeline: EstimatorPipeline[Any]) -> bool:
        """Return whether a state may replace the one in the file: after a reset, too, but not after a jump at once."""
        if pipeline.status.is_usable:
            self.is_wiped = False
        return pipeline.status is not Status.FAULT and not self.is_wiped and bool(pipeline.samples or pipeline.resets)

    def save(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Save to the file of the parameter ``checkpoint_file``, if it is given, and wait until that is done."""
        self._report()
        self._begin(pipeline)
        self._report()

    def _report(self) -> None:
        """Wait for the file; log each problem once, and that it is over."""
        if self._writing is None:
            return
        error = self._writing.exception()
        before, self._context.unsaved, self._writing = self._context.unsaved, str(error or ''), None
        if self._context.unsaved:
            self._saved = None
        if self._context.unsaved and self._context.unsaved != before:
            self._node.get_logger().warning(f'{self._context.unsaved}; what is learned from now on would be lost')
        elif before and not self._context.unsaved:
            self._node.get_logger().info('checkpoints are saved again')

    # On request

    def save_on_request(self, pipeline: EstimatorPipeline[Any]) -> Path:
        """Save to the file of the node, or to the default one; return its path; InputError if it cannot be written."""
        self._report()
        file = self._file_or_default()
        if file is not self._file:
            try:
                file.read(self._provenance)
            except ForeignFileError:  # of another estimate
                raise
            except InputError as error:  # of another train
                self._node.get_logger().warning(f'{error}; this file is kept as {file.set_aside()}')
        file.write(self._checkpoint(pipeline))
        self.is_wiped = False
        return file.path

    def load_on_request(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Load the file of the node, or the default one; return what was loaded; InputError if it does not fit."""
        self._report()
        file = self._file_or_default()
        checkpoint = file.read(self._provenance)
        if checkpoint is None:
            raise InputError(f'{file.path}: there is no checkpoint')
        age = self._load(pipeline, file, checkpoint)
        self.is_wiped = False
        return f'{file.path}, saved {age}'

    def _file_or_default(self) -> CheckpointFile:
        return self._file or CheckpointFile(default_path(self._node.get_fully_qualified_name()))

    def text(self) -> str:
        """Return the content of a checkpoint of now, '' before configure."""
        pipeline = self._context.pipeline
        return '' if pipeline is None else self._checkpoint(pipeline).text()

    # Both ways

    def _checkpoint(self, pipeline: EstimatorPipeline[Any]) -> Checkpoint:
        now_ns = self._node.now_ns()
        return Checkpoint(self._provenance, now_ns, pipeline.current().stamp_ns, pipeline.save())

    def _load(self, pipeline: EstimatorPipeline[Any], file: CheckpointFile, checkpoint: Checkpoint) -> str:
        """Continue from what a file holds; return its age as text; an InputError names the file."""
        try:
            return self._restore(pipeline, checkpoint)
        except InputError as error:
            raise InputError(f'{file.path}: checkpoint is invalid: {error}') from error

    def _restore(self, pipeline: EstimatorPipeline[Any], checkpoint: Checkpoint) -> str:
        """Continue from a checkpoint; return its age as text."""
        age_s = checkpoint.age_s(self._node.now_ns())
        pipeline.restore(checkpoint.state, 86_400.0 if age_s is None else age_s)  # as uncertain as after a day
        pipeline.current()  # An invalid state must raise here, not when it is published.
        return 'at an unknown time' if age_s is None else f'{shown_time(age_s)} ago'


def _mark(pipeline: EstimatorPipeline[Any]) -> object:
    """Return what differs if the state of a pipeline does."""
    return pipeline.samples, pipeline.rejections.total(), pipeline.resets, pipeline.status

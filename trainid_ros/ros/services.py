# SPDX-License-Identifier: Apache-2.0
"""Services of the estimator nodes."""

from __future__ import annotations

import traceback
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from numpy.linalg import LinAlgError
from std_srvs.srv import Trigger

from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.estimator_node import EstimatorNode

NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, LinAlgError)
"""What arithmetic on an invalid state raises; in old versions of numpy LinAlgError is not a ValueError."""


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
        self._node.checkpoints.note_wanted()
        self._node.watchdog.restart()
        if self._node.state != 'active':  # or else the next checkpoint comes soon
            self._node.checkpoints.save(pipeline)
        return f'reset to the prior; resets so far: {pipeline.resets}'

    def save(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Write the estimator's state to the checkpoint file."""
        return f'saved {self._node.algorithm} to {self._node.checkpoints.save_on_request(pipeline)}'

    def load(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Load the estimator's state from the checkpoint file."""
        loaded = self._node.checkpoints.load_on_request(pipeline)
        self._node.latch_loaded()
        return f'loaded {self._node.algorithm} from {loaded}'

# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node that logs every failed transition, survives invalid requests and releases what it holds."""

from __future__ import annotations

import functools
import traceback
from typing import TYPE_CHECKING, Any, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ROSInterruptException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from trainid_ros.errors import TrainIdError

if TYPE_CHECKING:
    from collections.abc import Callable

NodeT = TypeVar('NodeT', bound='ManagedNode')
RCLError = rclpy_implementation.RCLError


def guarded(
    transition: Callable[[NodeT, LifecycleState], TransitionCallbackReturn],
) -> Callable[[NodeT, LifecycleState], TransitionCallbackReturn]:
    """Wrap a transition so that the reason of a failure is logged; rclpy itself would drop the exception.

    A TrainIdError is logged in one line and results in FAILURE, which leaves the node in its previous
    state. Any other exception is logged with its traceback and results in ERROR.
    """

    @functools.wraps(transition)
    def run(node: NodeT, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except TrainIdError as error:
            node.failure = str(error)
            node.get_logger().error(node.failure)
            return TransitionCallbackReturn.FAILURE
        except (KeyboardInterrupt, ROSInterruptException):
            raise
        except Exception as error:  # logged in full, then handled by on_error
            node.failure = f'{type(error).__name__}: {error}'
            node.get_logger().error(f'{transition.__name__} failed\n{traceback.format_exc()}')
            return TransitionCallbackReturn.ERROR

    return run


class ManagedNode(LifecycleNode):
    """Lifecycle node that answers and logs invalid transition requests.

    A subclass pauses its work in ``_pause`` and releases in ``_release`` what configuring it created.

    Attributes:
        failure: Why the last transition failed, empty if it succeeded.

    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.failure = ''
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        change_state = self._service_change_state.callback

        def answer(request: Any, response: Any) -> Any:
            # An invalid transition raises, and an exception from a service callback ends the process.
            try:
                return change_state(request, response)
            except RCLError as error:
                self.get_logger().warning(f'transition rejected in state {self.state}: {error}')
                response.success = False
                return response

        self._service_change_state.callback = answer

    @property
    def state(self) -> str:
        """Label of the lifecycle state."""
        return str(self._state_machine.current_state[1])

    def bring_up(self) -> bool:
        """Configure and activate; return False, with the reason in ``failure``, if that fails."""
        for trigger in (self.trigger_configure, self.trigger_activate):
            self.failure = ''
            if trigger() != TransitionCallbackReturn.SUCCESS:
                return False
        return True

    def _pause(self) -> None:
        """Stop working until the next activation; also called when nothing runs."""
        raise NotImplementedError

    def _release(self) -> None:
        """Destroy what configure created, even if it did not finish."""
        raise NotImplementedError

    @guarded
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause; activating resumes."""
        self._pause()
        return super().on_deactivate(state)

    @guarded
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the state and release all resources."""
        self._release()
        return super().on_cleanup(state)

    @guarded
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release all resources, from any state."""
        self._release()
        return super().on_shutdown(state)

    @guarded
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured after an error in a transition."""
        self._release()
        return super().on_error(state)

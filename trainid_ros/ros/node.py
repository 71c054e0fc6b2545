# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes: checked parameters, lifecycle transitions that log every failure, and a run until a signal.

Parameters are declared at start and applied on configure, a few of them at once. rclpy's own signal handlers close the
context at once, while callbacks may still run: a publish or a wait then raises, and nodes can no longer be deactivated.
So signals are only recorded here.
"""

from __future__ import annotations

import functools
import gc
import signal
import sys
import traceback
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeVar

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterTypeException, ROSInterruptException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.setup.params_file import (
    LIVE,
    TAKEN,
    TRAIN_FILE,
    ParameterSpec,
    Value,
    Values,
    check_fallback,
    check_problems,
    check_sections,
    describe_differences,
    find_taken,
    params_files,
    taken_values,
    validate_overrides,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rclpy.node import Node

NodeT = TypeVar('NodeT', bound='ManagedNode')
_REACHED: Final = {
    'on_configure': 'configured',
    'on_activate': 'active',
    'on_deactivate': 'inactive',
    'on_cleanup': 'cleaned up',
    'on_shutdown': 'shut down',
    'on_error': 'unconfigured after an error',
}
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
            result = transition(node, state)
        except TrainIdError as error:
            node.failure = str(error)
            if not node.is_quiet:
                node.get_logger().error(node.failure)
            return TransitionCallbackReturn.FAILURE
        except (KeyboardInterrupt, ROSInterruptException):
            raise
        except Exception as error:  # logged in full, then handled by on_error
            node.failure = f'{type(error).__name__}: {error}'
            node.get_logger().error(f'{transition.__name__} failed\n{traceback.format_exc()}')
            return TransitionCallbackReturn.ERROR
        if result == TransitionCallbackReturn.SUCCESS:
            text = f'{_REACHED[transition.__name__]}: {node.about()}'
            if node.is_quiet or transition.__name__ == 'on_configure':  # most nodes are activated at once
                node.get_logger().debug(text)
            else:
                node.get_logger().info(text)
        return result

    return run


@contextmanager
def creation_of(name: str) -> Iterator[None]:
    """Raise an InputError where ROS cannot create a node, as without keys of DDS security."""
    try:
        yield
    except (RCLError, InvalidParameterTypeException) as error:
        raise InputError(f'ROS cannot start {name}: {" ".join(str(error).split())}') from error


class ManagedNode(LifecycleNode):
    """Lifecycle node that answers and logs invalid transition requests.

    A subclass pauses its work in ``_pause`` and releases in ``_release`` what configuring it created.

    Attributes:
        failure: Why the last transition failed, empty if it succeeded.
        is_quiet: Whether the caller reports transitions and their failures, so that the log does not.
        usual_name: Its name before remapping.
        steady_clock: The clock of the timers, which never jumps.
    """

    def __init__(self, name: str, **options: Any) -> None:
        with creation_of(name):
            super().__init__(name, **options)
        self.failure, self.usual_name, self.is_quiet = '', name, False
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
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

    @property
    def overrides(self) -> dict[str, object]:
        """Parameters given at start, by name; rclpy gives no public access to them."""
        return {name: parameter.value for name, parameter in self._parameter_overrides.items()}

    def now_ns(self) -> int:
        """Return the time of the node's clock [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def steady_ns(self) -> int:
        """Return the time of the steady clock [ns]."""
        return int(self.steady_clock.now().nanoseconds)

    def about(self) -> str:
        """Return what the node does, for the log."""
        return str(self.get_name())

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


class NodeParameters:
    """All parameters of one node.

    Attributes:
        given: Names of the parameters that the user set, in a file, on the command line or later.
        on_live_change: Called with the names of parameters that were set and take effect at once.
    """

    def __init__(
        self, node: ManagedNode, specs: Iterable[ParameterSpec], arguments: Sequence[str], expected: Iterable[str] = ()
    ) -> None:
        """Declare the parameters; problems with the given values are kept for :meth:`check`.

        Parameter files among the ROS arguments are searched for sections that do not match this node. Other code
        declares the ``expected`` names later.
        """
        self._node = node
        self._specs = {spec.name: spec for spec in specs}
        self._internal = False
        self.on_live_change: Callable[[set[str]], None] = lambda _: None
        self._filed: set[str] = set()  # Names of the values that the train file states
        self._used: Values = {}  # Values with which the node was configured
        values, self._problems = validate_overrides(node.overrides, self._specs, {*node._parameters, *expected})
        taken = find_taken(values) if values.get(TRAIN_FILE.name) else ()
        self._taken: Values = {name: values.pop(name) for name in taken}
        self.given = node.overrides.keys() & self._specs.keys() - self._taken.keys()
        for spec in self._specs.values():
            value = values.get(spec.name, spec.default)
            node.declare_parameter(spec.name, value, _descriptor(spec), ignore_override=True)
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._note)
        for path in params_files(arguments):
            try:
                check_sections(path, node.get_fully_qualified_name(), node.usual_name, node.get_logger().warning)
            except InputError as error:
                self._problems[str(path)] = str(error)

    def report(self) -> None:
        """Log every problem as an error, and for debugging the sources of all values in one line."""
        logger = self._node.get_logger()
        for problem in self._problems.values():
            logger.error(problem)
        filed = [f'{name} = {self.value(name)}' for name in self._specs if name in self._filed - self.given]
        logger.debug(f'{self.given_values}; from the train file: {", ".join(filed) or "none"}; defaults: all others')

    @property
    def given_values(self) -> str:
        """The values that the user set, as text."""
        given = [f'{name} = {self.value(name)}' for name in self._specs if name in self.given - self._problems.keys()]
        return f'parameters given: {", ".join(given) or "none"}'

    def check(self) -> None:
        """Raise InputError, naming them, while parameters are unknown or invalid."""
        check_problems(self._problems)

    def value(self, name: str) -> Value:
        """Return the value of a parameter."""
        value: Value = self._node.get_parameter(name).value
        return value

    def use(self) -> Values:
        """Return all values by name, with which the node is configured."""
        self._used = {name: self.value(name) for name in self._specs}
        return self._used

    @property
    def waiting(self) -> tuple[str, ...]:
        """Values set since the node was configured, which do not act yet, as texts."""
        set_later = ((name, self.value(name)) for name in sorted(self.given.intersection(self._used) - LIVE))
        return tuple(f'{name} = {value}' for name, value in set_later if value != self._used[name])

    def fall_back(self, values: Mapping[str, float], source: str) -> None:
        """Use values from a file for the parameters that the user did not set; InputError if one is out of range."""
        self._filed = set(values)
        new = {name: value for name, value in values.items() if name not in self.given}
        check_fallback(new, self._specs, source)
        logger = self._node.get_logger()
        if text := describe_differences({name: self.value(name) for name in self.given}, values):
            logger.warning(f'{source}: parameters replace values of the train file: {text}')
        if text := describe_differences(self._taken, values):
            logger.warning(f'{source}: values that a dump took from another train file are ignored: {text}')
        self._taken = {}
        changes: dict[str, Value] = {**new, TAKEN.name: taken_values(new)}
        self._internal = True
        self._node.set_parameters([Parameter(name, value=value) for name, value in changes.items()])
        self._internal = False

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            spec = self._specs.get(parameter.name)
            if spec is None:
                continue
            if spec is TAKEN and not self._internal:
                return SetParametersResult(successful=False, reason=f'{spec.name} is set by the node')
            try:
                spec.check(parameter.value)
            except InputError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _note(self, parameters: list[Parameter]) -> None:
        if self._internal:
            return
        for parameter in parameters:
            if (name := parameter.name) in self._specs:
                self.given.add(name)
                self._problems.pop(name, None)
                if name not in LIVE:
                    self._node.get_logger().info(f'{name} = {parameter.value} takes effect on the next configure')
        if names := {parameter.name for parameter in parameters} & LIVE:
            self.on_live_change(names)


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=spec.description, read_only=spec.read_only)
    if spec.choices:
        others = ' or of an installed plug-in' if spec.look_up is not None else ''
        descriptor.additional_constraints = f'one of {", ".join(spec.choices)}{others}'
    if isinstance(spec.default, float) and spec.low > float('-inf'):
        limits = FloatingPointRange(from_value=float(spec.low), to_value=float(spec.high), step=0.0)
        descriptor.floating_point_range = [limits]
    elif isinstance(spec.default, int) and not isinstance(spec.default, bool):
        low, high = int(max(spec.low, -(2**63))), int(min(spec.high, 2**63 - 1))
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return descriptor


class _StopRequest:
    """Records SIGINT and SIGTERM; a second one interrupts code that did not react to the first.

    From then on, and once the nodes are closed, further ones are ignored until the process has ended.
    """

    requested = False

    def note(self, _number: int, _frame: Any) -> None:
        if self.requested:
            _on_signals(signal.SIG_IGN)
            raise KeyboardInterrupt
        self.requested = True


_STOP: Final = _StopRequest()


def _on_signals(handler: Callable[[int, Any], None] | signal.Handlers) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def start_ros(ros_args: Sequence[str] | None = None) -> list[str]:
    """Start ROS with the arguments that follow ``--ros-args``, or those of the process; return all passed to ROS.

    From then on, SIGINT and SIGTERM only end :func:`spin_nodes`. InputError if ROS cannot use the arguments.
    """
    arguments = list(sys.argv) if ros_args is None else ['trainid', '--ros-args', *ros_args]
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, RuntimeError, ValueError) as error:
        hint = '; set ROS_LOG_DIR to a folder that can be written' if 'log' in str(error) else ''
        raise InputError(f'ROS cannot start: {str(error).splitlines()[0]}{hint}') from error
    _STOP.requested = False
    _on_signals(_STOP.note)
    return arguments


def spin_nodes(nodes: Sequence[Node], *, until: Callable[[], bool] = lambda: False) -> None:
    """Spin nodes in one thread until a signal or a condition; then deactivate and destroy them, and stop ROS.

    The nodes were created in the default context after :func:`start_ros`; the condition is checked after every
    callback. The process is expected to end after that: it ignores further signals.
    """
    executor = None
    try:
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        # What exists now stays: without it, a full garbage collection takes tens of milliseconds.
        gc.collect()
        gc.freeze()
        while not (_STOP.requested or until()):
            executor.spin_once(timeout_sec=0.2)  # a signal is only noticed when it returns
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        _on_signals(signal.SIG_IGN)
        gc.unfreeze()
        if executor is not None:
            executor.shutdown()
        close_nodes(nodes)


def close_nodes(nodes: Sequence[Node]) -> None:
    """Deactivate the active nodes, destroy all, and stop ROS."""
    for node in nodes:
        if isinstance(node, ManagedNode) and node.state == 'active' and rclpy.ok():
            node.trigger_deactivate()
        node.destroy_node()
    rclpy.try_shutdown()


def run_node(make: Callable[[Sequence[str]], ManagedNode]) -> int:
    """Run one node as a stand-alone program; with the parameter ``autostart`` it activates itself."""
    try:
        node = make(start_ros())
        if node.get_parameter('autostart').value:
            node.bring_up()
    except InputError as error:
        sys.stderr.write(f'{error}\n')
        return 2
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    spin_nodes([node])
    return 0

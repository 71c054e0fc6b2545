# SPDX-License-Identifier: Apache-2.0
"""Faults of messages, publishers and processes, and what is expected to name them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from trainid_ros.interface.records import BRAKE, FORCE, GRADIENT, MASS, SPEED

FAULT_S: Final = 30.0
"""How long a fault lasts that ends [s]."""


class Sender(NamedTuple):
    name: str  # Name of the process and of its node
    topics: tuple[int, ...]  # The topics, as places
    options: tuple[str, ...] = ()  # Options of the program
    waits: bool = False  # True if it is not started before an action does so
    is_second: bool = False  # True if it sends the messages of a second publisher of the brake command


class Action(NamedTuple):
    """What is done to a process, at a time from the start of the fault on [s]: start, kill, stop or resume."""

    at_s: float
    verb: str
    process: str


@dataclass(frozen=True, slots=True)
class Case:
    name: str  # What happens
    expected: str  # Regular expression of what names it in the diagnostics
    faults: tuple[str, ...] = ()  # Faults of the messages, by their names in the catalogue
    actions: tuple[Action, ...] = ()  # What is done to processes
    senders: tuple[Sender, ...] = ()  # Processes beside those of a healthy train
    parameters: tuple[str, ...] = ()  # Parameters of all nodes, each as YAML
    duration_s: float = FAULT_S  # How long it lasts [s]


NODES: Final = 'nodes'
ODOMETER: Final = Sender('odometer', (SPEED,))
HEALTHY: Final = (ODOMETER, Sender('train_control', (FORCE, GRADIENT, BRAKE, MASS)))
_RELIABLE: Final = 'qos_overrides./ato/speed.subscription.reliability: reliable'


def _replaced(other: Sender) -> tuple[Action, ...]:
    """Return actions that let another process publish in the place of the odometer for some time."""
    return (
        Action(0.0, 'kill', ODOMETER.name),
        Action(0.0, 'start', other.name),
        Action(FAULT_S, 'kill', other.name),
        Action(FAULT_S, 'start', ODOMETER.name),
    )


_BEST_EFFORT: Final = Sender('best_effort', (SPEED,), ('--best-effort',), waits=True)
_WRONG_TYPE: Final = Sender('wrong_type', (SPEED,), ('--wrong-type',), waits=True)
_SECOND: Final = Sender('second_control', (BRAKE,), waits=True, is_second=True)

CASES: Final = (
    Case('nothing', '.'),
    Case('speed in km/h', 'ato/speed is in km/h', ('speed in km/h',)),
    Case('force sign', 'ato/force', ('force sign',)),
    Case('force in kN', 'ato/force', ('force in kN',)),
    Case('speed frozen', 'ato/speed', ('speed frozen',)),
    Case('speed not a number', 'NOT_FINITE', ('speed not a number',)),
    Case('force stamped 1 s late', 'ato/force', ('force +1 s',)),
    Case('clock of speed 1 s behind', '1.0 s behind', ('speed clock -1 s',)),
    Case('all clocks 10 s back', r'(9\.9|10\.0) s behind', ('clock -10 s',)),
    Case('publisher silent', 'no messages arrive', ('speed missing',)),
    Case('publisher killed', 'no message for', actions=(Action(0.0, 'kill', 'odometer'),)),
    Case(
        'publisher restarted after 5 s',
        'no message for',
        actions=(Action(0.0, 'kill', 'odometer'), Action(5.0, 'start', 'odometer')),
        duration_s=5.0,
    ),
    Case(
        'publisher stalled for 3 s',
        'no message for',
        actions=(Action(0.0, 'stop', 'odometer'), Action(3.0, 'resume', 'odometer')),
        duration_s=3.0,
    ),
    Case(
        'best effort, reliable asked for',
        'incompatible quality of service',
        actions=_replaced(_BEST_EFFORT),
        senders=(_BEST_EFFORT,),
        parameters=(_RELIABLE,),
    ),
    Case(
        'wrong message type',
        'std_msgs/msg/Float64 instead of trainid_msgs/msg/AtoSpeed',
        actions=_replaced(_WRONG_TYPE),
        senders=(_WRONG_TYPE,),
    ),
    Case(
        'second brake publisher',
        '2 publishers|alternates',
        actions=(Action(0.0, 'start', 'second_control'), Action(FAULT_S, 'kill', 'second_control')),
        senders=(_SECOND,),
    ),
    Case(
        'nodes killed, restarted after 5 s',
        'not alive',
        actions=(Action(0.0, 'kill', NODES), Action(5.0, 'start', NODES)),
        duration_s=5.0,
    ),
    Case('nodes stalled for 3 s', 'not alive', actions=(Action(0.0, 'stop', NODES), Action(3.0, 'resume', NODES))),
)

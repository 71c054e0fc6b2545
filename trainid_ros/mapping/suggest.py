# SPDX-License-Identifier: Apache-2.0
"""Suggest a mapping for a bag, from the names of its topics and fields and from what its numbers do together.

Speed is what positions are the integral of, and forces go with its derivative; units follow from ratios.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.interface.records import BRAKE_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, MASS_TOPIC, SPEED_TOPIC
from trainid_ros.mapping.suggest_brake import choose_brake
from trainid_ros.mapping.suggest_force import choose_force, choose_gradient, choose_mass, specific_force, total_force
from trainid_ros.mapping.suggest_speed import choose_speed, possible_speeds, speeds_by_numbers
from trainid_ros.mapping.suggestion import Choice, Suggestion, listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.bag.number_series import BagNumbers, NumberSeries
    from trainid_ros.train.train_file import TrainFile


def suggest(numbers: BagNumbers, name: str, train_file: TrainFile | None = None) -> Suggestion:
    """Return a mapping for the numbers of a bag.

    Args:
        numbers: The numbers.
        name: Name of the bag.
        train_file: Its train, if known: the mass shows the unit of the force, the line may have the gradients.
    """
    head = (
        f'Suggested by trainid info --suggest-map for {name}: {numbers.duration_s / 60.0:.0f} min were read.',
        'Check each line before it is used; what is left out comes from our own topic.',
    )
    own = frozenset(topic.lstrip('/') for topic in numbers.own)
    choices = tuple(choice for choice in _choices(numbers, train_file) if _TOPICS[choice.quantity].name not in own)
    missing = tuple(name for name in _ADVICE if not any(choice.quantity == name for choice in choices))
    missing = tuple(name for name in missing if _TOPICS[name].name not in own)
    return Suggestion(head, choices, missing, tuple(_notes(numbers, choices, missing)))


_TOPICS: Final = {
    'speed': SPEED_TOPIC,
    'position': SPEED_TOPIC,
    'force': FORCE_TOPIC,
    'gradient': GRADIENT_TOPIC,
    'brake_command': BRAKE_TOPIC,
    'mass': MASS_TOPIC,
}
_ADVICE: Final = {
    'speed': 'speed: nothing found; it is needed, and all else is compared with it',
    'force': 'force: nothing found; the force at the wheel rim, or the sum of those of all motor cars, is needed',
    'gradient': 'gradient: nothing found; {from: line} takes it from the line of the train file (--train), by position',
    'brake_command': 'brake_command: nothing found; a notch with a table, percent of the full brake or m/s^2 is needed',
}


def _choices(numbers: BagNumbers, train_file: TrainFile | None) -> list[Choice]:
    """Return what may be each quantity, also of those that come from our own topics."""
    own = [item for item in numbers.series if item.topic in numbers.own]
    foreign = [item for item in numbers.series if item.topic not in numbers.own]
    speeds = [item for item in own if item.field == 'speed'] or possible_speeds(foreign) or speeds_by_numbers(foreign)
    if not speeds:
        return []
    speed, position, motion = choose_speed(speeds, [*foreign, *own])
    choices = [speed, *position]
    rest = _without(foreign, choices)
    forces = choose_force([item for item in own if item.field == 'force'] or rest, motion, train_file)
    rest = _without(rest, forces)
    total = total_force(forces[0], motion) if forces else None
    choices += forces
    choices += choose_gradient(rest, motion, total, train_file, has_position=bool(position))
    masses = choose_mass([item for item in own if item.field == 'mass'] or rest, train_file)
    choices += choose_brake(rest, motion, specific_force(total, masses, train_file))
    return [*choices, *masses]


def _without(series: Iterable[NumberSeries], choices: Iterable[Choice]) -> list[NumberSeries]:
    """Return the series that are not chosen."""
    chosen = {id(part.series) for choice in choices for part in choice.parts}
    return [item for item in series if id(item) not in chosen]


def _notes(numbers: BagNumbers, choices: Sequence[Choice], missing: Sequence[str]) -> Iterable[str]:
    yield from (_ADVICE[name] for name in missing)
    if numbers.own:
        yield f'from our own topics: {listed(sorted(topic.lstrip("/") for topic in numbers.own))}'
    used = {part.series.topic for choice in choices for part in choice.parts}
    if rest := sorted({item.topic for item in numbers.series} - used - numbers.own):
        yield f'not used: {listed(rest)}'
    if numbers.left_out:
        yield f'not read: {listed([f"{topic} ({why})" for topic, why in numbers.left_out])}'

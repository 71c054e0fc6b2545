# SPDX-License-Identifier: Apache-2.0
"""Parser for effects given on the command line: ``NAME:key=value`` or ``NAME:key=value,key=value``."""

from __future__ import annotations

from collections.abc import Iterable

from trainid_ros.errors import InputError
from trainid_ros.train.effects import check_effects
from trainid_ros.train.train_file import Effect


def parse_effects(texts: Iterable[str]) -> tuple[Effect, ...]:
    """Parse and check effects.

    Consecutive texts with the same name add parameters to one effect; a repeated key starts another one.

    Raises:
        InputError: A text has the wrong form, or an effect or parameter is unknown or out of range.

    """
    found: list[tuple[str, dict[str, float]]] = []
    for text in texts:
        name, colon, rest = text.partition(':')
        if not (name and colon and rest):
            msg = f'effect {text!r} must have the form NAME:key=value'
            raise InputError(msg)
        for assignment in rest.split(','):
            key, value = _assignment(text, assignment)
            if not (found and found[-1][0] == name and key not in found[-1][1]):
                found.append((name, {}))
            found[-1][1][key] = value
    effects = tuple(Effect(name, tuple(values.items()), (), 'command line') for name, values in found)
    check_effects(effects)
    return effects


def _assignment(text: str, assignment: str) -> tuple[str, float]:
    key, equals, value = assignment.partition('=')
    if not (key and equals):
        msg = f'effect {text!r} must have the form NAME:key=value'
        raise InputError(msg)
    try:
        return key.strip(), float(value)
    except ValueError:
        msg = f'effect {text!r}: {key} = {value!r} is not a number'
        raise InputError(msg) from None

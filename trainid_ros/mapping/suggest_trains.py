# SPDX-License-Identifier: Apache-2.0
"""Tell several trains in a bag from one train with several motor cars and speed sensors."""

from __future__ import annotations

import re
from collections import defaultdict
from typing import TYPE_CHECKING, Final

from trainid_ros.mapping.evidence import at_times, common_times, correlation
from trainid_ros.mapping.names import score
from trainid_ros.mapping.suggest_speed import possible_speeds

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from trainid_ros.bag.number_series import NumberSeries

_NAMED: Final = re.compile(r'(?:.*/)?train_?\d+', re.IGNORECASE)
# Speeds of one train are more alike [1].
_ALIKE: Final = 0.9


def trains_in(series: Sequence[NumberSeries]) -> tuple[str, ...]:
    """Return the namespaces of the trains if there are several, empty if not."""
    groups: dict[tuple[str, str, str], dict[str, NumberSeries]] = defaultdict(dict)
    for item in possible_speeds(series):
        for namespace, name in _splits(item.topic):
            groups[namespace.rpartition('/')[0], name, item.field][namespace] = item
    for speeds in groups.values():
        if len(speeds) > 1 and (all(map(_NAMED.fullmatch, speeds)) or _drive_apart(speeds, series)):
            return tuple(sorted(speeds))
    return ()


def _splits(topic: str) -> Iterator[tuple[str, str]]:
    """Yield namespace and name of a topic for each namespace that it is in."""
    for at in re.finditer(r'(?<!^)/', topic):
        yield topic[: at.start()], topic[at.end() :]


def _drive_apart(speeds: Mapping[str, NumberSeries], series: Sequence[NumberSeries]) -> bool:
    """Return whether each namespace has a force, and not all have the same speed."""
    forces = [item.topic for item in series if score('force', item.topic, item.field) > 0.0]
    if not all(any(topic.startswith(f'{namespace}/') for topic in forces) for namespace in speeds):
        return False
    first, *others = speeds.values()
    times = common_times(first)
    speed = abs(at_times(first, times))
    return any(correlation(speed, abs(at_times(other, times))) < _ALIKE for other in others)

# SPDX-License-Identifier: Apache-2.0
"""Days on which a train was away from its usual level: from the first change away from it to the change back.

The usual level is that before the first change, unless the train was then far from the others and came near them later:
a table may begin with a fault. What lies between two changes is a part; parts that lie to the same side of the usual
level belong to one departure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.fleet.changes import Level, Step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.fleet.changes import Change, Series

    Array = NDArray[np.float64]

# Distance to the fleet beyond which the first level of a train is a fault, in standard deviations among trains.
_FAR: Final = 5.0
# A train is back when less than this share of the departure is left.
_BACK: Final = 0.4


@dataclass(frozen=True, slots=True)
class Departure:
    """Days on which a train was away from its usual level.

    Attributes:
        first: First day; 0 if the table begins with it.
        end: First day after it, None if it has not ended.
        alarm: Day on which it was certain enough; if the table begins with it, that on which its end was.
        evidence: ln R of the most certain of its changes.
        steps: From the usual level to that of its most certain part by channel, None where the channel has no data.

    """

    first: int
    end: int | None
    alarm: int
    evidence: float
    steps: tuple[Step | None, ...]


class _Part(NamedTuple):
    """Days between two changes, and levels by channel, None without data."""

    first: int
    end: int | None
    levels: tuple[Level | None, ...]


def usual_days(channels: Sequence[Series], changes: Sequence[Change]) -> tuple[float, float]:
    """Return the first day of the usual level of a train, and the first one after it."""
    if not changes:
        return 0.0, math.inf
    parts = _parts(changes)
    part = parts[_usual(channels, parts)]
    return float(part.first), math.inf if part.end is None else float(part.end)


def departures(channels: Sequence[Series], changes: Sequence[Change]) -> tuple[Departure, ...]:
    """Return the departures of a train, in order.

    Args:
        channels: Its values.
        changes: Its changes, in order.

    """
    if not changes:
        return ()
    parts = _parts(changes)
    usual = _usual(channels, parts)
    steps = [_steps(channels, parts[usual], part) for part in parts]
    sizes = [_sizes(channels, step) for step in steps]
    groups: list[list[int]] = []
    away = False
    for k, size in enumerate(sizes):
        main = _main(steps, groups[-1]) if away else k
        if k == usual or (k != main and float(np.linalg.norm(size)) < _BACK * float(np.linalg.norm(sizes[main]))):
            away = False
        elif k != main and float(size @ sizes[main]) >= _BACK * float(sizes[main] @ sizes[main]):
            groups[-1].append(k)
        else:
            groups.append([k])
            away = True
    return tuple(_departure(changes, parts, group, steps[_main(steps, group)]) for group in groups)


def _departure(
    changes: Sequence[Change], parts: Sequence[_Part], group: Sequence[int], steps: tuple[Step | None, ...]
) -> Departure:
    # Change k - 1 begins part k; if the table begins with it, its end is what shows it.
    mine = [changes[max(k - 1, 0)] for k in group]
    evidence = max(change.evidence for change in mine)
    return Departure(parts[group[0]].first, parts[group[-1]].end, mine[0].alarm, evidence, steps)


def _parts(changes: Sequence[Change]) -> list[_Part]:
    starts = [0, *(change.day for change in changes)]
    ends = [*starts[1:], None]
    first = tuple(step and step.before for step in changes[0].steps)
    levels = [first, *(tuple(step and step.after for step in change.steps) for change in changes)]
    return [_Part(*part) for part in zip(starts, ends, levels, strict=True)]


def _usual(channels: Sequence[Series], parts: Sequence[_Part]) -> int:
    """Return the number of the part with the usual level."""
    distances = [_distance_to_fleet(channels, part) for part in parts]
    return 0 if distances[0] < _FAR else distances.index(min(distances))


def _distance_to_fleet(channels: Sequence[Series], part: _Part) -> float:
    """Return the largest difference from the fleet in standard deviations among trains."""
    known = ((series, level) for series, level in zip(channels, part.levels, strict=True) if level is not None)
    return max((abs(level.mean) / math.hypot(series.level_std, level.std) for series, level in known), default=0.0)


def _steps(channels: Sequence[Series], usual: _Part, part: _Part) -> tuple[Step | None, ...]:
    """Return the steps from the usual level to a part with ln of their Bayes factors, for normal levels."""
    found: list[Step | None] = []
    for series, before, after in zip(channels, usual.levels, part.levels, strict=True):
        if before is None or after is None:
            found.append(None)
            continue
        noise, total = before.std**2 + after.std**2, before.std**2 + after.std**2 + series.step_std**2
        square = (after.mean - before.mean) ** 2
        found.append(Step(before, after, 0.5 * (square / noise - square / total - math.log(total / noise))))
    return tuple(found)


def _sizes(channels: Sequence[Series], steps: Sequence[Step | None]) -> Array:
    """Return the sizes of steps in those that matter, 0 where a channel has no data."""
    return np.array(
        [step.size / series.step_std if step else 0.0 for series, step in zip(channels, steps, strict=True)]
    )


def _main(steps: Sequence[tuple[Step | None, ...]], group: Sequence[int]) -> int:
    """Return the most certain part of a departure."""
    return max(group, key=lambda k: sum(step.evidence for step in steps[k] if step))

# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the inputs of simulated drives: when they are named, and what is published meanwhile.

Each fault is injected from the first message on, and for a minute in mid-drive, on days and on drives of five worlds;
pairs of faults in mid-drive, on days. One row per fault: the worst of all drives.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults import BY_NAME, FAULTS, NOTHING, PAIRS, injected
from benchmarks.scenarios import DAY, DEFAULTS, Course, Published, Ride, course_of, publish, ride
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.worlds import WORLDS
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Status

# Seeds before it were looked at while the check of the inputs was written.
_FIRST_SEED: Final = 4101
TRAINS: Final = (DAY, *WORLDS)
# Seeds of the worlds per seed of the days.
_PER_WORLD: Final = 0.25
# A part of the drive without changes of the resistance, with several runs and stops [s].
LENGTH_S: Final = 1250.0
MID_DRIVE_S: Final = (590.0, 640.0, 700.0, 760.0)
DURATION_S: Final = 60.0
# Motion after the end of a fault at which what is left is measured, and around it [s].
_AFTER_S, _ABOUT_S = 60.0, 10.0
_PERIOD_S: Final = 0.2
# An estimate that was wrong for so much longer than without the fault is counted: little, and long [s].
_LITTLE_S, _LONG_S = 1.0, 30.0
# Reasons that reject a sample without saying what is wrong.
_UNTOLD: Final = frozenset({Reason.OUTLIER, Reason.CONTRADICTION, Reason.NUMERICAL, Reason.BRAKE_UNCERTAIN})
_HEADER: Final = (
    'fault', 'seen', 'after, s', 'named', 'after, s', 'used > 3 std, s', 'by the fault, s', *TRAINS, 'worst, std',
    'w left, N/kN', 'rate left', 'rejected', 'what names it',
)  # fmt: skip
_NOTE: Final = (
    '{drives}. Medians and worst cases over drives. Seen: share of the drives on which a finding, a reason of rejection'
    ' or a status that the healthy drive does not have shows up; after: median motion until then. Named: the same '
    'without OUTLIER, CONTRADICTION and BRAKE_UNCERTAIN, which do not say what is wrong. Used beyond 3 std: time that '
    'the resistance or the brake rate was VALID or HOLDING and that far off since the fault began, at most; by the '
    'fault: the same, but not at times at which it was so without the fault, too; on all trains, and on each. Left: '
    'median of the absolute error a minute of motion after the fault less that of the same drive without it. Rejected: '
    'the most frequent reason, and its mean count beyond that without the fault.'
)


@dataclass(frozen=True, slots=True)
class Injection:
    """Faults by name, from the first message or in mid-drive, on a day or on a drive of a world."""

    faults: tuple[str, ...]
    seed: int
    from_start: bool
    train: str = DAY


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was published under a fault."""

    train: str  # The train
    # Motion from the start of the fault until a finding, a status or a reason of rejection shows up that the healthy
    # drive does not have [s]; infinite if none does.
    seen_s: float
    named_s: float  # The same without reasons that do not say what is wrong
    name: str  # The first finding; without one, the status or the reason that named it
    # Time that the resistance or the brake rate was VALID or HOLDING at more than 3 std from the truth [s].
    wrong_s: float
    added_s: float  # The same at times at which it was not without the fault [s]
    worst: float  # Largest error of a VALID or HOLDING resistance or brake rate [std]
    # |error| of w [N/kN] and of the brake rate a minute of motion after the fault, less that without it.
    left: tuple[float, float]
    # Records and samples of the resistance rejected by each reason, less those without the fault.
    rejected: dict[Reason, int]
    is_finite: bool  # Whether all numbers published were finite


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables for faults from the first message on, in mid-drive, and in pairs."""
    per_world = max(1, round(_PER_WORLD * seeds))
    drives = [(DAY, _FIRST_SEED + k) for k in range(seeds)]
    drives += [(world, _FIRST_SEED + k) for world in WORLDS for k in range(per_world)]
    single, pairs = [(fault.name,) for fault in (NOTHING, *FAULTS)], [(NOTHING.name,), *PAIRS]
    counted = f'{seeds} days and {per_world} drives of each of {len(WORLDS)} worlds'
    runs = (
        ('Faults from the first message on', single, drives, True, counted),
        ('Faults for a minute in mid-drive', single, drives, False, counted),
        ('Pairs of faults for a minute in mid-drive', pairs, drives[:seeds], False, f'{seeds} days'),
    )
    tables, summary = [], []
    for title, faults, some, from_start, text in runs:
        # Drive by drive, so that each process simulates few of them.
        trials = [Injection(names, seed, from_start, train) for train, seed in some for names in faults]
        outcomes = over_seeds(judge, trials, 'faults')
        grouped = [outcomes[k :: len(faults)] for k in range(len(faults))]
        rows = tuple(_row(' + '.join(names), of_one) for names, of_one in zip(faults, grouped, strict=True))
        tables.append(Table(title, _HEADER, rows, _NOTE.format(drives=text)))
        summary.append(_summary(title, [one for of_one in grouped[1:] for one in of_one]))
    return _summary_table(summary), *tables


def _summary(title: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    added = np.array([outcome.added_s for outcome in outcomes])
    counts = (
        sum(math.isfinite(outcome.named_s) for outcome in outcomes),
        int(np.sum(added <= _LITTLE_S)),
        int(np.sum(added > _LONG_S)),
        sum(not outcome.is_finite for outcome in outcomes),
    )
    return title, str(len(added)), *map(str, counts)


def _summary_table(rows: Sequence[tuple[str, ...]]) -> Table:
    little, long = f'wrong for {_LITTLE_S:g} s or less', f'for more than {_LONG_S:g} s'
    header = ('', 'drives with a fault', 'named', little, long, 'not finite')
    note = 'Wrong: an estimate was VALID or HOLDING beyond 3 std for so much longer than without the fault.'
    return Table('Faults, all drives', header, (*rows, ('target', '', '', '', '', '0')), note)


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    texts = Counter(outcome.name.partition(':')[0] for outcome in outcomes if math.isfinite(outcome.named_s))
    return (
        name if all(outcome.is_finite for outcome in outcomes) else f'{name} (NOT FINITE)',
        *_when([outcome.seen_s for outcome in outcomes]),
        *_when([outcome.named_s for outcome in outcomes]),
        f'{max(outcome.wrong_s for outcome in outcomes):.1f}',
        _longest(outcomes),
        *(_longest([outcome for outcome in outcomes if outcome.train == train]) for train in TRAINS),
        f'{max(outcome.worst for outcome in outcomes):.1f}',
        *(_median([outcome.left[k] for outcome in outcomes]) for k in range(2)),
        _rejected(outcomes),
        texts.most_common(1)[0][0] if texts else '-',
    )


def _longest(outcomes: Sequence[Outcome]) -> str:
    return f'{max(outcome.added_s for outcome in outcomes):.1f}' if outcomes else '-'


def _when(times: Sequence[float]) -> tuple[str, str]:
    """Return how often a time is known, and the median of those that are [s]."""
    known = [time for time in times if math.isfinite(time)]
    return f'{len(known) / len(times):.0%}', f'{np.median(known):.0f}' if known else '-'


def _rejected(outcomes: Sequence[Outcome]) -> str:
    total = sum((Counter(outcome.rejected) for outcome in outcomes), Counter())
    ((reason, count),) = total.most_common(1) or ((None, 0),)
    return '-' if reason is None or count <= 0 else f'{count / len(outcomes):.0f} {reason.name}'


def _median(values: Sequence[float]) -> str:
    known = [value for value in values if math.isfinite(value)]
    return f'{np.median(known):+.3f}' if known else '-'


def judge(injection: Injection) -> Outcome:
    """Return the outcome of faults on a drive."""
    train, seed = injection.train, injection.seed
    source, healthy = _healthy(train, seed)
    begin_s = 0.0 if injection.from_start else MID_DRIVE_S[seed % len(MID_DRIVE_S)]
    end_s = LENGTH_S if injection.from_start else begin_s + DURATION_S
    faults = [BY_NAME[name] for name in injection.faults]
    ends = (source.start_ns + round(at_s * NS_PER_S) for at_s in (begin_s, end_s))
    found = publish(source, injected(source.rows, faults, *ends), DEFAULTS, seed)
    shift_s = sum(fault.clock_step_s for fault in faults)
    courses = [_used(course_of(found.traces[k], source, shift_s), k) for k in (0, 2)]
    references = [_used(course_of(healthy.traces[k], source), k) for k in (0, 2)]
    since = [course.time_s >= begin_s for course in courses]
    wrong = [c.usable & c.wrong & after for c, after in zip(courses, since, strict=True)]
    ratios = [(c.error / c.std)[c.usable & after] for c, after in zip(courses, since, strict=True)]
    seen_s, named_s, name = _naming(found, healthy, courses[0], source, begin_s)
    left = [_left(c, begin_s, end_s) - _left(r, begin_s, end_s) for c, r in zip(courses, references, strict=True)]
    return Outcome(
        train=train,
        seen_s=seen_s,
        named_s=named_s,
        name=name,
        wrong_s=max(float(np.sum(mask)) for mask in wrong) * _PERIOD_S,
        added_s=max(_added_s(c, mask, r) for c, mask, r in zip(courses, wrong, references, strict=True)),
        worst=max((float(values.max()) for values in ratios if values.size), default=0.0),
        left=(left[0], left[1]),
        rejected={reason: n - healthy.rejected.get(reason, 0) for reason, n in found.rejected.items()},
        is_finite=all(np.isfinite(trace.rows).all() for trace in found.traces),
    )


@lru_cache(maxsize=4)
def _healthy(train: str, seed: int) -> tuple[Ride, Published]:
    """Return the part of a drive that faults are injected into, and what is published without them."""
    whole = ride(train, seed)
    last_ns = whole.start_ns + round(LENGTH_S * NS_PER_S)
    source = replace(whole, rows=tuple(row for row in whole.rows if row[1] < last_ns))
    return source, publish(source, source.rows, DEFAULTS, seed)


def _used(course: Course, place: int) -> Course:
    """Return a course whose brake rate says nothing at a stand."""
    if place == 0:
        return course
    return replace(course, status=np.where(course.moving, course.status, Status.UNINITIALIZED))


def _added_s(course: Course, wrong: NDArray[np.bool_], healthy: Course) -> float:
    """Return for how long an estimate was wrong at times at which it was not without the fault [s]."""
    nearest = np.minimum(np.searchsorted(healthy.time_s, course.time_s - 0.5 * _PERIOD_S), len(healthy.time_s) - 1)
    return float(np.sum(wrong & ~(healthy.usable & healthy.wrong)[nearest])) * _PERIOD_S


def _since(course: Course, begin_s: float) -> NDArray[np.float64]:
    """Return the motion since the start of a fault [s]."""
    return course.moved_s - np.interp(begin_s, course.time_s, course.moved_s)


def _left(course: Course, begin_s: float, end_s: float) -> float:
    """Return the mean |error| over 20 s around a minute of motion after a time [s]; NaN if the drive ends before."""
    if not course.time_s.size or course.time_s[-1] < end_s:
        return math.nan
    moved_s = _since(course, begin_s)
    about = np.abs(moved_s - float(np.interp(end_s, course.time_s, moved_s)) - _AFTER_S) < _ABOUT_S
    return float(course.error[about].mean()) if about.any() else math.nan


def _naming(
    found: Published, healthy: Published, course: Course, source: Ride, begin_s: float
) -> tuple[float, float, str]:
    """Return when a fault is seen and when it is named, in seconds of motion, and by what."""
    usual = {sign for trace in healthy.traces for sign in trace.signs}
    signs = [
        (stamp_ns, sign) for trace in found.traces for (kind, sign), stamp_ns in trace.signs.items()
        if (kind, sign) not in usual
    ]  # fmt: skip
    names = [*found.findings[:1], *((stamp_ns, sign.name) for stamp_ns, sign in signs if sign not in _UNTOLD)]
    moved_s = _since(course, begin_s)

    def after_s(stamp_ns: int) -> float:
        time_s = (stamp_ns - source.start_ns) / NS_PER_S
        return float(np.interp(time_s, course.time_s, moved_s)) if time_s > begin_s else 0.0

    seen_s = min((after_s(stamp_ns) for stamp_ns, _ in (*found.findings[:1], *signs)), default=math.inf)
    if not names:
        return seen_s, math.inf, '-'
    return seen_s, after_s(min(names)[0]), (found.findings or (min(names),))[0][1]

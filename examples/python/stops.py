# SPDX-License-Identifier: Apache-2.0
"""How much better a simulated train stops whose controller uses the estimates: days by each controller, and a report.

.venv/bin/python examples/python/stops.py
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ato.days import CONTROLLERS, drive_day, plan_day
from ato.stop_report import Day, brake_changes, changed_stops, comparison, errors_of, stop_lines, stop_page
from trainid_ros.cli.output import prepare_page, print_json, progress
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ato.days import DayPlan

_WORLD: Final = 'metro'
_SEED: Final = 2017
_DAYS: Final = 3
_RUNS: Final = 12


@dataclass(frozen=True, slots=True)
class StopCase:
    """Result: the days, how they were driven by each controller, and the path of their report."""

    days: tuple[Day, ...]
    report: Path

    @property
    def worked(self) -> bool:
        """True if the estimates made the stops better than the train file did."""
        live, nominal = (np.abs(errors_of(self.days, name)).mean() for name in ('live', 'nominal'))
        return bool(live < nominal)


def changing_days(seed: int, count: int) -> list[tuple[int, DayPlan]]:
    """Return the next days from a seed on, with their seeds, whose brake changes at once."""
    plans = ((number, plan_day(_WORLD, _RUNS, np.random.default_rng(number))) for number in itertools.count(seed))
    return [*itertools.islice((one for one in plans if one[1].events_s), count)]


def play_stops(report: Path, seed: int, count: int, say: Callable[[str], None]) -> StopCase:
    """Let an ATO drive some simulated days with each of the controllers.

    Raises:
        InputError: The folder cannot be used, or the report would overwrite a file of somebody else.

    """
    prepare_page(report)
    planned = changing_days(seed, count)
    seeds = ', '.join(str(number) for number, _ in planned)
    say(f'{_RUNS} stops a day of a {_WORLD} train on the Yizhuang line, days of seeds {seeds}, by different values')
    days = []
    with progress('stops', count * len(CONTROLLERS)) as advance:
        for number, plan in planned:
            drives = {}
            for name in CONTROLLERS:
                drives[name] = drive_day(plan, name, number)
                advance(1)
            days.append(Day(plan, drives))
    write_text(stop_page(days), report)
    return StopCase(tuple(days), report)


def describe_stops(case: StopCase) -> str:
    """Return the errors of the stops as text, what they say, and where the brake changed during a braking."""
    said = [*comparison(case.days), *brake_changes(case.days)]
    return '\n'.join([*stop_lines(case.days), '', *said, '', f'report: {case.report}'])


def stops_to_json(case: StopCase) -> dict[str, Any]:
    """Return, for each day by controller, errors of the stops [m] and those with a change of the brake, as JSON."""
    days = [
        {name: {'errors': drive.errors.tolist(), 'brake_changed': changed_stops(day.plan, drive)}
         for name, drive in day.drives.items()}
        for day in case.days
    ]  # fmt: skip
    return {'days': days, 'report': case.report}


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive the days; return 0 only if the estimates made the stops better than the train file did."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--out', type=Path, default=Path('out/stops.html'), metavar='FILE', help='report')
    parser.add_argument('--seed', type=int, default=_SEED, metavar='N', help=f'first day (default {_SEED})')
    parser.add_argument('--days', type=int, default=_DAYS, metavar='N', help=f'number of days (default {_DAYS})')
    parser.add_argument('--json', action='store_true', help='print JSON')
    args = parser.parse_args(arguments)
    try:
        case = play_stops(args.out, args.seed, args.days, lambda text: print(text, file=sys.stderr))
    except InputError as error:
        print(f'stops.py: error: {error}', file=sys.stderr)
        return 2
    if args.json:
        print_json(stops_to_json(case) | {'worked': case.worked})
    else:
        print(describe_stops(case))
    return 0 if case.worked else 1


if __name__ == '__main__':
    sys.exit(main())

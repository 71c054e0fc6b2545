# SPDX-License-Identifier: Apache-2.0
"""How much better a simulated train stops whose controller uses the estimates: a day by each controller, and a report.

.venv/bin/python examples/python/stops.py
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ato.days import CONTROLLERS, drive_day, plan_day
from ato.stop_report import brake_changes, changed_stops, comparison, stop_lines, stop_page
from trainid_ros.cli.output import prepare_page, print_json, progress
from trainid_ros.interface.errors import InputError
from trainid_ros.report.page import write_page

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ato.days import DayPlan, Drive

_WORLD: Final = 'metro'
_SEED: Final = 2017
_RUNS: Final = 12


@dataclass(frozen=True, slots=True)
class StopCase:
    """Result: the day, how it was driven by each controller, and the path of its report."""

    plan: DayPlan
    drives: dict[str, Drive]
    report: Path

    @property
    def worked(self) -> bool:
        """True if the estimates made the stops better than the train file did."""
        live, nominal = (np.abs(self.drives[name].errors).mean() for name in ('live', 'nominal'))
        return bool(live < nominal)


def play_stops(report: Path, say: Callable[[str], None]) -> StopCase:
    """Let an ATO drive a simulated day with each of the controllers.

    Raises:
        InputError: The folder cannot be used, or the report would overwrite a file of somebody else.

    """
    prepare_page(report)
    plan = plan_day(_WORLD, _RUNS, np.random.default_rng(_SEED))
    say(f'{_RUNS} stops of a {_WORLD} train on the Yizhuang line, by different values of brake and resistance')
    drives = {}
    with progress('stops', len(CONTROLLERS)) as advance:
        for name in CONTROLLERS:
            drives[name] = drive_day(plan, name, _SEED)
            advance(1)
    write_page(stop_page(plan, drives), report)
    return StopCase(plan, drives, report)


def describe_stops(case: StopCase) -> str:
    """Return the errors of the stops as text, what they say, and where the brake changed during a braking."""
    said = [*comparison(case.drives), *brake_changes(case.plan, case.drives)]
    return '\n'.join([*stop_lines(case.plan, case.drives), '', *said, '', f'report: {case.report}'])


def stops_to_json(case: StopCase) -> dict[str, Any]:
    """Return, by controller, the errors of the stops [m] and those with a change of the brake as a JSON object."""
    errors = {name: drive.errors.tolist() for name, drive in case.drives.items()}
    changed = {name: changed_stops(case.plan, drive) for name, drive in case.drives.items()}
    return {'errors': errors, 'brake_changed': changed, 'report': case.report}


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive the day; return 0 only if the estimates made the stops better than the train file did."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--out', type=Path, default=Path('out/stops.html'), metavar='FILE', help='report')
    parser.add_argument('--json', action='store_true', help='print JSON')
    args = parser.parse_args(arguments)
    try:
        case = play_stops(args.out, lambda text: print(text, file=sys.stderr))
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

# SPDX-License-Identifier: Apache-2.0
"""Last chapter of the demo: how much better a train stops whose controller uses the estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.ato.days import CONTROLLERS, drive_day, plan_day
from trainid_ros.cli.output import prepare_page, progress
from trainid_ros.report.page import write_page
from trainid_ros.report.stop_report import brake_changes, changed_stops, comparison, stop_lines, stop_page

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from trainid_ros.ato.days import DayPlan, Drive

STOPS_HTML: Final = 'report.html'
_WORLD: Final = 'metro'
_SEED: Final = 2017
_RUNS: Final = 12


@dataclass(frozen=True, slots=True)
class StopCase:
    """Result of the chapter: the day, how it was driven by each controller, and the path of its report."""

    plan: DayPlan
    drives: dict[str, Drive]
    report: Path

    @property
    def worked(self) -> bool:
        """True if the estimates made the stops better than the train file did."""
        live, nominal = (np.abs(self.drives[name].errors).mean() for name in ('live', 'nominal'))
        return bool(live < nominal)


def prepare_stops(folder: Path) -> Path:
    """Create the folder of the chapter, and return the path of its report.

    Raises:
        InputError: The folder cannot be used, or the report would overwrite a file of somebody else.

    """
    return prepare_page(folder / STOPS_HTML)


def play_stops(folder: Path, say: Callable[[str], None]) -> StopCase:
    """Let an ATO drive a simulated day with each of the controllers.

    Raises:
        InputError: The folder cannot be used, or the report would overwrite a file of somebody else.

    """
    report = prepare_stops(folder)
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

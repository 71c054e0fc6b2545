# SPDX-License-Identifier: Apache-2.0
"""Standard scenario: the Beijing Yizhuang line there and back, with rain, added drag and brake wear.

The stated train is ``config/trains/yizhuang.yaml``; the true one differs from it as real trains do:

- The published resistance (a = 1.448, b = 0, c = 0.0106) has no term in v. The true one is
  a = 1.74, b = 0.020, c = 0.0086: 20 % up and 19 % down, with the linear term every real train has.
- At 1300 s, after about nine runs, rain adds 0.5 N/kN to a. At 2500 s, c grows by 20 %.
- The brake rate is 1.0 for six runs, falls to 0.85 by wear between 900 s and 1500 s in steps too small to be
  detected individually, and recovers to 0.95 at 2900 s.

The line is surveyed (map error 0.05 per mille, weighing error 0.1 %), speed and force have
the default noise, and gusts have a standard deviation of 0.1 N/kN.

26 runs from stop to stop take about 64 minutes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from trainid_ros.sim.plant import GustModel
from trainid_ros.sim.scenario import DEFAULT_START_NS, Change, Scenario, SensorModel
from trainid_ros.train.train_file import Davis, TrainFile

RUNS: Final = 26
DRY: Final = Davis(a=1.74, b=0.020, c=0.0086)
RAIN: Final = replace(DRY, a=DRY.a + 0.5)
RAIN_AND_DRAG: Final = replace(RAIN, c=1.2 * RAIN.c)
RAIN_S: Final = 1300.0
DRAG_S: Final = 2500.0
WEAR_S: Final = (900.0, 1500.0)
WEAR_RATE: Final = (1.0, 0.85)
WEAR_STEPS: Final = 60
RECOVERY_S: Final = 2900.0
RECOVERED_RATE: Final = 0.95
MAP_ERROR: Final = 0.05
WEIGHING_ERROR: Final = 0.001
GUST: Final = 0.1


def yizhuang_day(stated: TrainFile, *, runs: int = RUNS, start_ns: int = DEFAULT_START_NS) -> Scenario:
    """Return the scenario of the day, with the true train file, for the stated ``config/trains/yizhuang.yaml``.

    It has a number of runs from stop to stop and begins at a stamp [ns].
    """
    brake = replace(stated.brake, rate=WEAR_RATE[0])
    true = replace(stated, resistance=DRY, brake=brake)
    changes = (
        *_wear(),
        Change(RAIN_S, resistance=RAIN),
        Change(DRAG_S, resistance=RAIN_AND_DRAG),
        Change(RECOVERY_S, brake_rate=RECOVERED_RATE),
    )
    ordered = tuple(sorted(changes, key=lambda change: change.time_s))
    return Scenario(
        train_file=true,
        runs=runs,
        changes=ordered,
        sensors=SensorModel(map_error=MAP_ERROR, mass_noise=WEIGHING_ERROR),
        gust=GustModel(std=GUST),
        start_ns=start_ns,
    )


def _wear() -> tuple[Change, ...]:
    (start, end), (new, worn) = WEAR_S, WEAR_RATE
    shares = ((i + 1) / WEAR_STEPS for i in range(WEAR_STEPS))
    points = ((start + share * (end - start), new + share * (worn - new)) for share in shares)
    return tuple(Change(time_s, brake_rate=round(rate, 6)) for time_s, rate in points)

# SPDX-License-Identifier: Apache-2.0
"""Algorithms for the running resistance that are for comparison only."""

from __future__ import annotations

from typing import Final

from trainid_lab.resistance.regressions import Step, innovation_step, solve_step, strict_step
from trainid_lab.resistance.speed_ekf import SpeedEkf, SpeedEkfConfig
from trainid_lab.resistance.trajectory.two_window import TwoWindow, TwoWindowConfig
from trainid_lab.resistance.windowed import WindowedConfig, WindowedRegression
from trainid_ros.estimators.algorithm_registry import Algorithm
from trainid_ros.interface.results import ResistanceEstimate

_ONE: Final = frozenset({'innovation_length'})
_NO_PENALTY: Final = frozenset({'penalty', 'record_length'})


def _regression(
    name: str, summary: str, step: Step, config: WindowedConfig, fixed: frozenset[str] = frozenset()
) -> Algorithm[ResistanceEstimate]:
    """Return the registry entry of a regression of Liu et al. 2018."""
    return Algorithm(
        name,
        f'{summary}; for comparison',
        config,
        lambda train_file, chosen, _: WindowedRegression(train_file, chosen, step),
        fixed,
    )


ALGORITHMS: Final[tuple[Algorithm[ResistanceEstimate], ...]] = (
    Algorithm(
        'two-window',
        'trajectory fit over a long window, monitored by a short one; for records about every 100 m',
        TwoWindowConfig(),
        lambda train_file, config, _: TwoWindow(train_file, config),
    ),
    Algorithm(
        'speed-EKF',
        'extended Kalman filter on raw speed; most accurate with small disturbances and no parameter steps',
        SpeedEkfConfig(),
        lambda train_file, config, _: SpeedEkf(train_file, config),
    ),
    _regression('LS', 'least squares over all windows so far', solve_step, WindowedConfig(), _ONE | _NO_PENALTY),
    _regression(
        'regularised-LS',
        'LS with a penalty on the parameters',
        solve_step,
        WindowedConfig(penalty=50.0),
        _ONE | {'record_length'},
    ),
    _regression(
        'RLS',
        'recursive least squares, initialised as printed',
        innovation_step,
        WindowedConfig(),
        _ONE | _NO_PENALTY,
    ),
    _regression(
        'regularised-RLS',
        'RLS from P(0) = I/lambda, equal to regularised-LS at every step',
        innovation_step,
        WindowedConfig(penalty=50.0),
        _ONE,
    ),
    _regression(
        'MILS',
        'LS that counts each window p times',
        innovation_step,
        WindowedConfig(innovation_length=4),
        _NO_PENALTY,
    ),
    _regression(
        'regularised-MILS',
        'MILS from P(0) = I/(p lambda)',
        innovation_step,
        WindowedConfig(innovation_length=4, penalty=50.0),
    ),
    _regression(
        'V-MILS-printed',
        'MILS that updates only when the last p windows are all good',
        strict_step,
        WindowedConfig(innovation_length=4, gate=3.0),
        _NO_PENALTY,
    ),
    _regression(
        'regularised-V-MILS',
        'V-MILS-printed from P(0) = I/(p lambda)',
        strict_step,
        WindowedConfig(innovation_length=4, penalty=50.0, gate=3.0),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""How often a resistance or a brake rate is VALID and wrong: on simulated days with steps, and in the field worlds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.days import assumed_train
from benchmarks.rides import DAY, ride
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.worlds import WORLDS
from benchmarks.yizhuang_day import DRY, RAIN, yizhuang_day
from trainid_ros.estimators.pipeline import EstimatorPipeline, SharedRecord, share_streams
from trainid_ros.interface.results import Output, Status
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.train.forces import specific_inertia

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from trainid_ros.interface.records import Record
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_FIRST_SEED: Final = 7001
# More seeds than days are hardly needed for a share of a tenth of a per cent; a world takes longer to simulate.
DAYS: Final = 100
_DRIVES: Final = 20
_WRONG: Final = 3.0
_MOVING: Final = 1.0
_PERIOD_S: Final = 0.2
_HEADER: Final = (
    'estimate', 'drives', 'VALID, share of motion', 'VALID > 3 std', 'longest, mean s', 'longest, s',
    'with HOLDING > 3 std', '|error| in motion', 'median std', '95 % band',
)  # fmt: skip
_NOTE: Final = (
    'VALID > 3 std: share of the VALID outputs in motion whose error exceeds three of their own standard deviations; '
    'longest: longest such stretch of each drive. Resistance at the measured speed in N/kN. Steps are abrupt: on the '
    'Yizhuang days a grows by 0.5 N/kN and later c by 20 %. Even for a detector that knows the size of a step of a and '
    'all else, and to which only the speed is noisy, its evidence reaches three standard deviations after {:.1f} s.'
)
# Evidence for a step, in standard deviations.
_SIGMAS: Final = 3.0


@dataclass(frozen=True, slots=True)
class Integrity:
    """Scores of one estimate on one drive: shares [1], times [s], errors in the unit of the estimate."""

    valid: float
    wrong: float
    longest_s: float
    wrong_with_holding: float
    error: float
    std: float
    covered: float


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables for resistance and brake rate."""
    kinds = [(DAY, min(seeds, DAYS) if seeds < _DRIVES else DAYS), *((name, min(seeds, _DRIVES)) for name in WORLDS)]
    trials = [(kind, _FIRST_SEED + k) for kind, count in kinds for k in range(count)]
    scores = dict(zip(trials, over_seeds(run, trials, 'integrity'), strict=True))
    return tuple(
        Table(
            f'VALID and wrong: {title}',
            _HEADER,
            tuple(_row(kind, [scores[kind, _FIRST_SEED + k][place] for k in range(count)]) for kind, count in kinds),
            _NOTE.format(_least_detection_s()),
        )
        for place, title in enumerate(('running resistance', 'brake rate'))
    )


def _least_detection_s() -> float:
    """Return how long an ideal detector takes for the step of a on the days [s].

    After a time t the speed is off by d t, with d the change of the acceleration. Measured every T with a variance R,
    the squared sum of d t over its standard deviation is d^2 t^3 / (3 R T).
    """
    train, sensors = assumed_train().train, yizhuang_day(assumed_train()).sensors
    d = (RAIN.a - DRY.a) / specific_inertia(1.0, train.rotary_mass)
    R = sensors.speed_noise * sensors.speed_noise
    return float(np.cbrt(3.0 * R * _PERIOD_S * _SIGMAS * _SIGMAS / (d * d)))


def _row(kind: str, scores: Sequence[Integrity]) -> tuple[str, ...]:
    def mean(name: str) -> float:
        return float(np.mean([getattr(score, name) for score in scores]))

    return (
        kind,
        str(len(scores)),
        f'{mean("valid"):.1%}',
        f'{mean("wrong"):.3%}',
        f'{mean("longest_s"):.1f}',
        f'{max(score.longest_s for score in scores):.1f}',
        f'{mean("wrong_with_holding"):.3%}',
        f'{mean("error"):.4f}',
        f'{mean("std"):.4f}',
        f'{mean("covered"):.1%}',
    )


def run(trial: tuple[str, int]) -> tuple[Integrity, Integrity]:
    """Return the scores of resistance and brake rate on one drive."""
    kind, seed = trial
    train_file, records, truths = ride(kind, seed)
    resistance, brake_rate = _published(train_file, records)
    davis, rates = truths(np.array([output.stamp_ns for output in resistance]))
    speed = np.array([output.estimate.speed for output in resistance])
    w = davis[:, 0] + davis[:, 1] * speed + davis[:, 2] * speed * speed
    found = np.array([(output.estimate.resistance, output.estimate.resistance_std) for output in resistance])
    rate = np.array([(output.estimate.brake_rate, output.estimate.brake_rate_std) for output in brake_rate])
    statuses = [np.array([int(output.status) for output in outputs]) for outputs in (resistance, brake_rate)]
    return (
        _score(statuses[0], speed, found[:, 0] - w, found[:, 1]),
        _score(statuses[1], speed, rate[:, 0] - rates, rate[:, 1]),
    )


def _published(train_file: TrainFile, records: Iterable[Record]) -> tuple[list[Output[Any]], list[Output[Any]]]:
    settings = EstimatorSettings()
    pipelines: list[EstimatorPipeline[Any]] = [
        make(train_file, settings) for make in (resistance_pipeline, brake_rate_pipeline)
    ]
    share_streams(pipelines)
    outputs: tuple[list[Output[Any]], list[Output[Any]]] = ([], [])
    for record in records:
        shared = SharedRecord(record.row())
        for pipeline, made in zip(pipelines, outputs, strict=True):
            pipeline.take(shared.events(pipeline.stream), made.append)
    return outputs


def _score(status: NDArray[np.int64], speed: Array, error: Array, std: Array) -> Integrity:
    moving, valid = speed >= _MOVING, status == Status.VALID
    usable, wrong = valid | (status == Status.HOLDING), np.abs(error) > _WRONG * std
    longest = current = 0
    for bad in (valid & wrong)[moving]:
        current = current + 1 if bad else 0
        longest = max(longest, current)
    return Integrity(
        valid=float(valid[moving].mean()),
        wrong=_share(wrong, valid & moving),
        longest_s=longest * _PERIOD_S,
        wrong_with_holding=_share(wrong, usable & moving),
        error=float(np.abs(error[moving]).mean()),
        std=float(np.median(std[moving])),
        covered=float((np.abs(error) < 1.96 * std)[moving].mean()),
    )


def _share(chosen: NDArray[np.bool_], among: NDArray[np.bool_]) -> float:
    """Return the share of those chosen, 0 of none."""
    return float(chosen[among].mean()) if among.any() else 0.0

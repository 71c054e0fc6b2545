# SPDX-License-Identifier: Apache-2.0
"""What to drive so that the brake rate becomes known: brakings, and the standard deviation that they promise.

What a braking would show depends on the noise that the estimator has learned, on its particles, and on what it knows
of dead time, lag and the other errors of the train file. A copy of the estimator therefore goes through the planned
braking, fed with its own predicted speed plus noise.
"""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.resistance.suggested_drive import STEP_S, SuggestedDrive, Wanted, best_drive, planned_brakings
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import BrakeCommandChange, acceleration, davis, lag_integral, lag_response

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.interface.results import BrakeRateEstimate
    from trainid_ros.resistance.suggested_drive import Run
    from trainid_ros.train.train_file import TrainFile

# Interval of the speeds [s], time for which they show the train before it brakes, and longest braking.
_DT: Final = 0.2
_BEFORE_S: Final = 2.0
_MAX_BRAKING_S: Final = 300.0


def suggested_braking(estimator: object, train_file: TrainFile, now: BrakeRateEstimate) -> SuggestedDrive | None:
    """Return the shortest drive with brakings that make the brake rate valid, as far as any does.

    None if it is valid at present, if nothing was measured yet, if the train file is wrong, or if no braking would
    help; only GSMA can foresee its standard deviation.
    """
    config = estimator.config if isinstance(estimator, Gsma) else None
    if not (isinstance(estimator, Gsma) and isinstance(config, GsmaConfig)):
        return None
    if estimator.converged or estimator.state.stamp_ns == 0:
        return None
    saved = estimator.save()

    def foreseen(run: Run, times: int) -> Iterator[BrakeRateEstimate]:
        copy = Gsma(train_file, config, np.random.default_rng())
        copy.restore(saved)
        for _ in range(times):
            start_ns = copy.state.stamp_ns + round(len(run.steps) * STEP_S * NS_PER_S)
            for sample in _braking(copy, run, train_file, start_ns):
                copy.step(sample)
            yield copy.estimate(0.0)

    wanted = Wanted('brake rate', '', attrgetter('brake_rate_std'), config.valid_std)
    return best_drive((wanted,), now, planned_brakings(train_file), foreseen)


def _braking(estimator: Gsma, run: Run, train_file: TrainFile, start_ns: int) -> Iterator[Sample]:
    """Yield samples of a braking to the stop, on level track, by a brake as it is estimated."""
    state, brake, train, command = estimator.state, train_file.brake, train_file.train, run.manoeuvre.braking
    factor, lag, std = estimator.posterior.rate, state.timing.lag, math.sqrt(state.noise.variance)
    begin, acts_s = round(_BEFORE_S / _DT), _BEFORE_S + state.timing.delay
    rng, v, target = np.random.default_rng(0), run.manoeuvre.start, 0.0
    for k in range(round(_MAX_BRAKING_S / _DT)):
        if v < estimator.config.min_speed:
            return
        stamp_ns = start_ns + round(k * _DT * NS_PER_S)
        # The holding brake is released at the start.
        given = {0: 0.0, begin: command}.get(k)
        changes = () if given is None else (BrakeCommandChange(stamp_ns, given),)
        measured = v + std * float(rng.standard_normal())
        sample = coasting_sample(stamp_ns, math.nan if k == 0 else _DT, measured)
        sample.brake_command, sample.brake_changes = command if k >= begin else 0.0, changes
        sample.curvature_mean = 0.0
        yield sample
        acting_s = min(_DT, max(0.0, (k + 1) * _DT - acts_s))
        braked = factor * brake.shape_at(v) * lag_integral(target, command, lag, acting_s)
        target = lag_response(target, command, lag, acting_s)
        v += braked + _DT * acceleration(0.0, train.mass, train.rotary_mass, davis(train_file.resistance, v))

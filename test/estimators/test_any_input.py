# SPDX-License-Identifier: Apache-2.0
"""Whatever records and samples arrive, estimates stay finite; a sample that cannot be used changes no parameter."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from test.estimators.makers import NAMES, make, stepped
from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.records import NS_PER_S, Row
from trainid_ros.interface.results import BrakeRateEstimate, Reason, ResistanceEstimate
from trainid_ros.interface.state import encode
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.vmils import VMils
from trainid_ros.setup.pipelines import BRAKE_RATE, RESISTANCE, SPEED_MODEL
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Davis, Train, TrainFile

START_NS = 1_700_000_000 * NS_PER_S
TRAIN = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001))
STAMPS = st.one_of(
    st.integers(START_NS, START_NS + 60 * NS_PER_S),
    st.integers(0, 2**31 * NS_PER_S),
    st.integers(START_NS // NS_PER_S, START_NS // NS_PER_S + 60).map(lambda s: s * NS_PER_S),
)
VALUES = st.one_of(st.floats(), st.floats(-30.0, 30.0), st.floats(-1e6, 1e6))
ROWS = st.tuples(st.integers(0, 4), STAMPS, VALUES, VALUES, st.booleans())
DRIVE: list[Row] = [
    (topic, START_NS + i * NS_PER_S // 5, x, 0.0, False)
    for i in range(50)
    for topic, x in ((1, 1e4), (2, -2.0), (3, 0.0), (0, 10.0 + 0.01 * i))
]


def numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float) else []


@pytest.mark.parametrize('name', NAMES)
@settings(deadline=None, max_examples=60)
@given(rows=st.lists(ROWS, max_size=60), at=st.integers(0, len(DRIVE)))
def test_no_record_raises_or_makes_a_number_infinite(name: str, rows: list[Row], at: int) -> None:
    pipeline = make(name, TRAIN)
    for row in [*DRIVE[:at], *rows, *DRIVE[at:]]:
        outputs: list[Any] = []
        pipeline.take(pipeline.stream.push_row(*row), outputs.append)
        for output in outputs:
            assert not any(math.isinf(number) for number in numbers(astuple(output.estimate)))


Make = Callable[..., Sample]
ALGORITHMS = {name: kind for kind in (RESISTANCE, SPEED_MODEL, BRAKE_RATE) for name in kind.built_in}
ALL = pytest.mark.parametrize('name', ALGORITHMS)


def estimator_of(name: str, train_file: TrainFile) -> Any:
    if name == 'filter-bank':  # fewer hypotheses: the same filters, but faster
        return FilterBank(train_file, FilterBankConfig(hypotheses=8))
    algorithms: Any = ALGORITHMS[name]
    return algorithms.make(algorithms.choose(name), train_file, np.random.default_rng(1))


def learned(estimator: Any) -> Any:
    """Return what a rejected sample must not change."""
    if isinstance(estimator, VMils):
        return encode(estimator.learner.tracker)
    if isinstance(estimator, SpeedModelEstimator):
        return estimator.method.theta()
    return repr(estimator.estimate(12.0)) if isinstance(estimator, FilterBank) else estimator.estimate(12.0).brake_rate


REJECTED: list[tuple[dict[str, Any], Reason]] = [
    ({'dt': math.nan}, Reason.GAP),
    ({'force_mean': math.nan}, Reason.FORCE_MISSING),
    ({'force_mean': 1e8}, Reason.OUT_OF_RANGE),
    ({'gradient_mean': math.nan}, Reason.GRADIENT_MISSING),
    ({'brake_command': math.nan}, Reason.BRAKE_COMMAND_MISSING),
    ({'speed': 0.4}, Reason.STANDSTILL),
    ({'brake_command': -0.5}, Reason.BRAKING),  # of which GSMA learns
]


@ALL
def test_bad_samples_are_rejected_with_their_reason_and_change_no_parameter(
    train_file: TrainFile, sample: Make, journey: Callable[..., list[Sample]], name: str
) -> None:
    samples = journey(30.0, traction=lambda t: 30.0 if t % 40.0 < 20.0 else 0.0, speed=8.0)
    text = stepped(estimator_of(name, train_file), samples).save()
    for fields, reason in REJECTED[: -1 if name == 'GSMA' else None]:
        estimator = estimator_of(name, train_file)
        estimator.restore(text)
        before, std = learned(estimator), getattr(estimator.estimate(12.0), 'brake_rate_std', None)
        result = estimator.step(sample(151, **fields))
        assert (result.reason, learned(estimator)) == (reason, before)
        if isinstance(estimator, VMils):
            assert estimator.learner._windows.samples == []
        if std is not None:
            assert estimator.estimate(12.0).brake_rate_std > std


def wild(rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Yield the fields of samples as bad as the aligner passes on, mixed with good ones."""
    share, stamp, command = float(rng.choice([0.01, 0.1])), 1_700_000_000 * NS_PER_S, 0.0

    def near(value: float, spread: float, low: float, high: float) -> float:
        if rng.random() < share:
            return float(rng.choice([math.nan, low, high, rng.uniform(low, high)]))
        return float(np.clip(value + spread * rng.standard_normal(), low, high))

    for _ in range(int(rng.integers(50, 300))):
        dt = float(rng.choice([0.02, 0.2, 0.2, 0.2, 0.5, 1.0, 2.5]))
        stamp += round(dt * NS_PER_S)
        changes: tuple[BrakeCommandChange, ...] = ()
        if rng.random() < 0.05:
            command = -float(rng.choice([0.0, 0.0, 0.4, 1.0, 10.0]))
            changes = (BrakeCommandChange(stamp - 10, command), BrakeCommandChange(stamp, command))
        speed = near(12.0, 0.1, 0.0, 200.0)
        yield {
            'stamp_ns': stamp,
            'dt': math.nan if rng.random() < 0.03 else dt,
            'speed': 0.0 if math.isnan(speed) else speed,
            'position': near(1e3, 100.0, -1e6, 1e6),
            'force': near(0.0, 1e5, -1e8, 1e8),
            'force_mean': near(2e4, 5e4, -1e8, 1e8),
            'gradient': near(0.0, 5.0, -200.0, 200.0),
            'gradient_mean': near(0.0, 10.0, -200.0, 200.0),
            'curve_radius': abs(near(0.0, 400.0, 0.0, 1e9)),
            'curvature_mean': abs(near(0.0, 1e-3, 0.0, 1.0)),
            'tunnel': bool(rng.random() < 0.3),
            'mass': near(2e5, 5e3, 100.0, 1e9),
            'brake_command': math.nan if rng.random() < 0.03 else command,
            'brake_changes': changes,
            'brake_gap': bool(rng.random() < 0.02),
            'emergency': bool(rng.random() < 0.01),
        }


def check_finite(estimate: Any) -> None:
    values = [
        getattr(estimate, name) for name in estimate.__dataclass_fields__ if name not in ('covariance', 'position')
    ]
    assert all(map(math.isfinite, values))
    if isinstance(estimate, BrakeRateEstimate):
        assert 0.0 <= estimate.brake_rate <= 3.0
        assert estimate.brake_rate_std > 0.0
        assert 1.0 <= estimate.effective_particles <= 300.0 * (1.0 + 1e-9)
        return
    P = np.array(estimate.covariance)
    P = P.reshape(math.isqrt(P.size), -1)
    std = np.sqrt(np.diag(P))
    assert np.all(std > 0.0)
    assert np.max(np.abs(P - P.T) / np.outer(std, std)) < 1e-9
    # Rounding of the published form of P, relative to its own size.
    assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > (
        -1e-9 if isinstance(estimate, ResistanceEstimate) else -1e-6
    )


@ALL
@settings(max_examples=12, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(seed=st.integers(0, 2**32 - 1))
def test_no_input_invalidates_an_estimate(train_file: TrainFile, sample: Make, name: str, seed: int) -> None:
    """All numbers stay finite and the covariances valid; those of a saved state are checked when it is restored."""
    estimator, copy = estimator_of(name, train_file), estimator_of(name, train_file)
    for k, fields in enumerate(wild(np.random.default_rng(seed))):
        estimator.step(sample(k, **fields))
        check_finite(estimator.estimate(12.0))
        if k % 40 == 39:
            copy.restore(estimator.save())
            assert copy.save() == estimator.save()

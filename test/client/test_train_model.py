# SPDX-License-Identifier: Apache-2.0
"""Answers of the client without ROS: values, units, sources, refused arguments, and clocks that go back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from test.calls import count_in_sources
from trainid_ros.bag.bag_replay import Pipelines, Replay, replay_through
from trainid_ros.bag.reader import BagReader, LoggedRecord
from trainid_ros.client import TrainModel, Value
from trainid_ros.client.stopping import RateShape, StoppingBounds, StopPosterior
from trainid_ros.estimators.settings import FilterBankConfig, GsmaConfig
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import BRAKE_RATE_TOPIC, NS_PER_S, RESISTANCE_TOPIC, SpeedRecord
from trainid_ros.interface.results import AdhesionEstimate, BrakeRateEstimate, Output, ResistanceEstimate, Status
from trainid_ros.interface.scalars import seconds
from trainid_ros.setup.pipelines import BRAKE_RATE, EstimatorSettings
from trainid_ros.train.forces import G, acceleration
from trainid_ros.train.train_file import Brake, Davis, Effect, Train, TrainFile, load_train_file

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
FILE = TrainFile(Train(mass=200e3, rotary_mass=0.1), Davis(1.5, 0.02, 0.001), Brake(1.0, 0.4, 0.6))
COVARIANCE = (0.01, -4e-4, 0.0, -4e-4, 2e-5, 0.0, 0.0, 0.0, 1e-9)
W = ResistanceEstimate(
    *(2.0, 0.03, 0.0012, COVARIANCE, 2.4, 0.05, 10.0, 0.1, 0.01, 0.2, 3.0, 18.0, 0.1),
    force_scale=0.95,
    force_scale_std=0.004,
    force_delay=0.0,
    force_delay_std=0.02,
)
F = BrakeRateEstimate(0.9, 0.02, math.nan, 10.0, 0.0, 0.0, 50.0, False, 0.0, 0.01, 0.1)


def braking(estimate: BrakeRateEstimate) -> BrakeRateEstimate:
    """Return an estimate that braking has just updated."""
    return replace(estimate, observable=True)


class Drive:
    """A model with estimates at 5 Hz under a clock that the test sets."""

    def __init__(self, train_file: TrainFile = FILE) -> None:
        self.now = 0.0
        self.model = TrainModel(None, train_file, clock=lambda: self.now)

    def on(self, duration_s: float, status: Status = Status.VALID) -> TrainModel:
        for _ in range(round(duration_s / 0.2)):
            self.now += 0.2
            self.model.take(Output(round(self.now * 1e9), W, status, 1, 0, None))
            self.model.take(Output(round(self.now * 1e9), F, status, 1, 0, None))
        return self.model


class Listener:
    """A client that receives the outputs of a replay as the nodes publish them, by the clock of the log."""

    def __init__(self, train_file: TrainFile) -> None:
        self._now_ns = 0
        self._model = TrainModel(None, train_file, clock=lambda: seconds(self._now_ns))
        self.answers: dict[int, tuple[Value, ...]] = {}

    def on_record(self, entry: LoggedRecord) -> None:
        self._now_ns = entry.log_ns

    def on_output(self, output: Output[Any], log_ns: int) -> None:  # noqa: ARG002 - the clock has it
        self._model.take(output)
        if isinstance(output.estimate, BrakeRateEstimate):
            self.answers[self._now_ns] = asked(self._model)  # the last after each record


def asked(model: TrainModel) -> tuple[Value, ...]:
    return model.resistance(12.0), model.brake_rate(12.0), model.feed_forward(12.0, 1.0, 0.4)


@pytest.fixture(scope='module')
def heard() -> Listener:
    return Listener(load_train_file(BAG / 'train.yaml'))


@pytest.fixture(scope='module')
def replayed(heard: Listener) -> tuple[Replay, TrainFile]:
    train_file = load_train_file(BAG / 'train.yaml')
    with BagReader(BAG) as reader:
        return replay_through(Pipelines.of(train_file, EstimatorSettings()), reader, observers=[heard]), train_file


def test_the_resistance_at_a_speed_has_the_covariance_of_all_parameters() -> None:
    model, v = Drive().on(20.0), 15.0
    phi = (1.0, v, v * v)
    variance = sum(phi[i] * phi[j] * COVARIANCE[3 * i + j] for i in range(3) for j in range(3))
    w = model.resistance(v)
    assert w.value == pytest.approx(2.0 + 0.03 * v + 0.0012 * v * v)
    assert w.std == pytest.approx(math.sqrt(variance))
    assert (w.live, w.reason) == (True, 'VALID')


def test_without_estimates_the_train_file_answers_with_its_std() -> None:
    model = Drive().model
    w = model.resistance(10.0)
    assert w.value == pytest.approx(1.8)
    assert 0.5 < w.std < 2.0
    assert (w.live, w.reason) == (False, 'train file: no estimate yet')
    assert model.brake_rate() == Value(1.0, 0.2, False, 'train file: no estimate yet')


def test_the_air_drag_is_the_same_force_for_any_load() -> None:
    train = replace(FILE.train, c_by_weight=1.0)
    model, plain = TrainModel(None, replace(FILE, train=train)), TrainModel(None, FILE)
    v, M, c = 12.0, 1.3 * train.mass, FILE.resistance.c
    less = plain.feed_forward(v, 5.0, 0.0, M).value - model.feed_forward(v, 5.0, 0.0, M).value
    assert less == pytest.approx(0.001 * G * c * v * v * (M - train.mass))
    assert model.feed_forward(v, 5.0, 0.0).value == plain.feed_forward(v, 5.0, 0.0).value


@pytest.mark.parametrize('mass', [None, 230e3])
def test_the_force_gives_the_acceleration_that_was_asked_for(mass: float | None) -> None:
    model = Drive().on(20.0)
    w = model.resistance(12.0).value
    for wanted in (0.7, -0.7):
        force = model.feed_forward(12.0, 5.0, wanted, mass).value
        scale = 0.95 if wanted > 0.0 else 1.0  # the reported traction reads 5 % high, or the mass 5 % low
        assert acceleration(scale * force, mass or 200e3, 0.1, w + 5.0) == pytest.approx(wanted)


@pytest.mark.parametrize('mass', [None, 230e3])
@pytest.mark.parametrize(('wanted', 'scale'), [(0.5, 0.95), (-0.5, 1.0)])
def test_the_std_of_a_live_force_is_that_of_its_scale_or_while_braking_of_the_mass(
    wanted: float, scale: float, mass: float | None
) -> None:
    stated = math.hypot(0.03, 0.02)  # of mass and force in the train file
    for model, s, live_share in ((Drive().on(20.0), scale, 0.004 / scale), (Drive().model, 1.0, stated)):
        force = model.feed_forward(10.0, 0.0, wanted, mass)
        weight = 1e-3 * (mass or 200e3) * 9.80665 / s
        share = live_share if wanted > 0.0 else FILE.train.mass_std
        parts = (weight * model.resistance(10.0).std, weight * 0.2, force.value * share)
        assert force.std == pytest.approx(math.hypot(*parts))


def test_a_brake_command_gives_the_deceleration_that_was_asked_for() -> None:
    model = Drive().on(20.0)
    command = model.brake_command(12.0, -8.0, -0.6)
    w, k = model.resistance(12.0).value, 9.80665 / 1100.0
    assert 0.9 * command.value - k * (w - 8.0) == pytest.approx(-0.6)
    assert model.brake_command(12.0, 0.0, 0.0).value == 0.0


def test_the_brake_rate_at_a_speed_is_the_factor_on_the_table_with_its_change_over_speed() -> None:
    table = replace(FILE, brake=Brake(1.0, rate_table=((2.0, 1.2), (22.0, 0.4))))
    for file, speed, s, m in ((table, 12.0, 0.8, 0.0), (FILE, 0.0, 1.0, 0.0), (FILE, 2.5, 1.0, 1.0)):
        model = Drive(file).on(20.0)
        assert model.brake_rate().value == 0.9
        assert model.brake_rate().std == pytest.approx(0.02)
        rate, p = model.brake_rate(speed), speed / file.train.max_speed - 0.5
        assert rate.value == pytest.approx(0.9 * s)
        assert rate.std == pytest.approx(s * math.hypot(0.02, 0.08 * p, 0.06 * m))


def test_the_std_of_a_brake_command_is_that_of_its_parts() -> None:
    for map_std in (0.2, 20.0):
        model = Drive(replace(FILE, line=replace(FILE.line, gradient_std=map_std))).on(20.0)
        w, rate, k = model.resistance(12.0), model.brake_rate(12.0), 9.80665 / 1100.0
        command = model.brake_command(12.0, -8.0, -0.6)
        parts = (k * w.std, k * map_std, command.value * rate.std)
        assert command.std == pytest.approx(math.hypot(*parts) / rate.value)


def test_effects_of_the_brake_in_the_train_file_count() -> None:
    weaker = replace(FILE, effects=(Effect('brake_scale', (('ratio', 0.8),)), Effect('brake_delay', (('extra', 1.0),))))
    assert TrainModel(None, weaker).brake_rate().value == pytest.approx(0.8)
    long, usual = (TrainModel(None, x).stopping_distance(20.0, confidence=0.5).value for x in (weaker, FILE))
    assert long > 20.0 + 1.2 * usual


def test_live_values_shorten_a_bound_and_move_without_a_jump() -> None:
    drive = Drive()
    before = drive.model.stopping_distance(18.0)
    bounds, rates, forces = [before.value], [1.0], [drive.model.feed_forward(10.0, 0.0, 0.5).value]
    for _ in range(60):
        model = drive.on(0.2)
        bounds.append(model.stopping_distance(18.0).value)
        rates.append(model.brake_rate().value)
        forces.append(model.feed_forward(10.0, 0.0, 0.5).value)
    assert (bounds[-1] < 0.95 * before.value, rates[-1]) == (True, 0.9)
    for values, largest in ((bounds, 8.0), (rates, 0.011), (forces, 2000.0)):
        assert max(abs(after - value) for value, after in pairwise(values)) < largest


def test_records_of_numpy_are_learned_from_and_others_refused() -> None:
    model = TrainModel.offline(FILE, max_age=2.0)
    for k in range(3):
        model.push(SpeedRecord(k * NS_PER_S + 1, np.float64(5.0), np.float32(0.0)))  # type: ignore[arg-type]
    with pytest.raises(InputError, match='push: None is no record'):
        model.push(None)  # type: ignore[arg-type]


HAZARD = replace(FILE, brake=replace(FILE.brake, loss_per_hour=2.0, loss=0.2))


def test_a_bound_counts_drops_since_the_brake_was_last_observed() -> None:
    now = 0.0
    model, plain = (TrainModel(None, file, max_age=1e9, clock=lambda: now) for file in (HAZARD, FILE))
    for estimate in (W, braking(F)):
        model.take(Output(1, estimate, Status.VALID, 1, 0, None))
        plain.take(Output(1, estimate, Status.VALID, 1, 0, None))
    assert model.stopping_distance(20.0) == plain.stopping_distance(20.0)  # just observed
    now, later = 60.0, []
    known = plain.stopping_distance(20.0)
    for minutes in (1.0, 3.0, 30.0):
        now = 60.0 * minutes
        model.take(Output(round(now), F, Status.HOLDING, 1, 0, None))
        later.append(model.stopping_distance(20.0))
    assert known.value < later[0].value < later[1].value < later[2].value
    assert {answer.std for answer in later} == {known.std}
    # After half an hour, the brake has dropped with a probability of 1 - 1/e.
    posterior = StopPosterior(
        (0.9, 0.0, 0.0, *(W.a, W.b, W.c), 0.0, 0.6, 0.4),
        (0.02**2, 0.08**2, 0.06**2, 0.0, 0.0, 0.0, 0.2**2, *(x * x for x in HAZARD.brake.timing_stds)),
        COVARIANCE, 1.0 - math.exp(-1.0), 0.2,
    )  # fmt: skip
    k = 9.80665 / 1100.0
    bound = StoppingBounds(RateShape([], [], FILE.train.max_speed, 2.5, k), posterior, 1.0, 0.0, 0.95).at(20.0)
    assert later[2].value == pytest.approx(bound.distance, rel=1e-3)
    speed = model.braking_speed(later[2].value)
    assert speed.value == pytest.approx(20.0, abs=1e-5)
    assert model.braking_curve(later[2].value, (0.0,)) == (speed,)


@pytest.mark.parametrize(('confidence', 'share'), [(0.95, 0.9), (0.99, 0.9), (0.9, 0.9), (0.5, 0.5)])
def test_a_bound_holds_its_stated_share_of_the_first_stops_after_a_drop(confidence: float, share: float) -> None:
    now = 0.0
    asked = replace(HAZARD, brake=replace(HAZARD.brake, loss_per_hour=0.01, loss_confidence=0.9))
    model, plain = (TrainModel(None, file, max_age=1e9, clock=lambda: now) for file in (asked, FILE))
    for one, factor in ((model, 1.0), (plain, 1.0 - HAZARD.brake.loss)):
        one.take(Output(1, W, Status.VALID, 1, 0, None))
        lower = replace(F, brake_rate=factor * F.brake_rate, brake_rate_std=factor * F.brake_rate_std)
        one.take(Output(1, lower, Status.VALID, 1, 0, None))
    now = 60.0
    bound = model.stopping_distance(20.0, confidence=confidence).value
    # The rate over speed of the lower brake is as uncertain as that of the known one here: slightly longer.
    assert bound >= 0.995 * plain.stopping_distance(20.0, confidence=share).value
    assert bound <= 1.02 * plain.stopping_distance(20.0, confidence=max(share, confidence)).value


def test_without_a_braking_a_brake_counts_as_not_observed_for_an_hour() -> None:
    fresh, hour = Drive(HAZARD), Drive(HAZARD)
    seen = Output(1, braking(F), Status.CONVERGING, 1, 0, None)
    hour.model.take(seen)
    hour.now = 3600.0
    assert hour.model.stopping_distance(20.0).value == pytest.approx(fresh.model.stopping_distance(20.0).value)
    # Neither a copy of the last valid estimate nor one that repeats an old stamp tells when that was.
    fresh.model.take_message(BRAKE_RATE_TOPIC, Status.VALID, seen.estimate, 1, latched=True)
    hour.model.take(seen)
    assert fresh.model._observed_s == -math.inf
    assert hour.model._observed_s == 0.0


@pytest.mark.parametrize('status', [None, Status.STALE, Status.FAULT])
@pytest.mark.parametrize('back_s', [0.0, 75.0])
def test_the_train_file_is_back_within_a_second_also_of_a_clock_that_went_back(
    status: Status | None, back_s: float
) -> None:
    """As at the start of a bag that is played again."""
    drive = Drive()
    drive.on(80.0).resistance(10.0)
    drive.now -= back_s
    if status is not None:
        drive.on(0.2, status)
    drive.model.resistance(10.0)
    drive.now += 1.0
    for answer, expected in ((drive.model.brake_rate(), 1.0), (drive.model.resistance(10.0), 1.8)):
        assert answer.value == pytest.approx(expected)
        assert not answer.live
        assert (status.name if status else 'no new estimate') in answer.reason
    assert drive.model.brake_rate().std == 0.2
    assert not drive.model.stopping_distance(20.0).live


@pytest.mark.parametrize(
    ('estimate', 'reason'),
    [
        (W, 'resistance VALID; brake rate train file: no estimate yet'),
        (F, 'resistance train file: no estimate yet; brake rate VALID'),
    ],
)
def test_one_estimate_alone_may_be_missing(estimate: Any, reason: str) -> None:
    drive = Drive()
    for k in range(100):
        drive.now = 0.2 * k
        drive.model.take(Output(k, estimate, Status.VALID, 1, 0, None))
    model, of_brake = drive.model, estimate is F
    answers = (
        model.braking_speed(200.0), model.stopping_distance(10.0), model.brake_command(10.0, 0.0, -0.5),
        *model.braking_curve(200.0, (0.0,)),
    )  # fmt: skip
    assert {(answer.live, answer.reason) for answer in answers} == {(of_brake, reason)}
    for answer in (model.resistance(10.0), model.feed_forward(10.0, 0.0, 0.5)):
        assert (answer.live, 'brake' in answer.reason) == (not of_brake, False)
    assert model.brake_rate().live is of_brake


def test_a_resistance_in_doubt_does_not_make_answers_on_the_brake_those_of_the_train_file() -> None:
    """As in a gust: its last valid value is kept, as uncertain as that of the train file."""
    drive = Drive()
    before = drive.on(20.0).stopping_distance(18.0)
    drive.now += 0.2
    drive.model.take(Output(round(drive.now * 1e9), W, Status.CONVERGING, 1, 0, None))
    drive.model.take(Output(round(drive.now * 1e9), F, Status.VALID, 1, 0, None))
    after = drive.model.stopping_distance(18.0)
    assert after.live
    assert after.reason.startswith('resistance CONVERGING, the last valid value')
    assert after.reason.endswith('; brake rate VALID')
    assert before.value < after.value < 1.05 * before.value


def test_a_replay_answers_as_its_last_estimate(replayed: tuple[Replay, TrainFile]) -> None:
    result, train_file = replayed
    w, rate = result.resistance.output.estimate, result.brake_rate.output.estimate
    model = TrainModel.from_replay(result, train_file)
    answer = model.resistance(w.speed)
    assert answer.value == pytest.approx(w.resistance)
    assert answer.std == pytest.approx(w.resistance_std)
    assert model.brake_rate().std == pytest.approx(rate.brake_rate_std)
    assert answer.live == (result.resistance.output.status in (Status.VALID, Status.HOLDING))


@pytest.mark.usefixtures('replayed')
def test_a_train_that_learns_from_records_answers_as_one_that_hears_the_nodes(heard: Listener) -> None:
    model, found = TrainModel.offline(BAG / 'train.yaml'), {}
    with BagReader(BAG) as reader:
        for record in reader.records():
            if model.push(record):
                found[record.stamp_ns] = asked(model)
    assert len(found) > 1000
    assert found == heard.answers
    assert any(answer[0].live for answer in found.values())


def test_only_an_offline_model_takes_records() -> None:
    with pytest.raises(InputError, match='offline'):
        TrainModel(None, FILE).push(SpeedRecord(1, 5.0, 0.0))


def test_the_settings_of_the_estimators_are_those_of_the_values_that_an_offline_model_starts_with() -> None:
    settings = EstimatorSettings(brake_rate=BRAKE_RATE.choose(prior_std=0.3))
    assert TrainModel.offline(FILE, settings).brake_rate().std == 0.3


def test_a_clock_may_be_set_late() -> None:
    drive = Drive()
    drive.on(20.0)
    late = 5e6
    drive.model.set_clock(lambda: late)
    assert drive.model.brake_rate().live
    late += 0.7
    assert drive.model.brake_rate().live
    late += 0.1
    assert not drive.model.brake_rate().live
    with pytest.raises(InputError, match=r'^clock = '):
        drive.model.set_clock(5.0)  # type: ignore[arg-type]
    assert drive.model.brake_rate().value < 1.0  # time still goes on with the last one


def test_a_replay_that_ends_converging_answers_by_the_train_file(replayed: tuple[Replay, TrainFile]) -> None:
    result, train_file = replayed
    last = result.resistance.output
    output = Output(last.stamp_ns, last.estimate, Status.CONVERGING, last.used, last.rejected, None)
    suspected = replace(result.resistance, output=output)
    answer = TrainModel.from_replay(replace(result, resistance=suspected), train_file).resistance(12.0)
    assert not answer.live
    assert answer == replace(TrainModel(None, train_file).resistance(12.0), reason=answer.reason)
    assert 'CONVERGING' in answer.reason


def test_the_curve_is_the_inverse_of_the_distance() -> None:
    model = Drive().on(20.0)
    positions = (600.0, 800.0, 950.0, 999.9, 1000.0, 1020.0)
    curve = model.braking_curve(1000.0, positions, gradient=-4.0, command=-0.8, confidence=0.99)
    assert [speed.value for speed in curve[-2:]] == [0.0, 0.0]
    for position, speed in zip(positions[:3], curve, strict=False):
        away = 1000.0 - position
        assert model.stopping_distance(speed.value, -4.0, -0.8, 0.99).value == pytest.approx(away, abs=1e-6)
        assert speed == model.braking_speed(away, -4.0, -0.8, 0.99)
    assert model.braking_curve(1000.0, iter(positions), -4.0, -0.8, 0.99) == curve
    assert model.braking_curve(1000.0, ()) == ()
    # Positions may fall in the direction of travel.
    rising = model.braking_curve(1000.0, (600.0, 950.0, 1010.0), applied=-0.3)
    assert model.braking_curve(0.0, (400.0, 50.0, -10.0), applied=-0.3, direction=-1) == rising
    assert rising[0] == model.braking_speed(400.0, applied=-0.3)


CALLS_ALL: tuple[Callable[[TrainModel, float, float, float, float], Value], ...] = (
    lambda m, v, i, u, P: m.resistance(v),  # noqa: ARG005
    lambda m, v, i, u, P: m.feed_forward(v, i, u),  # noqa: ARG005
    lambda m, v, i, u, P: m.brake_rate(v),  # noqa: ARG005
    lambda m, v, i, u, P: m.brake_command(v, i, u),  # noqa: ARG005
    lambda m, v, i, u, P: m.stopping_distance(v, i, u, P),
    lambda m, v, i, u, P: m.braking_speed(10.0 * v, i, u, P),
)
# A call with an argument, and a value out of its range.
CALLS: dict[str, tuple[Callable[[TrainModel, Any], object], float]] = {
    'speed': (lambda m, x: m.resistance(x), -7.0),
    'gradient': (lambda m, x: m.feed_forward(10.0, x, 0.0), -700.0),
    'acceleration': (lambda m, x: m.brake_command(10.0, 0.0, x), -700.0),
    'mass': (lambda m, x: m.feed_forward(10.0, 0.0, 0.1, x), -7.0),
    'command': (lambda m, x: m.stopping_distance(10.0, command=x), 7.0),
    'confidence': (lambda m, x: m.braking_speed(10.0, confidence=x), -7.0),
    'distance': (lambda m, x: m.braking_speed(x), -7.0),
    'applied': (lambda m, x: m.stopping_distance(10.0, applied=x), 7.0),
    'stop': (lambda m, x: m.braking_curve(x, (0.0, 100.0)), 1e10),
    'position': (lambda m, x: m.braking_curve(100.0, (0.0, x)), 1e10),
}


@pytest.mark.parametrize('name', CALLS)
def test_an_argument_that_cannot_be_is_named(name: str) -> None:
    ask, beyond = CALLS[name]
    for value in (math.nan, math.inf, -math.inf, beyond):
        with pytest.raises(InputError, match=rf'^{name} = '):
            ask(Drive().model, value)
    with pytest.raises(InputError, match=rf'^{name} = .* must be a number'):
        ask(Drive().model, '5')


def test_numbers_of_numpy_give_plain_answers() -> None:
    model = Drive().model
    one: Any = np.float32(0.5)
    answers = [
        model.resistance(one), model.brake_rate(one), model.feed_forward(one, one, one, 4e5 * one),
        model.brake_command(one, one, -one), model.stopping_distance(one, one, -one, one),
        model.braking_speed(one, one),
    ]  # fmt: skip
    assert {type(x) for answer in answers for x in (answer.value, answer.std)} == {float}


def test_no_answer_is_ever_infinite_whatever_the_estimates_are() -> None:
    rng = np.random.default_rng(3)
    answered = 0
    for _ in range(150):
        a, b, c, rate, scale = (float(x) for x in rng.normal(0.5, 1.0, 5) * 10.0 ** rng.uniform(-4.0, 5.0, 5))
        spread = 10.0 ** rng.uniform(-9.0, 5.0, 3)
        covariance = (spread[0], 0.0, 0.0, 0.0, spread[1], 0.0, 0.0, 0.0, spread[2])
        drive = Drive()
        w = replace(W, a=a, b=b, c=c, covariance=covariance, force_scale=scale)
        f = replace(F, brake_rate=rate, brake_rate_std=float(10.0 ** rng.uniform(-4.0, 2.0)))
        for k in range(3):
            drive.now = 20.0 * k
            drive.model.take(Output(k, w, Status.VALID, 1, 0, None))
            drive.model.take(Output(k, f, Status.VALID, 1, 0, None))
            v, i, u, P = rng.uniform((0.0, -90.0, -3.0, 0.5), (150.0, 90.0, -0.01, 0.999)).tolist()
            for ask in CALLS_ALL:
                with suppress(NoAnswerError):
                    answer = ask(drive.model, v, i, u, P)
                    assert math.isfinite(answer.value), (answer, w, f, v, i, u, P)
                    assert 0.0 <= answer.std < math.inf, (answer, w, f, v, i, u, P)
                    answered += 1
    assert answered > 1000


def test_a_bound_is_that_of_all_that_is_known_of_the_stop() -> None:
    delay_std, lag_std = FILE.brake.timing_stds
    mean = (0.9, 0.0, 0.0, 2.0, 0.03, 0.0012, -4.0, 0.6, 0.4)
    variances = (0.02**2, 0.08**2, 0.06**2, 0.0, 0.0, 0.0, 0.2**2, delay_std**2, lag_std**2)
    form = RateShape([], [], FILE.train.max_speed, GsmaConfig().blend_speed, 9.80665 / 1100.0)
    bound = StoppingBounds(form, StopPosterior(mean, variances, COVARIANCE), 0.8, 0.3, 0.99).at(18.0)
    found = Drive().on(20.0).stopping_distance(18.0, -4.0, -0.8, 0.99, applied=-0.3)
    assert (found.value, found.std) == pytest.approx((bound.distance, bound.std))


def test_a_brake_that_may_not_hold_the_train_has_no_answer() -> None:
    with pytest.raises(NoAnswerError, match='the train may not stop'):
        Drive().model.stopping_distance(20.0, gradient=-60.0, command=-0.4)


def test_a_train_file_may_be_given_by_its_path() -> None:
    assert TrainModel(None, BAG / 'train.yaml').brake_rate().value == load_train_file(BAG / 'train.yaml').brake.rate
    with pytest.raises(InputError, match=r'nowhere\.yaml'):
        TrainModel(None, 'nowhere.yaml')


def test_a_setting_that_cannot_be_is_named() -> None:
    for config in (GsmaConfig(blend_speed=0.0), GsmaConfig(slope_std=math.nan)):
        with pytest.raises(InputError, match=r'^(blend_speed = 0|slope_std = nan) '):
            TrainModel(None, FILE, brake=config)
    with pytest.raises(InputError, match=r'^prior_std_a = '):
        TrainModel(None, FILE, prior=FilterBankConfig(prior_std_a=-1.0))


def answers() -> Iterator[Callable[[], Value]]:
    """Yield an answer of each kind that integrates the way to a stop, for a brake that changes over speed."""
    emu = Brake(1.0, delay=3.3, rate_table=((2.0, 1.25), (8.0, 0.9), (14.0, 0.6), (25.0, 0.4)))
    model = Drive(replace(FILE, brake=emu)).on(20.0)
    yield lambda: model.stopping_distance(20.0)
    yield lambda: model.braking_speed(200.0)


def test_answers_take_little_work() -> None:
    """Compiled, as many calls take 0.4 and 1.2 ms: a controller asks ten times a second."""
    stop, speed = count_in_sources(__file__, 'answers()')
    print(f'{stop} and {speed} calls')
    assert stop < 20_000
    assert speed < 110_000


def test_the_speeds_learned_from_are_those_of_usable_estimates() -> None:
    model = TrainModel(None, FILE)
    model.take_message(RESISTANCE_TOPIC, Status.VALID, replace(W, speed_min=3.0, speed_max=18.0), 1)
    for k, (status, low) in enumerate(((Status.CONVERGING, 0.0), (Status.VALID, math.nan)), 2):
        model.take_message(RESISTANCE_TOPIC, status, replace(W, speed_min=low, speed_max=30.0), k)
    assert model.resistance(20.0).reason.endswith('; outside the speeds learned from, 3.0 to 18.0 m/s')
    model.take_message(RESISTANCE_TOPIC, Status.VALID, replace(W, speed_max=30.0), 0, latched=True)
    assert 'outside' in model.resistance(20.0).reason  # the copy does not count
    late = TrainModel(None, FILE)
    late.take_message(RESISTANCE_TOPIC, Status.VALID, W, 0, latched=True)
    assert late.resistance(20.0).reason.endswith('; outside the speeds learned from, 3.0 to 18.0 m/s')


@pytest.mark.parametrize(
    'wrong',
    [
        {'a': -100.0},
        {'a': 900.0},
        {'c': -10.0},
        {'b': 15.0},
        {'b': -4.0, 'c': 0.18},  # possible at 0 and at full speed, but -20.2 N/kN at half
        {'covariance': (5e4, *COVARIANCE[1:])},
        {'covariance': (-1.0, *COVARIANCE[1:])},
        {'covariance': (1e-3, -1.0, 0.0, -1.0, *COVARIANCE[4:])},
    ],
)
def test_a_resistance_that_no_train_has_is_not_used(wrong: dict[str, Any]) -> None:
    model = TrainModel(None, FILE)
    model.take_message(RESISTANCE_TOPIC, Status.VALID, replace(W, **wrong), 1)
    assert model.resistance(10.0).reason == 'train file: a, b, c or their covariance are not possible'
    model.take(Output(1, replace(F, brake_rate_std=-1.0), Status.VALID, 1, 0, None))
    assert model.brake_rate().reason == 'train file: brake rate = 0.9 with a std of -1 is not possible'


def test_a_resistance_may_be_as_uncertain_as_its_largest_value() -> None:
    model = TrainModel(None, FILE)
    model.take_message(RESISTANCE_TOPIC, Status.VALID, replace(W, covariance=(3.9e4, *COVARIANCE[1:])), 1)
    assert model.resistance(10.0).live


def test_a_bound_relies_on_no_more_than_the_adhesion_of_a_slide() -> None:
    drive = Drive()
    before = drive.on(60.0).stopping_distance(20.0)
    slide = AdhesionEstimate(0.05, 0.0, 0.05, 0.01, -0.12, slipping=True, slip_share=0.1)
    drive.model.take(Output(round(drive.now * 1e9), slide, Status.VALID, 1, 0, None))
    assert drive.model.adhesion() == Value(0.05, 0.01, True, 'VALID')
    after = drive.model.stopping_distance(20.0)
    least = 0.05 * math.exp(-1.645 * 0.2)
    # The resistance of the train helps the brake.
    longest = 20.0**2 / (2.0 * least * G / 1.1) + 20.0 * 1.5
    assert 0.7 * longest < after.value < longest
    assert after.value > 2.0 * before.value
    assert 'limited to an adhesion of 0.036 by a slide' in after.reason
    assert 'adhesion' not in before.reason
    # The standard deviation has that of the adhesion, a fifth of the median.
    median = drive.model.stopping_distance(20.0, confidence=0.5)
    assert after.std > 0.17 * median.value > before.std
    assert median.std == pytest.approx(after.std, rel=0.1)
    speed = drive.model.braking_speed(after.value)
    assert speed.value == pytest.approx(20.0)
    assert speed.std == pytest.approx(0.5 * 20.0 * after.std / after.value, rel=0.1)
    (first,) = drive.model.braking_curve(after.value, [0.0])
    assert first == speed
    # Gentle braking is not limited, and is as uncertain as before.
    gentle = drive.model.stopping_distance(20.0, command=-0.1)
    assert 'slide' not in gentle.reason
    with pytest.raises(
        NoAnswerError, match=r'may not stop: braking limited to an adhesion of 0\.036 by a slide is too weak'
    ):
        drive.model.stopping_distance(20.0, gradient=-60.0)


@pytest.mark.parametrize(('status', 'stamp_ns'), [('VALID', 1), (None, 1), (Status.VALID, None), (Status.VALID, 0.5)])
def test_what_is_no_output_is_refused(status: Any, stamp_ns: Any) -> None:
    output: Any = SimpleNamespace(estimate=None, status=status, stamp_ns=stamp_ns)
    with pytest.raises(InputError, match=r'take: status .* is no output'):
        Drive().model.take(output)


def test_predictions_and_commands_say_that_a_slide_limits_the_brake() -> None:
    drive = Drive()
    before = drive.on(60.0).predict(10.0, speed=20.0, command=-0.8)
    slide = AdhesionEstimate(0.05, 0.0, 0.05, 0.01, -0.12, slipping=True, slip_share=0.1)
    drive.model.take(Output(round(drive.now * 1e9), slide, Status.VALID, 1, 0, None))
    after = drive.model.predict(10.0, speed=20.0, command=-0.8)
    assert after.value > before.value + 1.0
    assert after.std > 2.0 * before.std
    assert 'limited to an adhesion of 0.050 by a slide' in after.reason
    gentle = drive.model.predict(10.0, speed=20.0, command=-0.1)
    assert 'slide' not in gentle.reason
    over = drive.model.predict(10.0, speed=20.0, command=((-40.0, -1.0), (-20.0, -0.1)))
    assert 'slide' not in over.reason
    # A force that brakes is limited too: at most mu g / (1 + gamma) beside the resistance.
    full, coasting = (drive.model.predict(10.0, speed=20.0, force=force) for force in (-1e9, 0.0))
    assert 'limited to an adhesion of 0.050 by a slide' in full.reason
    assert coasting.value - 0.05 * 9.81 * 10.0 < full.value < coasting.value - 0.04 * 9.81 * 10.0
    for answer in (drive.model.brake_command, drive.model.feed_forward):
        assert 'after a slide at 0.050' in answer(20.0, 0.0, -0.8).reason
        assert 'slide' not in answer(20.0, 0.0, -0.2).reason

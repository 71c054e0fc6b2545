# SPDX-License-Identifier: Apache-2.0
"""What the train file says: how fast its resistance may move, and what its effects do to the answers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainid_ros.client import TrainModel
from trainid_ros.client.file_values import DAVIS, FileValues, StatedEffects
from trainid_ros.client.live_estimate import MAX_RATE, Normal, RateLimitedValue
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.estimators.settings import FilterBankConfig, GsmaConfig
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import Record
from trainid_ros.interface.results import Output
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.effects import EFFECTS, parse_effects
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile, load_train_file

TRAINS = sorted((Path(__file__).parents[2] / 'config' / 'trains').glob('*.yaml'))
FILE = TrainFile(Train(mass=200e3), Davis(1.5, 0.02, 0.003))
TABLE = Brake(rate_table=((2.0, 1.2), (22.0, 0.4)))


def values(file: TrainFile) -> FileValues:
    return FileValues(file, FilterBankConfig(), GsmaConfig())


@pytest.mark.parametrize('path', TRAINS, ids=[path.stem for path in TRAINS])
def test_a_resistance_moves_at_most_a_quarter_faster_than_stated_at_any_speed(path: Path) -> None:
    file = load_train_file(path)
    parameter = values(file).resistance()[DAVIS]
    top, start, rng = file.train.max_speed, parameter.file, np.random.default_rng(3)
    directions = [(1.0, v, v * v) for v in np.linspace(0.0, top, 61).tolist()]
    fastest = 0.0
    for _ in range(150):
        way = rng.standard_normal(3) * (1.0, 1.0 / top, 1.0 / top**2) * rng.uniform(0.1, 10.0, 3)
        target = Normal(tuple((np.array(start.mean) + way).tolist()), start.covariance)
        move = RateLimitedValue(start, parameter.probes)
        move.go_to(target, 0.0)
        for direction in directions:
            (before, variance), (after, _) = start.along(direction), target.along(direction)
            fastest = max(fastest, abs(after - before) / math.sqrt(variance) / move.left_s(0.0))
    print(f'{fastest / MAX_RATE:.3f}')
    assert MAX_RATE < fastest < 1.25 * MAX_RATE


def test_without_effects_the_brake_rate_has_the_rows_of_the_train_file() -> None:
    for brake in (Brake(), TABLE):
        shape = values(replace(FILE, brake=brake)).stop_shape(1)
        assert list(zip(shape.speeds, shape.rates, strict=True)) == list(brake.rate_table)
        assert shape.resistances == []


def test_effects_scale_the_rows_of_the_brake_rate() -> None:
    heavy = parse_effects(['mass_error:ratio=1.25'])
    assert values(replace(FILE, brake=TABLE, effects=heavy)).stop_shape(1).rates == pytest.approx([0.96, 0.32])
    one = values(replace(FILE, effects=heavy)).stop_shape(-1)
    assert one.speeds == [0.0]
    assert one.rates == pytest.approx([0.8])


def test_a_wind_gives_each_direction_its_resistance() -> None:
    windy = values(replace(FILE, effects=parse_effects(['headwind:speed=5'])))
    for direction in (1, -1):
        shape = windy.stop_shape(direction)
        for v in (0.0, 4.125, 20.0, 150.0):
            assert shape.extra(v) == pytest.approx(windy.effects.resistance(v, direction), abs=1e-3)


STOPS = tuple(1400.0 * k for k in range(6))
# All runs are in one direction, as a wind cannot be absorbed in both.
LINE = Line(stops=STOPS, gradient=((0.0, 0.0), (1900.0, 12.0), (2400.0, -8.0), (3600.0, 3.0)), gradient_std=0.1)
ON_LINE = replace(FILE, line=LINE)
# Kinds that need more than a speed, as docs/client_reference.md names them, with parameters that would be seen.
NOT_OF_A_SPEED = (
    'bearing_warmup:value=3,distance=5000',
    'curve_resistance:coefficient=600',
    'dragging_brake:permille=5,time=20',
    'gradient_error:start=-1e4,end=1e4,permille=4',
    'local_drag:start=-1e4,end=1e4,permille=4',
    'map_shift:distance=50',
    'resistance_step:time=100,a=2',
    'tunnel_drag:factor=2',
)
ON_RECORDS = ('stamp_skew:delay=0.5', 'wheel_diameter:ratio=1.1', 'wheel_slip:share=0.1,speed=2')
OF_A_SPEED = (
    'brake_delay:extra=0.5',
    'brake_fade:loss=0.3,energy=500',
    'brake_scale:ratio=0.8',
    'brake_slope:slope=-0.012',
    'headwind:speed=10',
    'higher_order_drag:coefficient=0.0005',
    'mass_error:ratio=1.2',
    'run_drag:size=2',
    'starting_resistance:value=4,speed=2',
    'traction_scale:ratio=0.8',
)


def stated(*texts: str) -> TrainFile:
    return replace(ON_LINE, effects=parse_effects(texts))


def model(*texts: str) -> TrainModel:
    return TrainModel(None, stated(*texts))


def replayed(records: tuple[Record, ...], file: TrainFile) -> TrainModel:
    """Return the client after all records, with values that have settled."""
    now, settings = 0.0, EstimatorSettings()
    group = PipelineGroup((resistance_pipeline(file, settings), brake_rate_pipeline(file, settings)))
    client = TrainModel(None, file, max_age=1e9, clock=lambda: now)
    outputs: list[Output[Any]] = []
    for record in records:
        group.push_rows((record.row(),), outputs.append)
    for output in outputs:
        now = output.stamp_ns / 1e9
        client.take(output)
    now += 1e6
    return client


@pytest.mark.parametrize(
    'effects',
    [
        pytest.param(('mass_error:ratio=1.2',), marks=pytest.mark.long),  # scales both forces, as the next ones do
        ('traction_scale:ratio=0.9', 'brake_scale:ratio=0.8'),
        ('headwind:speed=10',),
    ],
    ids=['mass', 'traction-brake', 'wind'],
)
def test_stated_effects_give_the_answers_of_estimates_that_absorb_them(effects: tuple[str, ...]) -> None:
    true = stated(*effects)
    records = simulate(Scenario(true, runs=3, stated=ON_LINE), np.random.default_rng(3)).records
    stating, absorbing = replayed(records, true), replayed(records, ON_LINE)
    assert stating.resistance(12.0).live
    assert stating.brake_rate().live
    assert absorbing.brake_rate().live
    for v in (8.0, 15.0):
        assert stating.resistance(v).value == pytest.approx(absorbing.resistance(v).value, abs=0.25)
        for wanted in (0.2, 0.6):
            force = absorbing.feed_forward(v, 5.0, wanted).value
            assert stating.feed_forward(v, 5.0, wanted).value == pytest.approx(force, rel=0.03)
        distance = absorbing.stopping_distance(v, confidence=0.5).value
        assert stating.stopping_distance(v, confidence=0.5).value == pytest.approx(distance, rel=0.03)
        command = absorbing.brake_command(v, 0.0, -0.7).value
        assert stating.brake_command(v, 0.0, -0.7).value == pytest.approx(command, rel=0.04)


def test_a_stated_mass_weakens_the_brake_and_raises_the_force() -> None:
    plain, heavy = model(), model('mass_error:ratio=1.2')
    for speed in (None, 10.0):
        assert heavy.brake_rate(speed).value == pytest.approx(1.0 / 1.2)
    for wanted in (0.5, -0.5):
        force = plain.feed_forward(10.0, 0.0, wanted).value
        assert heavy.feed_forward(10.0, 0.0, wanted).value == pytest.approx(1.2 * force)
        assert heavy.feed_forward(10.0, 0.0, wanted, 220e3).value == pytest.approx(1.2 * 1.1 * force)
    weak = TrainModel(None, replace(ON_LINE, brake=Brake(rate=1.0 / 1.2)))
    assert heavy.stopping_distance(20.0, confidence=0.5).value == pytest.approx(
        weak.stopping_distance(20.0, confidence=0.5).value
    )


def test_a_traction_scale_does_not_change_the_brake() -> None:
    plain, wrong = model(), model('traction_scale:ratio=0.8')
    assert wrong.feed_forward(10.0, 0.0, 0.5).value == pytest.approx(plain.feed_forward(10.0, 0.0, 0.5).value / 0.8)
    assert wrong.feed_forward(10.0, 0.0, -0.5) == plain.feed_forward(10.0, 0.0, -0.5)
    assert wrong.brake_rate() == plain.brake_rate()
    assert wrong.braking_speed(200.0) == plain.braking_speed(200.0)


def test_a_resistance_over_speed_counts_in_every_answer() -> None:
    plain, windy = model(), model('headwind:speed=10')
    v, extra = 20.0, 0.003 * (30.0**2 - 20.0**2)
    for way, more in ((1, extra), (-1, 0.003 * (10.0**2 - 20.0**2))):
        assert windy.resistance(v, direction=way).value - plain.resistance(v).value == pytest.approx(more)
    for name, arguments in (('feed_forward', (0.4,)), ('brake_command', (-0.6,))):
        against = getattr(windy, name)(v, 3.0, *arguments)
        assert against.value == pytest.approx(getattr(plain, name)(v, 3.0 + extra, *arguments).value)
    distances = [m.stopping_distance(v, command=-0.3).value for m in (windy, plain)]
    distances.append(windy.stopping_distance(v, command=-0.3, direction=-1).value)
    assert distances == sorted(distances)
    assert distances[2] > distances[0] + 2.0
    assert windy.braking_curve(0.0, (300.0,), direction=-1)[0] == windy.braking_speed(300.0, direction=-1)


def test_a_bound_with_a_constant_extra_resistance_is_that_of_a_larger_a() -> None:
    constant = model('resistance_step:time=0,a=2')  # from the start on
    plain = TrainModel(None, replace(ON_LINE, resistance=replace(ON_LINE.resistance, a=3.5)))
    found, expected = (m.stopping_distance(20.0, confidence=0.5).value for m in (constant, plain))
    assert found == pytest.approx(expected, rel=1e-9)


def test_no_bound_where_an_extra_push_may_be_too_strong() -> None:
    assert model().stopping_distance(20.0, command=-0.1, gradient=10.0).value > 0.0
    with pytest.raises(NoAnswerError):
        model('higher_order_drag:coefficient=-0.01').stopping_distance(20.0, command=-0.1, gradient=10.0)


def test_bounds_assume_a_fully_faded_brake_and_other_answers_a_cold_one() -> None:
    fading = model('brake_fade:loss=0.3,energy=500')
    assert fading.brake_rate() == model().brake_rate()
    faded = TrainModel(None, replace(ON_LINE, brake=Brake(rate_table=((0.0, 0.7),))))
    assert fading.stopping_distance(20.0).value == pytest.approx(faded.stopping_distance(20.0).value)


def test_effects_that_leave_no_brake_are_named() -> None:
    with pytest.raises(InputError, match=r'effects \(brake_fade, mass_error\) .* leave no brake force .* -0\.10'):
        model('brake_fade:loss=0.5,energy=200', 'mass_error:ratio=2.5')


@pytest.mark.parametrize('text', [*NOT_OF_A_SPEED, *ON_RECORDS])
def test_an_effect_that_needs_more_than_a_speed_adds_nothing(text: str) -> None:
    with_it, without = (
        (m.resistance(15.0), m.feed_forward(15.0, 0.0, 0.5), m.brake_rate(15.0), m.stopping_distance(15.0))
        for m in (model(text), model())
    )
    assert with_it == without


def test_the_page_names_every_effect() -> None:
    assert {text.partition(':')[0] for text in (*NOT_OF_A_SPEED, *ON_RECORDS, *OF_A_SPEED)} == set(EFFECTS)
    page = (Path(__file__).parents[2] / 'docs' / 'client_reference.md').read_text(encoding='utf-8')
    assert [name for name in EFFECTS if f'`{name}`' not in page] == []


def test_the_shares_depend_on_the_speed_for_one_built_in_effect_only() -> None:
    effects = StatedEffects(load_train_file(Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml'))
    assert (effects.brake_share(3.0, hot=True), effects.traction_share(3.0, 1)) == (1.0, 1.0)
    every = StatedEffects(stated(*(text for text in OF_A_SPEED if not text.startswith('brake_slope'))))
    assert len({every.brake_share(v) for v in (0.0, 7.0, 22.0)}) == 1
    assert every.brake_share(7.0) == pytest.approx(1.0 / 1.2)
    assert every.brake_share(7.0, hot=True) == pytest.approx(1.0 / 1.2 - 0.3)
    assert every.traction_share(7.0, 1) == pytest.approx(1.0 / 1.2 - 0.2)


OF_A_USER = """
from trainid_ros.train.effects import EffectKind, Parameter

EFFECT = EffectKind(
    name='weak_when_fast', title='a brake that is weaker at speed', equation='w = value v b',
    parameters={'value': Parameter('s/m', 0.0, 0.04)}, amplitude='value', typical_size=0.01,
    resistance=lambda p, davis, at: p['value'] * at.speed * at.brake,
)
"""


def test_an_effect_of_a_user_on_the_brake_may_depend_on_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'weak.py').write_text(OF_A_USER, encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    weaker, top = model('weak_when_fast:value=0.01'), FILE.train.max_speed
    for speed in (0.0, 3.0, 0.5 * top, top, 1.5 * top):  # constant above the highest one
        assert weaker.brake_rate(speed).value == pytest.approx(1.0 - 0.01 * min(speed, top))
    assert weaker.brake_rate() == replace(weaker.brake_rate(0.5 * top), std=weaker.brake_rate().std)


@pytest.mark.parametrize('direction', [1, -1])
def test_between_its_places_the_gradient_under_unequal_cars_is_linear(direction: int) -> None:
    line = Line(gradient=((0.0, 0.0), (300.0, 12.0), (350.0, -4.0), (900.0, 3.0)))
    train = replace(FILE.train, length=100.0, consist=((60e3, 20.0), (20e3, 40.0), (70e3, 40.0)))
    effects = StatedEffects(replace(FILE, train=train, line=line))
    places, z, _ = effects.along(direction)
    for position in np.linspace(-200.0, 1200.0, 141).tolist():
        wanted = effects.profile.gradient(position, direction)
        assert np.interp(direction * position, places, z) == pytest.approx(wanted, abs=1e-4)

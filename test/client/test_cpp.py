# SPDX-License-Identifier: Apache-2.0
"""The C++ of examples/cpp gives the numbers of the client, and builds where rclcpp is installed."""

from __future__ import annotations

import itertools
import math
import os
import re
import shutil
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist

import pytest

from test.client.test_live_adhesion import SLIDE
from test.client.test_stopping import EMU, LEARNED, TRAIN, UNKNOWN, shape
from test.client.test_train_model import Drive
from trainid_ros.client import TrainModel
from trainid_ros.client.stopping import DELAY, GRADIENT, LAG, Braking, StoppingBounds, StopPosterior
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.results import Output, Status
from trainid_ros.train.train_file import Brake, Davis, Pairs, Train, TrainFile

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'cpp'
STATED = re.compile(r'\b(P|p|stds|train_)\{([-0-9.e, ]+)')
NUMBER = re.compile(r'-?[0-9.][-0-9.e]*')
WARNINGS = ('-Wall', '-Wextra', '-Wpedantic', '-Werror')
MAIN = """
#include <cstdio>
#include <ctime>
#include <iostream>
#include "trainid_client/equations.hpp"
using namespace trainid;
int main() {{
  Train train{{{rotary_mass}, {max_speed}, 2.5, {{}}}};
  const Covariance P{{{davis}}};
  std::printf("%.17g %.17g ", resistance({{1.5, 0.02, 0.001}}, 15.0), resistance_std(P, 15.0));
  const double brake = feed_forward(194e3, 0.08, 2.1, 4.0, -0.5, 0.9);
  std::printf("%.17g %.17g ", feed_forward(194e3, 0.08, 2.1, 4.0, 0.5), brake);
  const Train emu{{{rotary_mass}, {max_speed}, 2.5, {{{emu}}}}};
  const auto limit = [](const Train & of) {{return adhesive_limit(of, 0.9, 0.05, 0.01, 1.645);}};
  std::printf("%.17g %.17g\\n", limit(train), limit(emu));
  for (int rows; std::cin >> rows;) {{
    train.rate_table.resize(rows);
    for (auto & row : train.rate_table) {{std::cin >> row.first >> row.second;}}
    Theta mean, stds;
    Covariance davis;
    double speed, command, z;
    for (double & x : mean) {{std::cin >> x;}}
    for (double & x : stds) {{std::cin >> x;}}
    for (double & x : davis) {{std::cin >> x;}}
    std::cin >> speed >> command >> z;
    const double distance = stopping_distance(train, mean, speed, command);
    const std::clock_t start = std::clock();
    const double bound = stopping_bound(train, mean, stds, davis, speed, command, z);
    const double taken = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    std::printf("%.17g %.17g %.17g\\n", distance, bound, taken);
  }}
}}
"""


@dataclass(frozen=True)
class Question:
    """A stop [m/s, m/s^2], from a released brake."""

    table: Pairs
    posterior: StopPosterior
    speed: float
    command: float
    confidence: float

    def line(self) -> str:
        """Return it for the program in C++."""
        stds = (math.sqrt(x) for x in self.posterior.variances)
        known = (*itertools.chain(*self.table), *self.posterior.mean, *stds, *self.posterior.davis)
        z = NormalDist().inv_cdf(self.confidence)
        return ' '.join(map(repr, (len(self.table), *known, self.speed, self.command, z)))

    def distance(self) -> float:
        """Return the distance of the client [m]."""
        return Braking(shape(self.table), list(self.posterior.mean), self.command, 0.0).stop(self.speed).distance

    def bound(self) -> float:
        """Return the bound of the client [m]."""
        bounds = StoppingBounds(shape(self.table), self.posterior, self.command, 0.0, self.confidence)
        return bounds.at(self.speed).distance


def known(posterior: StopPosterior, **means: float) -> StopPosterior:
    mean = list(posterior.mean)
    for name, value in means.items():
        mean[{'gradient': GRADIENT, 'delay': DELAY, 'lag': LAG}[name]] = value
    return replace(posterior, mean=tuple(mean))


@pytest.fixture(scope='module')
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which('g++') is None:
        pytest.skip('no C++ compiler')
    path = tmp_path_factory.mktemp('cpp')
    davis = ', '.join(map(repr, LEARNED.davis))
    emu = ', '.join(f'{{{v!r}, {rate!r}}}' for v, rate in EMU)
    code = MAIN.format(rotary_mass=TRAIN.rotary_mass, max_speed=TRAIN.max_speed, davis=davis, emu=emu)
    (path / 'main.cpp').write_text(code, encoding='utf-8')
    command = ['g++', '-std=c++17', '-O2', *WARNINGS, f'-I{EXAMPLE / "include"}', 'main.cpp']
    subprocess.run(command, cwd=path, check=True)
    return path / 'a.out'


def answers(program: Path, questions: list[Question]) -> list[tuple[float, ...]]:
    """Return the values that need no question, then distance [m], bound [m] and processor time [s] of each one."""
    lines = '\n'.join(question.line() for question in questions)
    out = subprocess.run([program], input=lines, capture_output=True, text=True, check=True).stdout
    return [tuple(map(float, line.split())) for line in out.splitlines()]


def test_resistance_and_force_in_cpp_are_those_of_the_client(program: Path) -> None:
    w, std, pull, brake, *_ = answers(program, [])[0]
    model = TrainModel(None, TrainFile(TRAIN, Davis(2.1, 0.0, 0.0)))
    assert w == pytest.approx(1.5 + 0.02 * 15.0 + 0.001 * 225.0)
    phi = (1.0, 15.0, 225.0)
    assert std**2 == pytest.approx(sum(phi[i] * phi[j] * LEARNED.davis[3 * i + j] for i in range(3) for j in range(3)))
    assert pull == pytest.approx(model.feed_forward(10.0, 4.0, 0.5).value)
    assert brake == pytest.approx(model.feed_forward(10.0, 4.0, -0.5).value)


@pytest.mark.parametrize(('place', 'table'), [(4, ()), (5, EMU)])
def test_the_limit_of_a_slide_in_cpp_is_that_of_the_client(program: Path, place: int, table: Pairs) -> None:
    limit = answers(program, [])[0][place]
    drive = Drive(TrainFile(TRAIN, Davis(2.1, 0.0, 0.0), Brake(rate_table=table)))
    drive.on(60.0)
    drive.model.take(Output(round(drive.now * 1e9), SLIDE, Status.VALID, 1, 0, None))
    full, same, less = (
        drive.model.stopping_distance(20.0, command=-command).value for command in (3.0, limit, 0.99 * limit)
    )
    assert full == pytest.approx(same, rel=1e-3)
    assert less > 1.002 * same


def test_stops_in_cpp_are_those_of_the_client_and_take_no_longer(program: Path) -> None:
    """At all speeds, also of a train that stops before its brake is built up, and downhill of one that may not stop."""
    late = replace(known(UNKNOWN, delay=2.5, lag=1.2), davis=LEARNED.davis)
    sudden = known(LEARNED, delay=0.0, lag=0.0)
    unsure = replace(UNKNOWN, variances=(0.4**2, *UNKNOWN.variances[1:]))
    questions = [
        Question(table, known(posterior, gradient=gradient), speed, command, confidence)
        for table, posterior, gradient, command, confidence, speed in itertools.product(
            ((), EMU),
            (LEARNED, UNKNOWN, unsure, late, sudden),
            (-30.0, -10.0, 0.0, 15.0),
            (0.1, 0.5, 2.0),
            (0.5, 0.95, 0.999),
            (0.0, 0.05, 0.2, 1.0, 3.5, 12.0, 20.0, 40.0),
        )
    ]
    found = answers(program, questions)[1:]
    distances = [question.distance() for question in questions]
    start = time.process_time()
    bounds = [question.bound() for question in questions]
    taken = time.process_time() - start
    assert 100 < sum(map(math.isinf, bounds)) < len(bounds) / 2
    for (distance, bound, _), by_client, bound_by_client, question in zip(
        found, distances, bounds, questions, strict=True
    ):
        assert distance == pytest.approx(by_client, rel=1e-9, abs=1e-9), question
        assert bound == pytest.approx(bound_by_client, rel=1e-6, abs=1e-9), question
    print(f'{sum(seconds for *_, seconds in found):.3f} s, client {taken:.3f} s')
    assert sum(seconds for *_, seconds in found) < taken


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize('gradient', [-25.0, -8.0])
def test_the_weakest_brake_with_a_bound_is_that_of_the_client(program: Path, table: Pairs, gradient: float) -> None:
    """Within a hundred thousandth of its command."""
    for posterior, confidence, speed in itertools.product((LEARNED, UNKNOWN), (0.5, 0.999), (2.0, 20.0)):
        low, high = 0.0, 8.0
        asked = Question(table, known(posterior, gradient=gradient), speed, high, confidence)
        while high - low > 5e-6 * high:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if math.isfinite(replace(asked, command=middle).bound()) else (middle, high)
        questions = [replace(asked, command=command) for command in (high * (1.0 - 1e-5), high * (1.0 + 1e-5))]
        (_, below, _), (_, above, _) = answers(program, questions)[1:]
        assert math.isinf(below)
        assert math.isfinite(above)


def test_the_controller_falls_back_to_the_values_of_the_client() -> None:
    """Of the train that its constants describe."""
    code = (EXAMPLE / 'src' / 'controller.cpp').read_text(encoding='utf-8')
    train = Train(mass=200e3, rotary_mass=0.08, max_speed=22.2)
    file = TrainFile(train, Davis(1.0, 0.03, 0.003), Brake(1.0, time_constant=0.4, delay=0.6))
    known = TrainModel(None, file)._posterior(0.0)
    stated = {name: [float(x) for x in NUMBER.findall(numbers)] for name, numbers in STATED.findall(code)}
    assert stated['P'] == pytest.approx(known.davis, rel=1e-2, abs=0.0)
    assert stated['p'] == pytest.approx(known.mean, rel=1e-2)
    assert stated['stds'] == pytest.approx([math.sqrt(x) for x in known.variances], rel=1e-2)
    assert stated['train_'] == [0.08, 22.2, GsmaConfig().blend_speed]


def prefixes() -> list[Path]:
    """Return the install prefixes of ROS that have both packages which the example needs."""
    found = [Path(name) for name in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if name]
    return [path for path in found if (path / 'share' / 'rclcpp' / 'cmake').is_dir()]


@pytest.mark.skipif(shutil.which('cmake') is None or not prefixes(), reason='no cmake, or no rclcpp to build with')
def test_the_controller_builds(tmp_path: Path) -> None:
    subprocess.run(['cmake', '-S', EXAMPLE, '-B', tmp_path], check=True)
    subprocess.run(['cmake', '--build', tmp_path], check=True)


def test_the_controller_is_short() -> None:
    assert len((EXAMPLE / 'src' / 'controller.cpp').read_text(encoding='utf-8').splitlines()) <= 86

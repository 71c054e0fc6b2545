# SPDX-License-Identifier: Apache-2.0
"""The C++ of examples/cpp gives the numbers of the client, and builds where rclcpp is installed."""

from __future__ import annotations

import math
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from test.client.test_bounds import LEARNED
from test.client.test_stopping import EMU, TRAIN, shape
from trainid_ros.brake_rate.brake_rate_settings import GsmaConfig
from trainid_ros.client import TrainModel
from trainid_ros.client.bounds import StoppingBounds, StopPosterior
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'cpp'
STATED = re.compile(r'\b(P|p|std|train_)\{([-0-9.e, ]+)')
NUMBER = re.compile(r'-?[0-9.][-0-9.e]*')
Z = 1.6448536269514722
MAIN = """
#include <cstdio>
#include "trainid_client/equations.hpp"
using namespace trainid;
int main() {{
  const Train plain{{{rotary_mass}, {max_speed}, 2.5, {{}}}};
  Train emu = plain;
  emu.rate_table = {{{table}}};
  const Theta mean{{{mean}}}, stds{{{stds}}};
  const Covariance P{{{davis}}};
  const Davis w{{1.5, 0.02, 0.001}};
  std::printf("%.9g %.9g ", resistance(w, 15.0), resistance_std(P, 15.0));
  std::printf("%.9g %.9g ", feed_forward(194e3, 0.08, 2.1, 4.0, 0.5), feed_forward(194e3, 0.08, 2.1, 4.0, -0.5, 0.9));
  std::printf("%.9g %.9g ", stopping_bound(plain, mean, stds, P, 20.0, 1.0, {z}),
    stopping_bound(emu, mean, stds, P, 12.0, 0.7, {z}));
  Theta steep = mean, unsure = stds;
  steep[GRADIENT] = -20.0, unsure[RATE] = 0.15;
  for (const double v : {{2.0, 10.0, 20.0}}) {{
    std::printf("%.9g ", stopping_bound(plain, steep, unsure, P, v, 0.32, {z}));
  }}
  steep[GRADIENT] = -25.0;
  std::printf("%.9g", stopping_bound(plain, steep, unsure, P, 10.0, 0.32, {z}));
}}
"""


def listed(numbers: tuple[float, ...]) -> str:
    return ', '.join(f'{x!r}' for x in numbers)


@pytest.mark.skipif(shutil.which('g++') is None, reason='no C++ compiler')
def test_the_equations_in_cpp_give_the_same_numbers(tmp_path: Path) -> None:
    code = MAIN.format(
        rotary_mass=TRAIN.rotary_mass,
        max_speed=TRAIN.max_speed,
        table=', '.join(f'{{{v}, {rate}}}' for v, rate in EMU),
        mean=listed(LEARNED.mean),
        stds=listed(tuple(variance**0.5 for variance in LEARNED.variances)),
        davis=listed(LEARNED.davis),
        z=Z,
    )
    (tmp_path / 'main.cpp').write_text(code, encoding='utf-8')
    command = ['g++', '-std=c++17', '-O1', '-Wall', '-Wextra', '-Werror', f'-I{EXAMPLE / "include"}', 'main.cpp']
    subprocess.run(command, cwd=tmp_path, check=True)
    out = subprocess.run([tmp_path / 'a.out'], capture_output=True, text=True, check=True).stdout
    w, std, pull, brake, plain, emu, *steep, never = map(float, out.split())
    model = TrainModel(None, TrainFile(TRAIN, Davis(2.1, 0.0, 0.0)))
    assert w == pytest.approx(1.5 + 0.02 * 15.0 + 0.001 * 225.0)
    phi = (1.0, 15.0, 225.0)
    assert std**2 == pytest.approx(sum(phi[i] * phi[j] * LEARNED.davis[3 * i + j] for i in range(3) for j in range(3)))
    assert pull == pytest.approx(model.feed_forward(10.0, 4.0, 0.5).value)
    assert brake == pytest.approx(model.feed_forward(10.0, 4.0, -0.5).value)
    for found, table, speed, target in ((plain, (), 20.0, 1.0), (emu, EMU, 12.0, 0.7)):
        bound = StoppingBounds(shape(table), LEARNED, target, 0.0, 0.95).at(speed)
        assert found == pytest.approx(bound.distance, rel=1e-3)
    unsure = replace(LEARNED, variances=(0.15**2, *LEARNED.variances[1:]))
    for found, speed in zip(steep, (2.0, 10.0, 20.0), strict=True):
        bound = StoppingBounds(shape(), downhill(unsure, -20.0), 0.32, 0.0, 0.95).at(speed)
        assert found == pytest.approx(bound.distance, rel=5e-3)
    assert math.isinf(never)
    assert math.isinf(StoppingBounds(shape(), downhill(unsure, -25.0), 0.32, 0.0, 0.95).at(10.0).distance)


def downhill(posterior: StopPosterior, gradient: float) -> StopPosterior:
    return replace(posterior, mean=(*posterior.mean[:6], gradient, *posterior.mean[7:]))


def test_the_controller_falls_back_to_the_values_of_the_client() -> None:
    """Of the train that its constants describe."""
    code = (EXAMPLE / 'src' / 'controller.cpp').read_text(encoding='utf-8')
    train = Train(mass=200e3, rotary_mass=0.08, max_speed=22.2)
    file = TrainFile(train, Davis(1.0, 0.03, 0.003), Brake(1.0, time_constant=0.4, delay=0.6))
    known = TrainModel(None, file)._posterior(0.0)
    stated = {name: [float(x) for x in NUMBER.findall(numbers)] for name, numbers in STATED.findall(code)}
    assert stated['P'] == pytest.approx(known.davis, rel=1e-2, abs=0.0)
    assert stated['p'] == pytest.approx(known.mean, rel=1e-2)
    assert stated['std'] == pytest.approx([math.sqrt(x) for x in known.variances], rel=1e-2)
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
    assert len((EXAMPLE / 'src' / 'controller.cpp').read_text(encoding='utf-8').splitlines()) <= 60

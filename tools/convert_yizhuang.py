# SPDX-License-Identifier: Apache-2.0
"""Convert the Beijing Yizhuang line and its train from TTOBench into a train file.

Usage: python tools/convert_yizhuang.py LINE.json TRAIN.json OUT.yaml

TTOBench (github.com/nuorail/ttobench, BSD-2-Clause) gives km/h, kN and per mille.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile, dump_train_file

KMH = 3.6

HEADER = """\
# Beijing Yizhuang line (Songjiazhuang - Yizhuang) and its metro train.
#
# Source: TTOBench, github.com/nuorail/ttobench, lines/CN_Songjiazhuang_Yizhuang.json and
# trains/CN_Beijing_Subway.json. Copyright (c) 2022, Dimitris Kouzoupis; BSD 2-Clause License, see
# LICENSE.ttobench beside this file. Converted to SI by tools/convert_yizhuang.py.
#
# Taken over: mass, traction, speed, stops, gradients, speed limits, resistance (r0, r2; the source has no
# term in v, so b = 0). The source neglects rotating masses (0); 0.06 is usual for a metro train, whose
# motors and gears turn in part of the axles only, and the identification needs a true value. The source
# has no train length (118 m: six cars of 19.5 m and couplers), no curves, no tunnels and no brake
# actuator: 0.4 s lag and 0.6 s dead time are usual values of electro-pneumatic brakes. mass_std, force_std,
# timing_std and gradient_std are about those of the simulated days.
"""


def convert(line: dict[str, Any], train: dict[str, Any]) -> TrainFile:
    """Return the train file of a TTOBench line and train."""
    mass = float(train['mass']['value'])
    per_weight = 1e6 / (mass * G)  # kN of resistance to N per kN of weight
    return TrainFile(
        Train(
            mass=mass,
            rotary_mass=0.06,
            length=118.0,
            cars=6,
            max_traction_force=1e3 * float(train['max traction force']['value']),
            max_traction_power=1e3 * float(train['max traction power']['value']),
            max_speed=round(float(train['max speed']['value']) / KMH, 4),
            mass_std=0.002,
            force_std=0.003,
        ),
        Davis(
            a=round(float(train['rolling resistance r0']['value']) * per_weight, 6),
            b=round(float(train['rolling resistance r1']['value']) * per_weight * KMH, 8),
            c=round(float(train['rolling resistance r2']['value']) * per_weight * KMH**2, 8),
        ),
        Brake(timing_std=0.01),
        Line(
            stops=tuple(float(x) for x in line['stops']['values']),
            gradient=tuple((float(x), float(i)) for x, i in line['gradients']['values']),
            speed_limit=tuple((float(x), round(v / KMH, 4)) for x, v in line['speed limits']['values']),
            gradient_std=0.05,
        ),
    )


def main(arguments: list[str]) -> int:
    """Convert the files named on the command line."""
    line, train, out = (Path(name) for name in arguments)
    converted = convert(json.loads(line.read_text('utf-8')), json.loads(train.read_text('utf-8')))
    out.write_text(HEADER + dump_train_file(converted), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))

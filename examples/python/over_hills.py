# SPDX-License-Identifier: Apache-2.0
"""Hold a speed over hills by prediction, as model predictive control does: with the map ahead, and without.

Every two seconds the controller asks the client which speeds each of some forces and a brake command would give, and
takes the one that stays closest to the set speed without exceeding the limit at two standard deviations.

.venv/bin/python examples/python/over_hills.py
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.client import TrainModel
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.sim.plant import Plant
from trainid_ros.sim.scenario import DEFAULT_START_NS, TICK_NS
from trainid_ros.sim.worlds import find_world, world_train
from trainid_ros.train.line import profile_of

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile

_SET: Final = 18.0  # speed to hold [m/s]
_LIMIT: Final = 19.5  # speed not to exceed [m/s]
_HORIZONS: Final = (3.0, 6.0)  # times at which predicted speeds count [s]
_SHARES: Final = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)  # forces to choose from, as shares of the largest [1]
_BRAKE: Final = -0.3  # brake command to choose [m/s^2]
_CHANGE: Final = 0.05  # cost of another choice than the last [(m/s)^2]
_TICKS: Final = 10  # ticks between two choices


class Choice(NamedTuple):
    """What to do until the next choice: traction [N] and brake command [m/s^2]."""

    force: float
    command: float


def choose(model: TrainModel, train: Plant, position: float | None, choices: list[Choice], last: Choice) -> Choice:
    """Return the best choice from now on; without a position the gradient stays as it is."""

    def cost(choice: Choice) -> float:
        found = model.predict(
            _HORIZONS, speed=train.speed, force=choice.force, command=choice.command, applied=train.brake,
            gradient=train.profile.gradient(train.position, 1) if position is None else 0.0, position=position,
        )  # fmt: skip
        excess = max(0.0, *(value.value + 2.0 * value.std - _LIMIT for value in found))
        off = float(np.mean([(value.value - _SET) ** 2 for value in found]))
        return off + 100.0 * excess**2 + _CHANGE * (choice != last)

    return min(choices, key=cost)


def drive(true: TrainFile, stated: TrainFile, seconds: float, *, uses_map: bool) -> tuple[np.ndarray, list[Choice]]:
    """Return the speeds [m/s] of a drive, one each tick, shape (n,), and the choices."""
    train = Plant(true, profile_of(true), DEFAULT_START_NS, 0.8)
    model, rng, speeds = TrainModel.offline(stated), np.random.default_rng(1), list[float]()
    forces = [share * stated.train.max_traction_force for share in _SHARES]
    choices = [*(Choice(force, 0.0) for force in forces), Choice(0.0, _BRAKE)]
    choice, chosen = choices[-2], list[Choice]()
    for tick in range(round(seconds * 1e9 / TICK_NS)):
        for record in (
            GradientRecord(train.now_ns, train.profile.gradient(train.position, 1), 0.0, tunnel=False),
            BrakeRecord(train.now_ns, choice.command, emergency=False),
            ForceRecord(train.now_ns, train.reported_force),
            SpeedRecord(train.now_ns, max(0.0, train.speed + 0.02 * float(rng.standard_normal())), train.position),
        ):
            model.push(record)
        if tick % _TICKS == 0 and train.speed > 0.0:
            choice = choose(model, train, train.position if uses_map else None, choices, choice)
            train.command(choice.command)
            chosen.append(choice)
        for _ in range(2):
            force = min(choice.force, stated.train.traction_limit(train.speed))
            train.step(force, TICK_NS // 2)
        speeds.append(train.speed)
    return np.array(speeds), chosen


def main() -> int:
    """Drive with and without the map, and print how close to the set speed, and by how much traction and braking."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--minutes', type=float, default=8.0)
    seconds = 60.0 * parser.parse_args().minutes
    stated = world_train(find_world('metro'))
    true = replace(stated, resistance=replace(stated.resistance, a=1.3 * stated.resistance.a))
    for name, uses_map in (('with the map ahead', True), ('without', False)):
        speeds, chosen = drive(true, stated, seconds, uses_map=uses_map)
        speeds = speeds[np.argmax(speeds > _SET - 0.5) :]
        off = np.sqrt(np.mean((speeds - _SET) ** 2))
        print(f'{name}: {off:.2f} m/s from {_SET:g} m/s (root mean square), at most {speeds.max():.2f} m/s')
        brakings, force = sum(choice.command < 0.0 for choice in chosen), np.mean([choice.force for choice in chosen])
        print(f'  traction {force / 1e3:.1f} kN on average; {brakings} of {len(chosen)} choices are to brake')
    return 0


if __name__ == '__main__':
    sys.exit(main())

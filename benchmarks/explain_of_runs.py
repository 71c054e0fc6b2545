# SPDX-License-Identifier: Apache-2.0
"""Effects of some runs hidden in simulated runs, one or two, and quantities that differ from run to run at random.

In all the train file lacks what it is, and states other a, b and c.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from benchmarks.explain import runs_of
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, columns
from trainid_ros.cli.demo import stock_bag
from trainid_ros.explain.workflow import explain
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.effects import EFFECTS, EffectKind
from trainid_ros.train.train_file import Davis, Effect, TrainFile, load_train_file

_FIRST_SEED: Final = 83_001
_RUNS: Final = 12
_STOPS: Final = 5
_KINDS: Final = ('brake_scale', 'headwind', 'mass_error', 'run_drag', 'traction_scale')
_PAIR_SIZE: Final = 2.0  # Size of each of two effects, on different runs
_SIZES: Final = (1.0, 2.0, 3.0)  # Sizes of effects of some runs, in typical ones [1]
_SCATTERS: Final = (0.1, 0.5)  # Standard deviations from run to run, in typical sizes [1]
_DAVIS: Final = (0.9, 1.1)  # Range of a, b and c over those of the train file [1]
_SOME: Final = (2, 5)  # Numbers of runs with an effect
_NOTE: Final = (
    f'Yizhuang line, {_RUNS} runs between {_STOPS} stops, there and back. Right: effect and runs are those hidden, and '
    f'nothing else is named. Sizes are in typical ones of each effect.'
)


class Trial(NamedTuple):
    """Effects of a size, each kind on some runs, or one scattered over all of them by its standard deviation."""

    kinds: tuple[str, ...]
    size: float
    scattered: bool
    seed: int


def hidden(trial: Trial, rng: np.random.Generator) -> tuple[Effect, ...]:
    """Return the effects hidden: one of each kind, on runs of its own, or one for each run."""
    if trial.scattered:
        (name,) = trial.kinds
        drawn = enumerate(trial.size * rng.standard_normal(_RUNS), 1)
        return tuple(_effect(EFFECTS[name], float(one), (k,)) for k, one in drawn)
    effects, order = [], (1 + rng.permutation(_RUNS)).tolist()
    for kind in map(EFFECTS.__getitem__, trial.kinds):
        chosen, order = order[: (count := int(rng.integers(*_SOME, endpoint=True)))], order[count:]
        size = float(kind.sign or rng.choice((-1, 1))) * trial.size
        effects.append(_effect(kind, size, tuple(sorted(chosen))))
    return tuple(effects)


def _effect(kind: EffectKind, size: float, runs: tuple[int, ...]) -> Effect:
    return Effect(kind.name, ((kind.amplitude, kind.neutral + size * kind.typical_size),), runs=runs)


def stated() -> TrainFile:
    """Return the train file with the first stops of the line."""
    full = load_train_file(stock_bag('yizhuang') / 'train.yaml')
    return replace(full, line=replace(full.line, stops=full.line.stops[:_STOPS]))


def answer(trial: Trial) -> str:
    """Return ``right``, ``wrong`` if anything else is named, else the verdict."""
    rng, file = np.random.default_rng([trial.seed, int(10 * trial.size)]), stated()
    a, b, c = (x * rng.uniform(*_DAVIS) for x in (file.resistance.a, file.resistance.b, file.resistance.c))
    effects = hidden(trial, rng)
    true = replace(file, resistance=Davis(a, b, c), effects=effects)
    found = explain(runs_of([simulate(Scenario(true, runs=_RUNS), rng).records], file), file)
    if not found.effects:
        return found.verdict.value
    named, true_ones = ({(one.name, one.runs) for one in some} for some in (found.effects, effects))
    if trial.scattered or not named <= true_ones:
        return 'wrong'
    return 'right' if named == true_ones else 'one of two'


_HEADER: Final = columns('hidden | size | cases | right | one of two | named otherwise | no_gap | unexplained')


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the answers by kind and size."""
    groups: list[tuple[tuple[str, ...], float, bool]] = [((kind,), size, False) for kind in _KINDS for size in _SIZES]
    groups += [(pair, _PAIR_SIZE, False) for pair in combinations(_KINDS, 2)]
    groups += [((kind,), size, True) for kind in _KINDS for size in _SCATTERS]
    trials = [Trial(*group, _FIRST_SEED + k) for group in groups for k in range(seeds)]
    answers = over_seeds(answer, trials, 'explain_of_runs')
    rows = []
    for place, (kinds, size, scattered) in enumerate(groups):
        count = Counter(answers[place * seeds : (place + 1) * seeds])
        what = f'{" + ".join(kinds)}{", at random" if scattered else ""}'
        told = (str(count[key]) for key in ('right', 'one of two', 'wrong', 'no_gap', 'unexplained'))
        rows.append((what, f'{size:g}', str(seeds), *told))
    return (Table('Effects of some runs', _HEADER, tuple(rows), _NOTE),)

# SPDX-License-Identifier: Apache-2.0
"""Effects of some runs hidden in simulated runs, and quantities that differ from run to run at random.

In both the train file lacks what it is, and states other a, b and c.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from benchmarks.explain import runs_of
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, columns
from trainid_ros.cli.demo import stock_bag
from trainid_ros.explain.workflow import explain
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Davis, Effect, TrainFile, load_train_file

_FIRST_SEED: Final = 83_001
_RUNS: Final = 12
_STOPS: Final = 5
_KINDS: Final = ('brake_scale', 'headwind', 'mass_error', 'run_drag', 'traction_scale')
_SIZES: Final = (1.0, 2.0, 3.0)  # Sizes of effects of some runs, in typical ones [1]
_SCATTERS: Final = (0.1, 0.5)  # Standard deviations from run to run, in typical sizes [1]
_DAVIS: Final = (0.9, 1.1)  # Range of a, b and c over those of the train file [1]
_SOME: Final = (2, 5)  # Numbers of runs with an effect
_NOTE: Final = (
    f'Yizhuang line, {_RUNS} runs between {_STOPS} stops, there and back. Right: effect and runs are those hidden, and '
    f'nothing else is named. Sizes are in typical ones of each effect.'
)


class Trial(NamedTuple):
    """Effects of a kind, of a size on some runs, or scattered over all of them by their standard deviation."""

    kind: str
    size: float
    scattered: bool
    seed: int


def hidden(trial: Trial, rng: np.random.Generator) -> tuple[Effect, ...]:
    """Return the effects hidden: one, or one for each run."""
    kind = EFFECTS[trial.kind]
    size = trial.size * kind.typical_size
    if trial.scattered:
        drawn = size * rng.standard_normal(_RUNS)
        return tuple(
            Effect(kind.name, ((kind.amplitude, kind.neutral + float(one)),), runs=(k,))
            for k, one in enumerate(drawn, 1)
        )
    chosen = 1 + rng.choice(_RUNS, rng.integers(*_SOME, endpoint=True), replace=False)
    sign = kind.sign or rng.choice((-1, 1))
    amplitude = kind.neutral + float(sign) * size
    return (Effect(kind.name, ((kind.amplitude, amplitude),), runs=tuple(sorted(chosen.tolist()))),)


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
    named = [(one.name, one.runs) for one in found.effects]
    return 'right' if not trial.scattered and named == [(trial.kind, effects[0].runs)] else 'wrong'


_HEADER: Final = columns('hidden | size | cases | right | named otherwise | no_gap | unexplained')


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the answers by kind and size."""
    groups = [(kind, size, False) for kind in _KINDS for size in _SIZES]
    groups += [(kind, size, True) for kind in _KINDS for size in _SCATTERS]
    trials = [Trial(*group, _FIRST_SEED + k) for group in groups for k in range(seeds)]
    answers = over_seeds(answer, trials, 'explain_of_runs')
    rows = []
    for place, (kind, size, scattered) in enumerate(groups):
        count = Counter(answers[place * seeds : (place + 1) * seeds])
        what = f'{kind}, at random' if scattered else kind
        told = (str(count[key]) for key in ('right', 'wrong', 'no_gap', 'unexplained'))
        rows.append((what, f'{size:g}', str(seeds), *told))
    return (Table('Effects of some runs', _HEADER, tuple(rows), _NOTE),)

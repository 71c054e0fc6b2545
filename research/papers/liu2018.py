# SPDX-License-Identifier: Apache-2.0
"""Train basic resistance by multi-innovation least squares (Liu et al. 2018): every claim with a check.

The data of the paper are not public. These are synthetic coasts on which its method leaves the printed residual
variance if there are gusts; see :mod:`research.papers.coasts`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from benchmarks.seeds import over_seeds
from benchmarks.tables import Plot, Table
from research.papers import liu_claims as claims
from research.papers import liu_numerics as numerics
from research.papers import liu_tables as tables
from research.papers.liu_numerics import Outcome
from research.papers.liu_streams import trial

_FIRST: Final = 5000
_SHORT: Final = 20_000


def measure(seeds: int) -> list[Table | Plot]:
    """Return all tables and plots, over ``seeds`` seeds."""
    trials = over_seeds(trial, range(_FIRST, _FIRST + seeds))
    return [
        tables.targets(trials),
        claims.equations(trials),
        claims.table_one(trials),
        tables.dilution_plot(trials),
        tables.preparations(trials),
        tables.segments(_FIRST),
        tables.batches(trials),
        tables.convergence(trials),
        tables.bad_data(trials),
        tables.tracking(trials),
        tables.consistency(trials),
        _rounding(_FIRST),
        _costs(_FIRST),
    ]


def _rounding(seed: int) -> Table:
    km_h, normalised = numerics.conditions(seed)
    rows = (
        ('20-80 km/h', numerics.as_printed(numerics.excited(seed, numerics.LONG))),
        ('20-80 km/h, factors', numerics.factored(numerics.excited(seed, 10 * numerics.LONG))),
        ('60 +- 0.05 km/h', numerics.as_printed(numerics.steady(seed, numerics.LONG))),
        ('60 +- 0.05 km/h, factors', numerics.factored(numerics.steady(seed, numerics.LONG))),
        ('20-80 km/h, 32 bits', numerics.as_printed(numerics.excited(seed, _SHORT), dtype=np.float32)),
        (
            "20-80 km/h, mu = 0.99, P -= (g/S) g'",
            numerics.as_printed(numerics.excited(seed, _SHORT), mu=numerics.MU, symmetric_gain=True),
        ),
        ('20-80 km/h, mu = 0.99, factors', numerics.factored(numerics.excited(seed, _SHORT), mu=numerics.MU)),
        ('exactly 60 km/h, mu = 0.99', numerics.as_printed(numerics.constant(seed, numerics.LONG), mu=numerics.MU)),
        (
            'exactly 60 km/h, mu = 0.99, factors',
            numerics.factored(numerics.constant(seed, numerics.LONG), mu=numerics.MU),
        ),
    )
    return Table(
        'Rounding and wind-up from P(0) = 1e6 I, v in km/h',
        ('speeds, form (matrices as printed unless said)', 'steps', 'P indefinite at', 'not finite at', 'RMSE, N/kN'),
        tuple((name, *_outcome(outcome)) for name, outcome in rows),
        f"Condition of the sum of phi phi': {km_h:.1e} with v in km/h, {normalised:.0f} with v normalised. Factors "
        'keep P positive definite, but it grows without bound under forgetting without excitation: wind-up is not '
        'a rounding effect.',
    )


def _outcome(outcome: Outcome) -> tuple[str, ...]:
    indefinite, broken = (f'{x:.0f}' if math.isfinite(x) else 'never' for x in (outcome.indefinite, outcome.broken))
    error = f'{outcome.error:.3g}' if math.isfinite(outcome.error) else 'none'
    return f'{outcome.steps}', indefinite, broken, error


def _costs(seed: int) -> Table:
    rows = tuple((name, f'{cost:.1f}') for name, cost in numerics.costs(seed))
    return Table('Cost of one observation', ('recursion', 'microseconds'), rows, 'CPU time in plain Python floats.')

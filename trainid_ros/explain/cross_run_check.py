# SPDX-License-Identifier: Apache-2.0
"""Check that an effect at one place shows in all runs that pass it.

A burst of slip or an unreported brake application causes a gap at one place too, but in a single run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.families import shape_names, unit_resistance
from trainid_ros.explain.regression import eliminate
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import Model

# Significance in standard deviations at which the other runs can detect the effect, and the share of its amplitude
# that they must show.
_VISIBLE: Final = 3.0
_SHARE: Final = 0.4


def is_confirmed_by_other_runs(model: Model, k: int, hyper: Hyperparameters) -> bool:
    """Return False if effect k is detectable in the other runs but does not show there.

    The other runs are all but the one that contributes most of its evidence.
    """
    term, kind = model.terms[k], EFFECTS[model.terms[k].name]
    without = model.without(k)
    shape = {name: term.parameters[name] for name in shape_names(kind)}
    column = without.dataset.column(unit_resistance(without.evaluator, kind, shape)[:, None])
    columns = np.concatenate([without.columns, column], axis=1)
    products = without.products_by_run(columns, hyper.spread, without.whitener(hyper))
    size = term.parameters[kind.amplitude] - kind.neutral
    most = int(np.argmax(size * products[:, 0, -1]))
    root = without.prior_factor(hyper.spread)
    others = eliminate(products.sum(axis=0) - products[most], len(root), root)
    A, b = float(others.A[0, 0]), float(others.b[0])
    return A * size * size < _VISIBLE**2 or b / (A * size) > _SHARE

# SPDX-License-Identifier: Apache-2.0
"""Whether an effect at one place is seen by all trains that pass it.

A burst of slip or a brake that nobody reported makes a gap at one place too, but in one run only.
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

# Standard deviations at which the other runs would see it, and the share of its size that they must see.
_VISIBLE: Final = 3.0
_SHARE: Final = 0.4


def is_seen_by_others(model: Model, k: int, hyper: Hyperparameters) -> bool:
    """Return False if the runs beside the one that tells most of member k could see it and do not."""
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

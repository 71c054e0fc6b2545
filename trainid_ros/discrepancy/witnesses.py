# SPDX-License-Identifier: Apache-2.0
"""Whether an effect at one place is seen by all trains that pass it.

A burst of slip or a brake that nobody reported makes a gap at one place too, but in one run only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.discrepancy.families import shape_names, unit_resistance
from trainid_ros.discrepancy.regression import eliminate
from trainid_ros.physics.effects import EFFECTS

if TYPE_CHECKING:
    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Model

# Standard deviations at which the other runs would see it, and the share of its size that they must see.
_VISIBLE: Final = 3.0
_SHARE: Final = 0.4


def is_seen_by_others(model: Model, k: int, sizes: Sizes) -> bool:
    """Return False if the runs beside the one that tells most of member k could see it and do not."""
    member, kind = model.members[k], EFFECTS[model.members[k].name]
    without = model.without(k)
    shape = {name: member.parameters[name] for name in shape_names(kind)}
    column = without.drive.column(unit_resistance(without.points, kind, shape)[:, None])
    columns = np.concatenate([without.columns, column], axis=1)
    products = without.products_by_run(columns, sizes.spread, without.whitener(sizes))
    size = member.parameters[kind.amplitude] - kind.neutral
    most = int(np.argmax(size * products[:, 0, -1]))
    root = without.prior_factor(sizes.spread)
    others = eliminate(products.sum(axis=0) - products[most], len(root), root)
    A, b = float(others.A[0, 0]), float(others.b[0])
    return A * size * size < _VISIBLE**2 or b / (A * size) > _SHARE

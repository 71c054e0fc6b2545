# SPDX-License-Identifier: Apache-2.0
"""When an effect set in: the posterior over all times, since a slope at one time says nothing of others.

While the train stands nothing tells one time from another, so the likelihood is flat there and jumps elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.discrepancy.families import shape_names, sign, unit_resistance
from trainid_ros.discrepancy.regression import log_bayes
from trainid_ros.discrepancy.screen import reduced_information
from trainid_ros.physics.effects import EFFECTS

if TYPE_CHECKING:
    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Member, Model

_TIMES: Final = 120


def with_onsets(model: Model, sizes: Sizes) -> Model:
    """Return a fitted model whose effects that set in at some time have the spread of all times."""
    members = model.members
    timed = tuple(with_onset(member, model.without(k), sizes) for k, member in enumerate(members))
    return model if all(a is b for a, b in zip(timed, members, strict=True)) else model.having(timed)


def with_onset(member: Member, without: Model, sizes: Sizes) -> Member:
    """Return a fitted member with the best time of all and its true spread; as it is if it has no such parameter.

    Args:
        member: A fitted member.
        without: The model without it.
        sizes: Sizes of noise and nuisances.

    """
    kind = EFFECTS[member.name]
    names = [n for n in shape_names(kind) if kind.parameters[n].unit == 's' and kind.parameters[n].search is None]
    if len(names) != 1 or member.covariance is None:
        return member
    name, drive = names[0], without.drive
    times = np.linspace(drive.time.min(), drive.time.max(), _TIMES + 2)[1:-1]
    times = np.sort(np.append(times, member.parameters[name]))
    shape = {n: member.parameters[n] for n in shape_names(kind)}
    columns = [unit_resistance(without.points, kind, {**shape, name: float(t)}) for t in times]
    information = reduced_information(without, sizes, drive.column(np.stack(columns, axis=1)))
    value = log_bayes(np.diag(information.A), information.b, kind.usual, sign(kind))
    weight = np.exp(0.5 * (value - value.max()))
    weight = weight * np.gradient(times)
    weight /= weight.sum()
    mean = float(weight @ times)
    variance = float(weight @ np.square(times - mean)) + float(np.median(np.diff(times))) ** 2 / 12.0
    at = list(member.parameters).index(name)
    covariance = member.covariance.copy()
    covariance[at, at] = max(covariance[at, at], variance)
    return replace(member, parameters={**member.parameters, name: mean}, covariance=covariance)

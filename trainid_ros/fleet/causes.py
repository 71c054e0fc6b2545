# SPDX-License-Identifier: Apache-2.0
"""What a change may be, by the channels that show it: a hint, until ``explain`` has seen the bags.

A cause of size theta changes channel c by theta d_c, as a share of the mean of the fleet. With a normal prior of theta
and a slack for what the directions leave out, the steps found are normal, and Bayes' rule gives the probability of
each cause; 'other' changes each channel on its own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping


class Cause(NamedTuple):
    """A cause with its probability: name of the effect of the library, what it is in a depot."""

    effect: str
    title: str
    probability: float


class _Kind(NamedTuple):
    """A cause: direction by channel, size of theta, and sign of theta (0 for both)."""

    effect: str
    title: str
    direction: Mapping[str, float]
    size: float
    sign: int


_KINDS: Final = (
    _Kind('dragging_brake', 'dragging brake or another added resistance', {'w15': 1.0}, 0.3, 1),
    _Kind('resistance_step', 'less resistance than before, as after a repair', {'w15': 1.0}, 0.3, -1),
    _Kind('brake_scale', 'worn or glazed brake pads', {'brake_rate': 1.0}, 0.1, -1),
    _Kind('brake_scale', 'brake stronger than before, as with new pads', {'brake_rate': 1.0}, 0.1, 1),
    # A wheel that reads r times the true speed makes each force seem r times as strong, and each distance as long.
    _Kind(
        'wheel_diameter', 'wrong wheel diameter', {'wheel_ratio': 1.0, 'force_scale': 1.0, 'brake_rate': 1.0}, 0.02, 0
    ),
    # A train heavier than weighed reaches less acceleration with each force.
    _Kind('mass_error', 'wrong weighing', {'force_scale': 1.0, 'brake_rate': 1.0}, 0.08, 0),
    _Kind('traction_scale', 'traction force reported wrongly', {'force_scale': 1.0}, 0.08, 0),
)
OTHER: Final = 'other'
_OTHER_SIZE: Final = {'w15': 0.2, 'brake_rate': 0.08, 'force_scale': 0.06, 'wheel_ratio': 0.02}
# What the directions leave out, as a share of the mean.
_SLACK: Final = {'w15': 0.04, 'brake_rate': 0.004, 'force_scale': 0.004, 'wheel_ratio': 0.0005}
_LEAST: Final = 0.05


def causes_of(steps: Mapping[str, tuple[float, float] | None]) -> tuple[Cause, ...]:
    """Return the causes with a probability that counts, the most probable first.

    Args:
        steps: Step and its standard deviation as shares of the mean of the fleet by channel, None without data.

    """
    known = {name: step for name, step in steps.items() if step is not None}
    names = tuple(known)
    step, std = np.array([known[name] for name in names]).reshape(-1, 2).T
    noise = np.diag(std**2 + np.array([_SLACK[name] for name in names]) ** 2)
    found = [_log_evidence(kind, names, step, noise) for kind in _KINDS]
    other = noise + np.diag([_OTHER_SIZE[name] ** 2 for name in names])
    log_p = np.array([*found, _log_normal(step, other)])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    causes = [Cause(kind.effect, kind.title, float(share)) for kind, share in zip(_KINDS, p, strict=False)]
    causes.append(Cause(OTHER, 'no single known cause', float(p[-1])))
    return tuple(sorted((c for c in causes if c.probability >= _LEAST), key=lambda cause: -cause.probability))


def _log_evidence(kind: _Kind, names: tuple[str, ...], step: np.ndarray, noise: np.ndarray) -> float:
    """Return ln p(steps | cause); a cause of one sign has twice the density on that side and none on the other."""
    d = np.array([kind.direction.get(name, 0.0) for name in names])
    if not d.any():
        return -math.inf
    log_p = _log_normal(step, noise + kind.size**2 * np.outer(d, d))
    if not kind.sign:
        return log_p
    # Posterior of theta: the share of it on the permitted side.
    weight = np.linalg.solve(noise, d)
    variance = 1.0 / (float(d @ weight) + kind.size**-2)
    z = kind.sign * variance * float(weight @ step) / math.sqrt(2.0 * variance)
    return log_p + math.log(max(1e-300, math.erfc(-z)))


def _log_normal(x: np.ndarray, covariance: np.ndarray) -> float:
    _, log_det = np.linalg.slogdet(covariance)
    return -0.5 * (float(log_det) + float(x @ np.linalg.solve(covariance, x)) + x.size * math.log(2.0 * math.pi))

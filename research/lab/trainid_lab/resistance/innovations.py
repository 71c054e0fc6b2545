# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation least squares as printed (Liu et al. 2018, sections 3 and 4.2; Ding et al. 2010).

Pure functions on floats, see :mod:`recursive` for the factors UD of P. ``Phi`` and ``Y`` hold the last p regressors
and observations, the newest last. A step of MILS with p innovations,

    ``L = P Phi [I + Phi' P Phi]^-1,  theta += L [Y - Phi' theta],  P -= L Phi' P``,

adds the information Phi Phi' and therefore equals p steps of RLS: MILS is weighted least squares that uses every
observation p times. It is no more accurate than RLS; its P is p times too small, and in the regularised form so is
the weight of the penalty.

V-MILS makes such a step only at times t_s whose last p observations are all good; :func:`stacked` maintains the
stack. Observations in a run of fewer than p good ones are never used.
"""

from __future__ import annotations

from typing import TypeAlias

from trainid_lab.resistance.recursive import Factors, Vector, rls, shrink

Regressors: TypeAlias = tuple[Vector, ...]
Values: TypeAlias = tuple[float, ...]


def mils(theta: Vector, UD: Factors, Phi: Regressors, Y: Values) -> tuple[Vector, Factors]:
    """Make one step of MILS with the p = len(Y) innovations of the stack."""
    for i in range(len(Y)):
        theta, UD = rls(theta, UD, Phi[i], Y[i])
    return theta, UD


def regularised_mils(theta: Vector, UD: Factors, Phi: Regressors, Y: Values, rate: float) -> tuple[Vector, Factors]:
    """Make one step of regularised MILS as printed, with rate = lambda/N.

    Every step adds p observations but only 1/p of their share of the penalty: at t = N the result is ridge
    regression with lambda/p.
    """
    theta, UD = shrink(theta, UD, rate)
    return mils(theta, UD, Phi, Y)


def stacked(Phi: Regressors, Y: Values, phi: Vector, y: float, p: int) -> tuple[Regressors, Values]:
    """Return the last p regressors and observations including a new one; fewer at the start (the rest are zero)."""
    return (*Phi, phi)[-p:], (*Y, y)[-p:]


def use_counts(good: tuple[bool, ...], p: int, *, strict: bool) -> tuple[int, ...]:
    """Return how often each observation of a record is used.

    Args:
        good: Which observations are good; a bad one empties the stack.
        p: Innovation length.
        strict: True for V-MILS, which steps only with a full stack; False for MILS, whose first stacks are shorter.

    """
    counts, run = [0] * len(good), 0
    for t, fine in enumerate(good):
        run = run + 1 if fine else 0
        if run >= p or (run and not strict):
            for k in range(min(run, p)):
                counts[t - k] += 1
    return tuple(counts)

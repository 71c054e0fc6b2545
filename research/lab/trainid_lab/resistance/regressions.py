# SPDX-License-Identifier: Apache-2.0
"""The eight regressions of Liu et al. 2018 as recursions on one state, one step per observation (phi, y).

======================  ==============================================================
LS, regularised LS      :func:`solve_step`, penalty 0 or lambda
RLS, regularised RLS    :func:`innovation_step` with p = 1
MILS, regularised MILS  :func:`innovation_step` with p > 1
V-MILS, regularised     :func:`strict_step`; :func:`skip` when an observation is bad
======================  ==============================================================

Regularised recursions have two forms. With ``record_length`` N > 0 they are as printed, (12)-(16). With N = 0 they
start from P(0) = I/(p lambda), theta(0) = 0, and equal (7) at every t for any p.

Multi-innovation least squares is as printed (sections 3 and 4.2; Ding et al. 2010). ``Phi`` and ``Y`` hold the last p
regressors and observations, the newest last; see :mod:`recursive` for the factors UD of P. A step with p innovations,

    ``L = P Phi [I + Phi' P Phi]^-1,  theta += L [Y - Phi' theta],  P -= L Phi' P``,

adds the information Phi Phi' and therefore equals p steps of RLS: MILS is weighted least squares that uses every
observation p times. It is no more accurate than RLS; its P is p times too small, and in the regularised form so is
the weight of the penalty. V-MILS makes such a step only at times t_s whose last p observations are all good.
Observations in a run of fewer than p good ones are never used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from trainid_lab.resistance.least_squares import add, solve
from trainid_lab.resistance.recursive import Factors, Symmetric, Vector, forget, rls, shrink, start

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


_P0: Final = 1e6


@dataclass(frozen=True, slots=True)
class Regression:
    """Settings of a regression."""

    innovation_length: int = 1  # p
    penalty: float = 0.0  # lambda, 0 = not regularised
    record_length: int = 0  # N of (12)-(14); 0 = the full penalty is in P(0)
    forgetting: float = 1.0  # Forgetting factor mu per step; 1 = no forgetting

    @property
    def rate(self) -> float:
        """Penalty per step, lambda/N as printed."""
        return self.penalty / self.record_length if self.record_length else 0.0


@dataclass(frozen=True, slots=True)
class RegressionState:
    """State of a regression."""

    theta: Vector  # Estimate
    UD: Factors  # Factors of P, the inverse information; for p = 1 the covariance in units of the noise variance
    determined: bool = True  # False while theta is only the initial value
    Phi: Regressors = ()  # Stack of regressors
    Y: Values = ()  # Stack of observations
    information: Symmetric = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # sum phi phi' (LS only)
    moment: Vector = (0.0, 0.0, 0.0)  # sum phi y (LS only)
    steps: int = 0  # Steps made


Step = Callable[[RegressionState, Vector, float, Regression], RegressionState]


def begin(regression: Regression) -> RegressionState:
    """Return the state before the first observation."""
    corrected = regression.penalty > 0.0 and not regression.record_length
    if corrected:
        return RegressionState(*start(1.0 / (regression.penalty * regression.innovation_length)))
    return RegressionState(*start(_P0, 1.0 / _P0))


def solve_step(state: RegressionState, phi: Vector, y: float, regression: Regression) -> RegressionState:
    """Make one step of LS or regularised LS (7): update the normal equations and solve them."""
    mu, penalty = regression.forgetting, regression.penalty
    (M11, M12, M13, M22, M23, M33), (m1, m2, m3) = state.information, state.moment
    decayed = mu * M11, mu * M12, mu * M13, mu * M22, mu * M23, mu * M33
    M, m = add(decayed, (mu * m1, mu * m2, mu * m3), phi, y)
    solved = solve((M[0] + penalty, M[1], M[2], M[3] + penalty, M[4], M[5] + penalty), m)
    state = replace(state, information=M, moment=m, steps=state.steps + 1, determined=solved is not None)
    return state if solved is None else replace(state, theta=solved[0], UD=solved[1])


def innovation_step(state: RegressionState, phi: Vector, y: float, regression: Regression) -> RegressionState:
    """Make one step of RLS or MILS, regularised or not; the first stacks have fewer than p observations."""
    Phi, Y = stacked(state.Phi, state.Y, phi, y, regression.innovation_length)
    return _step(replace(state, Phi=Phi, Y=Y), regression)


def strict_step(state: RegressionState, phi: Vector, y: float, regression: Regression) -> RegressionState:
    """Make one step of V-MILS, regularised or not, at t_s, when the last p observations are all good."""
    Phi, Y = stacked(state.Phi, state.Y, phi, y, regression.innovation_length)
    state = replace(state, Phi=Phi, Y=Y)
    return _step(state, regression) if len(Y) == regression.innovation_length else state


def skip(state: RegressionState) -> RegressionState:
    """Empty the stack at a bad or missing observation, so that no stack extends across it."""
    return replace(state, Phi=(), Y=())


def run(
    step: Step,
    regression: Regression,
    observations: Iterable[tuple[Vector, float]],
    good: Iterable[bool] | None = None,
) -> RegressionState:
    """Return the state after all observations (phi, y), skipping those that are not good."""
    state = begin(regression)
    if good is None:
        for phi, y in observations:
            state = step(state, phi, y, regression)
        return state
    for (phi, y), fine in zip(observations, good, strict=True):
        state = step(state, phi, y, regression) if fine else skip(state)
    return state


def _step(state: RegressionState, regression: Regression) -> RegressionState:
    theta, UD = state.theta, state.UD
    if regression.forgetting < 1.0:
        UD = forget(UD, regression.forgetting)
    theta, UD = shrink(theta, UD, regression.rate)
    theta, UD = mils(theta, UD, state.Phi, state.Y)
    return replace(state, theta=theta, UD=UD, steps=state.steps + 1)

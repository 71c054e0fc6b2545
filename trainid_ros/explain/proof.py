# SPDX-License-Identifier: Apache-2.0
"""The verdict on the selected effects, and its proof: the gap on held-out runs against that of noise alone.

The base model, the nuisances and the amplitudes of all effects are fitted to the other runs; only the initial speed is
fitted to the run held out. The set of effects, their positions and the noise level come from all runs, but an effect
that shows in the held-out run only gets no amplitude from the others and does not reduce the gap there. Products of
whitened columns are kept by run, so leaving runs out is a subtraction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.likelihood import Hyperparameters, posterior
from trainid_ros.explain.model import Model
from trainid_ros.explain.noise import share_of_mean
from trainid_ros.explain.result import Gap, Verdict
from trainid_ros.explain.search import GENERIC, LEFT_OVER, with_onsets
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.run_data import Run
    from trainid_ros.explain.search import Selection
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_FOLDS: Final = 12
"""Maximum number of fits."""
FEWEST: Final = 2
"""Minimum number of runs to hold one out."""
# Limit of plausible gusts, payloads, brakes and map errors; see MarginalLikelihood.excess.
_MAX_EXCESS: Final = 14.0
# The same when effects with evidence of their own have been found.
_MAX_EXCESS_NAMED: Final = 30.0
# Limit of a plausible amplitude, in units of its typical value.
_MAX_USUAL: Final = 12.0
_WORSE: Final = 1.1
"""Effects that increase the gap on held-out runs by this factor are not reported, whatever their evidence."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Speed gaps at all grid points, each from a fit to other runs.

    Attributes:
        gap: Measured less simulated speed [m/s], shape (m,).
        std: Standard deviation expected of a correct model [m/s], shape (m,).

    """

    gap: Array
    std: Array


def hold_out(model: Model, hyper: Hyperparameters) -> HeldOut | None:
    """Return the gaps of all runs, each held out in turn; None with fewer than :data:`FEWEST` runs."""
    runs = len(model.dataset.runs)
    if runs < FEWEST:
        return None
    products = model.products_by_run(model.columns, hyper)
    total = products.sum(axis=0)
    root, neutral = model.prior_factor(hyper.spread), _neutral(model)
    residual = model.columns @ neutral[:, 0]
    gap, deviation = np.zeros(model.residual.size), np.zeros(model.residual.size)
    for fold in np.array_split(np.arange(runs), min(runs, _FOLDS)):
        seen = total - products[fold].sum(axis=0)
        model.add_odometry(seen)
        mean, covariance = posterior(neutral.T @ seen @ neutral, root)
        for run in fold.tolist():
            at = model.dataset.point_run == run
            left = residual[at] - model.nuisance_columns[at] @ mean
            gap[at], deviation[at] = _centred(model, at, left, _noise(model, hyper, at, covariance))
    return HeldOut(gap, deviation)


def _neutral(model: Model) -> Array:
    """Return the transformation of columns that removes all effects from the residual, shape (1 + q + k, 1 + q + k).

    A fit to other runs then estimates their amplitudes from zero effect, with a wide prior centred there.
    """
    change = np.eye(model.columns.shape[1])
    for term, here in model.places():
        kind = EFFECTS[term.name]
        at = 1 + here.start + list(term.parameters).index(kind.amplitude)
        change[at, 0] = term.parameters[kind.amplitude] - kind.neutral
    return change


def _centred(model: Model, at: NDArray[np.bool_], left: Array, expected: Array) -> tuple[Array, Array]:
    """Return the residual of one run less its mean, and the std expected of it [m/s], shapes (m,)."""
    known = model.dataset.point_count[at] > 0.0
    weight = known / max(float(known.sum()), 1.0)
    # Variance of left - weight' left.
    common = expected @ weight
    variance = np.diag(expected) - 2.0 * common + weight @ common
    return left - weight @ left, np.sqrt(np.maximum(variance, 0.0))


def gap_of(before: HeldOut | None, after: HeldOut | None, model: Model) -> Gap | None:
    """Return the RMS gap without and with the effects over all measured points and the noise floor; None if unknown."""
    if before is None or after is None:
        return None
    known = model.dataset.point_count > 0.0
    return Gap(_rms(before.gap[known]), _rms(after.gap[known]), _rms(after.std[known]), len(model.dataset.runs))


def _noise(model: Model, hyper: Hyperparameters, at: NDArray[np.bool_], covariance: Array) -> Array:
    """Return the covariance of the speed errors of one run that a correct model leaves [(m/s)^2].

    It covers integrated gusts, sensor noise, payload and brake, and the uncertainty of a, b, c and of the map as fitted
    to the other runs, but not the uncertainty of the effects.
    """
    base = model.without_terms
    columns = model.nuisance_columns[at][:, base]
    noise, spread = hyper.noise, hyper.spread
    t = model.dataset.point_time[at] - model.dataset.point_time[at][0]
    tau = noise.gust_time
    lesser = np.minimum(t[:, None], t[None, :])
    decay = np.exp(-t / tau)
    gust = 2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    factors = model.factor_columns[at] * spread.of_run
    white = noise.speed**2 * share_of_mean(model.dataset.point_count[at])
    scale = (noise.gust * tau / model.dataset.inertia) ** 2
    nuisances = columns @ covariance[np.ix_(base, base)] @ columns.T
    return np.asarray(scale * gust + factors @ factors.T + np.diag(white) + nuisances)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


@dataclass(frozen=True, slots=True)
class Outcome:
    """Verdict with the models and held-out gaps behind it.

    Attributes:
        verdict: The verdict.
        remaining: One sentence on what the rest of the gap depends on.
        hyper: Hyperparameters of noise and nuisances.
        base: Model without effects, of all runs compared.
        final: Model with the effects that are reported.
        before: Gaps of held-out runs without effects; None with too few runs.
        after: Gaps of held-out runs with the effects; None with too few runs.

    """

    verdict: Verdict
    remaining: str
    hyper: Hyperparameters
    base: Model
    final: Model
    before: HeldOut | None
    after: HeldOut | None

    @property
    def gap(self) -> Gap | None:
        """The gap before and after; None with too few runs."""
        return gap_of(self.before, self.after, self.final)


def assess(selection: Selection, runs: Sequence[Run], train_file: TrainFile, *, slipping: bool) -> Outcome:
    """Return the verdict on the selected effects, from all runs compared."""
    verdict = _verdict(selection, slipping=slipping)
    # Effects that do not fit are not reported and not used.
    reported = selection.base if verdict is Verdict.UNEXPLAINED else selection.final
    hyper, base, final = reported.hyper, selection.base.model, reported.model
    if len(base.dataset.runs) < len(runs):
        base = Model.of(runs, train_file)
        final = with_onsets(base.with_terms(reported.model.terms).fit(hyper), hyper)
    before = hold_out(base, hyper)
    outcome = Outcome(verdict, _remaining(selection, verdict), hyper, base, final, before, hold_out(final, hyper))
    if (gap := outcome.gap) is None or gap.after <= _WORSE * gap.before:
        return outcome
    # Despite their evidence, the effects do not improve the simulation of held-out runs.
    return Outcome(Verdict.UNEXPLAINED, _no_better(final, gap), hyper, base, base, before, before)


def _verdict(selection: Selection, *, slipping: bool) -> Verdict:
    generic = selection.groups[0].evidence if selection.groups else 0.0
    if generic > max(GENERIC, LEFT_OVER * sum(selection.evidence)) or not _credible(selection, slipping=slipping):
        return Verdict.UNEXPLAINED
    if not selection.evidence:
        return Verdict.EXPLAINED if slipping else Verdict.NO_GAP
    return Verdict.AMBIGUOUS if any(selection.twins) else Verdict.EXPLAINED


def _credible(selection: Selection, *, slipping: bool) -> bool:
    """Return False if an amplitude or the noise is implausibly large.

    With slip the noise is not checked, since its bursts look like gusts.
    """
    terms = selection.final.model.terms
    most = _MAX_EXCESS_NAMED if terms else _MAX_EXCESS
    usual = slipping or selection.final.excess < most
    return usual and all(term.size < _MAX_USUAL for term in terms)


def _remaining(selection: Selection, verdict: Verdict) -> str:
    strongest = selection.groups[0] if selection.groups else None
    if strongest is not None and strongest.evidence >= GENERIC:
        size = 'depends' if verdict is Verdict.UNEXPLAINED else 'depends slightly'
        return f'The rest of the gap {size} on {strongest.text}, and no effect of the library fits it.'
    if verdict is Verdict.UNEXPLAINED:
        return f'Unmeasured forces exceed plausible noise: {_unusual(selection.final.hyper)}.'
    return 'What is left is noise: gusts, errors of the map and of the sensors.'


def _no_better(model: Model, gap: Gap) -> str:
    """Return why effects with enough evidence are not reported."""
    names = ' and '.join(sorted({term.name for term in model.terms}))
    return (
        f'The evidence for {names} is not confirmed: the gap on held-out runs would increase from {gap.before:.3f} to '
        f'{gap.after:.3f} m/s.'
    )


def _unusual(hyper: Hyperparameters) -> str:
    """Return as text the gusts, payloads, brakes and map errors that would be needed to explain the gap."""
    noise, spread = hyper.noise, hyper.spread
    return (
        f'gusts of {noise.gust:.2f} N/kN lasting {noise.gust_time:.0f} s, errors of {spread.payload:.1%} of the mass, '
        f'{spread.brake:.1%} of the brake force from run to run and {spread.map:.2f} per mille of the map gradient'
    )

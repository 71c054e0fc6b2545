# SPDX-License-Identifier: Apache-2.0
"""Locate the gap between simulation and data, and prove the verdict on the selected effects with held-out runs.

Location: each axis (position, speed, driving mode and so on) is divided into parts, and the mean resistance that the
model lacks in each part is estimated jointly with all nuisances, by the same whitened regression as the effects; its
standard deviation thus allows for errors that are correlated in time. What all parts of an axis have in common is
Davis ``a``, which is fitted anyway, so each part is given as its deviation from the mean of all parts.

Proof: runs held out are simulated from their initial speed, with the train file read and with the one written, whose
a, b, c and effects are fitted to the other runs. What a user cannot know of a run, such as payload and map errors, is
zero in both. The gap is compared with the noise floor, that of a correct train file: noise, and what no train file
states as fitted to the runs held out too. If that is more than the other runs let expect, the latter counts, so that an
effect which is missing does not pass for loads. The likelihoods of the runs held out, without and
with the effects, give an evidence that no fit to these runs has raised. It is the larger of two: by the train file,
with the priors of all nuisances, and by the fit to the other runs.

The set of effects, their positions and the noise level come from all runs, but an effect that shows in the held-out run
only gets no amplitude from the others and does not reduce the gap there. Products of whitened columns are kept by run,
so leaving runs out is a subtraction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from trainid_ros.explain.dataset import BRAKING, PULLING, Array, Dataset, Flags, Run
from trainid_ros.explain.effects import SHOWN, SIGNIFICANT, EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters, integrated_covariance, posterior, share_of_mean
from trainid_ros.explain.model import Model, Slip
from trainid_ros.explain.nuisances import DAVIS
from trainid_ros.explain.result import NONE, Gap, Location, Place, Verdict, place_text, probabilities
from trainid_ros.explain.search import CERTAIN, Selection, with_onsets
from trainid_ros.train.train_file import Davis, TrainFile

# Share of the evidence that may remain after the effects named: equations of real effects differ slightly [1].
_LEFT_OVER: Final = 0.15


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Measured less simulated speed of all runs at the grid points, each by a fit to other runs, shapes (m,)."""

    gap: Array  # With a, b, c and the effects as fitted: the train file written [m/s]
    std: Array  # Standard deviation that a correct train file leaves [m/s]
    shown: Array  # The same with loads, map errors and the like as fitted to these runs too [m/s]
    fitted: Array  # With all nuisances as fitted [m/s]
    likelihood: float  # 2 ln of the likelihood of the runs held out, each alone, given a, b, c and the effects
    fitted_likelihood: float  # The same given all nuisances as fitted


def hold_out(model: Model, hyper: Hyperparameters) -> HeldOut | None:
    """Return the gaps of all runs, each held out in turn; None of a single run."""
    runs = len(model.dataset.runs)
    if runs < 2:
        return None
    products = model.products_by_run(model.columns, hyper)
    total = products.sum(axis=0)
    root, neutral = model.prior_factor(hyper.spread), _neutral(model)
    residual = model.columns @ neutral[:, 0]
    found = list[_RunHeldOut]()
    for fold in np.array_split(np.arange(runs), min(runs, 12)):  # at most 12 fits
        seen = total - products[fold].sum(axis=0)
        model.add_odometry(seen)
        mean, covariance = posterior(neutral.T @ seen @ neutral, root)
        for run in fold.tolist():
            at = model.dataset.point_run == run
            found.append(_held_out(model, hyper, at, residual[at], mean, covariance, root @ root.T))
    # What all runs have in common a train file can state, but for errors of the map.
    common = np.mean([one.unstated.factors for one in found], axis=0)
    gap, deviation, shown, fitted = np.zeros((4, model.residual.size))
    for one in found:
        at = one.at
        gap[at], deviation[at], fitted[at] = one.gap, one.std, one.fitted
        own = one.unstated.mean - model.factor_columns[at] @ common
        _, shown[at] = _started(model, at, one.gap, one.noise + np.outer(own, own) + one.unstated.covariance)
    likelihood, fitted_likelihood = (sum(pair) for pair in zip(*(one.likelihoods for one in found), strict=True))
    return HeldOut(gap, deviation, shown, fitted, likelihood, fitted_likelihood)


class _RunHeldOut(NamedTuple):
    """One run by a fit to other runs: fields of :class:`HeldOut`, shapes (m,), and what its noise floor consists of."""

    at: Flags  # Its grid points
    gap: Array
    std: Array
    fitted: Array
    likelihoods: tuple[float, float]  # Given what a train file states, and given all as fitted
    noise: Array  # Covariance of noise and rounding [(m/s)^2], shape (m, m)
    unstated: _Unstated


def _held_out(
    model: Model, hyper: Hyperparameters, at: Flags, residual: Array, mean: Array, covariance: Array, prior: Array
) -> _RunHeldOut:
    """Return the gap of one run by the mean and covariance of a fit to other runs, whose prior covariance is given."""
    stated = ~model.without_terms
    stated[DAVIS] = stated[model.dependence] = True  # in a train file, unlike the nuisances
    both_stated, both_unstated = np.outer(stated, stated), np.outer(~stated, ~stated)
    beforehand = np.where(both_stated, covariance, np.where(both_unstated, prior, 0.0))
    columns, noise, factors = model.nuisance_columns[at], _noise(model, hyper, at), model.factor_columns[at]
    rounded, hiding = (
        noise + np.diag(one[at]) for one in (np.minimum(model.grid.hiding, model.grid.rounding), model.grid.hiding)
    )
    by_factors = factors @ np.diag(np.square(hyper.spread.of_run))
    of_run = by_factors @ factors.T
    apart = columns @ np.where(both_unstated, covariance, 0.0) @ columns.T + of_run
    found = np.where(stated, 0.0, mean)  # nuisances by the other runs
    by_found = columns @ found
    left = residual - columns @ np.where(stated, mean, 0.0)
    gap, std = _started(model, at, left, rounded + apart + np.outer(by_found, by_found))
    by_map = columns[:, len(model.common_std) :] @ found[len(model.common_std) :]
    rest = left - by_found
    return _RunHeldOut(
        at, gap, std,
        fitted=rest - rest[model.dataset.point_count[at] > 0.0].mean(),
        likelihoods=(
            _log_likelihood(model, at, left, hiding + of_run + columns @ beforehand @ columns.T),
            _log_likelihood(model, at, rest, hiding + of_run + columns @ covariance @ columns.T),
        ),
        noise=rounded,
        unstated=_unstated(model, at, by_map, rest, apart, hiding, by_factors),
    )  # fmt: skip


def read_gap(model: Model) -> Array:
    """Return measured less simulated speed of a train file as read, from a model without effects [m/s], shape (m,)."""
    gap = np.zeros(model.residual.size)
    for run in range(len(model.dataset.runs)):
        at = model.dataset.point_run == run
        gap[at] = model.residual[at] - model.residual[at][_first(model, at)]
    return gap


def _neutral(model: Model) -> Array:
    """Return the transformation of columns that removes all effects from the residual, shape (1 + q + k, 1 + q + k).

    A fit to other runs then estimates their amplitudes from zero effect, with a wide prior centred there.
    """
    change = np.eye(model.columns.shape[1])
    for term, here in model.places():
        change[1 + here.start + term.index(term.kind.amplitude), 0] = term.amount
    return change


def _first(model: Model, at: Flags) -> int:
    """Return the first measured grid point of a run."""
    return int(np.argmax(model.dataset.point_count[at] > 0.0))


def _started(model: Model, at: Flags, left: Array, expected: Array) -> tuple[Array, Array]:
    """Return the residual of one run simulated from its initial speed, and the std expected of it [m/s], (m,)."""
    k = _first(model, at)
    # Variance of left - left[k].
    variance = np.diag(expected) - 2.0 * expected[:, k] + expected[k, k]
    return left - left[k], np.sqrt(np.maximum(variance, 0.0))


class _Unstated(NamedTuple):
    """What no train file states of one run, as fitted to it: its effect on the speeds, and the factors of the run."""

    mean: Array  # [m/s], shape (m,)
    covariance: Array  # [(m/s)^2], shape (m, m)
    factors: Array  # Shape (3,)


def _unstated(
    model: Model, at: Flags, known: Array, left: Array, unknown: Array, noise: Array, by_factors: Array
) -> _Unstated:
    """Return what no train file states of one run, as fitted to this run too.

    ``known`` are the speeds by errors of the map, and ``unknown`` the covariance, that the other runs leave to it;
    ``left`` is the residual without all that they show, ``by_factors`` its covariance with the factors of the run.
    """
    measured = model.dataset.point_count[at] > 0.0
    expected = (unknown + noise + 100.0)[np.ix_(measured, measured)]  # 10 m/s: the initial speed is not known
    gain = np.linalg.solve(expected, np.concatenate((unknown, by_factors), axis=1)[measured]).T
    found, size = gain @ left[measured], known.size
    covariance = unknown - gain[:size] @ unknown[measured]
    return _Unstated(known + found[:size], np.asarray(covariance), found[size:])


def _log_likelihood(model: Model, at: Flags, left: Array, expected: Array) -> float:
    """Return 2 ln of the density of the residual of one run with a covariance, but for a flat initial speed."""
    known = model.dataset.point_count[at] > 0.0
    # A noise of 1 mm/s keeps the matrix positive definite.
    root = np.linalg.cholesky(expected[np.ix_(known, known)] + 1e-6 * np.eye(int(known.sum())))
    pair = np.stack((left[known], np.ones(int(known.sum()))), axis=1)
    (yy, y1), (_, of_one) = (white := solve_triangular(root, pair, lower=True)).T @ white
    return float(y1 * y1 / of_one - yy - np.log(of_one)) - 2.0 * float(np.log(np.diag(root)).sum())


def gap_of(read: Array, before: HeldOut | None, after: HeldOut | None, model: Model, bursts: float = 0.0) -> Gap | None:
    """Return the gap of the train file read and written over all measured points; None if no run was held out.

    ``read`` is that of the train file read at the grid points [m/s], shape (m,); ``bursts`` the mean square of bursts
    of slip [(m/s)^2], which only the train file read takes for motion.
    """
    if before is None or after is None:
        return None
    known = model.dataset.point_count > 0.0
    of_points = read, after.gap, after.std, after.shown, before.fitted, after.fitted
    first, last, *floors, without, with_effects = (float(np.mean(np.square(x[known]))) for x in of_points)
    # The distances between stops are a measurement of the wheel.
    of_file, of_fit = after.likelihood - before.likelihood, after.fitted_likelihood - before.fitted_likelihood
    evidence = max(of_file, of_fit) + model.odometry.precision * model.odometry.excess**2 - model.odometry_cost
    return Gap(
        math.sqrt(first + bursts), math.sqrt(last), math.sqrt(min(floors)), len(model.dataset.runs),
        math.sqrt(without), math.sqrt(with_effects), evidence,
    )  # fmt: skip


def _noise(model: Model, hyper: Hyperparameters, at: Flags) -> Array:
    """Return the covariance of the speeds of one run by gusts, sensors and jitter [(m/s)^2], shape (m, m)."""
    noise = hyper.noise
    jitter = np.cumsum(np.square(noise.jitter * model.dataset.point_change[at]))
    t = model.dataset.point_time[at] - model.dataset.point_time[at][0]
    white = noise.speed**2 * share_of_mean(model.dataset.point_count[at])
    gusts = (noise.gust * noise.gust_time / model.dataset.inertia) ** 2 * integrated_covariance(t, noise.gust_time)
    return np.asarray(gusts + np.diag(white) + np.minimum.outer(jitter, jitter))


@dataclass(frozen=True, slots=True)
class Outcome:
    """Verdict with the models and held-out gaps behind it."""

    verdict: Verdict
    remaining: str  # One sentence on what the rest of the gap depends on
    hyper: Hyperparameters
    base: Model  # Model without effects, of all runs compared
    final: Model  # Model with the effects that are reported
    terms: tuple[EffectTerm, ...]  # Effects that are written
    davis: Davis  # a, b, c that are written
    read: Array  # Gap of the train file read, from the initial speeds [m/s], shape (m,)
    after: HeldOut | None  # Gaps of the train file written on runs held out; None with too few runs
    gap: Gap | None  # Gap of the train file read and of the one written


def weakest(outcome: Outcome) -> int | None:
    """Return the index of the weakest effect that must go, None if there is none.

    That is the least significant one if it is not significant in the final fit, or of several effects the one that
    makes the train file least more likely on runs held out, if that is no strong evidence.
    """
    if outcome.verdict is Verdict.UNEXPLAINED:
        return None
    weak = [(term.significance, k) for k, term in enumerate(outcome.terms) if not term.significance > SIGNIFICANT]
    if weak or len(outcome.terms) < 2 or (held := hold_out(outcome.final, outcome.hyper)) is None:
        return min(weak)[1] if weak else None
    others = [hold_out(outcome.final.without(k), outcome.hyper) for k in range(len(outcome.terms))]
    shown = [(held.likelihood - other.likelihood, k) for k, other in enumerate(others) if other is not None]
    return min(shown)[1] if min(shown)[0] <= SHOWN else None


def assess(
    selection: Selection, runs: Sequence[Run], train_file: TrainFile, stated: TrainFile, slip: Slip | None = None
) -> Outcome:
    """Return the verdict on the selected effects, from all runs compared with the model of a train file.

    ``stated`` is the train file read, which may have effects that were found anew.
    """
    verdict = _verdict(selection, slipping=slip is not None)
    # Effects that do not fit are not reported and not used.
    reported = selection.base if verdict is Verdict.UNEXPLAINED else selection.final
    hyper, base, final = reported.hyper, selection.base.model, reported.model
    if len(base.dataset.runs) < len(runs):
        base = Model.of(runs, train_file)
        final = with_onsets(base.with_terms(reported.model.terms).fit(hyper), hyper)
    read = read_gap(base if stated is train_file else Model.of(runs, stated))
    bursts = 0.0 if slip is None else slip.square
    davis = final.found_davis(final.posterior(hyper)[0])
    written = _Written(final.terms, davis, *_both_held_out(base, final, hyper))
    # a, b, c of the train file stay where they are as good, and where something unknown bends those of the fit.
    known = _with_known_davis(base, final, hyper)
    if verdict is Verdict.UNEXPLAINED or known.square < written.square:
        written = known
    gap = gap_of(read, written.before, written.after, final, bursts)
    remaining = _remaining(selection, verdict)
    if remaining is _NOISE and leaves_more_than_noise(gap):
        remaining = _USUAL if verdict is Verdict.NO_GAP else _MORE
    outcome = Outcome(verdict, remaining, hyper, base, final, written.terms, written.davis, read, written.after, gap)
    if gap is None and verdict is Verdict.EXPLAINED:
        return replace(outcome, verdict=Verdict.AMBIGUOUS, remaining='No other run confirms it.')
    if gap is not None and final.terms and not (gap.after < gap.before and gap.evidence > SHOWN):
        # Their evidence is that of a fit: runs that it has not seen do not show the effects.
        names = ' and '.join(sorted({term.name for term in final.terms}))
        return unexplained(
            outcome,
            f'The evidence for {names} is not confirmed on runs left out of the fit: gap {gap.before:.3f} m/s before, '
            f'{gap.after:.3f} m/s after, evidence {gap.evidence:.0f}.',
            bursts,
        )
    return outcome


def unexplained(outcome: Outcome, remaining: str, bursts: float = 0.0) -> Outcome:
    """Return an outcome without its effects; ``bursts`` as in :func:`gap_of`."""
    base = outcome.base
    written = _with_known_davis(base, base, outcome.hyper)
    gap = gap_of(outcome.read, written.before, written.after, base, bursts)
    return replace(
        outcome, verdict=Verdict.UNEXPLAINED, remaining=remaining, final=base, terms=written.terms,
        davis=written.davis, after=written.after, gap=gap,
    )  # fmt: skip


class _Written(NamedTuple):
    """What a train file could get, and the gaps on runs held out without and with the effects."""

    terms: tuple[EffectTerm, ...]
    davis: Davis
    before: HeldOut | None
    after: HeldOut | None

    @property
    def square(self) -> float:
        """Mean square of the gap with the effects [(m/s)^2], 0 if unknown."""
        return 0.0 if self.after is None else float(np.mean(np.square(self.after.gap)))


def _with_known_davis(base: Model, final: Model, hyper: Hyperparameters) -> _Written:
    """Return the effects as fitted with a, b, c of the train file, with the standard deviations of a free fit."""
    known = final.with_known_davis().fit(hyper)
    terms = (replace(one, covariance=free.covariance) for one, free in zip(known.terms, final.terms, strict=True))
    held = _both_held_out(base.with_known_davis(), known, hyper)
    return _Written(tuple(terms), final.train_file.resistance, *held)


def _both_held_out(base: Model, final: Model, hyper: Hyperparameters) -> tuple[HeldOut | None, HeldOut | None]:
    """Return the gaps of held-out runs without and with the effects; without effects they are the same."""
    before = hold_out(base, hyper)
    return before, hold_out(final, hyper) if final.terms else before


def leaves_more_than_noise(gap: Gap | None) -> bool:
    """Return whether the gap of the train file written is clearly above the noise floor."""
    return gap is not None and gap.after > NEAR * gap.noise_floor


_MORE: Final = 'More is left than noise and errors of the map and of the sensors; it fits no effect of the library.'
_USUAL: Final = 'The gap is above its noise floor, as small errors of load, map and brake can leave it too.'
_NOISE: Final = 'What is left is noise: gusts, errors of the map and of the sensors.'
NEAR: Final = 1.2  # Gap over noise floor of 9 in 10 clean cases at most [1], as benchmarks/explain.py counts


def _verdict(selection: Selection, *, slipping: bool) -> Verdict:
    final = selection.final
    left = max(selection.groups[0].evidence, 0.0 if slipping else final.excess)
    is_other = _is_other(selection) and left > _LEFT_OVER * sum(selection.evidence)
    if is_other:
        return Verdict.UNEXPLAINED
    if not selection.evidence:
        if slipping:
            return Verdict.EXPLAINED
        none = dict(probabilities(selection.hypotheses).shares)[NONE]
        return Verdict.NO_GAP if none > 1.0 - CERTAIN else Verdict.UNEXPLAINED
    return Verdict.AMBIGUOUS if any(selection.twins) else Verdict.EXPLAINED


def _is_other(selection: Selection) -> bool:
    """Return whether something outside the library is more probable than not."""
    return probabilities(selection.hypotheses).other > 0.5


def _remaining(selection: Selection, verdict: Verdict) -> str:
    strongest = selection.groups[0]
    if verdict is not Verdict.UNEXPLAINED:
        if _is_other(selection) and strongest.evidence > selection.final.excess:
            return f'The rest of the gap depends slightly on {strongest.text}, and no effect of the library fits it.'
        if (name := _possible(selection)) is None:
            return _NOISE
        return f'What is left may be {name}, which is not certain enough to be named, or noise.'
    if not _is_other(selection):
        return 'Something is missing, but no effect of the library is certain enough to be named.'
    noise, spread = selection.final.hyper.noise, selection.final.hyper.spread
    return (
        f'Unmeasured forces exceed plausible noise: gusts of {noise.gust:.2f} N/kN lasting {noise.gust_time:.0f} s, '
        f'errors of {spread.payload:.1%} of the mass, {spread.brake:.1%} of the brake force from run to run and '
        f'{spread.map:.2f} per mille of the map gradient.'
    )


def _possible(selection: Selection) -> str | None:
    """Return the most probable effect that is neither selected nor a twin, None if its absence is certain."""
    named = {*selection.final.names, *(name for twins in selection.twins for name in twins)}
    others = [(p, name) for name, p in probabilities(selection.hypotheses).present if name not in named]
    p, name = max(others, default=(0.0, ''))
    return name if p > 1.0 - CERTAIN else None


class _Axis(NamedTuple):
    """One axis: labels and edges of its k parts, and the samples that lie in each, shape (n, k)."""

    name: str
    unit: str
    labels: tuple[str, ...]
    edges: tuple[tuple[float, float], ...]
    inside: Flags


def locate(before: Model, after: Model, hyper: Hyperparameters) -> tuple[Location, ...]:
    """Return the missing resistance of a model without and with the effects along all axes that the data cover."""
    axes = _axes(before.dataset)
    columns = [before.dataset.column(axis.inside.astype(float)) for axis in axes]
    weight = before.dataset.dt / before.dataset.dt.sum()
    shares = [weight @ axis.inside for axis in axes]
    estimates = [_missing(model, hyper, columns, shares) for model in (before, after)]
    locations = []
    for axis, share, (first, std), (second, _) in zip(axes, shares, *estimates, strict=True):
        rows = zip(axis.labels, axis.edges, first.tolist(), second.tolist(), std.tolist(), share.tolist(), strict=True)
        places = tuple(Place(label, low, high, a, b, s, part) for label, (low, high), a, b, s, part in rows)
        locations.append(Location(axis.name, axis.unit, places))
    return tuple(locations)


def where(resistance: Array, dataset: Dataset) -> str:
    """Return as text where the resistance of an effect [N/kN], shape (n,), differs most from its mean.

    It is one place of each axis, at most three in all, first on the axis that explains most of the variance.
    """
    weight = dataset.dt / dataset.dt.sum()
    off = resistance - weight @ resistance
    found = []
    for axis in _axes(dataset):
        total, share = np.stack((weight * off, weight)) @ axis.inside
        size = total / share
        explained = float(share @ np.square(size))
        if axis.name == 'run' or explained < max(0.1 * float(weight @ np.square(off)), 1e-9):
            continue
        most = int(np.argmax(np.abs(size)))
        label, inside = axis.labels[most], np.arange(size.size) == most
        if axis.unit:  # with the neighbours that have at least half of it
            near = size / size[most] >= 0.5
            inside = near & (np.cumsum(~near) == np.cumsum(~near)[most])
            low, *_, high = [edge for edges, part in zip(axis.edges, inside, strict=True) if part for edge in edges]
            label = f'{low:.0f} to {high:.0f} {axis.unit}'
        there = total[inside].sum() / share[inside].sum()
        found.append((explained, f'{place_text(axis.name, label)} ({there:+.2f} N/kN)'))
    return ', '.join(text for _, text in sorted(found, reverse=True)[:3]) or 'no distinct location'


def _missing(
    model: Model, hyper: Hyperparameters, columns: Sequence[Array], shares: Sequence[Array]
) -> list[tuple[Array, Array]]:
    """Return what each part of an axis lacks beyond the mean of all parts, with its std, for one axis at a time."""
    found = []
    for information, share in zip(model.informations(hyper, columns, terms=False), shares, strict=True):
        # Prior std of a part: 3 N/kN; a part without data keeps it.
        covariance = np.asarray(np.linalg.inv(information.A + np.eye(share.size) / 3.0**2))
        deviation = np.eye(share.size) - (share / share.sum())[None, :]
        variance = np.einsum('ij,jk,ik->i', deviation, covariance, deviation)
        found.append((deviation @ (covariance @ information.b), np.sqrt(np.maximum(variance, 0.0))))
    return found


def _axes(dataset: Dataset) -> list[_Axis]:
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    position, heat, release = dataset.joined('position'), dataset.joined('heat'), dataset.joined('since_release')
    rising, inside, curved = dataset.direction > 0, dataset.joined('tunnel') >= 0.5, dataset.joined('radius') > 0.0
    braking, pulling = brake < BRAKING, traction > PULLING
    released = ~braking & (release < 10.0)  # s
    modes = (pulling & ~released, ~pulling & ~braking & ~released, braking, released)
    runs = tuple(dataset.run_of == k for k in range(len(dataset.runs)))
    ways = [('position', np.full(v.size, dataset.positioned))]
    if dataset.positioned and rising.any() and not rising.all():
        ways = [('position, rising', rising), ('position, falling', ~rising)]
    axes = [
        *(_cut(name, 'm', np.where(way, position, np.nan), 40) for name, way in ways),
        _cut('speed', 'm/s', v, 8),
        _kinds('mode', ('traction', 'coasting', 'braking', 'just released'), modes),
        _kinds('direction', ('rising', 'falling'), (rising, ~rising)),
        _kinds('tunnel', ('open air', 'tunnel'), (~inside, inside)),
        _kinds('curve', ('straight', 'curve'), (~curved, curved)),
        _cut('heat of the brake', 'J/kg', np.where(braking, heat, np.nan), 6),
        _kinds('run', tuple(str(run.number or k + 1) for k, run in enumerate(dataset.runs)), runs),
    ]
    return [axis for axis in axes if len(axis.labels) > 1]


def _cut(name: str, unit: str, x: Array, count: int) -> _Axis:
    """Return an axis divided into ``count`` parts of equal length, without empty ones; NaN lies outside the axis."""
    known = x[np.isfinite(x)]
    if known.size == 0 or known.max() <= known.min():
        return _Axis(name, unit, (), (), np.zeros((x.size, 0), dtype=bool))
    cuts = np.linspace(known.min(), known.max(), count + 1)
    part = np.clip(np.digitize(x, cuts) - 1, 0, count - 1)
    inside = (part[:, None] == np.arange(count)) & np.isfinite(x)[:, None]
    seen = np.flatnonzero(inside.any(axis=0)).tolist()
    edges = tuple((float(cuts[i]), float(cuts[i + 1])) for i in seen)
    labels = tuple(f'{low:.0f} to {high:.0f} {unit}' for low, high in edges)
    return _Axis(name, unit, labels, edges, inside[:, seen])


def _kinds(name: str, labels: tuple[str, ...], kinds: tuple[Flags, ...]) -> _Axis:
    """Return an axis of categories, without empty ones."""
    inside = np.stack(kinds, axis=1)
    seen = np.flatnonzero(inside.any(axis=0)).tolist()
    edges = ((math.nan, math.nan),) * len(seen)
    return _Axis(name, '', tuple(labels[i] for i in seen), edges, inside[:, seen])

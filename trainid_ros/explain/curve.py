# SPDX-License-Identifier: Apache-2.0
"""Learn a missing force that no effect of the library describes, as a curve over one variable.

The missing resistance is ``f(x) m``, see :mod:`trainid_ros.explain.variables`. f is linear between knots, and its
Gaussian prior has the size and the correlation length of most evidence. All nuisances are eliminated as for effects.
Each variable is compared with hyperparameters estimated with its curve, since those estimated without it have absorbed
the missing force.

Functions of few coefficients compete with the curve by BIC: the best one is taken if it is as good. Runs held out
confirm it, or the curve itself where no function is as good.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.explain.effects import SHOWN
from trainid_ros.explain.likelihood import Information, Nuisances, posterior
from trainid_ros.explain.proof import gap_of, hold_out
from trainid_ros.explain.result import Learned
from trainid_ros.explain.variables import Variable, hats, variables
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Effect

if TYPE_CHECKING:
    from trainid_ros.explain.dataset import Array
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.model import Model
    from trainid_ros.explain.result import Gap
    from trainid_ros.explain.search import State

_FITTED: Final = 3  # Number of variables that are fitted in full


Shape = tuple[float, float]
"""Shape parameters p and q of a function; 0 if it has none."""


class Form(NamedTuple):
    """A kind of function of x: terms that are linear in their coefficients, with up to two shape parameters p and q."""

    terms: tuple[str, ...]  # Each as text
    values: Callable[[Array, float, float], Sequence[NDArray[Any]]]  # Each at x, by p and q
    shapes: Callable[[Array], Iterable[Shape]] = lambda _: [(0.0, 0.0)]  # p and q to try, by the knots
    free: int = 0  # Number of shape parameters that are fitted, p first

    def at(self, x: Array, shape: Shape, *, level: bool) -> Array:
        """Return the terms at x, with ``level`` a constant too, shape (n, t)."""
        ones = (np.ones_like(x),) if level else ()
        return np.stack([np.asarray(value, dtype=float) for value in (*self.values(x, *shape), *ones)], axis=1)


def _cuts(knots: Array) -> Iterable[Shape]:
    return product(knots[1:-1].tolist(), [0.0])


def _widths(knots: Array) -> list[float]:
    return [float(x) for x in np.geomspace(2.0 * (knots[1] - knots[0]), knots[-1] - knots[0], 8)]


def _sections(knots: Array) -> Iterable[Shape]:
    return combinations(knots[:: -(-knots.size // 40)].tolist(), 2)  # of 160 knots, pairs of every fourth


def _waves(knots: Array) -> Iterable[Shape]:
    quarter = 0.5 * math.pi / float(knots[-1] - knots[0])  # phase from end to end [rad]; at least one period
    return product((quarter * np.arange(4.0, knots.size)).tolist(), [0.0])


FORMS: Final = (
    Form(('1.0',), lambda x, *_: (np.ones_like(x),)),
    Form(('x',), lambda x, *_: (x,)),
    Form(('x', 'x * x'), lambda x, *_: (x, np.square(x))),
    Form(('(x >= {p})',), lambda x, p, _: (x >= p,), _cuts, 1),
    Form(('max(0.0, x - {p})',), lambda x, p, _: (np.maximum(0.0, x - p),), _cuts, 1),
    Form(('abs(x - {p})',), lambda x, p, _: (np.abs(x - p),), _cuts, 1),
    Form(
        ('exp(({q} - x) / {p})',), lambda x, p, q: (np.exp(np.minimum((q - x) / p, 50.0)),),
        lambda k: product(_widths(k), k[:1].tolist()), 1,
    ),
    Form(('sin({p} * x)', 'cos({p} * x)'), lambda x, p, _: (np.sin(p * x), np.cos(p * x)), _waves, 1),
    Form(('({p} <= x < {q})',), lambda x, p, q: ((p <= x) & (x < q),), _sections, 2),
    Form(
        ('exp(-(((x - {p}) / {q}) ** 2))',), lambda x, p, q: (np.exp(-np.square((x - p) / q)),),
        lambda k: product(k.tolist(), _widths(k)), 2,
    ),
)  # fmt: skip
"""The grammar: constant, linear, quadratic, step, hinge, two slopes, decay, wave, section, bump."""


class Function(NamedTuple):
    """A function of x: a form with its shape, or a curve between knots whose prior covariance there is L L'."""

    form: Form | None
    shape: Shape
    level: bool  # Whether a constant is added
    std: Array  # Prior std of the coefficients, shape (t,)
    knots: Array  # Of the curve, shape (k,)
    root: Array  # L, shape (k, t)

    def at(self, x: Array) -> Array:
        """Return the terms at x, shape (n, t)."""
        if self.form is None:
            return hats(x, self.knots) @ self.root
        return self.form.at(np.clip(x, self.knots[0], self.knots[-1]), self.shape, level=self.level)

    def text(self, size: Array) -> str:
        """Return the function with its coefficients (t,) as a Python expression of x."""
        if self.form is None:
            return 'CURVE.at(x)'
        p, q = (f'{value:.6g}' for value in self.shape)
        named = zip(size.tolist(), [*self.form.terms, *(['1.0'] if self.level else [])], strict=True)
        text = ' '.join(f'{"-" if c < 0.0 else "+"} {abs(c):.5g} * {term.format(p=p, q=q)}' for c, term in named)
        return text.replace(' * 1.0', '').replace('- -', '+ ').removeprefix('+ ')


class Fit(NamedTuple):
    """A variable with its curve."""

    evidence: float  # 2 ln of the Bayes factor of the curve [1]
    variable: Variable
    knots: Array  # Of the curve, shape (k,)
    root: Array  # L with L L' the prior covariance at the knots, shape (k, k)
    hyper: Hyperparameters  # Estimated with the curve


def _best_root(variable: Variable, knots: Array, found: Information) -> tuple[float, Array]:
    """Return 2 ln of the largest Bayes factor of a curve by the information on it, and the root of its prior."""
    tried, b = [], found.b[:, None]
    for root in variable.roots(knots):
        curve = Nuisances(found.A, root)
        tried.append((float(curve.explained(b, b)[0, 0]) - curve.log_det, root))
    return max(tried, key=lambda item: item[0])


def fits(state: State, varied: Sequence[Variable]) -> list[Fit]:
    """Return the variables with the best curves, each with its own hyperparameters, best first."""
    model, tried = state.model, []
    varying = [(one, one.knots) for one in varied]
    columns = [model.dataset.column(one.hats(knots)) for one, knots in varying]
    for (one, knots), column, found in zip(varying, columns, model.informations(state.hyper, columns), strict=True):
        tried.append((*_best_root(one, knots, found), one, knots, column))
    fitted: list[Fit] = []
    for _, root, one, knots, column in sorted(tried, key=lambda item: -item[0]):
        if len({fit.variable.text for fit in fitted}) < _FITTED:
            curved = model.with_columns(column @ root, np.ones(root.shape[1]))
            hyper, _ = curved.evidence().maximise(state.logs)
            evidence = hyper.evidence - state.hyper.evidence - 2.0 * math.log(len([*one.roots(knots)]))
            fitted.append(Fit(evidence, one, knots, root, hyper))
    return sorted(fitted, key=lambda fit: -fit.evidence)


def _function(fit: Fit, found: Information, curve: float, count: int) -> Function | None:
    """Return the best function by BIC; None if it is not as good as a curve of an evidence.

    ``found`` is the information on the curve at its knots, ``count`` the number of measurements.
    """
    knots, best, function = fit.knots, curve - SHOWN, None
    for form, level in product(FORMS if fit.variable.unit else (), {False, fit.variable.has_level}):
        of_shape = partial(scored, form, level=level, knots=knots, found=found, count=count)
        _, shape = max((of_shape(shape)[0], shape) for shape in form.shapes(knots))
        shape = _refined(of_shape, shape, form.free)
        value, size = of_shape(shape)
        if value > best:
            best, function = value, Function(form, shape, level, 3.0 * np.abs(size), knots, fit.root)
    return function


def scored(
    form: Form, shape: Shape, *, level: bool, knots: Array, found: Information, count: int
) -> tuple[float, Array]:
    """Return the BIC of a function relative to none, larger is better, and its coefficients."""
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        G = form.at(knots, shape, level=level)
    if not np.isfinite(G).all() or (np.abs(G).max(axis=0) < 1e-6).any():  # a width of zero, or a bump between two knots
        return -math.inf, np.zeros(G.shape[1])
    size = np.asarray(np.linalg.lstsq(G.T @ found.A @ G, G.T @ found.b, rcond=1e-12)[0], dtype=np.float64)
    return float(found.b @ G @ size) - (G.shape[1] + form.free) * math.log(count), size


def _refined(of_shape: Callable[[Shape], tuple[float, Array]], shape: Shape, free: int) -> Shape:
    """Return the best shape near one of the shapes tried, by the first ``free`` of its parameters."""
    from scipy.optimize import minimize  # noqa: PLC0415 (slow to load)

    def whole(z: Array) -> Shape:
        return float(z[0]), float(z[1]) if free > 1 else shape[1]

    def cost(z: Array) -> float:
        return -of_shape(whole(z))[0]

    start = np.array(shape[:free])
    return whole(minimize(cost, start, method='Nelder-Mead', options={'maxfev': 60}).x) if free else shape


def learn(state: State, whole: Model, read: Array, provenance: str) -> Learned | None:
    """Return the curve over the variable with the most evidence; None if none has enough.

    ``state`` is the model without effects of the runs that were searched, ``whole`` that of all runs, whose gap by the
    train file read is ``read`` [m/s], shape (m,).
    """
    varied = variables(state.model)
    found = fits(state, varied)
    if not found or found[0].evidence < SHOWN:
        return None
    chosen = found[0].variable
    of_all = varied if whole is state.model else variables(whole)
    variable = next(v for v in of_all if (v.name, v.source) == (chosen.name, chosen.source))
    twins = [fit.variable for fit in found[1:] if fit.evidence > found[0].evidence - SHOWN]
    fit = found[0]._replace(variable=variable, knots=variable.knots)
    (information,) = whole.informations(fit.hyper, [whole.dataset.column(variable.hats(fit.knots))])
    evidence, root = _best_root(variable, fit.knots, information)
    fit = fit._replace(root=root)
    products = np.block([[np.zeros((1, 1)), information.b[None]], [information.b[:, None], information.A]])
    mean, covariance = posterior(products, root)
    if not variable.has_level:  # the mean of the curve is Davis a
        dt = whole.dataset.dt
        deviation = np.eye(mean.size) - (dt @ variable.hats(fit.knots) / dt.sum())[None, :]
        mean, covariance = deviation @ mean, deviation @ covariance @ deviation.T
    learned = Learned(
        variable.name, variable.text, variable.unit, variable.of, fit.evidence,
        tuple(dict.fromkeys(twin.text for twin in twins if twin.text != variable.text)),
        fit.knots, mean, np.sqrt(np.maximum(np.diag(covariance), 0.0)),
    )  # fmt: skip
    measured = int((whole.dataset.point_count > 0.0).sum())
    curve = Function(None, (0.0, 0.0), False, np.ones(root.shape[1]), fit.knots, root)
    functions = (_function(fit, information, evidence, measured), curve) if variable.unit else ()
    for function in filter(None, functions):  # none of a run, which shows nothing of another
        gap, model = _held_out(function, fit, whole, read)
        learned = replace(learned, gap=gap)
        if gap is not None and gap.after < gap.before and gap.evidence > SHOWN:
            return _written(learned, function, fit, model, provenance)
    return learned


def _held_out(function: Function, fit: Fit, whole: Model, read: Array) -> tuple[Gap | None, Model]:
    """Return the gap on runs held out, and the model; with a, b, c fitted or as they are, whichever is better."""
    one, tried = fit.variable, []
    columns = whole.dataset.column(function.at(one.x) * one.weight[:, None])
    for base in (whole, whole.with_known_davis()):
        model = base.with_columns(columns, function.std)
        tried.append((gap_of(read, hold_out(base, fit.hyper), hold_out(model, fit.hyper), whole), model))
    return min(tried, key=lambda item: math.inf if item[0] is None else item[0].after)


def _written(learned: Learned, function: Function, fit: Fit, model: Model, provenance: str) -> Learned:
    """Return what was learned with its function, and as an effect if a TrackPoint knows the variable."""
    mean, covariance = model.posterior(fit.hyper)
    at, old, one = model.dependence, model.train_file, fit.variable
    size, text = mean[at], function.text(mean[at])
    learned = replace(learned, is_confirmed=True, function=text if function.form else '')
    if not one.source:
        return learned
    name = f'learned_{one.name.replace("-", "_")}'
    while name in EFFECTS:  # explained with what was learned before
        name += '_too'
    table = np.stack((fit.knots, function.at(fit.knots) @ size)).round(6).tolist()
    low, high = (f'{x:.6g}' for x in fit.knots[[0, -1]])
    source = _SOURCE.format(
        name=name, text=one.text, unit=one.unit, x=one.source, factor=one.factor_source, low=low, high=high,
        function=text, curve='' if function.form else _CURVE.format(*table),
    )  # fmt: skip
    std = 1.0 / math.sqrt(float(size @ np.linalg.solve(covariance[at, at], size)))
    effect = Effect(name, (('share', 1.0),), (('share', std),), provenance)
    file = replace(old, resistance=model.found_davis(mean), effects=(*old.effects, effect))
    return replace(learned, effect=name, source=source, train_file=file)


_CURVE: Final = """from trainid_ros.train.forces import Interpolation

CURVE = Interpolation(
    {},
    {},
)
"""
_SOURCE: Final = '''# Written by trainid explain.
"""Missing resistance over {text}, as learned from {low} to {high} {unit}."""

from math import cos, exp, isnan, sin

from trainid_ros.train.effects import Davis, EffectKind, Parameter, Parameters, TrackPoint
{curve}

def resistance(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    """Return the missing resistance [N/kN]; beyond the range learned, that at its end."""
    x = {x}
    if isnan(x):
        return 0.0
    x = min(max(x, {low}), {high})
    return p['share'] * ({function}) * {factor}


EFFECT = EffectKind(
    name='{name}',
    title='learned resistance over {text}',
    equation='w = share ({function}) {factor}, x = {text} [{unit}]',
    parameters={{'share': Parameter('', -10.0, 10.0)}},
    amplitude='share',
    linear=True,
    typical_size=1.0,
    resistance=resistance,
)
'''

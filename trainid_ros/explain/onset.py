# SPDX-License-Identifier: Apache-2.0
"""Onset time of an effect: its posterior over all times, since a linearisation at one time is not valid at others.

While the train stands, the onset time has no influence on the data, so the likelihood is flat there and changes
abruptly elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.effect_scores import reduced_information
from trainid_ros.explain.families import shape_names, sign, unit_resistance
from trainid_ros.explain.regression import log_bayes
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import EffectTerm, Model

_TIMES: Final = 120
"""Grid points of the onset time."""


def with_onsets(model: Model, hyper: Hyperparameters) -> Model:
    """Return a fitted model in which effects with an onset time have the mean and variance of its posterior."""
    terms = model.terms
    timed = tuple(with_onset(term, model.without(k), hyper) for k, term in enumerate(terms))
    return model if all(a is b for a, b in zip(timed, terms, strict=True)) else model.with_terms(timed)


def with_onset(term: EffectTerm, without: Model, hyper: Hyperparameters) -> EffectTerm:
    """Return a fitted effect with the posterior mean and variance of its onset time; unchanged if it has none.

    Args:
        term: The fitted effect.
        without: The model without it.
        hyper: Hyperparameters of noise and nuisances.

    """
    kind = EFFECTS[term.name]
    names = [n for n in shape_names(kind) if kind.parameters[n].unit == 's' and kind.parameters[n].search is None]
    if len(names) != 1 or term.covariance is None:
        return term
    name, dataset = names[0], without.dataset
    times = np.linspace(dataset.time.min(), dataset.time.max(), _TIMES + 2)[1:-1]
    times = np.sort(np.append(times, term.parameters[name]))
    shape = {n: term.parameters[n] for n in shape_names(kind)}
    columns = [unit_resistance(without.evaluator, kind, {**shape, name: float(t)}) for t in times]
    information = reduced_information(without, hyper, dataset.column(np.stack(columns, axis=1)))
    value = log_bayes(np.diag(information.A), information.b, kind.usual, sign(kind))
    weight = np.exp(0.5 * (value - value.max()))
    weight = weight * np.gradient(times)
    weight /= weight.sum()
    mean = float(weight @ times)
    variance = float(weight @ np.square(times - mean)) + float(np.median(np.diff(times))) ** 2 / 12.0
    at = list(term.parameters).index(name)
    covariance = term.covariance.copy()
    covariance[at, at] = max(covariance[at, at], variance)
    return replace(term, parameters={**term.parameters, name: mean}, covariance=covariance)

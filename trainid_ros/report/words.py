# SPDX-License-Identifier: Apache-2.0
"""Text and rounded numbers of an explanation, for the terminal and for the report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from trainid_ros.explain.result import Explanation, FoundEffect, Verdict, place_text
from trainid_ros.interface.results import ResistanceEstimate, quantities
from trainid_ros.interface.text import pluralise
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import TrainFile

DASH: Final = '–'
DAVIS_UNITS: Final = tuple(quantities(ResistanceEstimate)[name].unit.replace('^2', '²') for name in 'abc')


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, a dash if it is not finite."""
    return f'{value:.{digits}g}' if math.isfinite(value) else DASH


def headline(explanation: Explanation) -> str:
    """Return the outcome in one sentence."""
    times = {1: '', 2: ' twice', 3: ' three times'}
    counts = Counter(effect.name for effect in explanation.effects)
    names = join([f'{name}{times.get(n, f" {n} times")}' for name, n in counts.items()])
    match explanation.verdict:
        case Verdict.EXPLAINED:
            return f'The current model lacks {names}.'
        case Verdict.AMBIGUOUS:
            twins = [*dict.fromkeys(twin.name for effect in explanation.effects for twin in effect.twins)]
            best, also = ('fits' if len(found) == 1 else 'fit' for found in (explanation.effects, twins))
            return f'The current model lacks an effect: {names} {best} best, but {join(twins)} {also} equally well.'
        case Verdict.UNEXPLAINED:
            named = f'{names}, and ' if names else ''
            return f'The current model lacks {named}something that no effect of the library fits.'
        case Verdict.NO_GAP:
            return 'The current model lacks no effect detectable in the data, once a, b and c are fitted.'


def join(words: Sequence[str]) -> str:
    """Return words as an enumeration with commas and 'and'."""
    return ' and '.join(filter(None, (', '.join(words[:-1]), *words[-1:])))


def plus_minus(value: float, std: float) -> str:
    """Return a value with its standard deviation, both rounded to two significant digits of the latter."""
    if not (math.isfinite(std) and std > 0.0 and math.isfinite(value)):
        return number(value)
    places = max(0, 1 - math.floor(math.log10(std)))
    return f'{value:.{places}f} ± {std:.{places}f}' if places < 7 else f'{value:.4g} ± {std:.2g}'


def unit_of(effect: str, parameter: str) -> str:
    """Return the unit of a parameter, '' for ratios and for effects not in the library."""
    known = EFFECTS[effect].parameters if effect in EFFECTS else {}
    return known[parameter].unit if parameter in known else ''


def parameters_text(effect: FoundEffect) -> str:
    """Return the parameters of an effect with standard deviations and units."""
    std = dict(effect.std)
    values = [(name, plus_minus(value, std.get(name, 0.0))) for name, value in effect.parameters]
    return join([f'{name} = {text} {unit_of(effect.name, name)}'.rstrip() for name, text in values])


def causes_text(explanation: Explanation) -> str:
    """Return the probabilities of causes as text, those of less than one per cent together."""
    words = {'none': 'nothing is missing', 'other': 'something outside the library'}
    shown = [(name, p) for name, p in explanation.probabilities if p >= 0.01]
    rest = 1.0 - sum(p for _, p in shown)
    texts = [f'{words.get(name, name)} {p:.0%}' for name, p in shown]
    return ', '.join([*texts, *([f'all else {rest:.0%}'] if rest >= 0.01 else [])])


def how_sure(effect: FoundEffect) -> str:
    """Return the evidence for an effect as text."""
    digits = effect.evidence / (2.0 * math.log(10.0))
    odds = 'more than a million' if digits > 6.0 else f'{10.0**digits:.2g}'
    text = f'evidence {effect.evidence:.0f}: the data are {odds} times as likely with it as without'
    kind, std = EFFECTS.get(effect.name), dict(effect.std)
    if kind is None or kind.amplitude not in dict(effect.parameters) or not std.get(kind.amplitude, 0.0) > 0.0:
        return text
    sigmas = abs(dict(effect.parameters)[kind.amplitude] - kind.neutral) / std[kind.amplitude]
    return f'{text}; its amplitude is {sigmas:.1f} std from zero effect'


def gap_sentence(explanation: Explanation) -> str:
    """Return the gap before and after, and the noise floor, as text."""
    gap = explanation.gap
    if gap is None:
        return 'There are too few runs to hold one out, so the gap cannot be measured.'
    held_out = f'{pluralise(gap.runs_held_out, "run")}, each left out of the fit that simulates it'
    head = f'On {held_out}, simulated and measured speed '
    noise = f'the estimated noise alone would leave {gap.noise_floor:.3f} m/s'
    if not explanation.effects:
        return f'{head}differ by {gap.before:.3f} m/s (rms); {noise}.'
    text = f'{head}differ by {gap.before:.3f} m/s (rms) without the effects and {gap.after:.3f} m/s with them; {noise}.'
    if gap.noise_floor > 0.0 and gap.after > 1.1 * gap.noise_floor:
        text += f' The rest is {gap.after / gap.noise_floor - 1.0:.0%} above the noise.'
    return text


def alternatives(explanation: Explanation) -> list[str]:
    """Return the alternatives to each effect and the test run that would distinguish them, without repetitions."""
    lines = [
        f'{effect.name} could also be {twin.name}. To distinguish them: {twin.drive or "no test run is known"}.'
        for effect in explanation.effects
        for twin in effect.twins
    ]
    return [*dict.fromkeys(lines)]


def strongest(explanation: Explanation) -> list[str]:
    """Return the parts of the data where the current model significantly lacks most, as text."""
    places = [
        (abs(place.before) / place.std, place_text(location.axis, place.label), place)
        for location in explanation.locations
        for place in location.places
        if location.axis != 'run' and place.std > 0.0  # a run is no cause of the gap
    ]
    lines = []
    # Significant from three standard deviations on.
    for _, where, place in sorted((part for part in places if part[0] > 3.0), key=lambda part: -part[0])[:3]:
        size, more = plus_minus(abs(place.before), place.std), 'more' if place.before > 0.0 else 'less'
        lines.append(f'{where[0].upper()}{where[1:]}: {size} N/kN {more} resistance than modelled')
    return lines


def noise_rows(explanation: Explanation) -> list[tuple[str, str, str]]:
    """Return the estimates of noise and nuisances: name, unit, value."""
    noise, spread = explanation.noise, explanation.spread
    load = 'error of the weighed load' if explanation.weighed else 'load (the train is not weighed)'
    rows = (
        ('noise of the measured speed', 'm/s', noise.speed),
        ('gusts and other transient forces', 'N/kN', noise.gust),
        ('correlation time of these', 's', noise.gust_time),
        (load, '% of the mass', 100.0 * spread.payload),
        ('brake from run to run', '% of its force', 100.0 * spread.brake),
        ('error of the gradient in the map', 'per mille', spread.map),
        ('speeds excluded (slip, outliers)', '%', 100.0 * explanation.outliers),
    )
    return [(name, unit, number(value, 2)) for name, unit, value in rows]


def davis_rows(explanation: Explanation, train_file: TrainFile) -> list[tuple[str, str, str, str]]:
    """Return a, b, c: name, train file's value, estimate with standard deviation, unit."""
    before, after = train_file.resistance, explanation.davis
    return [
        (name, number(getattr(before, name)), plus_minus(getattr(after, name), std), unit)
        for name, std, unit in zip('abc', explanation.davis_std, DAVIS_UNITS, strict=True)
    ]


def drive_text(explanation: Explanation) -> str:
    """Return the amount of driving compared, as text."""
    traces = explanation.traces
    seconds = sum(float(trace.time[-1] - trace.time[0]) for trace in traces if trace.time.size)
    metres = sum(float(np.sum(0.5 * (trace.speed[1:] + trace.speed[:-1]) * np.diff(trace.time))) for trace in traces)
    ways = {trace.direction for trace in traces}
    way = 'both directions' if len(ways) > 1 else 'one direction only'
    bags = len({trace.bag for trace in traces})
    within = f' in {bags} bags' if bags > 1 else ''
    point = explanation.gradient_point
    read = f'; gradients taken as those at the {point} of the train, which fits better' if point else ''
    return f'{pluralise(len(traces), "run")}{within}, {metres / 1000.0:.1f} km in {seconds / 60.0:.0f} min, {way}{read}'

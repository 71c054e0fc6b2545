# SPDX-License-Identifier: Apache-2.0
"""Text and rounded numbers of an explanation, for the terminal and for the report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from trainid_ros.explain.result import Explanation, FoundEffect, Learned, Verdict, noise_floor, place_text
from trainid_ros.interface.results import ResistanceEstimate, quantities
from trainid_ros.interface.text import pluralise, plus_minus
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Effect, TrainFile

DASH: Final = '–'
# Causes that are no effects, as in ``explain.result``.
_CAUSES: Final = {'none': 'nothing is missing', 'other': 'something outside the library'}
_MIN_RUNS: Final = 6  # Runs from which on effects of usual size are mostly found, see docs/explain.md
_REJECTED: Final = 6  # Rejected causes shown at most
# Distance from which a, b, c of the data differ from the train file, by chance once in 400 times (chi^2 of three) [std]
_OTHER_DAVIS: Final = 3.8
DAVIS_UNITS: Final = tuple(quantities(ResistanceEstimate)[name].unit.replace('^2', '²') for name in 'abc')


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, a dash if it is not finite."""
    return f'{value:.{digits}g}' if math.isfinite(value) else DASH


def headline(explanation: Explanation) -> str:
    """Return the outcome in one sentence, with probabilities."""
    times = {1: '', 2: ' twice', 3: ' three times'}
    counts, shares = Counter(effect.name for effect in explanation.effects), dict(explanation.probabilities)
    chances = {effect.name: effect.probability for effect in explanation.effects}
    listed = [f'{name}{times.get(n, f" {n} times")} ({percent(chances[name])})' for name, n in counts.items()]
    names = join(listed).replace('(', '(probability ', 1)
    none, other = percent(shares.get('none', 0.0)), percent(explanation.other)
    twins = [f'{name} ({percent(shares[name])})' if name in shares else name for name in _twins(explanation)]
    match explanation.verdict:
        case Verdict.EXPLAINED:
            return f'The current model lacks {names}{f" or, with the same motion, {join(twins)}" if twins else ""}.'
        case Verdict.AMBIGUOUS:
            best = 'fits' if len(explanation.effects) == 1 else 'fit'
            if not twins:
                return f'The current model may lack {names}, but no run is left to confirm it.'
            return f'The current model lacks an effect: {names} {best} best, but it may be {join(twins)} instead.'
        case Verdict.UNEXPLAINED:
            named, what = f'{names}, and ' if names else '', f'outside the library (probability {other})'
            if not names and explanation.other < 0.5:
                best, p = explanation.probabilities[0]
                what = f'that the data do not confirm: {_CAUSES.get(best, best)} fits best (probability {percent(p)})'
            return f'The current model lacks {named}something {what}.'
        case Verdict.NO_GAP:
            moved = explanation.davis_distance
            other = (
                f', but a, b and c that differ from the train file by {moved:.1f} std' if moved > _OTHER_DAVIS else ''
            )
            if (likeliest := explanation.probabilities[0])[0] != 'none' and shares.get('none', 0.0) < 0.5:
                rival = f'{_CAUSES.get(likeliest[0], likeliest[0])} {percent(likeliest[1])}'
                return (
                    f'The data do not tell whether an effect is missing (probability of none {none}, {rival}){other}.'
                )
            return f'The data show no missing effect (probability that none is missing {none}){other}.'


def percent(p: float) -> str:
    """Return a probability as text that states no certainty."""
    return '>99%' if p > 0.995 else '<1%' if p < 0.005 else f'{p:.0%}'


def _twins(explanation: Explanation) -> list[str]:
    return [*dict.fromkeys(twin.name for effect in explanation.effects for twin in effect.twins)]


def join(words: Sequence[str]) -> str:
    """Return words as an enumeration with commas and 'and'."""
    return ' and '.join(filter(None, (', '.join(words[:-1]), *words[-1:])))


def unit_of(effect: str, parameter: str) -> str:
    """Return the unit of a parameter, '' for ratios and for effects not in the library."""
    known = EFFECTS[effect].parameters if effect in EFFECTS else {}
    return known[parameter].unit if parameter in known else ''


def parameters_text(effect: FoundEffect) -> str:
    """Return the parameters of an effect with standard deviations and units, and the runs if not all."""
    return ', '.join([join(each_parameter(effect)), *on_runs(effect)])


def each_parameter(effect: FoundEffect | Effect) -> list[str]:
    """Return each parameter of an effect with its standard deviation and unit."""
    std = dict(effect.std)
    values = [(name, plus_minus(value, std.get(name, 0.0))) for name, value in effect.parameters]
    return [f'{name} = {text} {unit_of(effect.name, name)}'.rstrip() for name, text in values]


def on_runs(effect: FoundEffect | Effect) -> list[str]:
    """Return the runs of an effect as text, none for all."""
    return [f'on runs {join([*map(str, effect.runs)])} only'] if effect.runs else []


def causes_text(explanation: Explanation) -> str:
    """Return the probabilities of causes as text, those of less than one per cent together."""
    shown = [(name, p) for name, p in explanation.probabilities if p >= 0.01]
    rest = 1.0 - sum(p for _, p in shown)
    texts = [f'{_CAUSES.get(name, name)} {p:.0%}' for name, p in shown]
    return ', '.join([*texts, *([f'all else {rest:.0%}'] if rest >= 0.01 else [])])


def how_sure(effect: FoundEffect) -> str:
    """Return the evidence for an effect as text."""
    odds = _times(math.exp(min(0.5 * effect.evidence, 20.0)))  # more than a million from 14 on
    text = f'evidence {effect.evidence:.0f}: the data are {odds} times as likely with it as without'
    return f'{text}; its amplitude is {effect.significance:.1f} std from zero effect'


def gap_sentence(explanation: Explanation) -> str:
    """Return the gap by the train files read and written, and the noise floor, as text."""
    gap = explanation.gap
    if gap is None:
        return 'There are too few runs to hold one out, so the gap cannot be measured.'
    is_same = math.isclose(gap.after, gap.before, rel_tol=1e-6)  # nothing was written
    written = '' if is_same else f' and {gap.after:.3f} m/s with the one written'
    proof = f' The evidence of these runs for the effects is {gap.evidence:.0f}.' if explanation.effects else ''
    floor = noise_floor(gap, explanation.learned)
    if explanation.verdict is Verdict.UNEXPLAINED and floor > gap.before:
        proof = ' That is more than the gap, so these data cannot tell what is missing.'
    return (
        f'On {pluralise(gap.runs_held_out, "run")}, each left out of the fit that simulates it, simulated and measured '
        f'speed differ by {gap.before:.3f} m/s (rms) with the train file read{written}; a correct one would leave '
        f'{floor:.3f} m/s.{proof}'
    )


def learned_sentence(learned: Learned | None) -> str:
    """Return what runs held out say about the curve that was learned, as text; '' without one."""
    if learned is None or (gap := learned.gap) is None or not learned.unit:  # a run held out shows nothing of itself
        return ''
    fell = f'from {gap.before:.3f} to {gap.after:.3f} m/s on runs left out of the fit, evidence {gap.evidence:.0f}'
    if not learned.is_confirmed:
        return f'That is not confirmed: with it the gap goes {fell}.'
    named = f' as the effect {learned.effect}' if learned.effect else ''
    return f'With it{named} the gap falls {fell}; a correct train file would leave {gap.noise_floor:.3f} m/s.'


def next_steps(explanation: Explanation) -> list[str]:
    """Return as sentences what to do next: the drive that would tell, and what the data lack."""
    if explanation.verdict is Verdict.EXPLAINED:
        slip = ' but that of slip' if any(effect.name == 'wheel_slip' for effect in explanation.effects) else ''
        use = f'Use the train file of --out, and explain further drives with it: they should show no gap{slip}.'
        return [*alternatives(explanation), use]
    steps, found = alternatives(explanation), {effect.name for effect in explanation.effects}
    if not found and explanation.train_file.resistance == explanation.davis:
        steps.append('Use the train file of --out, with a, b and c as fitted.')
    if (learned := explanation.learned) and learned.effect:
        steps.append(f'Find the cause. Until then use folder learned, with {learned.effect} as an effect of your own.')
    if explanation.verdict is not Verdict.AMBIGUOUS:
        others = [(name, p) for name, p in explanation.probabilities if name in EFFECTS and name not in found]
        steps += [f'Otherwise likeliest: {x} ({percent(p)}). To see it: {EFFECTS[x].needs}.' for x, p in others[:1]]
    return [*steps, *_lacking(explanation)]


def _lacking(explanation: Explanation) -> list[str]:
    """Return as a sentence what data of this kind should contain but do not; none if they are complete."""
    traces = explanation.traces
    modes = {place.label for location in explanation.locations if location.axis == 'mode' for place in location.places}
    absent = (
        (len(traces) < _MIN_RUNS, f'{_MIN_RUNS} runs or more'),
        (len({trace.direction for trace in traces}) < 2, 'both directions'),
        (bool(modes) and 'coasting' not in modes, 'coasting'),
        (not explanation.weighed, 'the weighed mass'),
    )
    texts = [text for is_absent, text in absent if is_absent]
    return [f'The data should also contain {join(texts)}.'] if texts else []


def rejected_rows(explanation: Explanation) -> list[tuple[str, str, str, str]]:
    """Return the likeliest causes beside the answer: name, meaning, probability, ratio of the answer's to it."""
    answers = {effect.name for effect in explanation.effects}.union(_twins(explanation))
    answers |= {Verdict.UNEXPLAINED: {'other'}, Verdict.NO_GAP: {'none'}}.get(explanation.verdict, set())
    best = max((p for name, p in explanation.probabilities if name in answers), default=0.0)
    rejected = [(name, p) for name, p in explanation.probabilities if name not in answers and p > 0.0]
    titles = {**{name: kind.title for name, kind in EFFECTS.items()}, **_CAUSES}
    return [(name, titles.get(name, DASH), percent(p), _times(best / p)) for name, p in rejected[:_REJECTED]]


def _times(ratio: float) -> str:
    """Return a ratio of probabilities with two significant digits."""
    return 'more than a million' if ratio > 1e6 else f'{float(f"{ratio:.2g}"):g}'


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

# SPDX-License-Identifier: Apache-2.0
"""Report of an explanation: the findings as text, then the figures, then the tables."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Final

from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.report.gap_figures import (
    Stretches,
    gap_along_line,
    gap_bars,
    gap_of_runs,
    missing_along_line,
    missing_by_part,
)
from trainid_ros.report.page import bullets, captioned, facts_list, page, write_page
from trainid_ros.report.tables import html_table
from trainid_ros.report.words import (
    alternatives,
    davis_rows,
    drive_text,
    gap_sentence,
    headline,
    how_sure,
    noise_rows,
    parameters_text,
    plus_minus,
    strong_text,
    strongest,
    unit_of,
)

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.train.train_file import TrainFile

# The tag has the colours of the estimators' statuses.
_TAGS: Final = {
    Verdict.EXPLAINED: 'VALID',
    Verdict.NO_GAP: 'HOLDING',
    Verdict.AMBIGUOUS: 'CONVERGING',
    Verdict.UNEXPLAINED: 'FAULT',
}
_FOOTER: Final = (
    'Missing resistance is what the current model (train file) lacks, in N per kN of train weight; positive: more '
    'resistance. Speed gap is measured less simulated speed. Bands are ±2 standard deviations.'
)


@dataclass(frozen=True, slots=True)
class Explained:
    """An explanation with the inputs it was made from."""

    title: str  # Heading
    explanation: Explanation  # Result of the workflow
    train_file: TrainFile  # Train file given to the workflow
    train_file_name: str  # Name of the train file
    bags: tuple[str, ...]  # Names of the bags
    notes: tuple[str, ...] = ()  # Further sentences, such as the truth


def write_explained(explained: Explained, path: str | Path) -> None:
    """Write the report and create missing folders.

    Raises:
        InputError: The file cannot be written.
    """
    write_page(render_explained(explained), path)


def render_explained(explained: Explained) -> str:
    """Return the report as HTML text."""
    return page(
        explained.title, _head(explained) + _findings(explained) + _figures(explained) + _tables(explained), _FOOTER
    )


def _head(explained: Explained) -> str:
    verdict = explained.explanation.verdict
    facts = (
        ('Bags', ', '.join(explained.bags)),
        ('Train file', explained.train_file_name),
        ('Drive', drive_text(explained.explanation)),
    )
    tag = f'<span class="tag {_TAGS[verdict]}">{verdict.value.replace("_", " ")}</span>'
    heading = f'<h2>{tag} {escape(headline(explained.explanation))}</h2>'
    return facts_list(facts) + heading + bullets(explained.notes)


def _findings(explained: Explained) -> str:
    explanation = explained.explanation
    where = [f'{effect.name}: {effect.where}' for effect in explanation.effects]
    parts = (
        ('Missing effects', [_what(explanation, i) for i in range(len(explanation.effects))]),
        ('Where', where or [strong_text(strong) for strong in strongest(explanation)]),
        ('Evidence', [f'{effect.name}: {how_sure(effect)}' for effect in explanation.effects]),
        ('Alternatives, and test runs to distinguish them', alternatives(explanation)),
        ('Gap before and after', [gap_sentence(explanation)]),
        ('Remaining gap', [explanation.remaining]),
    )
    return ''.join(f'<h3>{name}</h3>{_paragraphs(lines)}' for name, lines in parts if lines)


def _what(explanation: Explanation, index: int) -> str:
    effect = explanation.effects[index]
    side = 'This is a sensor error.' if effect.origin == 'sensor' else 'This is physical, not a sensor error.'
    return f'{effect.name}, {effect.title}: {effect.equation}, with {parameters_text(effect)}. {side}'


def _paragraphs(lines: list[str]) -> str:
    return f'<p>{escape(lines[0])}</p>' if len(lines) == 1 else bullets(lines)


def _figures(explained: Explained) -> str:
    explanation, line = explained.explanation, explained.train_file.line
    found = _stretches(explanation)
    figures = (
        (
            'Gap',
            'Amplitudes of effects are fitted to the other runs; which effects and where comes from all runs.',
            gap_bars(explanation),
        ),
        (
            'Missing resistance along the line',
            'Resistance to be added to the model to match the data, with ±2 std.',
            missing_along_line(explanation, line, found),
        ),
        (
            'Speed gap along the line',
            'Measured less simulated speed of each run. An effect at one place changes the slope of every run there: '
            'a drag slows the train in both directions, a wrong gradient in one direction only.',
            gap_along_line(explanation, line, found),
        ),
        (
            'Missing resistance by speed, mode and so on',
            'Each axis separately, with ±2 std; one effect may show on several axes.',
            missing_by_part(explanation),
        ),
        ('Single runs', _runs_caption(explanation), gap_of_runs(explanation)),
    )
    return captioned(figures)


def _runs_caption(explanation: Explanation) -> str:
    runs, band = len(explanation.traces), 'the band that contains 95 % of the gap of a correct model'
    return f'The only run, and {band}.' if runs == 1 else f'Of {runs} runs those with the largest gaps, and {band}.'


def _stretches(explanation: Explanation) -> Stretches:
    """Return start and end [m] of the effects that act on a section of the line."""
    found = []
    for effect in explanation.effects:
        values = dict(effect.parameters)
        if {'start', 'end'} <= values.keys() and unit_of(effect.name, 'start') == 'm':
            found.append((values['start'], values['end']))
    return tuple(found)


def _tables(explained: Explained) -> str:
    explanation = explained.explanation
    return _effects_table(explanation) + _davis_table(explained) + _noise_table(explanation)


def _effects_table(explanation: Explanation) -> str:
    rows = []
    for effect in explanation.effects:
        std = dict(effect.std)
        for k, (name, value) in enumerate(effect.parameters):
            first = (effect.name, f'{effect.evidence:.0f}') if k == 0 else ('', '')
            cells = (first[0], name, unit_of(effect.name, name) or '–')
            rows.append((*map(escape, cells), plus_minus(value, std.get(name, 0.0)), first[1]))
    if not rows:
        return ''
    caption = 'Effects added to the model; evidence is 2 ln of the Bayes factor'
    return html_table(caption, ('effect', 'parameter', 'unit', 'value ± std', 'evidence'), rows, text_columns=3)


def _davis_table(explained: Explained) -> str:
    rows = [(name, unit, old, new) for name, old, new, unit in davis_rows(explained.explanation, explained.train_file)]
    caption = 'Running resistance w(v) = a + b v + c v²'
    return html_table(caption, ('', 'unit', 'train file', 'estimate ± std'), rows, text_columns=2)


def _noise_table(explanation: Explanation) -> str:
    rows = [(name, unit, size) for name, size, unit in noise_rows(explanation)]
    return html_table('Noise and nuisances, estimated with the effects', ('', 'unit', 'value'), rows, text_columns=2)

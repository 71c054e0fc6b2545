# SPDX-License-Identifier: Apache-2.0
"""Estimates of a report as HTML tables and cards."""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.report.accuracy_scores import (
    final_truth,
    resistance_at,
    resistance_std,
    score_brake_rate,
    score_resistance,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.interface.results import Status
    from trainid_ros.report.accuracy_scores import AccuracyScore
    from trainid_ros.report.content import Chapter
    from trainid_ros.report.traces import Array

SPEEDS: Final = (10.0, 15.0, 20.0)
_DASH: Final = '–'
_PARAMETERS: Final = (('a', 'N/kN'), ('b', 'N/kN per m/s'), ('c', 'N/kN per (m/s)²'))


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, a dash if it is not finite."""
    return f'{value:.{digits}g}' if math.isfinite(value) else _DASH


def status_tag(status: Status) -> str:
    """Return a status as a coloured tag."""
    return f'<span class="tag {status.name}">{status.name}</span>'


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> str:
    """Return a table; cells of the rows are HTML, the first ``text_columns`` hold text."""
    heads = ''.join(f'<th{_text(i, text_columns)}>{escape(name)}</th>' for i, name in enumerate(head))
    lines = (''.join(f'<td{_text(i, text_columns)}>{cell}</td>' for i, cell in enumerate(row)) for row in rows)
    body = ''.join(f'<tr>{line}</tr>' for line in lines)
    table = f'<table><caption>{escape(caption)}</caption><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="wide">{table}</div>'


def _text(column: int, text_columns: int) -> str:
    return ' class="text"' if column < text_columns else ''


def cards(chapter: Chapter) -> str:
    """Return a summary of the estimates: resistance, brake rate, speed model."""
    return f'<div class="cards">{_resistance_card(chapter)}{_brake_card(chapter)}{_model_card(chapter)}</div>'


def _card(name: str, value: str, more: Sequence[str]) -> str:
    lines = ''.join(f'<div class="more">{line}</div>' for line in more)
    return f'<div class="card"><div class="name">{name}</div><div class="value">{value}</div>{lines}</div>'


def _resistance_card(chapter: Chapter) -> str:
    estimate, speed = chapter.resistance.estimate, _card_speed(chapter)
    w = resistance_at(np.array([estimate.a, estimate.b, estimate.c]), speed)
    std = resistance_std(np.array(estimate.covariance).reshape(3, 3), speed)
    value = f'{w:.2f} ± {std:.2f} <small>N/kN</small>'
    more = [f'{status_tag(chapter.resistance.status)} learned from {_range(chapter)}']
    if chapter.truth is not None:
        true = final_truth(chapter.traces, chapter.truth)[0]
        known = true.a + true.b * speed + true.c * speed**2
        more.append(f'truth {known:.2f}, error {float(w) - known:+.2f} N/kN')
    return _card(f'Running resistance at {speed:g} m/s ({3.6 * speed:.0f} km/h)', value, more)


def _card_speed(chapter: Chapter) -> float:
    """Return the speed [m/s] of the table nearest to the middle of the range learned from."""
    middle = 0.5 * sum(chapter.traces.resistance.speed_range)
    return min(SPEEDS, key=lambda speed: abs(speed - middle))


def _range(chapter: Chapter) -> str:
    low, high = chapter.traces.resistance.speed_range
    return f'{3.6 * low:.0f} to {3.6 * high:.0f} km/h' if high > low else 'nothing yet'


def _brake_card(chapter: Chapter) -> str:
    estimate = chapter.brake_rate.estimate
    more = [f'{status_tag(chapter.brake_rate.status)} 1 = nominal']
    rate = None if chapter.truth is None else final_truth(chapter.traces, chapter.truth)[1]
    if rate is not None:
        more.append(f'truth {rate:.3f}, error {estimate.brake_rate - rate:+.3f}')
    return _card('Brake rate', f'{estimate.brake_rate:.3f} ± {estimate.brake_rate_std:.3f}', more)


def _model_card(chapter: Chapter) -> str:
    estimate = chapter.speed_model.estimate
    nominal = 1.0 + chapter.train_file.train.rotary_mass
    more = [
        f'{status_tag(chapter.speed_model.status)} mass factor (train file {nominal:.3f})',
        f'a1 {number(estimate.a1)}, a2 {number(estimate.a2, 7)}, b1 {number(estimate.b1)}, d0 {number(estimate.d0)}',
    ]
    return _card('Speed model', number(estimate.mass_factor), more)


def estimates_table(chapter: Chapter) -> str:
    """Return parameters and resistances at the end, with standard deviation, prior, and truth if known."""
    basis = _basis(chapter)
    low, high = chapter.traces.resistance.speed_range
    rows = []
    for index, (name, unit) in enumerate(_PARAMETERS):
        rows.append(_row(name, unit, np.eye(3)[index], basis))
    for speed in SPEEDS:
        name = f'w at {speed:g} m/s ({3.6 * speed:.0f} km/h)'
        name += '' if low <= speed <= high else ' *'
        rows.append(_row(name, 'N/kN', np.array([1.0, speed, speed * speed]), basis))
    if (rate := _rate_row(chapter)) is not None:
        rows.append(rate)
    head = ['', 'unit', 'estimate', 'std', 'train file']
    if basis.truth is not None:
        head += ['truth', 'error', 'error / std']
    caption = 'Estimates at the end. * outside the speed range learned from.'
    return html_table(caption, head, rows, text_columns=2)


class _Basis(NamedTuple):
    """Parameters a, b, c at the end: estimate, covariance, train file, truth if known."""

    theta: Array
    P: Array
    before: Array
    truth: Array | None


def _basis(chapter: Chapter) -> _Basis:
    estimate, prior = chapter.resistance.estimate, chapter.train_file.resistance
    theta, P = np.array([estimate.a, estimate.b, estimate.c]), np.array(estimate.covariance).reshape(3, 3)
    before = np.array([prior.a, prior.b, prior.c])
    if chapter.truth is None:
        return _Basis(theta, P, before, None)
    true = final_truth(chapter.traces, chapter.truth)[0]
    return _Basis(theta, P, before, np.array([true.a, true.b, true.c]))


def _row(name: str, unit: str, phi: Array, basis: _Basis) -> list[str]:
    """Return the row of a linear combination ``phi`` of a, b, c."""
    value, std = float(phi @ basis.theta), math.sqrt(max(0.0, float(phi @ basis.P @ phi)))
    cells = [name, unit, number(value), number(std, 2), number(float(phi @ basis.before))]
    return cells if basis.truth is None else [*cells, *_against(value, std, float(phi @ basis.truth))]


def _against(value: float, std: float, true: float) -> list[str]:
    error = value - true
    return [number(true), f'{error:+.2g}', f'{error / std:+.1f}' if std > 0.0 else _DASH]


def _rate_row(chapter: Chapter) -> list[str] | None:
    estimate = chapter.brake_rate.estimate
    value, std = estimate.brake_rate, estimate.brake_rate_std
    cells = ['brake rate', '1 = nominal', number(value), number(std, 2), number(chapter.train_file.brake.rate)]
    if chapter.truth is None:
        return cells
    rate = final_truth(chapter.traces, chapter.truth)[1]
    return [*cells, *((_DASH,) * 3 if rate is None else _against(value, std, rate))]


def scores_table(chapter: Chapter) -> str:
    """Return errors against the truth and the coverage of the published standard deviation."""
    if chapter.truth is None:
        return ''
    scores: list[tuple[str, str, AccuracyScore | None]] = [
        ('w at the current speed', 'N/kN', score_resistance(chapter.traces, chapter.truth)),
        ('brake rate', '1', score_brake_rate(chapter.traces, chapter.truth)),
    ]
    rows = [
        (name, unit, number(s.rms, 3), f'{s.bias:+.2g}', f'{s.inside_68:.0%}', f'{s.inside_95:.0%}')
        for name, unit, s in scores
        if s is not None
    ]
    if not rows:
        return ''
    head = ('', 'unit', 'rms error', 'mean error', 'truth inside ±1 std', 'inside ±1.96 std')
    caption = 'Over the whole drive, while VALID or HOLDING; a consistent std gives 68 % and 95 %'
    return html_table(caption, head, rows, text_columns=2)


def rejections_table(chapter: Chapter) -> str:
    """Return the number of samples that each estimator used, and of those it rejected by reason."""
    names = [item.estimator for item in chapter.rejections]
    counts = [dict(item.counts) for item in chapter.rejections]
    reasons = sorted({reason for count in counts for reason in count})
    outputs = (chapter.resistance, chapter.speed_model, chapter.brake_rate)
    rows = [['used', *(f'{output.used}' for output in outputs)]]
    for reason in reasons:
        word = reason.name.lower().replace('_', ' ')
        rows.append([word, *(f'{count[reason]}' if reason in count else _DASH for count in counts)])
    return html_table('Samples used, and samples rejected by reason', ('', *names), rows)

# SPDX-License-Identifier: Apache-2.0
"""A train file in words, and as a page: running resistance, brake rate and line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from trainid_ros.interface.records import KM_H
from trainid_ros.interface.text import pluralise
from trainid_ros.report import page
from trainid_ros.report.words import each_parameter, on_runs
from trainid_ros.train.draft import doubts
from trainid_ros.train.forces import davis
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Effect, Pairs, TrainFile


def facts(train_file: TrainFile, assumed: Sequence[str]) -> list[tuple[str, str]]:
    """Return the content of a train file, a line of text for each part; it does not state the ``assumed`` fields."""
    train, brake, line, w = train_file.train, train_file.brake, train_file.line, train_file.resistance
    speeds = [share * train.max_speed for share in (0.25, 0.5, 1.0)]
    at = ', '.join(f'{davis(w, v):.2f} at {KM_H * v:.0f} km/h' for v in speeds)
    rates = sorted({brake.rate_at(v) for v in (*speeds, 0.0, *(v for v, _ in brake.rate_table))})
    cars = pluralise(train.cars, 'car')
    rows = [
        ('Train', f'{train.mass / 1e3:g} t, {train.length:g} m, {cars}, {KM_H * train.max_speed:.0f} km/h'),
        ('Resistance', f'{w.a:.4g} + {w.b:.4g} v + {w.c:.4g} v² N/kN, v in m/s: {at}'),
        ('Brake rate', f'{_range(rates)}; dead time {brake.delay:g} s, lag {brake.time_constant:g} s'),
    ]
    if train.consist:
        rows.insert(1, ('Cars', ', '.join(f'{mass / 1e3:g} t' for mass, _ in train.consist)))
    radii = [radius for _, radius in line.curve if radius]
    parts = (
        f'{len(line.stops)} stops over {(line.stops[-1] - line.stops[0]) / 1e3:.4g} km' if line.stops else '',
        f'gradients {_range([i for _, i in line.gradient])} per mille' if line.gradient else '',
        f'curves from {min(radii):g} m' if radii else '',
        pluralise(len(line.tunnel), 'tunnel') if line.tunnel else '',
        f'limits {_range([KM_H * v for _, v in line.speed_limit])} km/h' if line.speed_limit else '',
    )
    rows += [('Assumed', f'{", ".join(assumed)}: not in the file')] if assumed else []
    rows += [('Line', '; '.join(filter(None, parts)) or 'none')]
    rows += [('Effect', _effect(effect)) for effect in train_file.effects]
    return [*rows, *(('Check', doubt) for doubt in doubts(train_file))]


def _effect(effect: Effect) -> str:
    known = [*each_parameter(effect), *on_runs(effect)]
    return f'{effect.name}: {", ".join(known)}' if known else effect.name


def _range(values: list[float]) -> str:
    low, high = min(values), max(values)
    return f'{low:.4g}' if low == high else f'{low:.4g} to {high:.4g}'


def train_page(train_file: TrainFile, assumed: Sequence[str], name: str) -> str:
    """Return the page of a train file as HTML text; it does not state the ``assumed`` fields."""
    figures = [('Running resistance and brake rate', 'Over speed.', _over_speed(train_file))]
    if train_file.line.gradient or train_file.line.curve or train_file.line.speed_limit:
        caption = 'Grey: tunnels; ticks: stops. Black: mean gradient under the train, by the position of its front.'
        figures.append(('Line', caption, _line(train_file)))
    body = f'{page.facts(facts(train_file, assumed))}{page.captioned(figures)}'
    return page.page(name, body, 'Made by trainid train show.')


def _over_speed(train_file: TrainFile) -> Markup:
    speed = np.linspace(0.0, train_file.train.max_speed, 200)
    with page.styled_figure(3.2) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(KM_H * speed, davis(train_file.resistance, speed), color=page.ESTIMATE)
        right.plot(KM_H * speed, [train_file.brake.rate_at(v) for v in speed.tolist()], color=page.BRAKE)
        for axes, label in ((left, 'running resistance [N/kN]'), (right, 'brake rate [1]')):
            axes.set(xlabel='speed [km/h]', ylabel=label, ylim=(0.0, None))
        return page.to_svg(figure, 'Running resistance and brake rate over speed')


def _line(train_file: TrainFile) -> Markup:
    line, profile = train_file.line, profile_of(train_file)
    known = [*line.stops, *(x for rows in (line.gradient, line.curve, line.speed_limit, line.tunnel) for x, _ in rows)]
    low, high = min(known), max(*known, min(known) + profile.length)
    place = np.linspace(low, high, 1500)
    panels = (
        ('gradient [per mille]', line.gradient, page.ESTIMATE),
        ('curvature [1/km]', tuple((x, 1e3 / r if r else 0.0) for x, r in line.curve), page.SECOND),
        ('speed limit [km/h]', tuple((x, KM_H * v) for x, v in line.speed_limit), page.BRAKE),
    )
    shown = [panel for panel in panels if panel[1]]
    with page.styled_figure(1.0 + 1.6 * len(shown)) as figure:
        for axes, (label, rows, colour) in zip(page.column_of_axes(figure, len(shown)), shown, strict=True):
            ends: Pairs = ((low, rows[0][1]), *rows, (high, rows[-1][1]))
            axes.step([x / 1e3 for x, _ in ends], [y for _, y in ends], where='post', color=colour)
            if rows is line.gradient:
                felt = [profile.gradient(x, 1) for x in place.tolist()]
                axes.plot(place / 1e3, felt, color=page.INK, linewidth=0.9)
            for start, end in line.tunnel:
                axes.axvspan(start / 1e3, end / 1e3, color=page.STAND, alpha=0.3, linewidth=0)
            axes.plot([x / 1e3 for x in line.stops], [0.0] * len(line.stops), '|', color=page.INK,
                      transform=axes.get_xaxis_transform(), clip_on=False)  # fmt: skip
            axes.set_ylabel(label)
        axes.set(xlabel='position [km]', xlim=(low / 1e3, high / 1e3))
        return page.to_svg(figure, 'Gradient, curvature and speed limit along the line')

# SPDX-License-Identifier: Apache-2.0
"""Report of drives: for each a chapter of estimates, figures and, if the truth is known, errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from trainid_ros.client import TrainModel
from trainid_ros.interface.files import write_text
from trainid_ros.interface.records import KM_H, NS_PER_S
from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    Output,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
)
from trainid_ros.interface.text import in_step, pluralise, plus_minus
from trainid_ros.monitor.trains import resistance_at as estimated_resistance
from trainid_ros.report import page
from trainid_ros.report.page import render
from trainid_ros.report.recording import (
    BRAKING,
    COASTING,
    PULLING,
    STANDSTILL,
    Array,
    Panel,
    Recording,
    Series,
    Span,
    Track,
    input_panels,
)
from trainid_ros.report.verdict import EstimateRow, Verdict, estimate_rows, middle_speed, speed_text
from trainid_ros.report.words import DASH, DAVIS_UNITS, number
from trainid_ros.sim.truth import Truth
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis, TrainFile


@dataclass(frozen=True, slots=True)
class Chapter:
    """One drive in a report."""

    title: str  # Heading
    bag: str  # Name of the bag
    train_file_name: str  # Name of the train file
    train_file: TrainFile  # The train file, whose values are the priors
    how: str  # How the estimators were run, as text
    recording: Recording  # Columns to plot
    resistance: Output[ResistanceEstimate]  # Last output of the resistance estimator
    speed_model: Output[SpeedModelEstimate]  # Last output of AM-VFF-RLS
    brake_rate: Output[BrakeRateEstimate]  # Last output of GSMA
    rejections: Mapping[str, Mapping[Reason, int]]  # Numbers of rejected records and samples by name of the estimator
    truth: Truth | None = None  # True parameters, None if unknown
    notes: tuple[str, ...] = ()  # Further sentences, such as the outcome of a comparison
    others: tuple[tuple[str, Track], ...] = ()  # Resistance by other algorithms, by name
    adhesion: Output[AdhesionEstimate] | None = None  # Last output of the adhesion
    verdict: Verdict | None = None  # Whether the drive can be used, None if that was not judged
    certainty: tuple[str, ...] = ()  # Whether the stated uncertainty is right, and what was seen, as sentences

    def final_truth(self) -> tuple[Davis | None, float | None]:
        """Return the true resistance and brake rate [1] at the end, None where unknown."""
        if self.truth is None:
            return None, None
        recording = self.recording
        point = self.truth.truth_at_ns(recording.start_ns + round(recording.duration_s * NS_PER_S))
        return point.resistance, point.brake_rate


@dataclass(frozen=True, slots=True)
class AccuracyScore:
    """Errors over all usable outputs (VALID or HOLDING), in the unit of the quantity."""

    outputs: int  # Number of outputs compared
    bias: float  # Mean error, estimate less truth
    rms: float  # Root mean square error
    last: float  # Error of the last output
    inside_68: float  # Share of errors within one published standard deviation [1]
    inside_95: float  # Share of errors within 1.96 standard deviations [1]


def resistance_std(covariance: Array, speed: float | Array) -> Array:
    """Return the standard deviation of w [N/kN] at a speed [m/s] for covariances of a, b, c, shape (..., 3, 3)."""
    return _std(_phi(speed), covariance)


def _phi(speed: float | Array) -> Array:
    """Return the factors of a, b, c in w at a speed [m/s], shape (..., 3)."""
    v = np.asarray(speed, dtype=np.float64)
    return np.stack([np.ones_like(v), v, v * v], axis=-1)


def _std(phi: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(0.0, np.einsum('...i,...ij,...j->...', phi, covariance, phi))))


def resistance_at(theta: Array, speed: float | Array) -> Array:
    """Return w = a + b v + c v^2 [N/kN] at a speed [m/s] for parameters of shape (..., 3)."""
    return np.asarray(theta[..., 0] + speed * (theta[..., 1] + speed * theta[..., 2]))


def true_values(truth: Truth, recording: Recording, track: Track) -> tuple[Array, Array]:
    """Return the true a, b, c [N/kN, v in m/s], shape (n, 3), and brake rate [1], NaN if unknown, along a track."""
    points = [truth.truth_at_ns(recording.start_ns + round(time_s * NS_PER_S)) for time_s in track.time_s]
    theta = np.array([_theta(point.resistance) for point in points]).reshape(-1, 3)
    return theta, np.array([point.brake_rate for point in points], dtype=np.float64)


def score_resistance(recording: Recording, truth: Truth) -> AccuracyScore | None:
    """Score w [N/kN] at the current speed, None if no output was usable."""
    track = recording.resistance
    speed = track.column('speed')
    w = resistance_at(track.theta, speed)
    true = resistance_at(true_values(truth, recording, track)[0], speed)
    return _score(w - true, resistance_std(track.covariance, speed), track.usable)


def score_brake_rate(recording: Recording, truth: Truth) -> AccuracyScore | None:
    """Score the brake rate [1], None if the truth is unknown or no output was usable."""
    track = recording.brake_rate
    error = track.column('brake_rate') - true_values(truth, recording, track)[1]
    return _score(error, track.column('brake_rate_std'), track.usable)


STOP_COMMAND: Final = -0.8
"""Brake command to the stops that are compared [m/s^2], one of service."""
_VALUES: Final = {'train file': page.MUTED, 'brake rate of the last stop': page.BRAKE, 'live values': page.ESTIMATE}


def stop_errors(recording: Recording, truth: Truth | None, train_file: TrainFile) -> tuple[Array, dict[str, Array]]:
    """Return when brakings to stops begin [s], and by values how far beyond the stop the train would come to rest [m].

    One command, given where the values say, is never corrected. Values that are not usable are those of the train file.
    Without a true brake rate there is no stop.
    """
    rows, modes, stated = list[tuple[float, ...]](), recording.modes, (train_file.resistance, train_file.brake.rate)
    before, (time_ns, speed, _) = stated[1], recording.drive()
    for braking, rest in pairwise(modes):
        if truth is None or not truth.brake_rate or (braking.label, rest.label) != (BRAKING, STANDSTILL):
            continue
        v = float(np.interp(NS_PER_S * braking.start_s, time_ns, speed))
        true = truth.truth_at_ns(recording.start_ns + round(NS_PER_S * braking.start_s))
        w, f = (_usable(track, braking.start_s) for track in (recording.resistance, recording.brake_rate))
        live = Davis(w.a, w.b, w.c) if w else stated[0], f.brake_rate if f else stated[1]
        actual = _distance(train_file, true.resistance, true.brake_rate or stated[1], v)
        values = stated, (stated[0], before), live
        rows.append((braking.start_s, *(actual - _distance(train_file, *known, v) for known in values)))
        before = true.brake_rate or stated[1]
    time_s, *errors = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return time_s, dict(zip(_VALUES, errors, strict=True))


def _usable(track: Track, time_s: float) -> Any:
    """Return the newest estimate before a time [s] if it is usable, else None."""
    at = int(np.searchsorted(track.time_s, time_s)) - 1
    return track.estimates[at] if at >= 0 and track.usable[at] else None


def _distance(train_file: TrainFile, resistance: Davis, rate: float, speed: float) -> float:
    known = replace(train_file, resistance=resistance, brake=replace(train_file.brake, rate=rate))
    return TrainModel(None, known).stopping_distance(speed, command=STOP_COMMAND, confidence=0.5).value


def stop_sentences(errors: dict[str, Array]) -> tuple[str, ...]:
    """Return how far off the stops are on average; nothing without a stop."""
    sizes = ', '.join(f'{np.abs(each).mean():.1f} m by {name}' for name, each in errors.items() if each.size)
    return (f'stops by one brake command, never corrected, are off on average: {sizes}',) if sizes else ()


def _score(error: Array, std: Array, usable: NDArray[np.bool_]) -> AccuracyScore | None:
    kept = usable & np.isfinite(error) & np.isfinite(std)
    if not kept.any():
        return None
    error, std = error[kept], std[kept]
    return AccuracyScore(
        outputs=len(error),
        bias=float(error.mean()),
        rms=float(np.sqrt(np.mean(np.square(error)))),
        last=float(error[-1]),
        inside_68=float(np.mean(np.abs(error) <= std)),
        inside_95=float(np.mean(np.abs(error) <= page.SIGMA_95 * std)),
    )


MODES: Final = {PULLING: page.TRACTION, COASTING: page.COAST, BRAKING: page.BRAKE, STANDSTILL: page.STAND}
STATUSES: Final = {
    'UNINITIALIZED': page.STAND,
    'CONVERGING': page.WAIT,
    'VALID': page.GOOD,
    'HOLDING': page.COAST,
    'STALE': page.BRAKE,
    'FAULT': page.BAD,
}


def write_report(title: str, chapters: Sequence[Chapter], path: str | Path) -> None:
    """Write a report and create missing folders; InputError if it cannot be written."""
    write_text(render_report(title, chapters), path)


def render_report(title: str, chapters: Sequence[Chapter]) -> str:
    """Return a report as HTML text."""
    return render('drive.html.j2', title, chapters=[(chapter, _content(chapter)) for chapter in chapters])


def _content(chapter: Chapter) -> dict[str, object]:
    """Return what is shown of a chapter besides its own fields, figures by the names of their functions."""
    figures = (
        resistance_over_time, resistance_curve, brake_rate_over_time, adhesion_over_time, speed_profile,
        status_timeline, innovation_ratios, speed_model_over_time, stops,
    )  # fmt: skip
    train, recording = chapter.train_file.train, chapter.recording
    start = datetime.fromtimestamp(recording.start_ns / NS_PER_S, UTC)
    return {
        'facts': (
            ('Bag', chapter.bag),
            ('Train file', chapter.train_file_name),
            ('Train', f'{number(train.mass / 1000.0, 3)} t, {train.length:.0f} m, {pluralise(train.cars, "car")}'),
            ('Duration', f'{recording.duration_s / 60.0:.1f} min from {start:%Y-%m-%d %H:%M:%S} UTC'),
            ('Run', chapter.how),
        ),
        'cards': _cards(chapter),
        'estimates': _estimates(chapter),
        'scores': _scores(chapter),
        'rejections': _rejections(chapter),
        **{figure.__name__: figure(chapter) for figure in figures},
    }


def _cards(chapter: Chapter) -> list[dict[str, object]]:
    """Return the last estimate of each estimator: value with its unit, status with a remark, and further lines."""
    w, f, m = chapter.resistance.estimate, chapter.brake_rate.estimate, chapter.speed_model.estimate
    true, true_rate = chapter.final_truth()
    low, high = chapter.recording.resistance.speed_range
    speed = middle_speed(w)
    value, std = estimated_resistance(w, speed)
    learned = f'{KM_H * low:.0f} to {KM_H * high:.0f} km/h' if high > low else 'nothing yet'
    error = math.nan if true is None else value - davis(true, speed)
    cards = (
        (
            f'Running resistance at {speed_text(speed)}', plus_minus(value, std), 'N/kN',
            chapter.resistance, f'learned from {learned}',
            '' if true is None else f'truth {davis(true, speed):.2f}, error {error:+.2f} N/kN',
        ),
        (
            'Brake rate', plus_minus(f.brake_rate, f.brake_rate_std), '', chapter.brake_rate, '1 = nominal',
            '' if true_rate is None else f'truth {true_rate:.3f}, error {f.brake_rate - true_rate:+.3f}',
        ),
        (
            'Speed model', number(m.mass_factor), '', chapter.speed_model,
            f'mass factor (train file {1.0 + chapter.train_file.train.rotary_mass:.3f})',
            f'a1 {number(m.a1)}, a2 {number(m.a2, 7)}, b1 {number(m.b1)}, d0 {number(m.d0)}',
        ),
    )  # fmt: skip
    names = ('name', 'value', 'unit', 'output', 'remark', 'more')
    return [dict(zip(names, card, strict=True)) | {'usable': card[3].status.is_usable} for card in cards]


def _estimates(chapter: Chapter) -> list[list[str]]:
    """Return parameters and resistances at the end, with standard deviation, prior, and truth if known."""
    true, true_braking = chapter.final_truth()
    priors = {'brake rate': chapter.train_file.brake.rate, 'force scale': 1.0, 'force delay': 0.0}
    rows = []
    for row in estimate_rows(chapter.resistance, chapter.brake_rate, chapter.adhesion):
        prior, known = priors.get(row.name, math.nan), true_braking if row.name == 'brake rate' else None
        if row.factors is not None:
            phi = np.array(row.factors)
            prior = float(phi @ _theta(chapter.train_file.resistance))
            known = None if true is None else float(phi @ _theta(true))
        rows.append(_row(row, prior, known)[: 5 if chapter.truth is None else None])
    return rows


def _theta(davis: Davis | ResistanceEstimate) -> Array:
    return np.array([davis.a, davis.b, davis.c])


def _row(row: EstimateRow, prior: float, true: float | None) -> list[str]:
    cells = [row.name, row.unit.replace('^2', '²'), *in_step(row.value, row.std), number(prior)]
    if true is None:
        return [*cells, DASH, DASH, DASH]
    error = row.value - true
    return [*cells, number(true), f'{error:+.2g}', f'{error / row.std:+.1f}' if row.std > 0.0 else DASH]


def _scores(chapter: Chapter) -> list[tuple[str, ...]]:
    if chapter.truth is None:
        return []
    scores = (
        ('w at the current speed', 'N/kN', score_resistance(chapter.recording, chapter.truth)),
        ('brake rate', '1', score_brake_rate(chapter.recording, chapter.truth)),
    )
    return [
        (name, unit, number(s.rms, 3), f'{s.bias:+.2g}', f'{s.inside_68:.0%}', f'{s.inside_95:.0%}')
        for name, unit, s in scores
        if s is not None
    ]


def _rejections(chapter: Chapter) -> list[list[str]]:
    counts = chapter.rejections.values()
    outputs = (chapter.resistance, chapter.speed_model, chapter.brake_rate)
    reasons = sorted({reason for count in counts for reason in count})
    rows = [['used', *(f'{output.used}' for output in outputs)]]
    rows += [[item.text, *(f'{count[item]}' if item in count else DASH for count in counts)] for item in reasons]
    return rows


def shown_speeds(chapter: Chapter) -> tuple[float, ...]:
    """Return a low, a middle and a high speed [m/s] of the range learned from."""
    low, high = chapter.recording.resistance.speed_range
    if high <= low:
        low, high = 0.0, chapter.train_file.train.max_speed
    return tuple(float(round(low + share * (high - low))) for share in (0.15, 0.5, 0.9))


def _handles(*, has_truth: bool) -> list[Artist]:
    truth = [page.TRUTH_LINE] if has_truth else []
    return [page.ESTIMATE_LINE, page.BAND_68, page.BAND_95, *truth, page.PRIOR_LINE]


def resistance_over_time(chapter: Chapter) -> str:
    """Plot w at three speeds, and a, b, c, over time."""
    if not chapter.recording.resistance.estimates:
        return ''
    with page.styled_figure(6.6) as figure:
        panels = figure.subplots(3, 2, sharex=True)
        _, *_, shades = (_shade(axes, chapter, chapter.recording.resistance) for axes in panels.flat)
        for axes, speed in zip(panels[:, 0], shown_speeds(chapter), strict=True):
            page.draw_panel(axes, _linear_panel(chapter, _phi(speed), f'w at {speed_text(speed)}', 'w [N/kN]'))
        for axes, phi, name, unit in zip(panels[:, 1], np.eye(3), 'abc', DAVIS_UNITS, strict=True):
            page.draw_panel(axes, _linear_panel(chapter, phi, f'Davis {name}', f'{name} [{unit}]'))
        for axes in panels[-1]:
            page.time_axis(axes, chapter.recording.duration_s)
        page.legend_above(figure, [*_handles(has_truth=chapter.truth is not None), *shades])
        return page.to_svg(figure, 'Running resistance and Davis parameters over time')


def _linear_panel(chapter: Chapter, phi: Array, title: str, label: str) -> Panel:
    """Return the panel of a linear combination ``phi`` of a, b, c."""
    track = _picked(chapter.recording.resistance)
    prior, truth = float(phi @ _theta(chapter.train_file.resistance)), _true_w(chapter, track, phi)
    std = _std(phi, track.covariance)
    return Panel(title, label, track.time_ns, track.theta @ phi, std, track.usable, prior, truth)


def _panel(track: Track, name: str, title: str, label: str) -> Panel:
    """Return the panel of a field of an estimate that has a standard deviation."""
    return Panel(title, label, track.time_ns, track.column(name), track.column(f'{name}_std'), track.usable)


def _picked(track: Track) -> Track:
    return track[page.pick(len(track.estimates))]


def _true_w(chapter: Chapter, track: Track, phi: Array) -> Array | None:
    """Return the true linear combination ``phi`` of a, b, c over time, None if it is unknown."""
    return None if chapter.truth is None else true_values(chapter.truth, chapter.recording, track)[0] @ phi


def resistance_curve(chapter: Chapter) -> str:
    """Plot w(v) at the end with its band, prior, truth, other algorithms, and the driving time at each speed."""
    if not chapter.recording.resistance.estimates:
        return ''
    with page.styled_figure(4.6) as figure:
        curve, driven = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        speed = chapter.recording.drive()[1]
        fastest = float(speed.max()) if len(speed) else 0.0
        top = 1.05 * max(fastest, chapter.recording.resistance.speed_range[1], 1.0)
        speeds = np.linspace(0.0, top, 80)
        _draw_curve(curve, speeds, chapter.recording.resistance, page.ESTIMATE)
        others = [(name, track) for name, track in chapter.others if track.estimates]
        for _, track in others:
            _draw_curve(curve, speeds, track, page.BRAKE)
        prior = davis(chapter.train_file.resistance, speeds)
        curve.plot(KM_H * speeds, prior, color=page.MUTED, linestyle=page.PRIOR_DASHES, linewidth=1.4)
        if (true := chapter.final_truth()[0]) is not None:
            curve.plot(KM_H * speeds, davis(true, speeds), color=page.INK, linestyle=page.DASHES, linewidth=1.2)
        title = 'Running resistance w(v) at the end; band over the speeds learned from'
        curve.set(ylim=(0.0, None), ylabel='w [N/kN]', title=title)
        moving = speed[speed > 0.5]
        minutes_each = chapter.recording.duration_s / max(len(speed), 1) / 60.0
        driven.hist(KM_H * moving, bins=40, weights=np.full(len(moving), minutes_each), color=page.STAND)
        driven.set(ylabel='driven [min]', xlabel='speed [km/h]', xlim=(0.0, KM_H * top))
        lines = [Line2D([], [], color=page.BRAKE, label=name) for name, _ in others]
        page.legend_above(figure, [*lines, *_handles(has_truth=chapter.truth is not None)])
        return page.to_svg(figure, 'Resistance curve against speed')


def _draw_curve(axes: Axes, speeds: Array, track: Track, colour: str) -> None:
    """Draw w(v) of the last estimate, with its band over the speeds learned from."""
    low, high = track.speed_range
    seen = (speeds >= low) & (speeds <= high) if high > low else np.ones_like(speeds, dtype=bool)
    w, std = resistance_at(track[-1:].theta[0], speeds), resistance_std(track[-1:].covariance[0], speeds)
    page.draw_band(axes, KM_H * speeds[seen], w[seen], std[seen], colour)
    axes.plot(KM_H * speeds, w, color=colour, linewidth=0.8, alpha=0.6)


def brake_rate_over_time(chapter: Chapter) -> str:
    """Plot the brake rate over time, shaded where it is observable."""
    recording = chapter.recording
    track = _picked(recording.brake_rate)
    if not track.estimates:
        return ''
    truth = chapter.truth
    true = true_values(truth, recording, track)[1] if truth is not None and truth.brake_rate else None
    panel = _panel(track, 'brake_rate', 'Brake rate', 'brake rate (1 = nominal)')
    panel = panel._replace(prior=chapter.train_file.brake.rate, truth=true)
    with page.styled_figure(3.4) as figure:
        axes = figure.subplots()
        page.draw_spans(axes, recording.observable, {'observable': page.SECOND}, alpha=0.2)
        shades = _shade(axes, chapter, recording.brake_rate)
        page.draw_panel(axes, panel)
        page.time_axis(axes, recording.duration_s)
        shade = Patch(color=page.SECOND, alpha=0.2, linewidth=0, label='braking, observable')
        page.legend_above(figure, [*_handles(has_truth=true is not None), shade, *shades])
        return page.to_svg(figure, 'Brake rate over time')


def _shade(axes: Axes, chapter: Chapter, track: Track) -> list[Patch]:
    return page.draw_faults(axes, track.faults, chapter.recording.duration_s)


def adhesion_over_time(chapter: Chapter) -> str:
    """Plot adhesion and used force over time if the measured axle slipped or slid, shaded where it did; else ''."""
    recording = chapter.recording
    whole = recording.adhesion
    slipping = whole.column('slipping') > 0.0
    if not slipping.any():
        return ''
    track = _picked(whole)
    edges = np.flatnonzero(np.diff(slipping, prepend=False, append=False)).reshape(-1, 2)
    time_s = np.append(whole.time_s, recording.duration_s)
    slips = [Span(float(time_s[begin]), float(time_s[end]), 'slip') for begin, end in edges]
    with page.styled_figure(3.0) as figure:
        axes = figure.subplots()
        shades = page.draw_faults(axes, slips, recording.duration_s)
        page.draw_panel(axes, _panel(track, 'adhesion', 'Adhesion', 'share of the weight'))
        axes.plot(track.time_s / 60.0, np.abs(track.column('used')), color=page.MUTED, linewidth=0.8)
        axes.set_ylim(bottom=0.0)
        page.time_axis(axes, recording.duration_s)
        used = Line2D([], [], color=page.MUTED, label='used')
        page.legend_above(figure, [page.ESTIMATE_LINE, page.BAND_68, page.BAND_95, used, *shades])
        return page.to_svg(figure, 'Adhesion over time')


def speed_profile(chapter: Chapter) -> str:
    """Plot speed and gradient over time with the driving modes shaded."""
    recording, panels = chapter.recording, input_panels(chapter.recording)
    time_ns, speed, gradient = recording.drive()
    if not len(time_ns):
        return ''
    kept = page.pick(len(time_ns) // 2)
    with page.styled_figure(3.8) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        page.draw_spans(above, recording.modes, MODES, alpha=0.45)
        shades = _shade(below, chapter, recording.resistance)
        driven = Panel('Speed and driving modes', panels['speed'].label, time_ns[kept], KM_H * speed[kept])
        page.draw_panel(above, driven, page.INK, 0.9)
        above.set_ylim(bottom=0.0)
        page.draw_panel(below, Panel('', panels['gradient'].label, time_ns[kept], gradient[kept]), page.MUTED, 0.9)
        page.time_axis(below, recording.duration_s)
        modes = [Patch(color=colour, alpha=0.45, label=name) for name, colour in MODES.items()]
        page.legend_above(figure, [*modes, *shades])
        return page.to_svg(figure, 'Speed profile with driving modes')


def innovation_ratios(chapter: Chapter) -> str:
    """Plot the innovation test ratios of resistance and brake rate on a logarithmic scale with their gate."""
    recording = chapter.recording
    both = (('Resistance', recording.resistance.ratios), ('Brake rate', recording.brake_rate.ratios))
    rows = [(name, series) for name, series in both if len(series.values)]
    if not rows:
        return ''
    with page.styled_figure(0.6 + 1.7 * len(rows)) as figure:
        panels = page.column_of_axes(figure, len(rows))
        for axes, (name, series) in zip(panels, rows, strict=True):
            _draw_ratios(axes, series)
            axes.set_title(name)
        page.time_axis(panels[-1], recording.duration_s)
        return page.to_svg(figure, 'Innovation test ratios over time')


def _draw_ratios(axes: Axes, ratios: Series) -> None:
    # At most 900 bins keep their greatest ratio, so no rejected innovation is lost by thinning.
    ratio = ratios.values[:, 0]
    step = max(1, -(-len(ratio) // 900))
    starts = np.arange(0, len(ratio), step)
    greatest = np.maximum(np.maximum.reduceat(ratio, starts), 1e-4)
    time_min = ratios.time_s[starts] / 60.0
    rejected = greatest > 1.0
    axes.plot(time_min[~rejected], greatest[~rejected], '.', color=page.ESTIMATE, markersize=2.2)
    axes.plot(time_min[rejected], greatest[rejected], 'x', color=page.BAD, markersize=4.0)
    axes.axhline(1.0, color=page.BAD, linewidth=1.0)
    axes.set(yscale='log', ylim=(1e-4, max(3.0, 2.0 * float(greatest.max()))), ylabel='test ratio')


def stops(chapter: Chapter) -> str:
    """Plot a dot for each stop by one command, and values; '' without a stop."""
    time_s, errors = stop_errors(chapter.recording, chapter.truth, chapter.train_file)
    if not time_s.size:
        return ''
    with page.styled_figure(3.0) as figure:
        axes = figure.subplots()
        handles = [
            axes.plot(time_s / 60.0, each, 'o', color=_VALUES[name], label=name)[0] for name, each in errors.items()
        ]
        axes.set(title='Stops', ylabel='beyond the stop [m]')
        page.time_axis(axes, chapter.recording.duration_s)
        page.legend_above(figure, handles)
        return page.to_svg(figure, 'Errors of stops by one brake command')


def speed_model_over_time(chapter: Chapter) -> str:
    """Plot the speed model in physical terms: w at the middle speed and the mass factor."""
    track, speed = _picked(chapter.recording.speed_model), shown_speeds(chapter)[1]
    if not track.estimates:
        return ''
    title, value = f'Speed model: w at {speed_text(speed)}', resistance_at(track.theta, speed)
    prior, truth = davis(chapter.train_file.resistance, speed), _true_w(chapter, track, _phi(speed))
    w = Panel(title, 'w [N/kN]', track.time_ns, value, prior=prior, truth=truth)
    title, value = 'Speed model: mass factor (M / nominal M)(1 + γ)', track.column('mass_factor')
    mass = Panel(title, '', track.time_ns, value, prior=1.0 + chapter.train_file.train.rotary_mass)
    with page.styled_figure(2.8) as figure:
        for axes, panel in zip(figure.subplots(1, 2, sharex=True), (w, mass), strict=True):
            page.draw_panel(axes, panel, page.SECOND)
            page.time_axis(axes, chapter.recording.duration_s)
        return page.to_svg(figure, 'Speed model over time')


def status_timeline(chapter: Chapter) -> str:
    """Plot the status of the three estimators over time."""
    recording = chapter.recording
    tracks = (recording.resistance, recording.speed_model, recording.brake_rate)
    used = {span.label for track in tracks for span in track.statuses}
    if not used:
        return ''
    with page.styled_figure(2.1) as figure:
        axes = figure.subplots()
        for height, track in zip((2, 1, 0), tracks, strict=True):
            page.draw_spans(axes, track.statuses, STATUSES, lane=(height - 0.36, 0.72))
        axes.set_yticks([2, 1, 0], ['resistance', 'speed model', 'brake rate'])
        axes.grid(visible=False, axis='y')
        axes.set_title('Status')
        page.time_axis(axes, recording.duration_s)
        patches = [Patch(color=colour, label=name) for name, colour in STATUSES.items() if name in used]
        page.legend_above(figure, patches)
        return page.to_svg(figure, 'Status of the estimators over time')

# SPDX-License-Identifier: Apache-2.0
"""Figures of a report; each function returns an SVG element, or an empty string without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.patches import Patch

from trainid_ros.report.accuracy_scores import SIGMA_95, resistance_at, resistance_std, true_rate, true_theta
from trainid_ros.report.style import (
    BAD,
    BAND_68,
    BAND_95,
    BRAKE,
    COAST,
    ESTIMATE,
    ESTIMATE_LINE,
    GOOD,
    INK,
    MUTED,
    PRIOR_LINE,
    SECOND,
    STAND,
    TRACTION,
    TRUTH_LINE,
    WAIT,
    draw_band,
    draw_prior,
    draw_spans,
    draw_steps,
    legend_above,
    limit,
    minutes,
    pick,
    styled_figure,
    time_axis,
    to_svg,
)
from trainid_ros.report.traces import BRAKING, COASTING, PULLING, STANDSTILL
from trainid_ros.train.forces import davis

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from trainid_ros.report.content import Chapter
    from trainid_ros.report.traces import Array, Span

MODES: Final = {PULLING: TRACTION, COASTING: COAST, BRAKING: BRAKE, STANDSTILL: STAND}
STATUSES: Final = {
    'UNINITIALIZED': STAND,
    'CONVERGING': WAIT,
    'VALID': GOOD,
    'HOLDING': COAST,
    'STALE': BRAKE,
    'FAULT': BAD,
}
_KMH: Final = 3.6
_CURVE_POINTS: Final = 80
_PARAMETERS: Final = ('a [N/kN]', 'b [N/kN per m/s]', 'c [N/kN per (m/s)²]')


def shown_speeds(chapter: Chapter) -> tuple[float, ...]:
    """Return a low, a middle and a high speed [m/s] of the range learned from."""
    low, high = chapter.traces.resistance.speed_range
    if high <= low:
        low, high = 0.0, chapter.train_file.train.max_speed
    return tuple(float(round(low + share * (high - low))) for share in (0.15, 0.5, 0.9))


def _handles(chapter: Chapter) -> list[Artist]:
    truth = [TRUTH_LINE] if chapter.truth is not None else []
    return [ESTIMATE_LINE, BAND_68, BAND_95, *truth, PRIOR_LINE]


def _settled(values: Array, std: Array, usable: NDArray[np.bool_]) -> list[Array]:
    """Return the values that the axis must show: the band where the estimate is usable, otherwise the estimate."""
    if usable.any():
        return [(values - SIGMA_95 * std)[usable], (values + SIGMA_95 * std)[usable]]
    return [values]


def resistance_over_time(chapter: Chapter) -> str:
    """Plot w at three speeds, and a, b, c, over time."""
    if not len(chapter.traces.resistance.time_s):
        return ''
    with styled_figure(6.6) as figure:
        panels = figure.subplots(3, 2, sharex=True)
        for axes, speed in zip(panels[:, 0], shown_speeds(chapter), strict=True):
            _draw_resistance(axes, chapter, speed)
        for index, axes in enumerate(panels[:, 1]):
            _draw_parameter(axes, chapter, index)
        for axes in panels[-1]:
            time_axis(axes, chapter.traces.duration_s)
        legend_above(figure, _handles(chapter))
        return to_svg(figure, 'Running resistance and Davis parameters over time')


def _draw_resistance(axes: Axes, chapter: Chapter, speed: float) -> None:
    _draw_quantity(axes, chapter, np.array([1.0, speed, speed * speed]))
    axes.set_title(f'w at {speed:g} m/s ({speed * _KMH:.0f} km/h)')
    axes.set_ylabel('w [N/kN]')


def _draw_parameter(axes: Axes, chapter: Chapter, index: int) -> None:
    _draw_quantity(axes, chapter, np.eye(3)[index])
    axes.set_title(f'Davis {_PARAMETERS[index][0]}')
    axes.set_ylabel(_PARAMETERS[index])


def _draw_quantity(axes: Axes, chapter: Chapter, phi: Array) -> None:
    """Draw a linear combination ``phi`` of a, b, c with its band, truth and prior."""
    trace = chapter.traces.resistance
    kept = pick(len(trace.time_s))
    time_s, value = trace.time_s[kept], trace.theta[kept] @ phi
    std = np.sqrt(np.maximum(0.0, np.einsum('i,nij,j->n', phi, trace.covariance[kept], phi)))
    prior = chapter.train_file.resistance
    before = float(phi @ np.array([prior.a, prior.b, prior.c]))
    draw_band(axes, minutes(time_s), value, std)
    draw_prior(axes, before)
    shown = [*_settled(value, std, trace.usable[kept]), np.array([before])]
    if chapter.truth is not None:
        true = true_theta(chapter.truth, chapter.traces.start_ns, time_s) @ phi
        draw_steps(axes, minutes(time_s), true)
        shown.append(true)
    limit(axes, shown)


def resistance_curve(chapter: Chapter) -> str:
    """Plot w(v) at the end with its band, the prior, the truth, and the driving time at each speed."""
    trace = chapter.traces.resistance
    if not len(trace.time_s):
        return ''
    with styled_figure(4.6) as figure:
        curve, driven = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
        speeds = np.linspace(0.0, _top_speed(chapter), _CURVE_POINTS)
        low, high = trace.speed_range
        seen = (speeds >= low) & (speeds <= high) if high > low else np.ones_like(speeds, dtype=bool)
        w, std = resistance_at(trace.theta[-1], speeds), resistance_std(trace.covariance[-1], speeds)
        draw_band(curve, _KMH * speeds[seen], w[seen], std[seen])
        curve.plot(_KMH * speeds, w, color=ESTIMATE, linewidth=0.8, alpha=0.6)
        prior = davis(chapter.train_file.resistance, speeds)
        curve.plot(_KMH * speeds, prior, color=MUTED, linestyle=(0, (1, 1.5)), linewidth=1.4)
        if chapter.truth is not None:
            true = true_theta(chapter.truth, chapter.traces.start_ns, np.array([chapter.traces.duration_s]))[0]
            curve.plot(_KMH * speeds, resistance_at(true, speeds), color=INK, linestyle=(0, (5, 2)), linewidth=1.2)
        curve.set_ylim(bottom=0.0)
        curve.set_ylabel('w [N/kN]')
        curve.set_title('Running resistance w(v) at the end; band over the speeds learned from')
        _draw_time_driven(driven, chapter)
        legend_above(figure, _handles(chapter))
        return to_svg(figure, 'Resistance curve against speed')


def _top_speed(chapter: Chapter) -> float:
    speeds = chapter.traces.drive.speed
    fastest = float(speeds.max()) if len(speeds) else 0.0
    return 1.05 * max(fastest, chapter.traces.resistance.speed_range[1], 1.0)


def _draw_time_driven(axes: Axes, chapter: Chapter) -> None:
    drive = chapter.traces.drive
    moving = drive.speed[drive.speed > 0.5]
    share = chapter.traces.duration_s / max(len(drive.speed), 1) / 60.0
    axes.hist(_KMH * moving, bins=40, weights=np.full(len(moving), share), color=STAND)
    axes.set_ylabel('driven [min]')
    axes.set_xlabel('speed [km/h]')
    axes.set_xlim(0.0, _KMH * _top_speed(chapter))


def brake_rate_over_time(chapter: Chapter) -> str:
    """Plot the brake rate over time, shaded where it is observable."""
    trace, duration_s = chapter.traces.brake_rate, chapter.traces.duration_s
    if not len(trace.time_s):
        return ''
    with styled_figure(3.4) as figure:
        axes = figure.subplots()
        kept = pick(len(trace.time_s))
        time_s, rate, std = trace.time_s[kept], trace.rate[kept], trace.std[kept]
        draw_spans(axes, trace.observable, {'observable': BRAKE}, alpha=0.22)
        draw_band(axes, minutes(time_s), rate, std)
        draw_prior(axes, chapter.train_file.brake.rate)
        shown = [*_settled(rate, std, trace.usable[kept]), np.array([chapter.train_file.brake.rate])]
        true = None if chapter.truth is None else true_rate(chapter.truth, chapter.traces.start_ns, time_s)
        if true is not None:
            draw_steps(axes, minutes(time_s), true)
            shown.append(true)
        limit(axes, shown)
        axes.set_ylabel('brake rate (1 = nominal)')
        axes.set_title('Brake rate')
        time_axis(axes, duration_s)
        truth = [TRUTH_LINE] if true is not None else []
        shade = Patch(color=BRAKE, alpha=0.22, linewidth=0, label='braking, observable')
        legend_above(figure, [ESTIMATE_LINE, BAND_68, BAND_95, *truth, PRIOR_LINE, shade])
        return to_svg(figure, 'Brake rate over time')


def speed_profile(chapter: Chapter) -> str:
    """Plot speed and gradient over time with the driving modes shaded."""
    drive, duration_s = chapter.traces.drive, chapter.traces.duration_s
    if not len(drive.time_s):
        return ''
    with styled_figure(3.8) as figure:
        speed, gradient = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        kept = pick(len(drive.time_s) // 2)
        draw_spans(speed, drive.modes, MODES, alpha=0.45)
        speed.plot(minutes(drive.time_s[kept]), _KMH * drive.speed[kept], color=INK, linewidth=0.9)
        speed.set_ylabel('speed [km/h]')
        speed.set_ylim(bottom=0.0)
        speed.set_title('Speed and driving modes')
        gradient.plot(minutes(drive.time_s[kept]), drive.gradient[kept], color=MUTED, linewidth=0.9)
        gradient.set_ylabel('gradient [‰]')
        time_axis(gradient, duration_s)
        legend_above(figure, [Patch(color=colour, alpha=0.45, label=name) for name, colour in MODES.items()])
        return to_svg(figure, 'Speed profile with driving modes')


def innovation_ratios(chapter: Chapter) -> str:
    """Plot the innovation test ratios of resistance and brake rate on a logarithmic scale with their gate."""
    traces = chapter.traces
    both = (
        ('Resistance', traces.resistance.ratio_time_s, traces.resistance.ratio),
        ('Brake rate', traces.brake_rate.ratio_time_s, traces.brake_rate.ratio),
    )
    rows = [row for row in both if len(row[1])]
    if not rows:
        return ''
    with styled_figure(0.6 + 1.7 * len(rows)) as figure:
        panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, time_s, ratio) in zip(panels, rows, strict=True):
            _draw_ratio(axes, time_s, ratio)
            axes.set_title(name)
        time_axis(panels[-1], traces.duration_s)
        return to_svg(figure, 'Innovation test ratios over time')


def _draw_ratio(axes: Axes, time_s: Array, ratio: Array) -> None:
    # Bins keep their greatest ratio, so no rejected innovation is lost by thinning.
    step = max(1, -(-len(ratio) // 900))
    starts = np.arange(0, len(ratio), step)
    greatest = np.maximum(np.maximum.reduceat(ratio, starts), 1e-4)
    time_min = minutes(time_s[starts])
    rejected = greatest > 1.0
    axes.plot(time_min[~rejected], greatest[~rejected], '.', color=ESTIMATE, markersize=2.2)
    axes.plot(time_min[rejected], greatest[rejected], 'x', color=BAD, markersize=4.0)
    axes.axhline(1.0, color=BAD, linewidth=1.0)
    axes.set_yscale('log')
    axes.set_ylim(1e-4, max(3.0, 2.0 * float(greatest.max())))
    axes.set_ylabel('test ratio')


def speed_model_over_time(chapter: Chapter) -> str:
    """Plot the speed model in physical terms: w at the middle speed and the mass factor."""
    trace = chapter.traces.speed_model
    if not len(trace.time_s):
        return ''
    speed = shown_speeds(chapter)[1]
    with styled_figure(2.8) as figure:
        left, right = figure.subplots(1, 2, sharex=True)
        kept = pick(len(trace.time_s))
        time_s = trace.time_s[kept]
        w = resistance_at(trace.davis[kept], speed)
        left.plot(minutes(time_s), w, color=SECOND)
        draw_prior(left, davis(chapter.train_file.resistance, speed))
        if chapter.truth is not None:
            true = true_theta(chapter.truth, chapter.traces.start_ns, time_s)
            draw_steps(left, minutes(time_s), resistance_at(true, speed))
        left.set_title(f'Speed model: w at {speed:g} m/s ({speed * _KMH:.0f} km/h)')
        left.set_ylabel('w [N/kN]')
        right.plot(minutes(time_s), trace.mass_factor[kept], color=SECOND)
        draw_prior(right, 1.0 + chapter.train_file.train.rotary_mass)
        right.set_title('Speed model: mass factor (M / nominal M)(1 + γ)')
        for axes in (left, right):
            time_axis(axes, chapter.traces.duration_s)
        return to_svg(figure, 'Speed model over time')


def status_timeline(chapter: Chapter) -> str:
    """Plot the status of the three estimators over time."""
    traces = chapter.traces
    lanes: tuple[tuple[str, tuple[Span, ...]], ...] = (
        ('resistance', traces.resistance.statuses),
        ('speed model', traces.speed_model.statuses),
        ('brake rate', traces.brake_rate.statuses),
    )
    used = {span.label for _, spans in lanes for span in spans}
    if not used:
        return ''
    with styled_figure(2.1) as figure:
        axes = figure.subplots()
        for lane, (_, spans) in enumerate(lanes):
            _draw_lane(axes, 2 - lane, spans)
        axes.set_yticks([2, 1, 0], [name for name, _ in lanes])
        axes.grid(visible=False, axis='y')
        axes.set_title('Status')
        time_axis(axes, traces.duration_s)
        shown = [Patch(color=colour, label=name) for name, colour in STATUSES.items() if name in used]
        legend_above(figure, shown)
        return to_svg(figure, 'Status of the estimators over time')


def _draw_lane(axes: Axes, lane: int, spans: tuple[Span, ...]) -> None:
    for name, colour in STATUSES.items():
        bars = [(span.start_s / 60.0, (span.end_s - span.start_s) / 60.0) for span in spans if span.label == name]
        if bars:
            axes.broken_barh(bars, (lane - 0.36, 0.72), facecolors=colour, linewidth=0)

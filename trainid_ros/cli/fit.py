# SPDX-License-Identifier: Apache-2.0
"""``trainid fit``: batch fit of the Davis parameters to the speed trajectory of a bag outside braking."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from trainid_ros.bag.reader import require_topics
from trainid_ros.cli.output import davis_rows, opened, print_json, progress, show, table, warn
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import deviations
from trainid_ros.resistance.davis_fit import DavisFit, DavisFitConfig, PieceCollector, check_plausible, fit_davis
from trainid_ros.stream.alignment import AlignmentConfig, TimeJump
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from trainid_ros.bag.reader import BagReader
    from trainid_ros.brake_rate.braking import BrakingCollector
    from trainid_ros.interface.results import Reason

    Collector = PieceCollector | BrakingCollector


class Reading(NamedTuple):
    """Number of samples collected from a bag, those rejected by reason, and the last contradiction."""

    samples: int
    rejected: Counter[Reason]
    finding: str


def run(args: argparse.Namespace) -> int:
    """Fit a bag and print what was found; NoAnswerError if a, b and c remain unknown, or implausible (wrong units)."""
    config = DavisFitConfig()
    collector = PieceCollector(load_train_file(args.train), config.min_speed, config.shortest)
    motion = read(args, collector)
    try:
        fit = fit_davis(collector.trajectory(), config)
        check_plausible(fit, config)
    except NoAnswerError as error:
        if args.json:
            unknown = {**dict.fromkeys('abc'), 'std': [None] * 3, 'iterations': 0, 'mse': None, 'converged': False}
            print_json({**unknown, 'speed_range': [None, None]})
        contradiction = f'; inputs contradict each other: {motion.finding}' if motion.finding else ''
        raise NoAnswerError(f'{args.bag}: {error}{most_rejected(motion.rejected)}{contradiction}') from None
    if args.json:
        print_json(to_json(fit))
    else:
        show(describe(fit, motion))
    if not fit.converged:
        raise NoAnswerError(f'{args.bag}: the fit did not converge within {fit.iterations} iterations')
    return 0


def most_rejected(rejected: Counter[Reason]) -> str:
    """Return why most samples were not used, as the end of a sentence; empty if all were."""
    most = rejected.most_common(1)
    return ''.join(f' (most often rejected: {reason.name}, {count} times)' for reason, count in most)


def read(args: argparse.Namespace, collector: Collector) -> Reading:
    """Collect the part of ``args.bag`` that is asked for, with progress and warnings; see :func:`collect`."""
    inputs = mapped_inputs(args.map, collector.train_file)
    with opened(args, inputs) as reader:
        known = reader.warnings
        for line in known:
            warn(line)
        with progress(f'read {reader.path.name}', total=reader.input_count) as advance:
            reading = collect(reader, collector, args.start, args.duration, advance)
        for line in reader.warnings[len(known) :]:
            warn(line)
    return reading


def collect(
    reader: BagReader, collector: Collector, start_s: float, duration_s: float, advance: Callable[[float], None]
) -> Reading:
    """Collect what lies within a part of a bag, by log time.

    Records before that part are processed too: they give the state of the brake and the mass of the train. InputError
    if a required topic is missing, or the part lies outside the bag.
    """
    require_topics(reader)
    first_ns, last_ns = reader.time_range() or (0, 0)
    begin_ns = first_ns + round(start_s * NS_PER_S)
    if begin_ns > last_ns or duration_s == 0.0:
        wanted, length = f'--start {start_s:g} --duration {duration_s:g}', (last_ns - first_ns) / NS_PER_S
        raise InputError(f'{reader.path}: {wanted} selects nothing of its {length:.1f} s')
    end_ns = math.inf if math.isinf(duration_s) else begin_ns + round(duration_s * NS_PER_S)
    config = StreamConfig(collector.train_file, reader.mapping.alignment(AlignmentConfig()))
    stream, samples = SampleStream(config), 0
    rejected: Counter[Reason] = Counter()
    for log_ns, event in reader.events(stream, advance, end_ns):
        if isinstance(event, TimeJump):
            collector.end_piece()
        elif isinstance(event, Sample) and log_ns < begin_ns:
            collector.monitor(event)
        elif isinstance(event, Sample):
            samples += 1
            collector.add(event, rejected)
    collector.end_piece()
    return Reading(samples, rejected, stream.last_finding)


def to_json(fit: DavisFit) -> dict[str, Any]:
    """Return the object of ``--json``."""
    fitted = {'iterations': fit.iterations, 'mse': fit.mse, 'converged': fit.converged}
    values = dict(zip('abc', fit.theta.tolist(), strict=True))
    return {**values, 'std': _stds(fit), **fitted, 'speed_range': list(fit.speed_range)}


def _stds(fit: DavisFit) -> list[float]:
    return deviations(fit.covariance.ravel().tolist())


def describe(fit: DavisFit, motion: Reading) -> str:
    """Return the fit as text."""
    rows = [('value', 'estimate', 'std', 'unit'), *davis_rows(fit.theta.tolist(), _stds(fit))]
    slow, fast = fit.speed_range
    for v in (slow, 0.5 * (slow + fast), fast):
        w, std = fit.resistance(v)
        rows.append((f'w at {v:.1f} m/s', f'{w:.4g}', f'{std:.2g}', 'N/kN'))
    head = (
        f'{fit.nodes} of {motion.samples} samples in {fit.pieces} pieces without braking, {slow:.1f} to {fast:.1f} m/s'
    )
    tail = (
        f'mean square of measured less calculated speed {fit.mse:.3g} (m/s)^2, {fit.iterations} iterations\n'
        f'speed noise {fit.speed_std:.3g} m/s, {fit.outliers:.1%} outliers; gusts {fit.disturbance:.2g} (N/kN)^2 s; '
        f'force {1e3 * fit.force_delay:.0f} ms late, {fit.force_gain:+.2%}'
    )
    return '\n\n'.join((head, table(rows, numbers=(1, 2)), tail))

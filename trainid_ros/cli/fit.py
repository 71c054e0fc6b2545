# SPDX-License-Identifier: Apache-2.0
"""``trainid fit``: batch fit of the Davis parameters to the speed trajectory of a bag outside braking.

With ``--brake`` it fits dead time, lag and rate of the brake to bags, as the ``brake:`` section of a train file.
``--etcs`` states them in the form of the brake parameters of ERTMS/ETCS, SUBSET-026-3: deceleration as a step function
of speed with at most seven steps (3.13.2.2.3.1.1 to .4), equivalent brake build up time as dead time and half the time
from there to 95 % of the effort (3.13.2.2.3.2.3 and .4), and a factor Kdry_rst with the same steps, for a confidence
that the brake is no weaker than deceleration times factor (3.13.2.2.9.1.2 to .4).
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from scipy.special import stdtrit

from trainid_ros.bag.reader import require_topics
from trainid_ros.brake_rate.brake_fit import DEAD_TIME, LAG, RESPONSE, BrakeFit, fit_brake
from trainid_ros.brake_rate.braking import BrakingCollector
from trainid_ros.cli.output import check_output, opened, print_json, progress, show, table, warn
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.files import write_text
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, ResistanceEstimate, deviations, quantities
from trainid_ros.interface.text import in_step, pluralise, plus_minus
from trainid_ros.resistance.davis_fit import DavisFit, DavisFitConfig, PieceCollector, check_plausible, fit_davis
from trainid_ros.stream.alignment import AlignmentConfig, TimeJump
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import effect_value
from trainid_ros.train.train_file import Brake, TrainFile, load_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.brake_rate.braking import Braking

_START: Final = '# Brake, fitted'
_MOST_STEPS: Final = 7  # of a deceleration over speed, SUBSET-026-3, 3.13.2.2.3.1.2


class Reading(NamedTuple):
    """Number of samples collected from a bag, those rejected by reason, and the last contradiction."""

    samples: int
    rejected: Counter[Reason]
    finding: str


def run(args: argparse.Namespace) -> int:
    """Fit the brake if asked to, else the resistance; NoAnswerError if the data hold too little of it."""
    if args.brake:
        return _run_brake(args)
    if args.etcs or args.out is not None or len(args.bags) > 1:
        given = '--etcs' if args.etcs else '--out' if args.out is not None else f'{len(args.bags)} bags'
        raise InputError(f'trainid fit: {given} only with --brake')
    config = DavisFitConfig()
    collector = PieceCollector(load_train_file(args.train), config.min_speed, config.shortest)
    args.bag = args.bags[0]
    motion = read(args, collector)
    try:
        fit = fit_davis(collector.trajectory(), config)
        check_plausible(fit, config)
    except NoAnswerError as error:
        if args.json:
            unknown = {**dict.fromkeys('abc'), 'std': [None] * 3, 'iterations': 0, 'mse': None, 'converged': False}
            print_json({**unknown, 'speed_range': [None, None]})
        contradiction = f'; inputs contradict each other: {motion.finding}' if motion.finding else ''
        raise NoAnswerError(f'{args.bag}: {error}{_most_rejected(motion.rejected)}{contradiction}') from None
    stds = deviations(fit.covariance.ravel().tolist())
    if args.json:
        fitted = {'iterations': fit.iterations, 'mse': fit.mse, 'converged': fit.converged}
        values = dict(zip('abc', fit.theta.tolist(), strict=True))
        print_json({**values, 'std': stds, **fitted, 'speed_range': list(fit.speed_range)})
    else:
        show(_describe(fit, stds, motion))
    if not fit.converged:
        raise NoAnswerError(f'{args.bag}: the fit did not converge within {fit.iterations} iterations')
    return 0


def _run_brake(args: argparse.Namespace) -> int:
    train_file = load_train_file(args.train)
    if len({bag.resolve() for bag in args.bags}) < len(args.bags):
        raise InputError('trainid fit: a bag is given twice; its data would count twice')
    if args.out is not None:
        check_output(args.out, (args.train, *args.bags), _START)
    brakings, rejected = [], Counter[Reason]()
    for bag in args.bags:
        args.bag, collector = bag, BrakingCollector(train_file)
        reading = read(args, collector)
        rejected += reading.rejected
        if reading.finding:
            warn(f'{bag}: inputs contradict each other: {reading.finding}')
        brakings += collector.brakings
    name = args.bags[0].name if len(args.bags) == 1 else f'{len(args.bags)} bags'
    try:
        fit = _fitted(brakings, train_file, etcs=args.etcs)
    except NoAnswerError as error:
        if args.json:
            print_json({'brake': None, 'std': None, 'quantities': [], 'brakings': 0})
        raise NoAnswerError(f'{name}: {error}{_most_rejected(rejected)}') from None
    brake, command = fitted_brake(fit, train_file), max(-u for one in brakings for _, u in one.changes)
    etcs = etcs_brake(fit, command) if args.etcs else None
    text = describe(fit, brake, name, etcs)
    if args.out is not None:
        write_text(f'{text}\n', args.out)
    if args.json:
        print_json(to_json(fit, brake, train_file, etcs))
    else:
        show(text)
    return 0


def _fitted(brakings: Sequence[Braking], train_file: TrainFile, *, etcs: bool) -> BrakeFit:
    """Return the fit of a brake; NoAnswerError without a braking, or for ``etcs`` without a rate."""
    with progress(f'fit {pluralise(len(brakings), "braking")}'):
        fit = fit_brake(brakings, train_file)
    if etcs and not fit.tells_rate:
        raise NoAnswerError(f'--etcs: {pluralise(fit.brakings, "braking")} cannot tell the rate of the brake')
    return fit


def _most_rejected(rejected: Counter[Reason]) -> str:
    """Return why most samples were not used, as the end of a sentence; empty if all were."""
    most = rejected.most_common(1)
    return ''.join(f' (most often rejected: {reason.name}, {count} times)' for reason, count in most)


def read(args: argparse.Namespace, collector: PieceCollector | BrakingCollector) -> Reading:
    """Collect the part of ``args.bag`` that is asked for, by log time, with progress and warnings.

    Records before that part are processed too: they give the state of the brake and the mass of the train. InputError
    if a required topic is missing, or the part lies outside the bag.
    """
    with opened(args, mapped_inputs(args.map, collector.train_file)) as reader:
        known = reader.warnings
        for line in known:
            warn(line)
        require_topics(reader)
        first_ns, last_ns = reader.time_range() or (0, 0)
        begin_ns = first_ns + round(args.start * NS_PER_S)
        if begin_ns > last_ns or args.duration == 0.0:
            wanted, length = f'--start {args.start:g} --duration {args.duration:g}', (last_ns - first_ns) / NS_PER_S
            raise InputError(f'{reader.path}: {wanted} selects nothing of its {length:.1f} s')
        end_ns = math.inf if math.isinf(args.duration) else begin_ns + round(args.duration * NS_PER_S)
        stream = SampleStream(StreamConfig(collector.train_file, reader.mapping.alignment(AlignmentConfig())))
        samples, rejected = 0, Counter[Reason]()
        with progress(f'read {reader.path.name}', total=reader.input_count) as advance:
            for log_ns, event in reader.events(stream, advance, end_ns):
                if isinstance(event, TimeJump):
                    collector.end_piece()
                elif isinstance(event, Sample) and log_ns < begin_ns:
                    collector.monitor(event)
                elif isinstance(event, Sample):
                    samples += 1
                    collector.add(event, rejected)
        collector.end_piece()
        for line in reader.warnings[len(known) :]:
            warn(line)
    return Reading(samples, rejected, stream.last_finding)


def _describe(fit: DavisFit, stds: list[float], motion: Reading) -> str:
    rows = [('value', 'estimate', 'std', 'unit')]
    for name, value, std in zip('abc', fit.theta.tolist(), stds, strict=True):
        rows.append((name, *in_step(value, std), quantities(ResistanceEstimate)[name].unit))
    slow, fast = fit.speed_range
    speeds = slow, 0.5 * (slow + fast), fast
    rows += [(f'w at {v:.1f} m/s', *in_step(*fit.resistance(v)), 'N/kN') for v in speeds]
    head = (
        f'{fit.nodes} of {motion.samples} samples in {fit.pieces} pieces without braking, {slow:.1f} to {fast:.1f} m/s'
    )
    tail = (
        f'mean square of measured less calculated speed {fit.mse:.3g} (m/s)^2, {fit.iterations} iterations\n'
        f'speed noise {fit.speed_std:.3g} m/s, {fit.outliers:.1%} outliers; gusts {fit.disturbance:.2g} (N/kN)^2 s; '
        f'force {1e3 * fit.force_delay:.0f} ms late, {fit.force_gain:+.2%}'
    )
    return '\n\n'.join((head, table(rows, numbers=(1, 2)), tail))


def fitted_brake(fit: BrakeFit, train_file: TrainFile) -> Brake:
    """Return the brake beside the effects of a train file, which stay.

    The stated times are kept where the data do not tell the response time, or tell the same less accurately, and the
    stated rate where they tell none; beyond the speeds braked at, the rate changes as stated.
    """
    stated = train_file.brake
    times = _fitted_times(fit, train_file) or (stated.delay, stated.time_constant, stated.timing_std)
    dead, constant, std = map(_rounded, times)
    timed = replace(stated, time_constant=constant, delay=dead, timing_std=std)
    if not fit.tells_rate:
        return timed
    kept = replace(timed, rate=1.0, rate_table=())
    rows = list(zip(fit.knots, fit.rates.tolist(), strict=True))
    if len(rows) == 1 and not stated.rate_table:
        return replace(kept, rate=_rounded(rows[0][1]))
    if len(rows) == 1:
        rows = [(v, rows[0][1]) for v in fit.speed_range]
    (slow, first), (fast, last) = rows[0], rows[-1]
    below = [(v, first * stated.rate_at(v) / stated.rate_at(slow)) for v, _ in stated.rate_table if v < slow]
    above = [(v, last * stated.rate_at(v) / stated.rate_at(fast)) for v, _ in stated.rate_table if v > fast]
    return replace(kept, rate_table=tuple((_rounded(v), _rounded(r)) for v, r in (*below, *rows, *above)))


def _fitted_times(fit: BrakeFit, train_file: TrainFile) -> tuple[float, float, float] | None:
    """Return dead time, lag [s] and ``timing_std`` [1] as fitted; None where those of the train file stay."""
    delay, lag, response = (fit.find(name) for name in (DEAD_TIME, LAG, RESPONSE))
    # Stated is the error in single brakings, so their scatter counts.
    ones = Brake(1.0, lag.value, delay.value, timing_std=1.0).timing_stds
    shares = math.hypot(delay.std, fit.jitter) / ones[0], lag.std / ones[1]
    timing_std = min(max(*shares, 0.005), 1.0)  # its range
    if not response.is_told or (response.agrees and timing_std > train_file.brake.timing_std):
        return None
    extra = effect_value(train_file.effects, 'brake_delay', 'extra', 0.0)
    return max(delay.value - extra, 0.0), lag.value, timing_std


def _rounded(value: float) -> float:
    return float(f'{value:.4g}')


class EtcsBrake(NamedTuple):
    """Brake parameters for one command."""

    command: float  # Strongest command in the bags [m/s^2]
    upper_speeds: list[float]  # Upper speeds of the steps but the last, which is open [m/s]
    decelerations: list[float]  # Deceleration in each step, on level track without resistance [m/s^2]
    build_up_s: float  # Equivalent brake build up time [s]
    kdry_rst: dict[str, list[float]]  # Factor in each step by confidence


def etcs_brake(fit: BrakeFit, command: float) -> EtcsBrake:
    """Return the brake parameters for a command [m/s^2]; each step takes the weakest rate within it."""
    edges = np.linspace(*fit.speed_range, (_MOST_STEPS if len(fit.knots) > 1 else 1) + 1)
    speeds = np.linspace(edges[:-1], edges[1:], 9)
    W = np.stack([np.interp(speeds, fit.knots, unit) for unit in np.eye(len(fit.knots))], axis=-1)
    rate = W @ fit.rates
    # Of the next braking: what is not known of the mean, and the scatter.
    std = np.sqrt(np.einsum('...i,ij,...j->...', W, fit.covariance, W) + fit.scatter**2)
    least, factors = rate.min(axis=0), {}
    # Confidences of the first levels of M_NVEBCL [1]: brakings by the dozen do not show rarer events.
    for confidence in (0.5, 0.9, 0.99, 0.999):
        safe = (rate - stdtrit(fit.brakings, confidence) * std).min(axis=0) / least
        factors[f'{confidence:.1%}'] = [math.floor(100.0 * max(0.0, k)) / 100.0 for k in safe.tolist()]
    # A first-order lag reaches 95 % of its step after ln 20 time constants.
    build_up = fit.find(DEAD_TIME).value + 0.5 * math.log(20.0) * fit.find(LAG).value
    return EtcsBrake(command, edges[1:-1].tolist(), (command * least).tolist(), build_up, factors)


def to_json(fit: BrakeFit, brake: Brake, train_file: TrainFile, etcs: EtcsBrake | None) -> dict[str, Any]:
    """Return the object of ``--json``; what stays as stated has the std of the train file or of the estimator."""
    rate_std = np.sqrt(np.diag(fit.covariance)).tolist() if fit.tells_rate else [BrakeRateConfig().prior_std]
    times = [fit.find(name).std for name in (DEAD_TIME, LAG)]
    if _fitted_times(fit, train_file) is None:
        times = list(train_file.brake.timing_stds)
    std = {
        'rate': rate_std if brake.rate_table and fit.tells_rate else rate_std[0],
        'delay': times[0], 'time_constant': times[1],
    }  # fmt: skip
    names = ('name', 'value', 'std', 'unit', 'stated', 'is_told', 'verdict')
    more = {} if etcs is None else {'etcs': etcs._asdict()}
    return {
        'brake': _section(brake), 'std': std,
        'quantities': [{name: getattr(one, name) for name in names} for one in fit.quantities],
        'lags': fit.lags, 'scatter': fit.scatter, 'jitter': fit.jitter, 'models': dict(fit.models),
        'brakings': fit.brakings, 'speed_range': fit.speed_range, **more,
    }  # fmt: skip


def _section(brake: Brake) -> dict[str, Any]:
    rate = [list(row) for row in brake.rate_table] if brake.rate_table else brake.rate
    section = {'rate': rate, 'delay': brake.delay, 'time_constant': brake.time_constant, 'timing_std': brake.timing_std}
    # No braking tells how often the brake drops: what is stated stays.
    losses = {name: getattr(brake, name) for name in ('loss_per_hour', 'loss', 'loss_confidence')}
    return section | {name: value for name, value in losses.items() if value > 0.0}


def describe(fit: BrakeFit, brake: Brake, name: str, etcs: EtcsBrake | None) -> str:
    """Return the section as YAML, with all that was found as comments."""
    slow, fast = fit.speed_range
    lines = [f'{_START} to {pluralise(fit.brakings, "braking")} of {name} from {fast:.1f} to {slow:.1f} m/s']
    for one in fit.quantities:
        unit = '' if one.unit == '1' else f' {one.unit}'
        lines.append(f'# {one.name}: {plus_minus(one.value, one.std)}{unit}; {one.verdict}')
    others = ', '.join(f'{model} {evidence:+.1f}' for model, evidence in fit.models if evidence < 0.0)
    lines += [
        f'# from braking to braking: rate ± {fit.scatter:.2g}, response time ± {fit.jitter:.2g} s',
        f'# evidence of other models against this one [nats]: {others}',
    ]
    if len(fit.lags) > 1:
        lags = ' and '.join(f'{lag:.2g}' for lag in fit.lags)
        lines.append(f'# two lags of {lags} s: below is the first-order brake of the same area and spread of response')
    if etcs is not None:
        bounds = ', '.join(f'{v:.1f}' for v in etcs.upper_speeds)
        lines += [
            f'# in the form of SUBSET-026-3 for a command of {etcs.command:.2f} m/s^2, which is no approval:',
            f'#   A_brake [m/s^2] (3.13.2.2.3.1): {_numbers(etcs.decelerations)}; up to [m/s]: {bounds or "any"}',
            f'#   T_brake_build_up [s] (3.13.2.2.3.2.4): {etcs.build_up_s:.2f}',
            *(f'#   Kdry_rst at {key} (3.13.2.2.9.1): {_numbers(row)}' for key, row in etcs.kdry_rst.items()),
        ]
    return '\n'.join((*lines, 'brake:', *(f'  {key}: {value}' for key, value in _section(brake).items())))


def _numbers(values: list[float]) -> str:
    return ', '.join(f'{value:.2f}' for value in values)

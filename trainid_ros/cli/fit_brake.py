# SPDX-License-Identifier: Apache-2.0
"""``trainid fit --brake``: dead time, lag and rate of the brake from bags, as the ``brake:`` section of a train file.

``--etcs`` states them in the form of the brake parameters of ERTMS/ETCS, SUBSET-026-3: deceleration as a step function
of speed with at most seven steps (3.13.2.2.3.1.1 to .4), equivalent brake build up time as dead time and half the time
from there to 95 % of the effort (3.13.2.2.3.2.3 and .4), and a factor Kdry_rst with the same steps, for a confidence
that the brake is no weaker than deceleration times factor (3.13.2.2.9.1.2 to .4).
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from scipy.special import stdtrit

from trainid_ros.brake_rate.brake_fit import DEAD_TIME, LAG, RESPONSE, BrakeFit, fit_brake
from trainid_ros.brake_rate.braking import BrakingCollector
from trainid_ros.cli import fit as fit_davis
from trainid_ros.cli.output import check_output, print_json, progress, show, warn
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.results import Reason
from trainid_ros.interface.text import pluralise
from trainid_ros.train.effects import effect_value
from trainid_ros.train.train_file import Brake, load_train_file

if TYPE_CHECKING:
    import argparse

    from trainid_ros.train.train_file import TrainFile

_START: Final = '# Brake, fitted'
_MOST_STEPS: Final = 7  # of a deceleration over speed, SUBSET-026-3, 3.13.2.2.3.1.2
# Confidences of the first levels of M_NVEBCL [1]: brakings by the dozen do not show rarer events.
_CONFIDENCES: Final = (0.5, 0.9, 0.99, 0.999)
_TO_95: Final = math.log(20.0)  # Time of a first-order lag to 95 % of its step [time constants]
_LEAST_TIMING, _MOST_TIMING = 0.005, 1.0  # Range of ``timing_std`` [1]


def run(args: argparse.Namespace) -> int:
    """Fit the brake if asked to, else the resistance; NoAnswerError if no braking was found."""
    if not args.brake:
        if args.etcs or args.out is not None or len(args.bags) > 1:
            given = '--etcs' if args.etcs else '--out' if args.out is not None else f'{len(args.bags)} bags'
            raise InputError(f'trainid fit: {given} only with --brake')
        args.bag = args.bags[0]
        return fit_davis.run(args)
    train_file = load_train_file(args.train)
    if len({bag.resolve() for bag in args.bags}) < len(args.bags):
        raise InputError('trainid fit: a bag is given twice; its data would count twice')
    if args.out is not None:
        check_output(args.out, (args.train, *args.bags), _START)
    brakings, rejected = [], Counter[Reason]()
    for bag in args.bags:
        args.bag, collector = bag, BrakingCollector(train_file)
        reading = fit_davis.read(args, collector)
        rejected += reading.rejected
        if reading.finding:
            warn(f'{bag}: inputs contradict each other: {reading.finding}')
        brakings += collector.brakings
    name = args.bags[0].name if len(args.bags) == 1 else f'{len(args.bags)} bags'
    try:
        with progress(f'fit {pluralise(len(brakings), "braking")}'):
            fit = fit_brake(brakings, train_file)
    except NoAnswerError as error:
        if args.json:
            print_json({'brake': None, 'std': None, 'quantities': [], 'brakings': 0})
        raise NoAnswerError(f'{name}: {error}{fit_davis.most_rejected(rejected)}') from None
    brake, command = fitted_brake(fit, train_file), max(-u for one in brakings for _, u in one.changes)
    etcs = etcs_brake(fit, command) if args.etcs else None
    text = describe(fit, brake, name, etcs)
    if args.out is not None:
        try:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(f'{text}\n', encoding='utf-8')
        except OSError as error:
            raise InputError(f'{args.out}: cannot be written ({error.strerror})') from None
    if args.json:
        print_json(to_json(fit, brake, etcs))
    else:
        show(text)
    return 0


def fitted_brake(fit: BrakeFit, train_file: TrainFile) -> Brake:
    """Return the brake beside the effects of a train file, which stay.

    The stated times are kept where the data do not tell the response time, or tell the same less accurately; beyond the
    speeds braked at, the rate changes as stated.
    """
    stated, extra = train_file.brake, effect_value(train_file.effects, 'brake_delay', 'extra', 0.0)
    delay, lag, response = (fit.find(name) for name in (DEAD_TIME, LAG, RESPONSE))
    # Stated is the error in single brakings, so their scatter counts; see ``Brake.timing_stds``.
    shares = (
        math.hypot(delay.std, fit.jitter) / math.hypot(delay.value, 0.67),
        lag.std / math.hypot(lag.value, 0.25),
    )
    times = max(delay.value - extra, 0.0), lag.value, min(max(*shares, _LEAST_TIMING), _MOST_TIMING)
    if not response.is_told or (response.agrees and times[2] > stated.timing_std):
        times = stated.delay, stated.time_constant, stated.timing_std
    dead, constant, std = map(_rounded, times)
    rows = list(zip(fit.knots, fit.rates.tolist(), strict=True))
    if len(rows) == 1 and not stated.rate_table:
        return Brake(_rounded(rows[0][1]), constant, dead, timing_std=std)
    if len(rows) == 1:
        rows = [(v, rows[0][1]) for v in fit.speed_range]
    (slow, first), (fast, last) = rows[0], rows[-1]
    below = [(v, first * stated.rate_at(v) / stated.rate_at(slow)) for v, _ in stated.rate_table if v < slow]
    above = [(v, last * stated.rate_at(v) / stated.rate_at(fast)) for v, _ in stated.rate_table if v > fast]
    return Brake(1.0, constant, dead, tuple((_rounded(v), _rounded(r)) for v, r in (*below, *rows, *above)), std)


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
    for confidence in _CONFIDENCES:
        safe = (rate - stdtrit(fit.brakings, confidence) * std).min(axis=0) / least
        factors[f'{confidence:.1%}'] = [math.floor(100.0 * max(0.0, k)) / 100.0 for k in safe.tolist()]
    build_up = fit.find(DEAD_TIME).value + 0.5 * _TO_95 * fit.find(LAG).value
    return EtcsBrake(command, edges[1:-1].tolist(), (command * least).tolist(), build_up, factors)


def to_json(fit: BrakeFit, brake: Brake, etcs: EtcsBrake | None) -> dict[str, Any]:
    """Return the object of ``--json``."""
    rate_std = np.sqrt(np.diag(fit.covariance)).tolist()
    std = {
        'rate': rate_std if brake.rate_table else rate_std[0],
        'delay': fit.find(DEAD_TIME).std, 'time_constant': fit.find(LAG).std,
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
    return {'rate': rate, 'delay': brake.delay, 'time_constant': brake.time_constant, 'timing_std': brake.timing_std}


def describe(fit: BrakeFit, brake: Brake, name: str, etcs: EtcsBrake | None) -> str:
    """Return the section as YAML, with all that was found as comments."""
    slow, fast = fit.speed_range
    lines = [f'{_START} to {pluralise(fit.brakings, "braking")} of {name} from {fast:.1f} to {slow:.1f} m/s']
    for one in fit.quantities:
        unit = '' if one.unit == '1' else f' {one.unit}'
        lines.append(f'# {one.name}: {one.value:.3g} ± {one.std:.2g}{unit}; {one.verdict}')
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

# SPDX-License-Identifier: Apache-2.0
"""``trainid replay``: the estimators over a bag, off line, as fast as the machine goes."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.observers import BagRecorder, TraceObserver
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.output import add_json_option, print_json, progress, table, to_plain, warn
from trainid_ros.errors import NoAnswerError
from trainid_ros.estimators.force_findings import force_findings
from trainid_ros.estimators.observability import observe
from trainid_ros.ros.offline import node_setups
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from trainid_ros.bag.bag_replay import Observer, Replay, Result
    from trainid_ros.report.traces import Traces
    from trainid_ros.results import Reason
    from trainid_ros.ros.offline import Setup
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile

TRUTH_FILE: Final = 'truth.yaml'
_SPEEDS: Final = (10.0, 15.0, 20.0)


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 directory or .mcap file')
    parser.add_argument('--train', type=Path, required=True, metavar='T.yaml', help='train file')
    parser.add_argument('--params', type=Path, metavar='FILE.yaml', help='ROS parameter file, as the nodes take it')
    parser.add_argument(
        '--algorithm',
        action='append',
        default=[],
        metavar='NAME',
        help='algorithm instead of the default, or resistance=NAME and so on; repeatable',
    )
    parser.add_argument('--out', type=Path, metavar='BAG2', help='write inputs and estimates to a new bag')
    parser.add_argument('--report', type=Path, metavar='FILE.html', help='write a report with plots')
    parser.add_argument(
        '--truth', type=Path, metavar='FILE', help=f'truth for the report (default: {TRUTH_FILE} in the bag, if any)'
    )
    parser.add_argument('--namespace', default='/', help='namespace of topics and nodes (default: /)')
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Replay a bag and print what was identified.

    Raises:
        InputError: If bag, train file, parameters or truth cannot be used, or an output exists already.
        NoAnswerError: If nothing was learned of the resistance.

    """
    train_file = load_train_file(args.train)
    setups = node_setups(train_file, str(args.train), args.params, args.algorithm, namespace=args.namespace, warn=warn)
    if args.report is not None:
        find_truth(args.bag, args.truth)  # a truth that cannot be read is reported before the work
    traces = TraceObserver() if args.report else None
    with ExitStack() as stack:
        reader = stack.enter_context(BagReader(args.bag, args.namespace))
        observers: list[Observer] = [] if traces is None else [traces]
        if args.out is not None:
            observers.append(BagRecorder(stack.enter_context(BagWriter(args.out))))
        for line in reader.warnings:
            warn(line)
        outcome, wall_s = timed_replay(reader, setups, observers)
    if args.json:
        print_json(to_json(outcome, setups, wall_s))
    else:
        print(describe(outcome, setups, wall_s))
    if traces is not None:
        _write_report(args, outcome, train_file, traces.finish(), f'off line {_pace(outcome, wall_s)}')
    check_answer(args.bag, outcome)
    return 0


def timed_replay(
    reader: BagReader, setups: Sequence[Setup], observers: Sequence[Observer] = ()
) -> tuple[Replay, float]:
    """Replay with progress on a terminal; return the outcome and the seconds it took."""
    start = time.perf_counter()
    with progress(f'replay {reader.path.name}', total=reader.input_count) as advance:
        outcome = replay_through(Pipelines(*(setup.pipeline() for setup in setups)), reader, advance, observers)
    return outcome, time.perf_counter() - start


def find_truth(bag: Path, given: Path | None) -> Truth | None:
    """Return the truth of a bag: from the file given, or from the one in its directory, None without either.

    Raises:
        InputError: The file cannot be used.

    """
    if given is not None:
        return load_truth(given)
    beside = (bag if bag.is_dir() else bag.parent) / TRUTH_FILE
    return load_truth(beside) if beside.is_file() else None


def check_answer(bag: Path, outcome: Replay) -> None:
    """Raise NoAnswerError, with the most frequent reason of rejection, if nothing was learned of the resistance."""
    result = outcome.resistance
    estimate = result.output.estimate
    if result.output.used and estimate.speed_max > 0.0:
        return
    msg = f'{bag}: nothing was learned of the resistance: {result.samples} samples, {result.output.used} used'
    if result.rejections:
        reason, count = result.rejections[0]
        msg += f', most often rejected: {reason.name} ({count} times), last: {result.output.last_rejection}'
    raise NoAnswerError(msg)


def to_json(outcome: Replay, setups: Sequence[Setup], wall_s: float) -> dict[str, Any]:
    """Return the object of ``--json``; counters at the top are those of the resistance."""
    resistance, model, brake = outcome.resistance, outcome.speed_model, outcome.brake_rate
    w, m, f = resistance.output.estimate, model.output.estimate, brake.output.estimate
    learned = w.speed_max > 0.0
    body = {
        'samples': resistance.samples,
        'duration_s': outcome.duration_s,
        'used': resistance.output.used,
        'rejected': dict(resistance.rejections),
        'resistance': {
            **{'a': w.a, 'b': w.b, 'c': w.c, 'std': _deviations(w.covariance)},
            'status': resistance.output.status,
            'speed_range': [w.speed_min, w.speed_max] if learned else [None, None],
            'force_scale': {'value': w.force_scale, 'std': w.force_scale_std},
            'force_delay': {'value': w.force_delay, 'std': w.force_delay_std},
            'findings': list(force_findings(w)),
        },
        'speed_model': {
            **{'a1': m.a1, 'a2': m.a2, 'b1': m.b1, 'd0': m.d0, 'status': model.output.status},
            **_counters(model),
        },
        'brake_rate': {
            **{'value': f.brake_rate, 'std': f.brake_rate_std, 'status': brake.output.status},
            **_counters(brake),
        },
        'algorithms': {setup.job.field: setup.algorithm for setup in setups},
        'wall_s': wall_s,
    }
    plain: dict[str, Any] = to_plain(body)
    return plain


def _counters(result: Result[Any]) -> dict[str, Any]:
    return {'used': result.output.used, 'rejected': dict(result.rejections)}


def _deviations(covariance: Sequence[float]) -> list[float]:
    size = math.isqrt(len(covariance))
    return [math.sqrt(max(0.0, covariance[i * (size + 1)])) for i in range(size)]


def describe(outcome: Replay, setups: Sequence[Setup], wall_s: float) -> str:
    """Return the outcome as text for people."""
    head = (
        f'{outcome.records} messages, {outcome.resistance.samples} samples over {outcome.duration_s:.1f} s, '
        f'replayed {_pace(outcome, wall_s)}'
    )
    return '\n\n'.join((head, _estimates(outcome), _usage(outcome), _uncertainty(outcome, setups)))


def _estimates(outcome: Replay) -> str:
    w = outcome.resistance.output.estimate
    rows = [('value', 'estimate', 'std', 'unit', 'status'), *_resistance_rows(outcome), *_other_rows(outcome)]
    seen = f'* outside the speeds learned from, {w.speed_min:.1f} to {w.speed_max:.1f} m/s'
    return '\n'.join((table(rows, numbers=(1, 2)), seen, *force_findings(w)))


def _resistance_rows(outcome: Replay) -> list[tuple[str, ...]]:
    w, status = outcome.resistance.output.estimate, outcome.resistance.output.status.name
    units = ('N/kN', 'N/kN per m/s', 'N/kN per (m/s)^2')
    parameters = zip('abc', (w.a, w.b, w.c), _deviations(w.covariance), units, strict=True)
    rows: list[tuple[str, ...]] = [
        (name, f'{value:.5g}', f'{std:.2g}', unit, status) for name, value, std, unit in parameters
    ]
    for v in _SPEEDS:
        phi = (1.0, v, v * v)
        variance = sum(phi[i] * phi[j] * w.covariance[3 * i + j] for i in range(3) for j in range(3))
        name = f'w at {v:g} m/s' + ('' if w.speed_min <= v <= w.speed_max else ' *')
        std = math.sqrt(max(0.0, variance))
        rows.append((name, f'{w.a + w.b * v + w.c * v * v:.4g}', f'{std:.2g}', 'N/kN', status))
    if not math.isnan(w.force_scale):
        rows.append(('force scale', f'{w.force_scale:.4f}', f'{w.force_scale_std:.2g}', '1 = as reported', status))
        rows.append(('force delay', f'{w.force_delay:.3f}', f'{w.force_delay_std:.2g}', 's', status))
    return rows


def _other_rows(outcome: Replay) -> list[tuple[str, ...]]:
    f, m = outcome.brake_rate.output.estimate, outcome.speed_model.output.estimate
    rate_status, model_status = outcome.brake_rate.output.status.name, outcome.speed_model.output.status.name
    model = (('a1', m.a1, '1/(m/s)'), ('a2', m.a2, '1'), ('b1', m.b1, 'm/s per N/kN'), ('d0', m.d0, 'm/s'))
    return [
        ('brake rate', f'{f.brake_rate:.4g}', f'{f.brake_rate_std:.2g}', '1 = nominal', rate_status),
        *((name, f'{value:.6g}', '', unit, model_status) for name, value, unit in model),
    ]


def _usage(outcome: Replay) -> str:
    results = (outcome.resistance, outcome.speed_model, outcome.brake_rate)
    counts: list[dict[Reason, int]] = [dict(result.rejections) for result in results]
    reasons = sorted({reason for count in counts for reason in count})
    rows = [
        ('samples', 'resistance', 'speed model', 'brake rate'),
        ('used', *(str(result.output.used) for result in results)),
        *((f'not: {reason.name}', *(str(count.get(reason, 0)) for count in counts)) for reason in reasons),
    ]
    return table(rows, numbers=(1, 2, 3))


def _uncertainty(outcome: Replay, setups: Sequence[Setup]) -> str:
    """Return the algorithms, the consistency of their uncertainty, and the observability of the resistance."""
    results: tuple[Result[Any], ...] = (outcome.resistance, outcome.speed_model, outcome.brake_rate)
    lines = [
        f'{setup.job.field.replace("_", " ")} by {setup.algorithm}: uncertainty {result.consistency}'
        for setup, result in zip(setups, results, strict=True)
    ]
    w, prior = outcome.resistance.output.estimate, outcome.resistance.prior
    seen = observe(w.covariance, prior.covariance, w.speed_min, w.speed_max)
    shares = ', '.join(f'{name} {100.0 * share:.0f} %' for name, share in zip('abc', seen.shares, strict=True))
    return '\n'.join((*lines, f'{seen.text}; prior variance removed: {shares}'))


def _write_report(args: argparse.Namespace, outcome: Replay, train_file: TrainFile, traces: Traces, how: str) -> None:
    # Imported here because matplotlib takes long to load and only reports need it.
    from trainid_ros.report.content import Report  # noqa: PLC0415
    from trainid_ros.report.from_replay import chapter_of  # noqa: PLC0415
    from trainid_ros.report.html import write_report  # noqa: PLC0415

    chapter = chapter_of(
        outcome,
        traces,
        title=args.bag.name,
        bag=str(args.bag),
        train_file_name=str(args.train),
        train_file=train_file,
        how=how,
        truth=find_truth(args.bag, args.truth),
    )
    write_report(Report(f'trainid replay: {args.bag.name}', (chapter,)), args.report)


def _pace(outcome: Replay, wall_s: float) -> str:
    speed = outcome.duration_s / wall_s if wall_s > 0.0 else math.nan
    return f'in {wall_s:.1f} s ({speed:.0f} x real time)'

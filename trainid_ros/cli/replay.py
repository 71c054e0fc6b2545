# SPDX-License-Identifier: Apache-2.0
"""``trainid replay``: the estimators over bags, off line, as fast as the machine goes."""

from __future__ import annotations

import math
import time
from collections import Counter
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.reader import BagReader, in_two
from trainid_ros.brake_rate.suggested_braking import suggested_braking
from trainid_ros.cli.bags import BagResult, beside, davis_rows, load_setups, run_per_bag
from trainid_ros.cli.output import check_output, table, to_plain
from trainid_ros.inputs.estimate_table import TABLE_SUFFIXES, estimate_table
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inspection.bag_info import brake_sign
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import MASS_TOPIC
from trainid_ros.interface.results import Reason, SpeedModelEstimate, deviations, parameters, quantities
from trainid_ros.interface.text import pluralise
from trainid_ros.report import HTML_START
from trainid_ros.resistance.davis_posterior import observe, resistance_std
from trainid_ros.resistance.suggested_drive import suggested_drive
from trainid_ros.setup.params_file import mapping_in
from trainid_ros.setup.pipelines import force_findings
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from trainid_ros.bag.bag_replay import Observer, Replay, Result
    from trainid_ros.interface.results import ResistanceEstimate
    from trainid_ros.report.recording import Recorder, Recording
    from trainid_ros.resistance.suggested_drive import SuggestedDrive
    from trainid_ros.setup.params_file import Setup
    from trainid_ros.sim.truth import Truth
    from trainid_ros.train.train_file import TrainFile

# A load that nobody weighs varies by more than this share of the mass [1].
_UNWEIGHED: Final = 0.02


Drives = tuple['SuggestedDrive | None', 'SuggestedDrive | None']
"""What to drive for a better resistance and a better brake rate; None where nothing is missing or would help."""


def run(args: argparse.Namespace) -> int:
    """Replay bags and print what was identified."""
    args.map = args.map or mapping_in(args.params, args.namespace)
    # What cannot be used for any bag is reported once.
    mapped_inputs(args.map, load_setups(args, args.train)[0].train_file)
    if len(args.bags) > 1:
        _check_outputs(args)
    for out, report in (_outputs(args, bag) for bag in args.bags):
        if report is not None:
            if out is not None and out.resolve() == report.resolve():
                raise InputError(f'{report}: is given for two outputs; choose another name for one of them')
            check_output(report, (args.train, args.params, args.truth, *args.bags), HTML_START)
    return run_per_bag(args, _replay, 'replay')


def _check_outputs(args: argparse.Namespace) -> None:
    """Prepare the folders of the outputs of several bags; InputError if two would have the same name."""
    if args.truth is not None:
        raise InputError('--truth is of one bag, but several bags are given')
    if args.out is not None and args.out.suffix in TABLE_SUFFIXES:
        raise InputError(f'{args.out}: is the table of one bag, but several bags are given')
    folders = [folder for folder in (args.out, args.report) if folder is not None]
    names = Counter(_name(bag) for bag in args.bags)
    name, count = names.most_common(1)[0]
    if folders and count > 1:
        raise InputError(f'{pluralise(count, "bag")} have the name {name}, so their outputs would have the same name')
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)


def _name(bag: Path) -> str:
    """Return the name of the outputs of one of several bags."""
    return bag.resolve().name.removesuffix('.mcap').removesuffix('.db3')


def _outputs(args: argparse.Namespace, bag: Path) -> tuple[Path | None, Path | None]:
    """Return the paths of the new bag and of the report of a bag, None where it is not asked for."""
    if len(args.bags) == 1:
        return args.out, args.report
    out = None if args.out is None else args.out / _name(bag)
    return out, None if args.report is None else args.report / f'{_name(bag)}.html'


def _replay(args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> BagResult:
    warnings: list[str] = []
    setups = load_setups(args, args.train, warnings.append)
    out, report = _outputs(args, bag)
    truth = None if report is None else _find_truth(bag, args.truth)
    with ExitStack() as stack:
        inputs = mapped_inputs(args.map, setups[0].train_file)
        opening, reading = in_two(advance)
        reader = stack.enter_context(BagReader(bag, args.namespace, args.max_chunk, inputs, opening=opening))
        observers, recorder = _observers(stack, out, report)
        start = time.perf_counter()
        pipelines = Pipelines(*(setup.realigned(reader.mapping.alignment).pipeline() for setup in setups))
        count = max(reader.input_count, 1)
        outcome = replay_through(pipelines, reader, lambda amount: reading(amount / count), observers)
        wall_s = time.perf_counter() - start
        warnings += _unweighed(reader, setups[0].train_file)
        if Reason.OUT_OF_RANGE in dict(outcome.brake_rate.rejections) and (wrong := brake_sign(reader.tables())):
            warnings.append(reader.mapping.named(wrong))
    if report is not None and recorder is not None:
        _write_report(args, bag, outcome, recorder.finish(), truth, f'off line {_pace(outcome, wall_s)}', report)
    first = outcome.resistance
    drives: Drives = (None, None)
    if not pipelines.resistance.stream.finding:  # else it is the inputs that need a look
        drives = (
            suggested_drive(pipelines.resistance.estimator, setups[0].train_file, first.prior, first.output.estimate),
            suggested_braking(pipelines.brake_rate.estimator, setups[2].train_file, outcome.brake_rate.output.estimate),
        )
    shown: Any
    if args.json:
        shown = to_json(outcome, setups, wall_s, drives)
        shown['resistance']['findings'] = [reader.mapping.named(text) for text in shown['resistance']['findings']]
    else:
        shown = reader.mapping.named(describe(outcome, setups, wall_s, drives))
        shown = f'{bag}: {shown}' if len(args.bags) > 1 else shown
    reason = outcome.why_no_resistance()
    return BagResult(shown, (*warnings, *reader.warnings), f'{bag}: {reason}' if reason else '')


def _unweighed(reader: BagReader, train_file: TrainFile) -> list[str]:
    """Say so where no mass is recorded, and the train file states one as if the load were weighed at each stop."""
    share = train_file.train.mass_std
    text = (
        f'{MASS_TOPIC.name}: no messages, so train.mass_std = {share:g} must cover the load too: state at least '
        f'{_UNWEIGHED:g} unless it never changes'
    )
    return [text] if share < _UNWEIGHED and reader.missing(MASS_TOPIC) else []


def _observers(stack: ExitStack, out: Path | None, report: Path | None) -> tuple[list[Observer], Recorder | None]:
    """Return what writes the new bag or table and what collects the columns of the report, and the latter alone."""
    if out is None and report is None:
        return [], None
    from trainid_ros.bag.writer import BagRecorder, BagWriter  # noqa: PLC0415
    from trainid_ros.report.recording import Recorder  # noqa: PLC0415

    recorder = None if report is None else Recorder()
    observers: list[Observer] = [] if recorder is None else [recorder]
    if out is not None and out.suffix in TABLE_SUFFIXES:
        observers.append(stack.enter_context(estimate_table(out)))
    elif out is not None:
        observers.append(BagRecorder(stack.enter_context(BagWriter(out))))
    return observers, recorder


def _find_truth(bag: Path, given: Path | None) -> Truth | None:
    """Return the truth of a bag: from the file given, or from the one in its directory, None without either."""
    path = given or beside(bag, 'truth.yaml')
    return load_truth(path) if given is not None or path.is_file() else None


def to_json(outcome: Replay, setups: Sequence[Setup], wall_s: float, drives: Drives) -> dict[str, Any]:
    """Return the object of ``--json``; counters at the top are those of the resistance."""
    resistance, model, brake = outcome.resistance, outcome.speed_model, outcome.brake_rate
    body = {
        'samples': resistance.samples,
        'duration_s': outcome.duration_s,
        'used': resistance.output.used,
        'rejected': dict(resistance.rejections),
        'resistance': _resistance(resistance),
        'speed_model': {**_parameters(model), 'status': model.output.status, **_counters(model)},
        'brake_rate': {
            **_with_std(brake, 'brake_rate'),
            'status': brake.output.status,
            **_counters(brake),
            'findings': list(outcome.brake_findings),
        },
        'input_finding': outcome.contradiction.finding,
        'input_finding_begin_s': outcome.contradiction.begin_s,
        'input_finding_end_s': outcome.contradiction.end_s,
        'suggested_drive': drives[0] and drives[0].numbers,
        'suggested_braking': drives[1] and drives[1].numbers,
        'algorithms': {setup.kind.name: setup.algorithm for setup in setups},
        'wall_s': wall_s,
    }
    plain: dict[str, Any] = to_plain(body)
    return plain


def _resistance(result: Result[ResistanceEstimate]) -> dict[str, Any]:
    w = result.output.estimate
    return {
        **_parameters(result),
        'std': deviations(w.covariance),
        'status': result.output.status,
        'speed_range': [w.speed_min, w.speed_max] if w.speed_max > 0.0 else [None, None],
        **{name: _with_std(result, name) for name in ('force_scale', 'force_delay')},
        'findings': list(force_findings(w)),
        'why_converging': result.why_converging,
    }


def _counters(result: Result[Any]) -> dict[str, Any]:
    return {'used': result.output.used, 'rejected': dict(result.rejections), 'why_converging': result.why_converging}


def _parameters(result: Result[Any]) -> dict[str, float]:
    estimate = result.output.estimate
    return {name: getattr(estimate, name) for name in parameters(type(estimate))}


def _with_std(result: Result[Any], name: str) -> dict[str, float]:
    estimate = result.output.estimate
    return {'value': getattr(estimate, name), 'std': getattr(estimate, f'{name}_std')}


def describe(outcome: Replay, setups: Sequence[Setup], wall_s: float, drives: Drives) -> str:
    """Return the outcome as text for people."""
    head = (
        f'{outcome.records} messages, {outcome.resistance.samples} samples over {outcome.duration_s:.1f} s, '
        f'replayed {_pace(outcome, wall_s)}'
    )
    contradiction = (outcome.contradiction.text,) if outcome.contradiction.finding else ()
    to_drive = (f'to learn more: {drive.text}' for drive in drives if drive is not None)
    parts = (head, *contradiction, _estimates(outcome), _usage(outcome), _uncertainty(outcome, setups), *to_drive)
    return '\n\n'.join(parts)


def _estimates(outcome: Replay) -> str:
    w = outcome.resistance.output.estimate
    rows = [('value', 'estimate', 'std', 'unit', 'status'), *_resistance_rows(outcome), *_other_rows(outcome)]
    shown = table(rows, numbers=(1, 2))
    seen = [f'* outside the speeds learned from, {w.speed_min:.1f} to {w.speed_max:.1f} m/s'] if '*' in shown else []
    converging = (
        f'{name} CONVERGING: {result.why_converging}'
        for name, result in _results(outcome).items()
        if result.why_converging
    )
    return '\n'.join((shown, *seen, *converging, *force_findings(w), *outcome.brake_findings))


def _results(outcome: Replay) -> dict[str, Result[Any]]:
    """Return the results by the names of the estimators for people."""
    return {
        'resistance': outcome.resistance, 'speed model': outcome.speed_model, 'brake rate': outcome.brake_rate
    }  # fmt: skip


def _resistance_rows(outcome: Replay) -> list[tuple[str, ...]]:
    w, status = outcome.resistance.output.estimate, outcome.resistance.output.status.name
    known = davis_rows((w.a, w.b, w.c), deviations(w.covariance))
    rows: list[tuple[str, ...]] = [(*row, status) for row in known]
    for v in (10.0, 15.0, 20.0):
        name = f'w at {v:g} m/s' + ('' if w.speed_min <= v <= w.speed_max else ' *')
        std = resistance_std(w.covariance, v)
        rows.append((name, f'{w.a + w.b * v + w.c * v * v:.4g}', f'{std:.2g}', 'N/kN', status))
    if not math.isnan(w.force_scale):
        rows.append(('force scale', f'{w.force_scale:.4f}', f'{w.force_scale_std:.2g}', '1 = as reported', status))
        rows.append(('force delay', f'{w.force_delay:.3f}', f'{w.force_delay_std:.2g}', 's', status))
    return rows


def _other_rows(outcome: Replay) -> list[tuple[str, ...]]:
    f, m = outcome.brake_rate.output.estimate, outcome.speed_model.output.estimate
    rate_status, model_status = outcome.brake_rate.output.status.name, outcome.speed_model.output.status.name
    known = quantities(SpeedModelEstimate)
    rate = ('brake rate', f'{f.brake_rate:.4g}', f'{f.brake_rate_std:.2g}', '1 = nominal', rate_status)
    names = parameters(SpeedModelEstimate)
    return [rate, *((name, f'{getattr(m, name):.6g}', '', known[name].unit, model_status) for name in names)]


def _usage(outcome: Replay) -> str:
    results = _results(outcome)
    counts: list[dict[Reason, int]] = [dict(result.rejections) for result in results.values()]
    reasons = sorted({reason for count in counts for reason in count})
    rows = [
        ('samples', *results),
        ('used', *(str(result.output.used) for result in results.values())),
        *((f'rejected: {reason.text}', *(str(count.get(reason, 0)) for count in counts)) for reason in reasons),
    ]
    return table(rows, numbers=(1, 2, 3))


def _uncertainty(outcome: Replay, setups: Sequence[Setup]) -> str:
    """Return the algorithms, the consistency of their uncertainty, and the observability of the resistance."""
    lines = [
        f'{name} by {setup.algorithm}: uncertainty {result.consistency}'
        for (name, result), setup in zip(_results(outcome).items(), setups, strict=True)
    ]
    w, prior = outcome.resistance.output.estimate, outcome.resistance.prior
    seen = observe(w.covariance, prior.covariance, w.speed_min, w.speed_max)
    shares = ', '.join(f'{name} {100.0 * share:.0f} %' for name, share in zip('abc', seen.shares, strict=True))
    return '\n'.join((*lines, f'{seen.text}; prior variance removed: {shares}'))


def _write_report(
    args: argparse.Namespace,
    bag: Path,
    outcome: Replay,
    recording: Recording,
    truth: Truth | None,
    how: str,
    path: Path,
) -> None:
    from trainid_ros.report.drive_report import Chapter, write_report  # noqa: PLC0415

    chapter = Chapter(
        title=bag.name,
        bag=str(bag),
        train_file_name=str(args.train),
        train_file=load_train_file(args.train),
        how=how,
        recording=recording,
        resistance=outcome.resistance.output,
        speed_model=outcome.speed_model.output,
        brake_rate=outcome.brake_rate.output,
        rejections={name: dict(result.rejections) for name, result in _results(outcome).items()},
        truth=truth,
    )
    write_report(f'trainid replay: {bag.name}', (chapter,), path)


def _pace(outcome: Replay, wall_s: float) -> str:
    speed = outcome.duration_s / wall_s if wall_s > 0.0 else math.nan
    return f'in {wall_s:.1f} s ({speed:.0f} x real time)'

# SPDX-License-Identifier: Apache-2.0
"""``trainid replay`` and ``view``: the estimators over bags, off line, printed or in the Rerun viewer."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.bag_replay import TABLE_SUFFIXES, Pipelines, estimate_table, replay_through
from trainid_ros.bag.reader import BagReader, in_two
from trainid_ros.cli import output
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import load_mapping
from trainid_ros.inspection.bag_info import brake_sign
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import MASS_TOPIC
from trainid_ros.interface.results import (
    AdhesionEstimate,
    Reason,
    SpeedModelEstimate,
    deviations,
    parameters,
    quantities,
)
from trainid_ros.interface.text import in_step, pluralise
from trainid_ros.report import HTML_START
from trainid_ros.report.verdict import Verdict, estimate_rows, judge, results_of
from trainid_ros.resistance.davis_posterior import observe
from trainid_ros.resistance.suggested_drive import SuggestedDrive, suggested_braking, suggested_drive
from trainid_ros.setup.checkpoint import SUFFIX, provenance_of, read_checkpoint
from trainid_ros.setup.params_file import Setup, mapping_in, node_setups
from trainid_ros.setup.pipelines import force_findings
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import Observer, Replay, Result
    from trainid_ros.report.recording import Recorder

Drives = tuple[SuggestedDrive | None, SuggestedDrive | None]
"""What to drive for a better resistance and a better brake rate; None where nothing is missing or would help."""


def _load_setups(
    args: argparse.Namespace, train: Path, warn: Callable[[str], None] = lambda _: None
) -> tuple[Setup, ...]:
    """Return the set-ups of the three nodes by a train file and the options; InputError if a file cannot be used."""
    foreign = () if args.map is None else load_mapping(args.map).topics
    train_file = load_train_file(train)
    return node_setups(
        train_file, str(train), args.params, args.algorithm, namespace=args.namespace, foreign=foreign, warn=warn
    )


def _start(
    args: argparse.Namespace, setups: Sequence[Setup], warn: Callable[[str], None]
) -> tuple[list[Setup], list[str]]:
    """Return set-ups and the states to start from, '' for the prior; with checkpoints also their alignment.

    InputError if there is no checkpoint in the folder given, or one does not fit.
    """
    started, states = list(setups), [''] * len(setups)
    for k, setup in enumerate(setups if args.checkpoint is not None else ()):
        path = args.checkpoint / f'{setup.kind.node_name}{SUFFIX}'
        if (checkpoint := read_checkpoint(path)) is None:
            warn(f'{path}: there is no checkpoint, so this estimator starts from the train file')
            continue
        # A recording of other topics was aligned as its mapping needs.
        started[k] = setup.aligned(checkpoint.provenance.values)
        here = provenance_of(setup.kind.name, setup.train_file, started[k].settings)
        if reason := checkpoint.provenance.mismatch(here):
            raise InputError(f'{path}: checkpoint {reason}')
        states[k] = checkpoint.state
    if args.checkpoint is not None and not any(states):
        raise InputError(f'{args.checkpoint}: there is no checkpoint such as {path.name}')
    return started, states


def _beside(bag: Path, name: str) -> Path:
    return (bag if bag.is_dir() else bag.parent) / name


def run(args: argparse.Namespace) -> int:
    """Replay bags and print what was identified."""
    args.map = args.map or mapping_in(args.params, args.namespace)
    # What cannot be used for any bag is reported once.
    setups, _ = _start(args, _load_setups(args, args.train), lambda _: None)
    mapped_inputs(args.map, setups[0].train_file)
    if len(args.bags) > 1:
        _check_outputs(args)
    for out, report in (_outputs(args, bag) for bag in args.bags):
        if report is not None:
            if out is not None and out.resolve() == report.resolve():
                raise InputError(f'{report}: is given for two outputs; choose another name for one of them')
            output.check_output(report, (args.train, args.params, args.truth, *args.bags), HTML_START)
    return output.run_per_bag(args, _replay, 'replay')


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
    return bag.resolve().name.removesuffix('.mcap').removesuffix('.db3')


def _outputs(args: argparse.Namespace, bag: Path) -> tuple[Path | None, Path | None]:
    """Return the paths of the new bag and of the report of a bag, None where it is not asked for."""
    if len(args.bags) == 1:
        return args.out, args.report
    out = None if args.out is None else args.out / _name(bag)
    return out, None if args.report is None else args.report / f'{_name(bag)}.html'


def _replay(args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> output.BagResult:
    warnings: list[str] = []
    setups, states = _start(args, _load_setups(args, args.train, warnings.append), warnings.append)
    out, report = _outputs(args, bag)
    truth = args.truth or _beside(bag, 'truth.yaml')
    known = load_truth(truth) if report is not None and (args.truth or truth.is_file()) else None
    with ExitStack() as stack:
        inputs = mapped_inputs(args.map, setups[0].train_file)
        opening, reading = in_two(advance)
        reader = stack.enter_context(BagReader(bag, args.namespace, args.max_chunk, inputs, opening=opening))
        observers, recorder = _observers(stack, out, report)
        start = time.perf_counter()
        pipelines = Pipelines.of_nodes(setups, reader.mapping, states)
        count = max(reader.input_count, 1)
        outcome = replay_through(pipelines, reader, lambda n: reading(n / count), observers)
        wall_s = time.perf_counter() - start
        share = setups[0].train_file.train.mass_std
        if share < 0.02 and reader.missing(MASS_TOPIC):  # a load that nobody weighs varies by more
            warnings.append(
                f'{MASS_TOPIC.name}: no messages, so train.mass_std = {share:g} must cover the load too: state at '
                'least 0.02 unless it never changes'
            )
        if Reason.OUT_OF_RANGE in dict(outcome.brake_rate.rejections) and (wrong := brake_sign(reader.tables())):
            warnings.append(reader.mapping.named(wrong))
    first = outcome.resistance
    drives: Drives = (None, None)
    if not pipelines.resistance.stream.finding:  # else it is the inputs that need a look
        drives = (
            suggested_drive(pipelines.resistance.estimator, setups[0].train_file, first.prior, first.output.estimate),
            suggested_braking(pipelines.brake_rate.estimator, setups[2].train_file, outcome.brake_rate.output.estimate),
        )
    verdict = judge(outcome, drives, str(bag), str(args.train), reader.mapping.named)
    if report is not None and recorder is not None:
        from trainid_ros.report.drive_report import Chapter, write_report  # noqa: PLC0415

        chapter = Chapter(
            bag.name,
            str(bag),
            str(args.train),
            load_train_file(args.train),
            f'off line {_pace(outcome, wall_s)}',
            recorder.finish(),
            first.output,
            outcome.speed_model.output,
            outcome.brake_rate.output,
            rejections={name: dict(result.rejections) for name, result in results_of(outcome).items()},
            truth=known,
            notes=tuple(reader.mapping.named(line) for line in (*_findings(outcome), *_to_drive(drives))),
            adhesion=outcome.adhesion,
            verdict=verdict,
            certainty=_uncertainty(outcome, setups),
        )
        write_report(f'trainid replay: {bag.name}', (chapter,), report)
    shown: Any
    if args.json:
        shown = to_json(outcome, setups, wall_s, drives, reader.mapping.named)
        shown['verdict'] = {'level': verdict.level.value, 'text': verdict.text}
    else:
        shown = reader.mapping.named(describe(outcome, setups, wall_s, drives, verdict))
        shown = f'{bag}: {shown}' if len(args.bags) > 1 else shown
    reason = outcome.why_no_resistance()
    return output.BagResult(shown, (*warnings, *reader.warnings), f'{bag}: {reason}' if reason else '')


def _observers(stack: ExitStack, out: Path | None, report: Path | None) -> tuple[list[Observer], Recorder | None]:
    """Return what writes the new bag or table and what collects the columns of the report, and the latter alone."""
    if out is None and report is None:
        return [], None
    from trainid_ros.bag.writer import BagWriter  # noqa: PLC0415
    from trainid_ros.report.recording import Recorder  # noqa: PLC0415

    recorder = None if report is None else Recorder()
    observers: list[Observer] = [] if recorder is None else [recorder]
    if out is not None and out.suffix in TABLE_SUFFIXES:
        observers.append(stack.enter_context(estimate_table(out)))
    elif out is not None:
        observers.append(stack.enter_context(BagWriter(out)))
    return observers, recorder


def to_json(
    outcome: Replay, setups: Sequence[Setup], wall_s: float, drives: Drives, named: Callable[[str], str]
) -> dict[str, Any]:
    """Return the object of ``--json``; counters at the top are those of the resistance."""
    resistance, model, brake = outcome.resistance, outcome.speed_model, outcome.brake_rate
    w = resistance.output.estimate
    body = {
        'samples': resistance.samples,
        'duration_s': outcome.duration_s,
        'used': resistance.output.used,
        'rejected': dict(resistance.rejections),
        'resistance': {
            **_parameters(w),
            'std': deviations(w.covariance),
            'status': resistance.output.status,
            'speed_range': [w.speed_min, w.speed_max] if w.speed_max > 0.0 else [None, None],
            **{name: _with_std(w, name) for name in ('force_scale', 'force_delay')},
            'findings': [*map(named, force_findings(w))],
            'why_converging': resistance.why_converging,
        },
        'speed_model': {**_parameters(model.output.estimate), **_state(model)},
        'brake_rate': {
            **_with_std(brake.output.estimate, 'brake_rate'),
            **_state(brake),
            'findings': list(outcome.brake_findings),
        },
        'adhesion': {
            **{name: getattr(outcome.adhesion.estimate, name) for name in quantities(AdhesionEstimate)},
            'status': outcome.adhesion.status,
        },
        'wheel_ratio': outcome.wheel_ratio and dict(zip(('value', 'std'), outcome.wheel_ratio, strict=True)),
        'input_finding': outcome.contradiction.finding,
        'input_finding_begin_s': outcome.contradiction.begin_s,
        'input_finding_end_s': outcome.contradiction.end_s,
        'inputs': list(outcome.contradiction.inputs),
        'holds_back': list(outcome.contradiction.holds_back),
        'suggested_drive': drives[0] and drives[0].numbers,
        'suggested_braking': drives[1] and drives[1].numbers,
        'algorithms': {setup.kind.name: setup.algorithm for setup in setups},
        'wall_s': wall_s,
    }
    plain: dict[str, Any] = output.to_plain(body)
    return plain


def _state(result: Result[Any]) -> dict[str, Any]:
    rejected, last = dict(result.rejections), result.output
    return {'status': last.status, 'used': last.used, 'rejected': rejected, 'why_converging': result.why_converging}


def _parameters(estimate: Any) -> dict[str, float]:
    return {name: getattr(estimate, name) for name in parameters(type(estimate))}


def _with_std(estimate: Any, name: str) -> dict[str, float]:
    return {'value': getattr(estimate, name), 'std': getattr(estimate, f'{name}_std')}


def describe(outcome: Replay, setups: Sequence[Setup], wall_s: float, drives: Drives, verdict: Verdict) -> str:
    """Return the outcome as text for people."""
    head = (
        f'{outcome.records} messages, {outcome.resistance.samples} samples over {outcome.duration_s:.1f} s, '
        f'replayed {_pace(outcome, wall_s)}'
    )
    certainty = '\n'.join(_uncertainty(outcome, setups))
    return '\n\n'.join((verdict.text, head, _estimates(outcome), _usage(outcome), certainty, *_to_drive(drives)))


def _estimates(outcome: Replay) -> str:
    model = outcome.speed_model.output
    rows: list[tuple[str, ...]] = [('value', 'estimate', 'std', 'unit', 'status')]
    rows += [
        (row.name, *in_step(row.value, row.std), row.unit, row.status)
        for row in estimate_rows(outcome.resistance.output, outcome.brake_rate.output, outcome.adhesion)
    ]
    if outcome.wheel_ratio is not None:
        rows.append(('wheel ratio', *in_step(*outcome.wheel_ratio), '1 = as by positions', ''))
    known = quantities(SpeedModelEstimate)
    for name, value in _parameters(model.estimate).items():
        rows.append((name, f'{value:.6g}', '', known[name].unit, model.status.name))
    shown, w = output.table(rows, numbers=(1, 2)), outcome.resistance.output.estimate
    seen = [f'* outside the speeds learned from, {w.speed_min:.1f} to {w.speed_max:.1f} m/s'] if '*' in shown else []
    return '\n'.join((shown, *seen, *_findings(outcome)))


def _findings(outcome: Replay) -> tuple[str, ...]:
    """Return why estimates are CONVERGING, and errors found in force and brake."""
    converging = (
        f'{name} CONVERGING: {result.why_converging}'
        for name, result in results_of(outcome).items()
        if result.why_converging
    )
    return (*converging, *outcome.findings)


def _to_drive(drives: Drives) -> list[str]:
    return [f'to learn more: {drive.text}' for drive in drives if drive is not None]


def _usage(outcome: Replay) -> str:
    results = results_of(outcome)
    counts: list[dict[Reason, int]] = [dict(result.rejections) for result in results.values()]
    reasons = sorted({reason for count in counts for reason in count})
    rows = [
        ('samples', *results),
        ('used', *(str(result.output.used) for result in results.values())),
        *((f'rejected: {reason.text}', *(str(count.get(reason, 0)) for count in counts)) for reason in reasons),
    ]
    return output.table(rows, numbers=(1, 2, 3))


def _uncertainty(outcome: Replay, setups: Sequence[Setup]) -> tuple[str, ...]:
    """Return the algorithms, the consistency of their uncertainty, and the observability of the resistance."""
    lines = [
        f'{name} by {setup.algorithm}: uncertainty {result.consistency}'
        for (name, result), setup in zip(results_of(outcome).items(), setups, strict=True)
    ]
    w, prior = outcome.resistance.output.estimate, outcome.resistance.prior
    seen = observe(w.covariance, prior.covariance, w.speed_min, w.speed_max)
    shares = ', '.join(f'{name} {100.0 * share:.0f} %' for name, share in zip('abc', seen.shares, strict=True))
    return (*lines, f'{seen.text}; prior variance removed: {shares}')


def _pace(outcome: Replay, wall_s: float) -> str:
    speed = outcome.duration_s / wall_s if wall_s > 0.0 else math.nan
    return f'in {wall_s:.1f} s ({speed:.0f} x real time)'


_ELSEWHERE: Final = 'give --out FILE.rrd, and open that where there is one'


def view(args: argparse.Namespace) -> int:
    """Replay a bag and write a recording or open it in the viewer."""
    if args.out is not None and args.out.suffix != '.rrd':
        raise InputError(f'{args.out}: the name of a recording must end in .rrd, or Rerun does not open it')
    args.map = args.map or mapping_in(args.params, args.namespace)
    from trainid_ros.report.recording import RRD_START, switch_off_telemetry  # noqa: PLC0415

    switch_off_telemetry()
    import rerun  # noqa: F401, PLC0415 - if it is missing, that is said before the replay

    train: Path = args.train or _beside(args.bag, 'train.yaml')
    if args.train is None and not args.bag.exists():
        raise InputError(f'{args.bag}: no such bag')
    if args.train is None and not train.is_file():
        raise InputError(f'{args.bag}: there is no {train.name} beside it: give --train T.yaml')
    if args.out is not None:
        output.check_output(args.out, (train, args.params, args.bag), RRD_START)
        _write_view(args, train, args.out)
        output.show(f'{args.out}: open it with: rerun {shlex.quote(str(args.out))}')
        return 0
    if not any(map(os.environ.get, ('DISPLAY', 'WAYLAND_DISPLAY'))):
        raise InputError(f'there is no display to open the viewer on: {_ELSEWHERE}')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f'{args.bag.resolve().stem}.rrd'
        _write_view(args, train, path)
        _open_viewer(path)
    return 0


def _open_viewer(path: Path) -> None:
    """Open a recording until the viewer is closed; InputError if it cannot run, as without an X server."""
    # Its server is for this machine alone.
    command = [sys.executable, '-m', 'rerun', '--bind', '127.0.0.1', '--port', 'auto', str(path)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors='replace', check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        reason = said[-1].rpartition(': ')[2].strip() if said else f'exit code {done.returncode}'
        raise InputError(f'the viewer cannot run on this display: {reason}; {_ELSEWHERE}')


def _write_view(args: argparse.Namespace, train: Path, out: Path) -> None:
    from trainid_ros.report.recording import ViewRecorder, write_recording  # noqa: PLC0415

    setups = _load_setups(args, train, output.warn)
    with output.opened(args, mapped_inputs(args.map, setups[0].train_file)) as reader:
        pipelines = Pipelines.of_nodes(setups, reader.mapping)
        recorder = ViewRecorder(pipelines)
        with output.progress(f'replaying {args.bag.name}', reader.input_count) as advance:
            replay_through(pipelines, reader, advance, (recorder,))
        for text in reader.warnings:
            output.warn(text)
    write_recording(recorder, args.bag.resolve().stem, out)

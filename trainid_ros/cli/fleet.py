# SPDX-License-Identifier: Apache-2.0
"""``trainid fleet``: replay the bags of a fleet into a table; ``trainid fleet report``: the trains that stand out."""

from __future__ import annotations

import shlex
from collections import Counter
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any

from trainid_ros.bag.worker_pool import processors
from trainid_ros.cli import output
from trainid_ros.cli.output import print_json, progress, show, warn
from trainid_ros.fleet import table_file as files
from trainid_ros.fleet.run_fleet import known_rows, prepared, rows_folder, rows_here, rows_on_cluster, run_plan
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_text
from trainid_ros.interface.text import pluralise
from trainid_ros.report import HTML_START
from trainid_ros.setup.params_file import mapping_in

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping
    from pathlib import Path

    from trainid_ros.fleet.analysis import CauseByBags, FleetView, TrainView
    from trainid_ros.fleet.changes import Change, Departure


def run(args: argparse.Namespace) -> int:
    """Replay all bags and write the table."""
    files.check_table(args.out)
    if args.out.exists() and not (files.plan_file(args.out).exists() or rows_folder(args.out).exists()):
        raise InputError(f'{args.out}: exists already, and no run of fleet has written it; choose another --out')
    plan = _plan(args)
    if not args.replace:
        _check_plan(plan, args.out)
    rows_folder(args.out).mkdir(parents=True, exist_ok=True)
    plan.write(files.plan_file(args.out))
    known = known_rows(plan, args.out)
    try:
        place = (
            nullcontext(partial(rows_here, args.jobs or processors()))
            if args.scheduler is None
            else rows_on_cluster(args.scheduler)
        )
        with progress('replay', total=len(plan.bags), unit='bags') as advance, place as rows:
            advance(len(known))
            table = run_plan(plan, args.out, known, rows, advance)
    except (KeyboardInterrupt, SystemExit):  # Ctrl-C, or SIGTERM
        done = len(files.read_table(args.out)[0])
        warn(f'stopped: {done} of {pluralise(len(plan.bags), "bag")} are in {args.out}; the same command goes on')
        raise
    return _report(args, table, len(known))


def _check_plan(plan: files.Plan, table: Path) -> None:
    """Raise InputError if a table is there whose rows would be lost or made in another way."""
    old = files.read_plan(table)
    bags = {bag['path'] for bag in old.get('bags', ())}
    if not table.exists() or not bags:
        return
    if lost := bags - {bag.path for bag in plan.bags}:
        problem = f'{len(lost)} of its {pluralise(len(bags), "bag")} are not given now, such as {min(lost)}'
    elif files.setup_of(old) != plan.setup:
        problem = 'it was made with another train file, mapping, parameter file, namespace or --max-chunk'
    else:
        return
    raise InputError(f'{table}: is the table of another plan: {problem}; choose another --out, or --replace it')


def _plan(args: argparse.Namespace) -> files.Plan:
    """Return the plan: all bags listed, none decoded."""
    rule = files.label_rule(args.label, args.namespace)
    # A report may be made from another folder.
    mapping = args.map or mapping_in(args.params, args.namespace)
    params, mapping = (path and path.absolute() for path in (args.params, mapping))
    setup = files.Setup(args.train.absolute(), params, mapping, args.namespace, args.max_chunk)
    prepared(setup)
    bags = files.find_bags(args.bags)
    with progress('list', total=len(bags), unit='bags') as advance:
        return files.make_plan(setup, files.list_bags(bags, rule, advance))


def _report(args: argparse.Namespace, table: list[files.Row], known: int) -> int:
    """Print a summary; return the exit code: failures are rows, so one estimate is enough for success."""
    errors = [row for row in table if row['error']]
    for row in errors[:3]:  # all are in the table
        warn(row['error'] if row['bag'] in row['error'] else f'{row["bag"]}: {row["error"]}', 'error')
    if len(errors) > 3:
        warn(f'{len(errors) - 3} more bags without an estimate, see the column error of {args.out}')
    summary: dict[str, Any] = {
        'out': args.out,
        'bags': len(table),
        'known': known,
        'errors': len(errors),
        'trains': len({row['train'] for row in table} - {None}),
        'days': len({row['day'] for row in table} - {None}),
        'statuses': Counter(row['status'] or 'NONE' for row in table),
    }
    if args.json:
        print_json(summary)
    else:
        counts = ', '.join(pluralise(summary[f'{word}s'], word) for word in ('bag', 'train', 'day'))
        more = ((known, 'replayed before'), (len(errors), 'without an estimate'))
        show('; '.join((f'{args.out}: {counts}', *(f'{count} {what}' for count, what in more if count))))
        if summary['days'] > 1:
            page = args.out.with_name('report.html')
            show(f'next: {shlex.join(("trainid", "fleet", "report", str(args.out), "--out", str(page)))}')
    if len(errors) < len(table):
        return 0
    return output.EXIT_BAD_INPUT if all(row['status'] is None for row in table) else output.EXIT_NO_ANSWER


def report(args: argparse.Namespace) -> int:
    """Analyse the tables, print what stands out, and write the report; NoAnswerError if the tables hold too little."""
    from trainid_ros.fleet.analysis import analyse, name_cause  # noqa: PLC0415 - with SciPy

    if args.out is not None:
        output.check_output(args.out, args.tables, HTML_START)
    runs = _read(args)
    view = analyse([run.row for run in runs], args.false_alarm_days)
    named = {}
    if worst := [train for train in view.found if train.main][: args.explain]:
        with progress('explain', total=len(worst), unit='trains') as advance:
            for train in worst:
                named[train.name] = name_cause(view, train, runs)
                advance(1.0)
    if args.out is not None:
        from trainid_ros.report.fleet_report import fleet_page  # noqa: PLC0415 - with matplotlib

        notes = {train.name: (_named_text(train, named[train.name]),) for train in view.found if train.name in named}
        write_text(fleet_page(view, ', '.join(map(str, args.tables)), args.false_alarm_days, notes), args.out)
    if args.json:
        print_json(to_json(view, args.false_alarm_days, named))
    else:
        show(describe(view, named))
        if args.out is not None:
            show(f'\nreport: {args.out}')
    return 0


def _read(args: argparse.Namespace) -> list[files.FleetRun]:
    """Return the rows of all tables, each train of a bag once, with how their table was made."""
    runs: dict[tuple[str, str, str], files.FleetRun] = {}
    for path in args.tables:
        rows, about = files.read_table(path)
        setup = files.setup_of(about) or files.setup_of(files.read_plan(path))
        namespace = '' if setup is None else setup.namespace.strip('/')
        runs |= {(row['bag'], row['train'], namespace): files.FleetRun(row, setup) for row in rows}
    return list(runs.values())


def _named_text(train: TrainView, cause: CauseByBags) -> str:
    """Return the cause by the bags of a train, and whether it agrees with that by its channels."""
    from trainid_ros.fleet.changes import OTHER  # noqa: PLC0415
    from trainid_ros.report.words import parameters_text  # noqa: PLC0415

    if cause.problem:
        return f'By its bags: no answer ({cause.problem}).'
    effects = [
        f'{effect.name} ({effect.title}) in {count} of {cause.bags}, with {parameters_text(effect)}'
        for effect, count in cause.effects
    ]
    # Several effects at once, or one that no channel shows alone, look like no single cause in the channels.
    is_unclear = bool(effects and train.causes) and train.causes[0].effect == OTHER
    more = ', which tell apart what the channels do not' if is_unclear else ''
    return f'By its bags{more}: {"; ".join(effects) or "no effect that is new"}.'


def describe(view: FleetView, named: Mapping[str, CauseByBags]) -> str:
    """Return the findings as text."""
    from trainid_ros.report.fleet_report import checks, findings, summary  # noqa: PLC0415

    blocks = [summary(view)]
    for train in view.found:
        lines = [*findings(view, train), *([_named_text(train, named[train.name])] if train.name in named else [])]
        lines += [f'In the depot: {check}' for check in checks(train)]
        blocks.append('\n'.join((f'{train.name} (evidence {train.evidence:.0f})', *(f'  {line}' for line in lines))))
    if view.hidden:
        blocks.append('\n'.join(('Not visible yet:', *(f'  {line}' for line in view.hidden))))
    return '\n\n'.join(blocks)


def to_json(view: FleetView, limit: float, named: Mapping[str, CauseByBags]) -> dict[str, Any]:
    """Return the object of ``--json``."""
    return {
        'trains': len(view.labels.trains),
        'days': view.labels.days,
        'false_alarm_days': limit,
        'channels': {
            v.channel.name: {'mean': v.fit.mean, 'std': v.fit.stds, 'degrees': v.fit.degrees} for v in view.channels
        },
        'contradicted': dict(view.contradicted),
        'not_visible': list(view.hidden),
        'found': [_train(view, train, named.get(train.name)) for train in view.found],
    }


def _train(view: FleetView, train: TrainView, cause: CauseByBags | None) -> dict[str, Any]:
    days, explained = view.labels.days, {}
    if cause is not None:
        effects = {effect.name: {'bags': count, **dict(effect.parameters)} for effect, count in cause.effects}
        explained = {'explained': {'bags': cause.bags, 'effects': effects, 'problem': cause.problem}}
    return {
        'train': train.name,
        'evidence': train.evidence,
        'changes': [{'day': days[change.day], **_step(view, change)} for change in train.changes],
        'departures': [
            {
                'day': days[departure.first],
                'last': None if departure.end is None else days[departure.end - 1],
                **_step(view, departure),
            }
            for departure in train.departures
        ],
        'outliers': {o.channel.name: {'size': o.size, 'std': o.std, 'sigmas': o.sigmas} for o in train.outliers},
        'causes': {found.title: found.probability for found in train.causes},
        'check': [found.check for found in train.causes],
        **explained,
    }


def _step(view: FleetView, found: Change | Departure) -> dict[str, Any]:
    """Return day of the alarm, evidence, and by channel the levels, the standard deviation of the step and evidence."""
    steps = {
        v.channel.name: step
        and {'before': step.before.mean, 'after': step.after.mean, 'std': step.std, 'evidence': step.evidence}
        for v, step in zip(view.channels, found.steps, strict=True)
    }
    return {'certain': view.labels.days[found.alarm], 'evidence': found.evidence, 'steps': steps}

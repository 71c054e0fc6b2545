# SPDX-License-Identifier: Apache-2.0
"""``trainid fleet``: replay the bags of a fleet into a table, one row per bag."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.worker_pool import processors
from trainid_ros.cli.output import EXIT_BAD_INPUT, EXIT_NO_ANSWER, print_json, progress, report_error, show, warn
from trainid_ros.fleet.plan import (
    Setup,
    find_bags,
    label_rule,
    list_bags,
    make_plan,
    plan_file,
    read_plan,
    setup_of,
)
from trainid_ros.fleet.run_fleet import check_setup, known_rows, rows_folder, rows_here, rows_on_cluster, run_plan
from trainid_ros.fleet.table_file import check_table, read_table
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.text import pluralise
from trainid_ros.setup.params_file import mapping_in

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator
    from pathlib import Path

    from trainid_ros.fleet.plan import Plan
    from trainid_ros.fleet.run_fleet import Rows
    from trainid_ros.fleet.table_file import Row

_NAMED_ERRORS: Final = 3  # Failures that are printed; all are in the table.


def run(args: argparse.Namespace) -> int:
    """Replay all bags and write the table; return the exit code.

    Raises:
        InputError: Train file, mapping, labels or bags cannot be used, or the table cannot be written.
    """
    check_table(args.out)
    if args.out.exists() and not (plan_file(args.out).exists() or rows_folder(args.out).exists()):
        raise InputError(f'{args.out}: exists already, and no run of fleet has written it; choose another --out')
    plan = _plan(args)
    if not args.replace:
        _check_plan(plan, args.out)
    rows_folder(args.out).mkdir(parents=True, exist_ok=True)
    plan.write(plan_file(args.out))
    known = known_rows(plan, args.out)
    try:
        with progress('replay', total=len(plan.bags), unit='bags') as advance, _rows(args) as rows:
            advance(len(known))
            table = run_plan(plan, args.out, known, rows, advance)
    except (KeyboardInterrupt, SystemExit):  # Ctrl-C, or SIGTERM
        done = len(read_table(args.out)[0])
        warn(f'stopped: {done} of {pluralise(len(plan.bags), "bag")} are in {args.out}; the same command goes on')
        raise
    return _report(args, table, len(known))


def _check_plan(plan: Plan, table: Path) -> None:
    """Raise InputError if a table is there whose rows would be lost or made in another way."""
    old = read_plan(table)
    bags = {bag['path'] for bag in old.get('bags', ())}
    if not table.exists() or not bags:
        return
    if lost := bags - {bag.path for bag in plan.bags}:
        problem = f'{len(lost)} of its {pluralise(len(bags), "bag")} are not given now, such as {min(lost)}'
    elif setup_of(old) != plan.setup:
        problem = 'it was made with another train file, mapping, parameter file, namespace or --max-chunk'
    else:
        return
    raise InputError(f'{table}: is the table of another plan: {problem}; choose another --out, or --replace it')


def _plan(args: argparse.Namespace) -> Plan:
    """Return the plan: all bags listed, none decoded.

    Raises:
        InputError: Train file, mapping, labels or bags cannot be used.
    """
    rule = label_rule(args.label, args.namespace)
    # A report may be made from another folder.
    mapping = args.map or mapping_in(args.params, args.namespace)
    params, mapping = (path and path.absolute() for path in (args.params, mapping))
    setup = Setup(args.train.absolute(), params, mapping, args.namespace, args.max_chunk)
    check_setup(setup)
    bags = find_bags(args.bags)
    with progress('list', total=len(bags), unit='bags') as advance:
        return make_plan(setup, list_bags(bags, rule, advance))


@contextmanager
def _rows(args: argparse.Namespace) -> Iterator[Rows]:
    """Yield what replays bags, here or on a cluster."""
    if args.scheduler is None:
        yield rows_here(args.jobs or processors())
        return
    with rows_on_cluster(args.scheduler) as rows:
        yield rows


def _report(args: argparse.Namespace, table: list[Row], known: int) -> int:
    """Print a summary; return the exit code: failures are rows, so one estimate is enough for success."""
    errors = [row for row in table if row['error']]
    for row in errors[:_NAMED_ERRORS]:
        report_error(row['error'] if row['bag'] in row['error'] else f'{row["bag"]}: {row["error"]}')
    if len(errors) > _NAMED_ERRORS:
        warn(f'{len(errors) - _NAMED_ERRORS} more bags without an estimate, see the column error of {args.out}')
    summary = {
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
        show(_text(summary))
    if len(errors) < len(table):
        return 0
    return EXIT_BAD_INPUT if all(row['status'] is None for row in table) else EXIT_NO_ANSWER


def _text(summary: dict[str, Any]) -> str:
    counts = (pluralise(summary[f'{word}s'], word) for word in ('bag', 'train', 'day'))
    more = ((summary['known'], 'replayed before'), (summary['errors'], 'without an estimate'))
    return '; '.join((f'{summary["out"]}: {", ".join(counts)}', *(f'{count} {what}' for count, what in more if count)))

# SPDX-License-Identifier: Apache-2.0
"""``trainid demo``: play bags through the live nodes and find a hidden effect."""

from __future__ import annotations

import signal
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, NoReturn

from trainid_ros.cli.arguments import DEMO_QUICK_S, EXPLAIN_CHAPTER
from trainid_ros.cli.output import prepare_page, print_json, progress, show
from trainid_ros.demo.bags import STOCK, load_demo_bag, stock_bag

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from trainid_ros.demo.bags import DemoBag
    from trainid_ros.demo.comparison import ComparisonOutcome
    from trainid_ros.demo.hidden import HiddenCase
    from trainid_ros.demo.view import View
    from trainid_ros.report.chapter import AccuracyScore

_CHECK_FAILED: Final = 1


def run(args: argparse.Namespace) -> int:
    """Run the demo; return 0 only if live estimates equal the replayed ones and the effect was found.

    Raises:
        InputError: A bag, a train file or the output folder cannot be used.
        NoAnswerError: A process failed.
    """
    # Imported here so that the help needs neither ROS nor matplotlib.
    from rich.console import Console  # noqa: PLC0415

    # Before anything starts: the optional packages for bags may be missing.
    import trainid_ros.bag.reader  # noqa: PLC0415
    import trainid_ros.bag.writer  # noqa: F401, PLC0415
    from trainid_ros.demo.view import View  # noqa: PLC0415

    bags = _bags(args)
    start = time.monotonic()
    view = View(Console(stderr=args.json))
    report = _prepare(bags, args)
    with _interruptible():
        outcomes = [] if report is None else _live(bags, args, view, report)
        hidden = _hidden(args, view)
    wall_s = time.monotonic() - start
    worked = all(one.worked for one in (*outcomes, hidden) if one is not None)
    if args.json:
        print_json(_to_json(outcomes, hidden, report, wall_s) | {'worked': worked})
    else:
        show(summary(outcomes, hidden))
        show(f'\nreport: {report}' if report else '')
        print(f'{wall_s:.0f} s in total; {"all checks passed" if worked else "NOT all checks passed, see above"}')
    return 0 if worked else _CHECK_FAILED


def _bags(args: argparse.Namespace) -> list[DemoBag]:
    names = (args.only,) if args.only else tuple(STOCK)
    return [load_demo_bag(path) for path in args.bag or (stock_bag(name) for name in names if name in STOCK)]


def _prepare(bags: Sequence[DemoBag], args: argparse.Namespace) -> Path | None:
    """Create the folders of all chapters, before any of them runs; return the path of the report on bags.

    Raises:
        InputError: A folder cannot be used, or a file of somebody else would be overwritten.
    """
    from trainid_ros.demo.hidden import prepare_hidden  # noqa: PLC0415

    report = prepare_page(args.out / 'report.html') if bags else None
    if _is_played(EXPLAIN_CHAPTER, args):
        prepare_hidden(args.out / EXPLAIN_CHAPTER)
    return report


def _is_played(chapter: str, args: argparse.Namespace) -> bool:
    return not args.bag and args.only in (None, chapter)


def _live(bags: Sequence[DemoBag], args: argparse.Namespace, view: View, report: Path) -> list[ComparisonOutcome]:
    """Play all bags through the live nodes and write the report."""
    from trainid_ros.demo.processes import isolate  # noqa: PLC0415
    from trainid_ros.report.drive_report import write_report  # noqa: PLC0415

    logs: Path = args.out / 'log'
    logs.mkdir(parents=True, exist_ok=True)
    domain = isolate(logs)
    view.say(f'ROS 2 domain {domain}, logs in {logs}')
    outcomes = [_play(bag, args, logs, view) for bag in bags]
    write_report('trainid demo', [outcome.chapter for outcome in outcomes], report)
    return outcomes


def _hidden(args: argparse.Namespace, view: View) -> HiddenCase | None:
    """Hide an effect and find it, unless only bags are to be played."""
    if not _is_played(EXPLAIN_CHAPTER, args):
        return None
    from trainid_ros.demo.hidden import play_hidden  # noqa: PLC0415

    return play_hidden(args.out / EXPLAIN_CHAPTER, view.say)


def _play(bag: DemoBag, args: argparse.Namespace, logs: Path, view: View) -> ComparisonOutcome:
    from trainid_ros.demo.comparison import conclude, describe_comparison  # noqa: PLC0415
    from trainid_ros.demo.live import run_live  # noqa: PLC0415

    duration_s = DEMO_QUICK_S if args.quick else 0.0
    folder = logs / bag.path.name
    folder.mkdir(exist_ok=True)
    view.say(f'\n{bag.title}: {bag.path} at {args.rate:g} x real time')
    with view:
        live = run_live(bag, args.rate, duration_s, folder, view)
    view.say('replaying the same bag off line for comparison')
    with progress('replay') as advance:
        outcome = conclude(bag, live, duration_s, advance)
    for label, comparison in outcome.comparisons:
        view.say(describe_comparison(label, comparison))
    return outcome


def summary(outcomes: Sequence[ComparisonOutcome], hidden: HiddenCase | None = None) -> str:
    """Return the results as lines of text."""
    chapters = [(outcome.chapter.title, _outcome_lines(outcome)) for outcome in outcomes]
    if hidden is not None:
        from trainid_ros.demo.hidden import describe_hidden  # noqa: PLC0415

        chapters.append(('Effect missing from the train file', describe_hidden(hidden).split('\n')))
    return '\n'.join(text for title, lines in chapters for text in ('', title, *(f'  {x}'.rstrip() for x in lines)))


def _outcome_lines(outcome: ComparisonOutcome) -> list[str]:
    chapter = outcome.chapter
    w, f = chapter.resistance, chapter.brake_rate
    return [
        f'{chapter.recording.duration_s / 60.0:.0f} min of driving, {chapter.how}',
        f'w(v) = {w.estimate.a:.3f} + {w.estimate.b:.4f} v + {w.estimate.c:.5f} v² N/kN, '
        f'{w.status.name}, {w.used} samples used, {w.rejected} rejected',
        f'brake rate {f.estimate.brake_rate:.3f} ± {f.estimate.brake_rate_std:.3f}, {f.status.name}',
        *_score_lines('w at the current speed', 'N/kN', outcome.resistance),
        *_score_lines('brake rate', '', outcome.brake_rate),
        *chapter.notes,
    ]


def _score_lines(name: str, unit: str, score: AccuracyScore | None) -> list[str]:
    if score is None:
        return []
    return [
        f'{name}, error against truth: rms {score.rms:.3f} {unit}'.rstrip()
        + f', mean {score.bias:+.3f}, last {score.last:+.3f}; truth within ±1 std {score.inside_68:.0%}, '
        f'within ±1.96 std {score.inside_95:.0%} of the time'
    ]


def _to_json(
    outcomes: Sequence[ComparisonOutcome],
    hidden: HiddenCase | None,
    report: Path | None,
    wall_s: float,
) -> dict[str, Any]:
    return {
        'report': report,
        'wall_s': wall_s,
        'bags': [
            {
                'bag': outcome.chapter.bag,
                'duration_s': outcome.chapter.recording.duration_s,
                'rate': outcome.rate,
                'resistance': outcome.chapter.resistance,
                'speed_model': outcome.chapter.speed_model,
                'brake_rate': outcome.chapter.brake_rate,
                'scores': {'resistance': outcome.resistance, 'brake_rate': outcome.brake_rate},
                'live_against_replay': dict(outcome.comparisons),
            }
            for outcome in outcomes
        ],
        'explain': _hidden_to_json(hidden),
    }


def _hidden_to_json(hidden: HiddenCase | None) -> dict[str, Any] | None:
    if hidden is None:
        return None
    from trainid_ros.demo.hidden import hidden_to_json  # noqa: PLC0415

    return hidden_to_json(hidden)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Handle termination signals like Ctrl-C, so that child processes are stopped.

    A signal during a call into ROS can surface as a RuntimeError of that call; it still counts as an interruption.
    """
    received: list[int] = []

    def interrupt(number: int, _frame: object) -> NoReturn:
        received.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)
    try:
        yield
    except RuntimeError:
        if received:
            raise KeyboardInterrupt from None
        raise

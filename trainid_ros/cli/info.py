# SPDX-License-Identifier: Apache-2.0
"""``trainid info``: what is in bags and whether they can be used."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from trainid_ros.bag.reader import NAMESPACE
from trainid_ros.cli.output import BagResult, run_per_bag, table, to_plain
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inspection.bag_info import BagInfo, TopicInfo, inspect
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, REQUIRED_TOPICS
from trainid_ros.interface.text import pluralise
from trainid_ros.train.train_file import TrainFile, load_train_file


def run(args: argparse.Namespace) -> int:
    """Print the contents of bags, or a mapping for one."""
    mapped_inputs(args.map, _train_file(args))  # what cannot be used for any bag is reported once
    if not args.suggest_map:
        return run_per_bag(args, _inspect, 'read')
    if len(args.bags) > 1 or args.map is not None:
        raise InputError('--suggest-map takes one bag, and no --map')
    return run_per_bag(args, _suggest, 'read')


def _train_file(args: argparse.Namespace) -> TrainFile | None:
    return None if args.train is None else load_train_file(args.train)


def _suggest(args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> BagResult:
    """Return a mapping for one bag; InputError if it cannot be read, or holds several trains."""
    from trainid_ros.inspection.number_series import read_numbers  # noqa: PLC0415
    from trainid_ros.inspection.suggest import suggest  # noqa: PLC0415 - loads much that only this needs
    from trainid_ros.inspection.suggest_speed import trains_in  # noqa: PLC0415

    numbers = read_numbers(bag, args.namespace, args.max_chunk, advance)
    if trains := trains_in(numbers.series):
        count = 'two' if len(trains) == 2 else len(trains)
        base = args.namespace.strip('/')
        names = (f'/{base}/{name}' if base else name for name in trains)
        raise InputError(f'{bag}: {count} trains here: {", ".join(names)}; use --namespace')
    suggestion = suggest(numbers, bag.name, _train_file(args))
    text, missing = suggestion.text(), suggestion.missing
    if missing and numbers.trains and not numbers.own:
        own = ', '.join(numbers.trains)
        raise InputError(f'{bag}: our own topics are in {own}: no mapping is needed, use --namespace')
    error = f'{bag}: nothing found for {", ".join(missing)}' if missing else ''
    return BagResult({'mapping': text, 'missing': list(missing)} if args.json else text, error=error)


def _inspect(args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> BagResult:
    train_file = _train_file(args)
    info = inspect(bag, args.namespace, args.max_chunk, mapped_inputs(args.map, train_file), train_file, advance)
    shown = to_plain(info) | {'usable': info.usable} if args.json else describe(info)
    error = '' if info.usable else f'{info.path}: cannot be used: {"; ".join(info.problems)}'
    if args.map is None and len(info.missing) == len(REQUIRED_TOPICS):  # a bag of others
        error += '' if NAMESPACE in error else '; --suggest-map proposes a mapping'
    return BagResult(shown, error=error)


def describe(info: BagInfo) -> str:
    """Return the contents of a bag as text, whether it can be used first."""
    care = f'with care, see the {pluralise(len(info.warnings), "warning")} below' if info.warnings else ''
    verdict = f'usable {care}'.rstrip() if info.usable else 'not usable'
    blocks = [
        f'{info.path}: {verdict}; {info.messages} messages in {info.duration_s:.1f} s',
        table([_HEADINGS, *(_topic_row(topic) for topic in info.topics)], numbers=range(2, 10)),
    ]
    if info.ranges:
        heads = ('value', 'minimum', 'maximum', 'unit')
        rows = [(f'{r.topic} {r.field}', f'{r.low:.6g}', f'{r.high:.6g}', r.unit) for r in info.ranges]
        blocks.append(table([heads, *rows], numbers=(1, 2)))
        blocks.append(f'moving {_percent(info.moving_share)}, braking {_percent(info.braking_share)} of the time')
    if starts := [topic.stamps.first_ns for topic in info.topics if topic.stamps and topic.stamps.first_ns]:
        blocks.append(f'first stamp {datetime.fromtimestamp(min(starts) / NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC')
    blocks += [f'warning: {line}' for line in info.warnings]
    return '\n\n'.join(blocks[:3]) + '\n' + '\n'.join(blocks[3:])


_HEADINGS = ['topic', 'type', 'count', 'rate Hz', 'gaps', 'late', 'duplicate', 'zero', 'not finite', 'log - stamp s']


def _topic_row(topic: TopicInfo) -> tuple[str, ...]:
    head = (topic.name, topic.type, str(topic.count))
    if (stamps := topic.stamps) is None:
        return (*head, *('',) * (len(_HEADINGS) - len(head)))
    counts = (stamps.gaps, stamps.out_of_order, stamps.duplicates, stamps.zero, topic.not_finite)
    rate = '' if math.isnan(stamps.rate) else f'{stamps.rate:.3g}'
    return (*head, rate, *(str(count) for count in counts), f'{stamps.log_offset_s:.3f}')


def _percent(share: float) -> str:
    return 'unknown' if math.isnan(share) else f'{share:.0%}'

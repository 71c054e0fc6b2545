# SPDX-License-Identifier: Apache-2.0
"""``trainid explain --watch``: explain the bags of folders again whenever one is added, and tell only what is new."""

from __future__ import annotations

import time
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final, NoReturn

from trainid_ros.bag.bag_files import bags_below
from trainid_ros.bag.run_reader import survey
from trainid_ros.cli import explain
from trainid_ros.cli.output import print_json, show, warn
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.text import pluralise
from trainid_ros.report import words
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence
    from pathlib import Path

    from trainid_ros.explain.result import Explanation, FoundEffect
    from trainid_ros.train.train_file import TrainFile

_PERIOD_S: Final = 5.0  # Between two looks at the folders; a bag whose size has not changed in between is complete [s]
_NEWS_STD: Final = 2.0  # Change of a parameter that is news [standard deviations, of both estimates together]


def run(args: argparse.Namespace) -> int:
    """Explain bags once, or with ``--watch`` whenever one is added."""
    return watch(args) if args.watch else explain.run(args)


def watch(args: argparse.Namespace) -> NoReturn:
    """Explain and tell news until interrupted; InputError if there is no folder, or an option that writes files."""
    train_file = load_train_file(args.train)
    if args.out is not None or args.propose is not None:
        raise InputError('--watch writes no files; give --out or --propose without it')
    before: Explanation | None = None
    explained: dict[Path, int] = {}
    sizes: dict[Path, int] = {}
    while True:
        for folder in args.bags:
            if not folder.is_dir():
                raise InputError(f'{folder}: is no folder to watch')
        last, sizes = sizes, _sizes(args.bags)
        complete = {bag: size for bag, size in sizes.items() if last.get(bag) == size}
        if complete and complete != explained:
            explained = complete
            before = _tell(args, sorted(complete), train_file, before)
        time.sleep(_PERIOD_S)


def _sizes(folders: Sequence[Path]) -> dict[Path, int]:
    """Return all bags in folders with their size [bytes], but those that have just been removed."""
    found = {}
    for bag in chain.from_iterable(bags_below(folder) for folder in folders):
        with suppress(OSError):
            found[bag] = sum(file.stat().st_size for file in (bag.rglob('*') if bag.is_dir() else [bag]))
    return found


def _tell(
    args: argparse.Namespace, bags: Sequence[Path], train_file: TrainFile, before: Explanation | None
) -> Explanation | None:
    """Explain bags and print what is new; return the explanation, the one before if the bags give none.

    Those that cannot be read are left out, each with a warning.
    """
    usable, inputs = [], mapped_inputs(args.map, train_file)
    for bag in bags:
        try:
            survey([bag], args.namespace, args.max_chunk, inputs)
            usable.append(bag)
        except InputError as error:
            warn(error)
    if not usable:
        return before
    try:
        now = explain.explain_bags(args, usable, train_file, [])
    except (InputError, NoAnswerError) as error:  # a bag may be mended or removed
        warn(error, 'error')
        return before
    if found := news(before, now):
        if args.json:
            print_json({'bags': [str(bag) for bag in usable], 'news': found, **explain.to_json(now)})
        else:
            show('\n  '.join((f'{pluralise(len(usable), "bag")}: {found[0]}', *found[1:])))
    return now


def news(before: Explanation | None, now: Explanation) -> list[str]:
    """Return as sentences what an explanation says that the one before did not."""
    if before is None or before.verdict is not now.verdict:
        head = f'{now.verdict.value.upper()}: {words.headline(now)}'
        return [head, *(f'{effect.name}: {words.parameters_text(effect)}' for effect in now.effects)]
    old, new = ({effect.name: effect for effect in one.effects} for one in (before, now))
    found = [f'{name} is no longer found.' for name in old if name not in new]
    for name, effect in new.items():
        if name not in old:
            found.append(f'New: {name}, {words.parameters_text(effect)}.')
        elif _has_moved(old[name], effect):
            found.append(f'{name} is now {words.parameters_text(effect)}, before {words.parameters_text(old[name])}.')
    return found


def _has_moved(old: FoundEffect, new: FoundEffect) -> bool:
    """Return whether a parameter has changed by more than its uncertainty before and now."""
    values, before, now = dict(old.parameters), dict(old.std), dict(new.std)
    return any(
        abs(value - values[name]) > _NEWS_STD * (before[name] ** 2 + now[name] ** 2) ** 0.5
        for name, value in new.parameters
    )

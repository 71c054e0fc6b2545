# SPDX-License-Identifier: Apache-2.0
"""What verbs that read bags share: the set-up of the nodes, opening a bag, the same work on each of several bags."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.worker_pool import killed_message, map_bags, processors
from trainid_ros.cli.output import EXIT_BAD_INPUT, EXIT_NO_ANSWER, print_json, progress, report_error, show, warn
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import ResistanceEstimate, quantities
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.setup.params_file import Setup

    Work = Callable[[argparse.Namespace, Path, Callable[[float], None]], 'BagResult']


def load_setups(
    args: argparse.Namespace, train: Path, warn: Callable[[str], None] = lambda _: None
) -> tuple[Setup, ...]:
    """Return the set-ups of the three nodes by a train file and the options; InputError if a file cannot be used."""
    from trainid_ros.setup.params_file import node_setups  # noqa: PLC0415

    foreign = () if args.map is None else load_mapping(args.map).topics
    train_file = load_train_file(train)
    return node_setups(
        train_file, str(train), args.params, args.algorithm, namespace=args.namespace, foreign=foreign, warn=warn
    )


@contextmanager
def opened(
    args: argparse.Namespace, inputs: Callable[[], MappedInputs] | None = None, mapping: Mapping = OWN
) -> Iterator[BagReader]:
    """Open ``args.bag``, with a progress bar as one without an index is read as a whole; see :class:`BagReader`."""
    with ExitStack() as stack:
        with progress(f'open {args.bag.name}', 1.0) as advance:
            reader = BagReader(args.bag, args.namespace, args.max_chunk, inputs, mapping=mapping, opening=advance)
            stack.enter_context(reader)
        yield reader


def beside(bag: Path, name: str) -> Path:
    """Return the path of a file in the folder of a bag."""
    return (bag if bag.is_dir() else bag.parent) / name


@dataclass(frozen=True, slots=True)
class BagResult:
    """What a command says of one bag."""

    shown: Any  # JSON object with ``--json``, else text; None if the bag could not be used
    warnings: tuple[str, ...] = ()  # Faults that do not prevent an answer
    error: str = ''  # Why there is no answer, '' if there is one


def run_per_bag(args: argparse.Namespace, work: Work, text: str) -> int:
    """Do the work for each of ``args.bags``, ``args.jobs`` at once, print the results and return the exit code.

    Args:
        args: Arguments of the command, with ``bags``, ``jobs`` and ``json``.
        work: Function of a module: gets the arguments, a bag, and a function to call with the share done since its last
            call. InputError and OSError are reported as errors of the bag.
        text: What is being done.
    """
    bags: Sequence[Path] = args.bags
    name = bags[0].name if len(bags) == 1 else f'{len(bags)} bags'
    with progress(f'{text} {name}', total=len(bags)) as advance:
        results = map_bags(
            partial(_attempt, work, args), bags, args.jobs or processors(), advance,
            killed=lambda bag: BagResult(None, error=killed_message(bag)),
        )  # fmt: skip
    for line in dict.fromkeys(line for result in results for line in result.warnings):
        warn(line)
    shown = [result.shown for result in results if result.shown is not None]
    if len(bags) > 1 and args.json:
        answers = zip(bags, results, strict=True)
        print_json(
            [{'bag': bag, **(one.shown or {}), **({'error': one.error} if one.error else {})} for bag, one in answers]
        )
    elif shown and args.json:
        print_json(shown[0])
    elif shown:
        show('\n\n'.join(map(str, shown)))
    failed = [result for result in results if result.error]
    for result in failed:
        report_error(result.error)
    return max((EXIT_BAD_INPUT if result.shown is None else EXIT_NO_ANSWER for result in failed), default=0)


def _attempt(work: Work, args: argparse.Namespace, bag: Path, advance: Callable[[float], None]) -> BagResult:
    try:
        return work(args, bag, advance)
    except InputError as error:
        return BagResult(None, error=str(error))
    except OSError as error:
        return BagResult(None, error=f'{error.filename or bag}: {error.strerror}')


def davis_rows(values: Sequence[float], stds: Sequence[float]) -> list[tuple[str, str, str, str]]:
    """Return a row of text for each Davis parameter: name, value, standard deviation, unit."""
    known = quantities(ResistanceEstimate)
    return [
        (name, f'{value:.5g}', f'{std:.2g}', known[name].unit)
        for name, value, std in zip('abc', values, stds, strict=True)
    ]

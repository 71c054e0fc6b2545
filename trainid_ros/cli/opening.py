# SPDX-License-Identifier: Apache-2.0
"""What commands that replay have in common: the set-up of the nodes, and the bag.

It is opened with a progress bar: one without an index is read as a whole for that.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.output import progress
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.setup.params_file import Setup, node_setups
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping


def load_setups(
    args: argparse.Namespace, train: Path, warn: Callable[[str], None] = lambda _: None
) -> tuple[Setup, ...]:
    """Return the set-ups of the three nodes, by a train file and ``params``, ``algorithm``, ``map`` and ``namespace``.

    Raises:
        InputError: Train file, mapping or parameters cannot be used.
    """
    foreign = () if args.map is None else load_mapping(args.map).topics
    train_file = load_train_file(train)
    return node_setups(
        train_file, str(train), args.params, args.algorithm, namespace=args.namespace, foreign=foreign, warn=warn
    )


@contextmanager
def opened(
    args: argparse.Namespace, inputs: Callable[[], MappedInputs] | None = None, mapping: Mapping = OWN
) -> Iterator[BagReader]:
    """Open ``args.bag``; the other arguments are those of :class:`BagReader`.

    Raises:
        InputError: If the bag cannot be read.
    """
    with ExitStack() as stack:
        with progress(f'open {args.bag.name}', 1.0) as advance:
            reader = BagReader(args.bag, args.namespace, args.max_chunk, inputs, mapping=mapping, opening=advance)
            stack.enter_context(reader)
        yield reader

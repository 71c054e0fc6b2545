# SPDX-License-Identifier: Apache-2.0
"""Open the bag of a command with a progress bar: one without an index is read as a whole for that."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.output import progress
from trainid_ros.mapping.mapping import OWN

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

    from trainid_ros.mapping.mapped_inputs import MappedInputs
    from trainid_ros.mapping.mapping import Mapping


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

# SPDX-License-Identifier: Apache-2.0
"""Algorithms of other distributions, found through entry points of the group ``trainid_ros.algorithms``.

The name of an entry point is that of the job (``resistance``, ``speed_model`` or ``brake_rate``), its object a tuple
of :class:`Algorithm`. Reading the entry points takes 40 ms, so nothing here runs until a name is not built in.
"""

from __future__ import annotations

from typing import Final

from trainid_ros.errors import InputError

GROUP: Final = 'trainid_ros.algorithms'


def plugged_in(job: str) -> tuple[tuple[str, object], ...]:
    """Return the objects of all entry points for a job, each with a text that names the entry point.

    Raises:
        InputError: One of them cannot be imported.

    """
    # Imported here because start-up must not pay for it.
    from importlib.metadata import entry_points  # noqa: PLC0415

    found = []
    for entry in entry_points(group=GROUP, name=job):
        source = f'plug-in {entry.dist.name if entry.dist else "?"} ({entry.name} = {entry.value})'
        try:
            found.append((source, entry.load()))
        except Exception as error:  # whatever its code raises
            msg = f'{source} cannot be loaded: {type(error).__name__}: {error}'
            raise InputError(msg) from error
    return tuple(found)

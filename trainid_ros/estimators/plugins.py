# SPDX-License-Identifier: Apache-2.0
"""Algorithms of other distributions, found through entry points of the group ``trainid_ros.algorithms``.

The name of an entry point is that of the job (``resistance``, ``speed_model`` or ``brake_rate``), its object a tuple
of :class:`Algorithm`. Reading the entry points takes 40 ms, so nothing here runs until a name is not built in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = 'trainid_ros.algorithms'


@dataclass(frozen=True, slots=True)
class PlugIn:
    """An entry point."""

    entry: EntryPoint

    def __str__(self) -> str:
        """Return the names of its distribution, of the job and of its object."""
        entry = self.entry
        return f'plug-in {entry.dist.name if entry.dist else "?"} ({entry.name} = {entry.value})'

    def load(self) -> object:
        """Return its object; InputError if that cannot be imported."""
        try:
            return self.entry.load()
        except Exception as error:  # whatever its code raises
            msg = f'{self} cannot be loaded: {type(error).__name__}: {error}'
            raise InputError(msg) from error


def plugged_in(job: str) -> tuple[PlugIn, ...]:
    """Return the plug-ins for a job."""
    # Imported here because start-up must not pay for it.
    from importlib.metadata import entry_points  # noqa: PLC0415

    return tuple(map(PlugIn, entry_points(group=GROUP, name=job)))

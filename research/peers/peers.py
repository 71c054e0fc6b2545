# SPDX-License-Identifier: Apache-2.0
"""Other libraries compared with ours on the same data in one run: CPU time, accuracy, memory, saving.

Libraries come from `.venv-peers` (``make research-peers``); without it only our estimators and the hand-written ones
run, and the tables say so.
"""

from __future__ import annotations

import sys
from typing import Final

from benchmarks.tables import Plot, Table
from research.peers import peer_brake, peer_fits, peer_stream
from research.peers.contest import PEERS

_PARTS: Final = (peer_stream.measure, peer_fits.measure, peer_brake.measure, peer_fits.measure_costs)


def measure(seeds: int) -> list[Table | Plot]:
    """Return the tables of all comparisons; slow parts use fewer than ``seeds`` seeds."""
    if PEERS.is_dir() and str(PEERS) not in sys.path:
        # Appended last, so that packages of .venv have priority; child processes inherit the path.
        sys.path.append(str(PEERS))
    return [table for part in _PARTS for table in part(seeds)]

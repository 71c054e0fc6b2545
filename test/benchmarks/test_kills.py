# SPDX-License-Identifier: Apache-2.0
"""One kill of the live nodes and one clean stop: the benchmark does 200."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.kills import Campaign
from trainid_ros.setup.checkpoint import parse_checkpoint
from trainid_ros.setup.pipelines import KINDS


@pytest.mark.ros
def test_after_a_kill_and_a_sigterm_there_is_one_complete_file_for_each_node(tmp_path: Path) -> None:
    outcome = Campaign(tmp_path).run(1)
    assert (outcome.kills, outcome.torn, outcome.rejected, outcome.backward, outcome.unsaved) == (1, 0, 0, 0, 0)
    assert (outcome.strays, outcome.lost_at_stop) == (set(), 0)
    # Generous: a busy machine may stop the writer for seconds.
    assert max(outcome.age_s, default=0.0) < 20.0
    for kind in KINDS:
        path = tmp_path / 'states' / f'{kind.node_name}.json'
        assert parse_checkpoint(path.read_text(encoding='utf-8'), str(path)).stamp_ns > 0

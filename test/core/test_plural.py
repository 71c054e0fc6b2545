# SPDX-License-Identifier: Apache-2.0
"""Numbers of things in words."""

from __future__ import annotations

import pytest

from trainid_ros.core.plural import counted


@pytest.mark.parametrize(('count', 'text'), [(0, '0 runs'), (1, '1 run'), (2, '2 runs')])
def test_one_thing_has_no_plural(count: int, text: str) -> None:
    assert counted(count, 'run') == text

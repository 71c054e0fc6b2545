# SPDX-License-Identifier: Apache-2.0
"""Nouns are pluralised by their count."""

from __future__ import annotations

import pytest

from trainid_ros.interface.text import pluralise


@pytest.mark.parametrize(('count', 'text'), [(0, '0 runs'), (1, '1 run'), (2, '2 runs')])
def test_only_a_count_of_one_has_no_plural(count: int, text: str) -> None:
    assert pluralise(count, 'run') == text

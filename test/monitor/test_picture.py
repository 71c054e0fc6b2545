# SPDX-License-Identifier: Apache-2.0
"""The picture in the documents is what the monitor draws."""

from __future__ import annotations

from tools.documents import ROOT
from tools.monitor_picture import picture


def test_the_picture_of_the_documents_is_up_to_date() -> None:
    drawn = picture()
    assert drawn == (ROOT / 'docs' / 'monitor.svg').read_text(encoding='utf-8'), 'make golden draws it anew'
    assert 'http' not in drawn.replace('http://www.w3.org', '').replace('https://www.textualize.io', '')

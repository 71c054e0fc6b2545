# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.required_topics import require_topics
from trainid_ros.bag.types import message_from_record
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import ForceRecord

STAMP = 1_700_000_000_000_000_000


@pytest.mark.parametrize(
    ('names', 'missing', 'where'),
    [
        (('ato/force',), 'ato/speed, ato/gradient, ato/brake_command', 'found: ato/force'),
        (
            ('/t1/ato/force', '/north/t2/ato/force', 'other'),
            'ato/speed, ato/force, ato/gradient, ato/brake_command',
            'they are in /north/t2, /t1; use --namespace',
        ),
    ],
)
def test_missing_topics_are_named_with_where_they_are(
    tmp_path: Path, names: tuple[str, ...], missing: str, where: str
) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for name in names:
            writer.write_message(name, 'AtoForce', STAMP, message_from_record(ForceRecord(STAMP, 1.0)))
    with BagReader(tmp_path / 'bag') as reader, pytest.raises(InputError) as caught:
        require_topics(reader)
    assert str(caught.value) == f'{tmp_path / "bag"}: no messages on {missing} ({where})'

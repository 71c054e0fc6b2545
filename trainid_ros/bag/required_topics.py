# SPDX-License-Identifier: Apache-2.0
"""Input topics that a bag must have, and where they are if they are elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import REQUIRED_TOPICS, InputTopic

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.bag.reader import BagReader

NAMESPACE: Final = 'use --namespace'
_REQUIRED: Final = tuple(topic.name for topic in REQUIRED_TOPICS)


def require_topics(reader: BagReader) -> None:
    """Raise InputError, naming them, if required topics have no messages in the bag."""
    missing = missing_topics(reader)
    if not missing:
        return
    found = [topic.name for topic in reader.topics() if topic.count]
    where = in_namespaces(found) or f'found: {", ".join(found) or "nothing"}'
    raise InputError(f'{reader.path}: no messages on {", ".join(missing)} ({where})')


def missing_topics(reader: BagReader, topics: Iterable[InputTopic] = REQUIRED_TOPICS) -> tuple[str, ...]:
    """Return the names of those topics that have no messages in the bag."""
    return tuple(name for topic in topics for name in reader.missing(topic))


def in_namespaces(topics: Iterable[str]) -> str:
    """Return in which namespaces required topics are, and how to choose one; '' if in none."""
    elsewhere = [name.strip('/') for name in topics if name.endswith(_REQUIRED)]
    others = {name.rpartition('ato/')[0].strip('/') for name in elsewhere} - {''}
    return f'they are in /{", /".join(sorted(others))}; {NAMESPACE}' if others else ''

# SPDX-License-Identifier: Apache-2.0
"""Who publishes on an input topic, and why some of them are not heard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

if TYPE_CHECKING:
    from collections.abc import Iterable

NAMELESS: Final = 'a node without a name'
"""A publisher that is not of ROS, or whose node is not known yet."""


@dataclass(frozen=True, slots=True)
class Publishers:
    """Publishers of a topic."""

    heard: tuple[str, ...] = ()  # Nodes whose messages arrive, one name for each publisher
    unheard: tuple[str, ...] = ()  # One sentence for each publisher whose messages cannot arrive or be read
    remedy: str = 'correct this publisher'  # What to do about those

    @property
    def count(self) -> int:
        """Number of all publishers."""
        return len(self.heard) + len(self.unheard)

    def at_a_time(self) -> Publishers:
        """Return the same where messages come from one publisher at a time.

        One that was killed stays in the graph for its lease, up to 20 s: each name counts once. Its successor has no
        name at first.
        """
        names = dict.fromkeys(self.heard)
        return Publishers(tuple(name for name in names if name != NAMELESS) or tuple(names), self.unheard, self.remedy)


def type_name(message: Any) -> str:
    """Return the name of a message class in the graph."""
    package, _, _ = message.__module__.partition('.')
    return f'{package}/msg/{message.__name__}'


def is_hash(text: str) -> bool:
    """Return whether a text is the hash of a definition; not every middleware states it."""
    return text.startswith('RIHS')


def _node_name(info: Any) -> str:
    unknown = info.node_name.startswith('_NODE_NAME_UNKNOWN')
    return NAMELESS if unknown else f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def sort_publishers(infos: Iterable[Any], wanted: str, definition: str, profile: QoSProfile) -> Publishers:
    """Sort publishers by whether a subscription hears them.

    Args:
        infos: What ``get_publishers_info_by_topic`` returns.
        wanted: Message type of the subscription.
        definition: Hash of its definition, '' if it is not known. The middleware does not compare it, and misreads
            messages of another one.
        profile: Its quality of service.
    """
    heard, unheard = [], []
    for info in infos:
        name = _node_name(info)
        if info.topic_type != wanted:
            unheard.append(f'{name} publishes {info.topic_type} instead of {wanted}')
            continue
        if definition and is_hash(other := str(info.topic_type_hash)) and other != definition:
            unheard.append(f'{name} publishes another version of {wanted}, whose messages are misread')
            continue
        compatibility, reason = qos_check_compatible(info.qos_profile, profile)
        if compatibility == QoSCompatibility.ERROR:
            text = reason.strip().removeprefix('ERROR: ').rstrip(';').replace(';ERROR:', ',')
            unheard.append(f'{name} has an incompatible quality of service ({text})')
        else:
            heard.append(name)
    return Publishers(tuple(sorted(heard)), tuple(sorted(unheard)))

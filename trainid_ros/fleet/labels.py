# SPDX-License-Identifier: Apache-2.0
"""Train, line, weather and day of a bag: from its path, or from the custom data that was recorded with it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Final

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

LABELS: Final = ('train', 'line', 'weather', 'day')
DEFAULT_PATTERN: Final = r'(?P<train>[^/]+)/[^/]+$'
"""Without another and without a namespace, the train has the name of the folder that holds the bag."""


@dataclass(frozen=True, slots=True)
class LabelRule:
    """How labels are found.

    Attributes:
        pattern: Regular expression that is searched in the absolute path as it is given, or else with links resolved;
            its named groups are labels.
        is_given: True if the user gave it: then it comes before the custom data, else after.
        namespace: Namespace of the train, without the first slash; '' without one. It is the train unless the user's
            pattern or the custom data name another; a folder may be that of several trains.

    """

    pattern: re.Pattern[str]
    is_given: bool
    namespace: str

    def labels(self, path: Path, custom: Mapping[str, str]) -> dict[str, str]:
        """Return the labels of a bag by name, '' where unknown.

        Raises:
            InputError: The pattern was given, but does not fit the path.

        """
        places = (path.absolute(), path.resolve())
        match = next(filter(None, (self.pattern.search(place.as_posix()) for place in places)), None)
        if match is None and self.is_given:
            msg = f"{path}: --label '{self.pattern.pattern}' does not fit the path"
            raise InputError(msg)
        found = {} if match is None else {name: text for name, text in match.groupdict().items() if text}
        if self.namespace:
            custom = {'train': self.namespace, **custom}
        both = {**custom, **found} if self.is_given else {**found, **custom}
        return {name: both.get(name, '') for name in LABELS}


def label_rule(pattern: str | None, namespace: str = '/') -> LabelRule:
    """Return the rule of a pattern, or the default without one, for the train in a namespace.

    Raises:
        InputError: The pattern is no regular expression, or has no group or another one than the labels.

    """
    try:
        compiled = re.compile(pattern or DEFAULT_PATTERN)
    except re.error as error:
        msg = f"--label '{pattern}': {error}"
        raise InputError(msg) from None
    unknown = sorted(set(compiled.groupindex) - set(LABELS))
    if unknown or not compiled.groupindex:
        problem = f'has a group {unknown[0]!r}' if unknown else 'has no named group such as (?P<train>[^/]+)'
        msg = f"--label '{pattern}': {problem}; the labels are " + ', '.join(LABELS)
        raise InputError(msg)
    return LabelRule(compiled, is_given=pattern is not None, namespace=namespace.strip('/'))


def day_of(label: str, start_s: float | None, where: Path) -> str | None:
    """Return a day as YYYY-MM-DD: that of the label, or of the start [s] in UTC; None without either.

    Raises:
        InputError: The label is no day.

    """
    if label:
        try:
            return date.fromisoformat(label.replace('_', '-')).isoformat()
        except ValueError:
            msg = f'{where}: label day {label!r} is not a day such as 2026-01-31'
            raise InputError(msg) from None
    return None if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()

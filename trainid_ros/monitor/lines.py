# SPDX-License-Identifier: Apache-2.0
"""Views as lines of text, where no screen can be drawn: no terminal, a dumb one, or no colours wanted."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from trainid_ros.monitor.view import number, state_of, with_band
from trainid_ros.text import printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.monitor.view import InputView, TrainView

_NUMBER: Final = re.compile(r'-?[0-9.]+(e[-+]?[0-9]+)?')


class Lines:
    """Turns views into lines: the state of each train every time, findings when they come and go."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], str] = {}
        self._notice = ''

    def of(self, views: Sequence[TrainView], notice: str) -> list[str]:
        """Return what to print now; the notice, where there is no train, only when it changes."""
        lines = [] if views or notice == self._notice else [notice]
        self._notice = '' if views else notice
        present: dict[tuple[str, str, str], str] = {}
        for view in views:
            lines.append(train_line(view))
            for item in view.findings:
                present[view.namespace, item.source, item.level.name] = item.text
        for namespace, source, level in sorted(key for key, text in present.items() if self._is_news(key, text)):
            lines.append(f'{namespace} {level} {source}: {present[namespace, source, level]}')
        gone = sorted(self._known.keys() - present.keys())
        shown = {view.namespace for view in views}
        lines += [f'{namespace} {level} {source} cleared' for namespace, source, level in gone if namespace in shown]
        self._known = present
        return [printable(line.replace('\n', ' ')) for line in lines]

    def _is_news(self, key: tuple[str, str, str], text: str) -> bool:
        """Return whether a finding is new, or says more than other numbers."""
        return key not in self._known or _NUMBER.sub('', text) != _NUMBER.sub('', self._known[key])


def train_line(view: TrainView) -> str:
    """Return the state of a train as one line."""
    parts = [f'{view.time} {view.namespace}  {number(view.speed_kmh, 1)} km/h']
    for item in view.estimates:
        known = '' if item.status is None else f' {with_band(item)}'
        parts.append(f'{item.name}{known} {state_of(item)}')
    return ' | '.join((*parts, 'inputs ' + ', '.join(_inputs(view.inputs))))


def _inputs(inputs: Iterable[InputView]) -> Iterable[str]:
    """Yield name, rate and age of each input; optional ones only if they come."""
    for item in inputs:
        if math.isinf(item.silent_s):
            if not item.optional:
                yield f'{item.name} never'
            continue
        yield f'{item.name} {number(item.rate, 1)} Hz {number(item.silent_s, 1)} s'

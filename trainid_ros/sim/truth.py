# SPDX-License-Identifier: Apache-2.0
"""True values while a bag was recorded: resistance and brake rate over time, and values missing from the train file.

They are in the file ``truth.yaml`` beside a bag; external bags with known true values use the same file.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Final

import yaml

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.fields import parse_yaml, read_text
from trainid_ros.train.train_file import Davis, NamedValues, plain_numbers

_HEAD: Final = '# resistance: [time s, a, b, c]; brake_rate: [time s, rate]\n'
_HEAD_UNKNOWNS: Final = (
    '# unknowns: mass_ratio true over stated, force_ratio true over reported traction, force_delay of its stamps [s],\n'
    '# wheel_ratio measured over true; else true values in SI units, map_std in per mille, gust_std in N/kN\n'
)


@dataclass(frozen=True, slots=True)
class TruthPoint:
    """True values at one time; the brake rate [1] is None if it is not known."""

    resistance: Davis
    brake_rate: float | None


@dataclass(frozen=True, slots=True)
class Truth:
    """Piecewise-constant true values; times in seconds since the start, increasing."""

    start_ns: int  # Stamp of time zero [ns]
    # (time, a, b, c) in s and N/kN with v in m/s; at least one entry
    resistance: tuple[tuple[float, float, float, float], ...]
    brake_rate: tuple[tuple[float, float], ...] = ()  # (time [s], rate [1]); empty if the rate is not known
    # True values that are wrong in the train file or missing from it, see ``sim.worlds.Unknowns``; SI units
    unknowns: NamedValues = ()

    def truth_at(self, time_s: float) -> TruthPoint:
        """Return the true values at a time since the start [s]; the first values also apply before their time."""
        _, a, b, c = self.resistance[_index(self.resistance, time_s)]
        rate = self.brake_rate[_index(self.brake_rate, time_s)][1] if self.brake_rate else None
        return TruthPoint(Davis(a, b, c), rate)

    def truth_at_ns(self, stamp_ns: int) -> TruthPoint:
        """Return the true values at a stamp [ns]."""
        return self.truth_at((stamp_ns - self.start_ns) / NS_PER_S)


def plain_truth(truth: Truth) -> dict[str, object]:
    """Return the truth as lists and mappings; without the key ``unknowns`` if there are none."""
    document: dict[str, object] = {
        'start_ns': truth.start_ns,
        'resistance': [[float(x) for x in row] for row in truth.resistance],
        'brake_rate': [[float(x) for x in row] for row in truth.brake_rate],
    }
    if truth.unknowns:
        document['unknowns'] = plain_numbers(truth.unknowns)
    return document


def dump_truth(truth: Truth) -> str:
    """Return the truth as YAML text that reads back as exactly the same values."""
    head = _HEAD + _HEAD_UNKNOWNS if truth.unknowns else _HEAD
    return head + yaml.safe_dump(plain_truth(truth), sort_keys=False, default_flow_style=None)


def save_truth(truth: Truth, path: str | Path) -> None:
    """Write a truth file; raise InputError if it cannot be written."""
    try:
        Path(path).write_text(dump_truth(truth), encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: cannot be written: {error.strerror or error}') from error


def load_truth(path: str | Path) -> Truth:
    """Read a truth file; raise InputError if it cannot be read or a field is invalid."""
    return parse_truth(read_text(path), str(path))


def parse_truth(text: str, source: str) -> Truth:
    """Read a truth file from its text; ``source`` is the name shown in the InputError of an invalid field."""
    top = parse_yaml(text, source).only(('start_ns', 'resistance', 'brake_rate', 'unknowns'))
    resistance = top.rows('resistance', ('time s', 'a', 'b', 'c'))
    brake_rate = top.pairs('brake_rate', ('time s', 'rate'))
    if not resistance:
        top.fail('resistance', 'is missing: at least one row [time s, a, b, c] is required')
    for key, rows in (('resistance', resistance), ('brake_rate', brake_rate)):
        top.check_rising(f'{key}[{{}}]', (row[0] for row in rows), 's', 'later than', what='times')
    return Truth(
        start_ns=top.integer('start_ns', 0, low=0, high=2**63 - 1),
        resistance=tuple((t, a, b, c) for t, a, b, c in resistance),
        brake_rate=brake_rate,
        unknowns=top.named_numbers('unknowns'),
    )


def _index(rows: Sequence[tuple[float, ...]], time_s: float) -> int:
    return max(0, bisect_right(rows, time_s, key=itemgetter(0)) - 1)

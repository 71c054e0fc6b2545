# SPDX-License-Identifier: Apache-2.0
"""Display of the running demo: a live table on a terminal, elsewhere a line of text at intervals."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from trainid_ros.cli.output import for_output
from trainid_ros.interface.results import BrakeRateEstimate, Reason, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.train.forces import davis

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Any

    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.sim.truth import Truth

LABELS: Final = {
    ResistanceEstimate: 'resistance w(v)',
    SpeedModelEstimate: 'speed model, mass factor',
    BrakeRateEstimate: 'brake rate',
}
_STYLES: Final = {Status.VALID: 'bold green', Status.HOLDING: 'cyan', Status.CONVERGING: 'yellow'}
_REASONS: Final = 3


@dataclass(slots=True)
class Snapshot:
    """Current state of a live run."""

    title: str  # What is being played
    rate: float  # Recorded seconds per second [1]
    start_ns: int  # Stamp of the start of the bag [ns]
    duration_s: float  # Length to play [s]
    truth: Truth | None  # The truth, None if unknown
    # Newest output of each estimator, by the class of its estimate
    newest: dict[type, AnyOutput] = field(default_factory=dict)
    # Rejected samples by reason, by the class of the estimate
    rejections: dict[type, dict[Reason, int]] = field(default_factory=dict)
    received: int = 0  # Estimates received so far

    @property
    def elapsed_s(self) -> float:
        """Recorded time so far [s]."""
        stamps = [output.stamp_ns for output in self.newest.values()]
        return max(0.0, (max(stamps) - self.start_ns) * 1e-9) if stamps else 0.0

    def values(self, kind: type) -> tuple[float, float | None, float | None] | None:
        """Return w [N/kN], brake rate [1] or mass factor [1] with its std and truth, None before the first."""
        output = self.newest.get(kind)
        if output is None:
            return None
        point = None if self.truth is None else self.truth.truth_at_ns(output.stamp_ns)
        match output.estimate:
            case ResistanceEstimate() as e:
                return e.resistance, e.resistance_std, None if point is None else davis(point.resistance, e.speed)
            case BrakeRateEstimate() as e:
                return e.brake_rate, e.brake_rate_std, None if point is None else point.brake_rate
            case SpeedModelEstimate() as e:
                return e.mass_factor, None, None

    @property
    def speed_kmh(self) -> float:
        """Speed of the train in the newest resistance estimate [km/h]."""
        output = self.newest.get(ResistanceEstimate)
        estimate: Any = None if output is None else output.estimate
        return 0.0 if estimate is None else 3.6 * float(estimate.speed)


class View:
    """Shows snapshots; use as a context manager."""

    def __init__(self, console: Console, line_every_s: float = 5.0) -> None:
        self._console = console
        self._stack = ExitStack()
        self._live: Live | None = None
        self._line_every_s = line_every_s
        self._next_s = 0.0

    def __enter__(self) -> Self:
        """Start the live table if the console is a terminal."""
        if self._console.is_terminal:
            self._live = self._stack.enter_context(Live(console=self._console, auto_refresh=False))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the live table."""
        self._stack.close()
        self._live = None

    def say(self, text: str) -> None:
        """Print a line above the table."""
        self._console.print(for_output(text), highlight=False, markup=False, soft_wrap=True)

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot if the next one is due."""
        now = time.monotonic()
        if now < self._next_s:
            return
        self._next_s = now + (0.2 if self._live is not None else self._line_every_s)
        if self._live is not None:
            self._live.update(render(snapshot), refresh=True)
        elif snapshot.newest:
            self.say(line(snapshot))


def line(snapshot: Snapshot) -> str:
    """Return a snapshot as one line of text."""
    parts = [f'{_clock(snapshot.elapsed_s)}/{_clock(snapshot.duration_s)}', f'{snapshot.speed_kmh:5.1f} km/h']
    for kind, name in ((ResistanceEstimate, 'w'), (BrakeRateEstimate, 'brake rate')):
        if (values := snapshot.values(kind)) is not None:
            value, std, true = values
            known = '' if true is None else f' (truth {true:.3f})'
            parts.append(f'{name} {value:.3f} ± {std:.3f}{known} {snapshot.newest[kind].status.name}')
    output = snapshot.newest.get(ResistanceEstimate)
    if output is not None:
        parts.append(f'used {output.used}, rejected {output.rejected}')
    return '  '.join(parts)


def render(snapshot: Snapshot) -> Group:
    """Return a snapshot as a table for a terminal."""
    table = Table(expand=True, pad_edge=False)
    for name in ('estimate', 'value ± std', 'truth', 'error', 'status', 'used', 'rejected'):
        table.add_column(name, justify='left' if name in ('estimate', 'status', 'rejected') else 'right')
    for kind, label in LABELS.items():
        table.add_row(*_row(snapshot, kind, label))
    head = Text.assemble(
        (snapshot.title, 'bold'),
        f'   {_clock(snapshot.elapsed_s)} of {_clock(snapshot.duration_s)}   {snapshot.rate:g} x real time   ',
        (f'{snapshot.speed_kmh:5.1f} km/h', 'bold'),
        f'   {snapshot.received} estimates received',
    )
    bar = ProgressBar(total=max(snapshot.duration_s, 1e-9), completed=snapshot.elapsed_s)
    return Group(head, bar, table)


def _row(snapshot: Snapshot, kind: type, label: str) -> tuple[str | Text, ...]:
    values = snapshot.values(kind)
    if values is None:
        return label, 'waiting', '', '', '', '', ''
    value, std, true = values
    output = snapshot.newest[kind]
    return (
        label,
        f'{value:.3f}' if std is None else f'{value:.3f} ± {std:.3f}',
        '' if true is None else f'{true:.3f}',
        '' if true is None else f'{value - true:+.3f}',
        Text(output.status.name, style=_STYLES.get(output.status, 'bold red')),
        str(output.used),
        _reasons(output.rejected, snapshot.rejections.get(kind, {})),
    )


def _reasons(total: int, rejections: dict[Reason, int]) -> str:
    most_common = sorted(rejections.items(), key=lambda item: -item[1])[:_REASONS]
    text = ', '.join(f'{reason.name.lower()} {count}' for reason, count in most_common)
    return f'{total} ({text})' if text else str(total)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f'{minutes}:{rest:02d}'

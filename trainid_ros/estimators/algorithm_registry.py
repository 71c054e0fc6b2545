# SPDX-License-Identifier: Apache-2.0
"""Registry of the algorithms for each kind of estimator, by name, and the interface that all estimators have.

Other distributions add algorithms through entry points of the group ``trainid_ros.algorithms``. The name of an entry
point is the kind of estimator (``resistance``, ``speed_model`` or ``brake_rate``), its object a tuple of
:class:`Algorithm`. Reading them takes 40 ms, so none is read until a name is not built in.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

from trainid_ros.interface.errors import InputError, setting_info

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from importlib.metadata import EntryPoint

    import numpy as np
    from _typeshed import DataclassInstance

    from trainid_ros.interface.results import Estimate, Rejection
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

EstimateT_co = TypeVar('EstimateT_co', covariant=True)


class Estimator(Protocol[EstimateT_co]):
    """A streaming estimator: explicit state, one step per sample, an estimate when asked for."""

    def step(self, sample: Sample) -> Rejection | None:
        """Take in one sample; return why it was not used, None if it was."""

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update and its variance as stated before the measurement, 0 if none is stated.

        That of the resistance is a specific force [N/kN], the others are speeds [m/s].
        """

    def estimate(self, speed: float) -> EstimateT_co:
        """Return the current estimate at a speed [m/s]."""

    @property
    def converged(self) -> bool:
        """True while the estimate is fit for use."""

    def idle(self, seconds: float) -> None:
        """Widen the uncertainty by what may have changed in a time without samples [s]."""

    def reset(self) -> None:
        """Return to the prior."""

    def save(self) -> str:
        """Return the state as JSON text."""

    def restore(self, text: str) -> None:
        """Restore a state made by :meth:`save`; raise InputError if it does not fit."""


EstimateT = TypeVar('EstimateT', bound='Estimate')


@dataclass(frozen=True, slots=True)
class Choice:
    """A selected algorithm by name, and its settings."""

    algorithm: str  # its name
    config: DataclassInstance  # its settings


@dataclass(frozen=True, slots=True)
class Algorithm(Generic[EstimateT]):
    """One algorithm."""

    name: str  # Name for users
    summary: str  # Description and when to choose it, in one line
    config: DataclassInstance  # Default settings
    # Creates the estimator from the train file, settings of the same class, and a random generator
    make: Callable[[TrainFile, Any, np.random.Generator], Estimator[EstimateT]]
    # Settings of that class that cannot be changed, since they define the algorithm or it ignores them
    fixed: frozenset[str] = frozenset()

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings that can be changed."""
        names = (item.name for item in fields(self.config) if setting_info(item) is not None)
        return tuple(name for name in names if name not in self.fixed)


class Algorithms(Generic[EstimateT]):
    """All algorithms for one kind of estimate.

    Attributes:
        kind: The kind of estimator.
        built_in: Names of the built-in algorithms, the default first; the others come from plug-ins.
        default: Name of the default.
    """

    def __init__(self, kind: str, *algorithms: Algorithm[EstimateT]) -> None:
        self.kind = kind
        self._built_in = {item.name: item for item in algorithms}
        self.built_in = tuple(self._built_in)
        self.default = self.built_in[0]

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the built-in ones first, without those of plug-ins that cannot be used."""
        return (*self.built_in, *self._plug_ins[0])

    @property
    def hint(self) -> str:
        """End of a message that lists all names: where others come from if there are no plug-ins."""
        return '' if self._plug_ins[0] else '; others come with research/lab'

    @property
    def problem(self) -> str:
        """Why a plug-in cannot be used, '' if all can; a name that is missing may be one of its own."""
        return self._plug_ins[1]

    def __contains__(self, name: str) -> bool:
        """Return whether there is an algorithm of that name."""
        return name in self._built_in or name in self._plug_ins[0]

    def __getitem__(self, name: str) -> Algorithm[EstimateT]:
        """Return an algorithm by name; raise InputError if there is none of that name."""
        if (algorithm := self._built_in.get(name) or self._plug_ins[0].get(name)) is None:
            raise InputError(self.problem or f'algorithm = {name!r} must be one of {", ".join(self.names)}{self.hint}')
        return algorithm

    @cached_property
    def _plug_ins(self) -> tuple[dict[str, Algorithm[EstimateT]], str]:
        """Usable algorithms of plug-ins by name, and the first problem; read when a name is not built in."""
        found: dict[str, Algorithm[EstimateT]] = {}
        problems, twice = [], set()
        for entry in plugged_in(self.kind):
            try:
                given = _algorithms(entry)
            except InputError as error:
                problems.append(str(error))
                continue
            for item in given:
                if item.name in self._built_in or item.name in found:
                    problems.append(f'{_described(entry)}: there are two algorithms {item.name!r}')
                    twice.add(item.name)
                found.setdefault(item.name, item)
        usable = {name: algorithm for name, algorithm in found.items() if name not in twice}
        return usable, next(iter(problems), '')

    def choose(self, name: str = '', **changes: float) -> Choice:
        """Return a choice, the default if unnamed, with some settings changed; InputError if a name is unknown."""
        algorithm = self[name or self.default]
        for setting in changes:
            if setting not in algorithm.settings:
                raise InputError(f'{algorithm.name} has no setting {setting!r}')
        return Choice(algorithm.name, replace(algorithm.config, **changes))

    def make(self, choice: Choice, train_file: TrainFile, generator: np.random.Generator) -> Estimator[EstimateT]:
        """Return the chosen estimator; raise InputError, naming the field, if a setting is out of range."""
        return self[choice.algorithm].make(train_file, choice.config, generator)


GROUP: Final = 'trainid_ros.algorithms'  # entry points of algorithms from other packages


def plugged_in(kind: str) -> Iterable[EntryPoint]:
    """Return the entry points for a kind of estimator."""
    # Imported here because start-up must not pay for it.
    from importlib.metadata import entry_points  # noqa: PLC0415

    return entry_points(group=GROUP, name=kind)


def _described(entry: EntryPoint) -> str:
    return f'plug-in {entry.dist.name if entry.dist else "?"} ({entry.name} = {entry.value})'


def _algorithms(entry: EntryPoint) -> tuple[Algorithm[Any], ...]:
    """Return the algorithms of an entry point; raise InputError, naming it, if it gives anything else."""
    try:
        given = entry.load()
    except Exception as error:  # whatever its code raises
        raise InputError(f'{_described(entry)} cannot be loaded: {type(error).__name__}: {error}') from error
    if not isinstance(given, tuple) or not all(isinstance(item, Algorithm) for item in given):
        raise InputError(f'{_described(entry)} must be a tuple of Algorithm, not {type(given).__name__}')
    return given

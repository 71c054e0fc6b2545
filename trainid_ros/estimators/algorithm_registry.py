# SPDX-License-Identifier: Apache-2.0
"""Registry of the algorithms for each kind of estimate, by name: drivers need not know the estimator classes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from trainid_ros.errors import InputError
from trainid_ros.estimators.plugins import PlugIn, plugged_in
from trainid_ros.settings import setting_info

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from _typeshed import DataclassInstance

    from trainid_ros.estimators.protocol import Estimator
    from trainid_ros.results import Estimate
    from trainid_ros.train.train_file import TrainFile

EstimateT = TypeVar('EstimateT', bound='Estimate')


@dataclass(frozen=True, slots=True)
class Choice:
    """A selected algorithm by name, and its settings."""

    algorithm: str
    config: DataclassInstance


@dataclass(frozen=True, slots=True)
class Algorithm(Generic[EstimateT]):
    """One algorithm.

    Attributes:
        name: Name for users.
        summary: Description and when to choose it, in one line.
        config: Default settings.
        make: Creates the estimator from the train file, settings of the same class, and a random generator.
        fixed: Settings of that class that cannot be changed, since they define the algorithm or it ignores them.

    """

    name: str
    summary: str
    config: DataclassInstance
    make: Callable[[TrainFile, Any, np.random.Generator], Estimator[EstimateT]]
    fixed: frozenset[str] = frozenset()

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings that can be changed."""
        names = (item.name for item in fields(self.config) if setting_info(item) is not None)
        return tuple(name for name in names if name not in self.fixed)


class Algorithms(Generic[EstimateT]):
    """All algorithms for one kind of estimate: the built-in ones, the first of which is the default, and plug-ins."""

    def __init__(self, job: str, *algorithms: Algorithm[EstimateT]) -> None:
        self.job = job
        self._built_in = {item.name: item for item in algorithms}

    @property
    def built_in(self) -> tuple[str, ...]:
        """Names of the built-in algorithms, the default first."""
        return tuple(self._built_in)

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the built-in ones first, without those of plug-ins that cannot be used."""
        return (*self._built_in, *self._plug_ins[0])

    @property
    def default(self) -> str:
        """Name of the default."""
        return self.built_in[0]

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
        """Algorithms of plug-ins by name, read at the first look-up of a name that is not built in; first problem."""
        found: dict[str, Algorithm[EstimateT]] = {}
        problems, twice = [], set()
        for plug_in in plugged_in(self.job):
            try:
                given = _algorithms(plug_in)
            except InputError as error:
                problems.append(str(error))
                continue
            for item in given:
                if item.name in self._built_in or item.name in found:
                    problems.append(f'{plug_in}: there are two algorithms {item.name!r}')
                    twice.add(item.name)
                found.setdefault(item.name, item)
        usable = {name: algorithm for name, algorithm in found.items() if name not in twice}
        return usable, next(iter(problems), '')

    def choose(self, name: str = '', **changes: float) -> Choice:
        """Return a choice, the default if unnamed, with some settings changed; InputError if a name is unknown."""
        algorithm = self[name or self.default]
        for setting in changes:
            if setting not in algorithm.settings:
                msg = f'{algorithm.name} has no setting {setting!r}'
                raise InputError(msg)
        return Choice(algorithm.name, replace(algorithm.config, **changes))

    def make(self, choice: Choice, train_file: TrainFile, generator: np.random.Generator) -> Estimator[EstimateT]:
        """Return the chosen estimator; raise InputError, naming the field, if a setting is out of range."""
        return self[choice.algorithm].make(train_file, choice.config, generator)


def _algorithms(plug_in: PlugIn) -> tuple[Algorithm[Any], ...]:
    """Return what a plug-in gives; raise InputError, naming it, if that is not a tuple of algorithms."""
    given = plug_in.load()
    if not isinstance(given, tuple) or not all(isinstance(item, Algorithm) for item in given):
        msg = f'{plug_in} must be a tuple of Algorithm, not {type(given).__name__}'
        raise InputError(msg)
    return given

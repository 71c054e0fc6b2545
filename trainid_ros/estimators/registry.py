# SPDX-License-Identifier: Apache-2.0
"""Registry of the algorithms for each kind of estimate, by name: drivers need not know the estimator classes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from trainid_ros.core.errors import InputError
from trainid_ros.core.settings import setting_info

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from _typeshed import DataclassInstance

    from trainid_ros.core.results import Estimate
    from trainid_ros.estimators.protocol import Estimator
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
    """All algorithms for one kind of estimate; the first one is the default."""

    def __init__(self, *algorithms: Algorithm[EstimateT]) -> None:
        self._by_name = {item.name: item for item in algorithms}

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the default first."""
        return tuple(self._by_name)

    @property
    def default(self) -> str:
        """Name of the default."""
        return self.names[0]

    def __getitem__(self, name: str) -> Algorithm[EstimateT]:
        """Return an algorithm by name; raise InputError if the name is unknown."""
        if (algorithm := self._by_name.get(name)) is None:
            msg = f'algorithm = {name!r} must be one of {", ".join(self.names)}'
            raise InputError(msg)
        return algorithm

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

# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes as plain values, and their conversion to configurations, whose metadata declare them."""

from __future__ import annotations

import math
from dataclasses import MISSING, Field, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from trainid_ros.estimators.algorithm_registry import Choice
from trainid_ros.estimators.pipeline import PipelineConfig
from trainid_ros.interface.errors import InputError, setting_info
from trainid_ros.interface.records import INPUT_TOPICS
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from _typeshed import DataclassInstance

    from trainid_ros.estimators.algorithm_registry import Algorithms
    from trainid_ros.interface.records import OutputTopic

Value: TypeAlias = bool | int | float | str
Values: TypeAlias = 'Mapping[str, Value]'

_NEXT: Final = 'takes effect on the next configure'
LIVE: Final = frozenset({'diagnostic_period', 'checkpoint_period', 'stale_after'})
"""Names of the parameters that take effect at once."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter: default (its type is the parameter's type), description and permitted values.

    ``low`` and ``high`` are the inclusive bounds of a number, ``least`` the smallest one but 0; ``choices`` lists the
    permitted strings. ``look_up``, if given, decides instead of ``choices`` and raises InputError for a string that is
    not permitted: plug-ins may add strings, and are only read when one is looked up.
    """

    name: str
    default: Value
    description: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    look_up: Callable[[str], object] | None = None
    read_only: bool = False
    least: float = -math.inf

    def coerce(self, value: object) -> Value:
        """Return a value from a file as the parameter's type; a whole number is accepted for a float.

        InputError if it is of another type, not finite, out of range or not among the choices.
        """
        if isinstance(self.default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, type(self.default)) or isinstance(value, bool) is not isinstance(self.default, bool):
            wanted = {float: 'a number', int: 'a whole number', str: 'a string', bool: 'true or false'}
            raise InputError(f'{self.name} = {value!r} must be {wanted[type(self.default)]}')
        self.check(value)
        return value

    def check(self, value: Value) -> None:
        """Raise InputError, naming the parameter, if a value of the right type is not permitted."""
        if isinstance(value, str):
            if self.look_up is not None:
                self.look_up(value)
            elif self.choices and value not in self.choices:
                raise InputError(f'{self.name} = {value!r} must be one of {", ".join(self.choices)}')
        elif not isinstance(value, bool):
            if not (math.isfinite(value) and self.low <= value <= self.high):
                raise InputError(f'{self.name} = {value:g} is outside [{self.low:g}, {self.high:g}]')
            if value < self.least and value != 0.0:
                raise InputError(f'{self.name} = {value:g} must be 0 or at least {self.least:g}')


def on_configure(
    name: str, default: Value, text: str, low: float = -math.inf, high: float = math.inf, choices: tuple[str, ...] = ()
) -> ParameterSpec:
    """Return a parameter that takes effect on the next configure."""
    return ParameterSpec(name, default, f'{text}; {_NEXT}', low, high, choices)


@dataclass(frozen=True, slots=True)
class TrainParameter:
    """A parameter that overrides a field of the train file."""

    section: str
    field: str
    spec: ParameterSpec
    required: bool = False

    @property
    def name(self) -> str:
        """Name of the parameter."""
        return self.spec.name

    def of(self, train_file: TrainFile) -> float:
        """Return the value in a train file."""
        return float(getattr(getattr(train_file, self.section), self.field))


def _train_parameters(section: str, kind: type[Any], *names: str) -> Iterator[TrainParameter]:
    """Yield parameters for fields of a section; ranges and defaults are stated on the fields."""
    by_name: dict[str, Field[Any]] = {item.name: item for item in fields(kind)}
    for name in names:
        item, info = by_name[name], setting_info(by_name[name])
        assert info is not None
        required = item.default is MISSING
        default = 0.0 if item.default is MISSING else float(item.default)
        source = 'required without a train file' if required else 'default if set neither here nor in the train file'
        text = f'{info.description} [{info.unit}]; overrides the train file ({source})'
        spec = on_configure(f'{section}.{name}', default, text, min(info.low, default), info.high)
        yield TrainParameter(section, name, spec, required)


TRAIN_PARAMETERS: Final = (
    *_train_parameters('train', Train, 'mass', 'rotary_mass', 'length', 'mass_std', 'force_std'),
    *_train_parameters('resistance', Davis, 'a', 'b', 'c'),
    *_train_parameters('brake', Brake, 'rate', 'time_constant', 'delay', 'timing_std'),
    *_train_parameters('line', Line, 'gradient_std'),
)
ALGORITHM: Final = 'algorithm'
TRAIN_FILE: Final = ParameterSpec(
    'train_file', '', 'path of the train file (YAML), read again on each configure', read_only=True
)
MAPPING_FILE: Final = ParameterSpec(
    'mapping_file',
    '',
    'path of the mapping file (YAML): inputs from other topics, types and units; read again on each configure',
    read_only=True,
)
TAKEN: Final = ParameterSpec(
    'taken_from_train_file', '', 'values of the train file, by which a dump of the parameters is known; set by the node'
)
_QOS: Final = ('history', 'depth', 'reliability')
QOS_POLICIES: Final = {
    'subscription': _QOS,
    'publisher': (*_QOS, 'deadline', 'lifespan', 'liveliness', 'liveliness_lease_duration'),
}
"""What parameters ``qos_overrides.*`` change; durations in ns."""
AUTOSTART: Final = ParameterSpec('autostart', False, 'configure and activate at start', read_only=True)
SEED: Final = on_configure('seed', EstimatorSettings().seed, 'seed of the random numbers', 0, 2**31 - 1)
# Parameters of every estimator node.
_OF_NODES: Final = (
    on_configure(
        'time_jump_policy',
        PipelineConfig().time_jump_policy.value,
        'what to do when stamps or /clock jump back',
        choices=tuple(policy.value for policy in TimeJumpPolicy),
    ),
    ParameterSpec(
        'checkpoint_file', '', 'path (.json) of the state, loaded at start and kept up to date', read_only=True
    ),
    ParameterSpec(
        'checkpoint_period',
        5.0,
        'time between checkpoints, at least 0.1, or 0: only when the node stops [s]',
        0.0,
        3600.0,
        least=0.1,
    ),
    SEED,
    ParameterSpec('diagnostic_period', 1.0, 'time between diagnostics [s]', 0.1, 60.0),
    AUTOSTART,
    TAKEN,
    *(item.spec for item in TRAIN_PARAMETERS),
)


def estimator_parameters(algorithms: Algorithms[Any], name: str = '') -> tuple[ParameterSpec, ...]:
    """Return all parameters of a node that runs the named algorithm, the default one without a name."""
    algorithm = algorithms[name or algorithms.default]
    algorithm_spec = ParameterSpec(
        ALGORITHM,
        algorithms.default,
        'algorithm of the estimator, chosen at start (others come with research/lab)',
        choices=algorithms.built_in,
        look_up=algorithms.__getitem__,
        read_only=True,
    )
    return (
        TRAIN_FILE,
        MAPPING_FILE,
        algorithm_spec,
        *_OF_NODES,
        *_settings('', PipelineConfig()),
        *_settings('alignment.', AlignmentConfig()),
        *_settings('estimator.', algorithm.config, algorithm.fixed),
    )


def _settings(prefix: str, config: DataclassInstance, fixed: frozenset[str] = frozenset()) -> Iterator[ParameterSpec]:
    for item in fields(config):
        if (info := setting_info(item)) is not None and item.name not in fixed:
            name, later = prefix + item.name, '' if prefix + item.name in LIVE else f'; {_NEXT}'
            text = f'{info.description} [{info.unit}]{later}'
            yield ParameterSpec(name, getattr(config, item.name), text, info.low, info.high)


def requested_algorithm(overrides: Mapping[str, object], algorithms: Algorithms[Any]) -> str:
    """Return the algorithm whose settings are parameters: the default if the given one is unusable (reported later)."""
    name = overrides.get(ALGORITHM)
    try:
        return algorithms[name].name if isinstance(name, str) else algorithms.default
    except InputError:
        return algorithms.default


def taken_values(values: Mapping[str, float]) -> str:
    """Return the value of the parameter TAKEN for values of the train file."""
    return ' '.join(f'{name}={value!r}' for name, value in values.items())


def find_taken(given: Values) -> frozenset[str]:
    """Return the names of given values that are not the user's: a dump holds those of its train file too."""
    pairs = (pair.partition('=') for pair in str(given.get(TAKEN.name, '')).split())
    return frozenset(name for name, _, value in pairs if name in given and repr(given[name]) == value)


def describe_differences(own: Values, filed: Mapping[str, float]) -> str:
    """Return values that differ from those of a train file, as text; empty if none does."""
    different = [(name, value) for name, value in filed.items() if own.get(name, value) != value]
    return ', '.join(f'{name} = {own[name]:g} (train file: {value:g})' for name, value in different)


def qos_overrides(output: OutputTopic, resolve: Callable[[str], str], foreign: Iterable[str] = ()) -> list[str]:
    """Return the names of the QoS parameters of a node, by its output, full names of topics, and a mapping's topics."""
    topics = [(name, 'subscription') for name in (*(topic.name for topic in INPUT_TOPICS), *foreign)]
    topics += [(topic, 'publisher') for topic in (output.name, output.last_valid) if topic]
    return [
        f'qos_overrides.{resolve(name)}.{entity}.{policy}' for name, entity in topics for policy in QOS_POLICIES[entity]
    ]


def validate_overrides(
    overrides: Mapping[str, object], specs: Mapping[str, ParameterSpec], others: Collection[str]
) -> tuple[dict[str, Value], dict[str, str]]:
    """Return the valid values and the problems of the others, by name; ``others`` are handled elsewhere."""
    values: dict[str, Value] = {}
    problems: dict[str, str] = {}
    for name, value in overrides.items():
        try:
            if name in specs:
                values[name] = specs[name].coerce(value)
            elif name not in others:
                problems[name] = f'unknown parameter {name!r}: {did_you_mean(name, {*specs, *others})}'
        except InputError as error:
            problems[name] = str(error)
    return values, problems


def check_problems(problems: Mapping[str, str]) -> None:
    """Raise InputError with all problems, if there are any."""
    if problems:
        raise InputError(f'not configured: {"; ".join(problems.values())}')


def check_fallback(values: Mapping[str, Value], specs: Mapping[str, ParameterSpec], source: str) -> None:
    """Raise InputError, naming the source file, if a value is outside the range of its parameter."""
    for name, value in values.items():
        try:
            specs[name].check(value)
        except InputError as error:
            raise InputError(f'{source}: {error}') from None


def build_settings(values: Values, algorithms: Algorithms[Any], field: str) -> EstimatorSettings:
    """Return the settings for parameter values; ``field`` is the EstimatorSettings field of the algorithm choice."""
    algorithm = algorithms[str(values[ALGORITHM])]
    base = EstimatorSettings()
    policy = TimeJumpPolicy(values['time_jump_policy'])
    changes: dict[str, Any] = {
        'alignment': _configure(base.alignment, 'alignment.', values),
        'pipeline': replace(_configure(base.pipeline, '', values), time_jump_policy=policy),
        field: Choice(algorithm.name, _configure(algorithm.config, 'estimator.', values, algorithm.fixed)),
        'seed': values['seed'],
    }
    return replace(base, **changes)


def _configure(config: Any, prefix: str, values: Values, fixed: frozenset[str] = frozenset()) -> Any:
    names = [item.name for item in fields(config) if setting_info(item) is not None and item.name not in fixed]
    return replace(config, **{name: values[prefix + name] for name in names})


def build_train_file(values: Values, given: frozenset[str], base: TrainFile | None) -> TrainFile:
    """Return the train file overridden by the given parameters; InputError if a required one is given nowhere."""
    if base is None:
        missing = [item.name for item in TRAIN_PARAMETERS if item.required and item.name not in given]
        if missing:
            raise InputError(f'no train: give the parameter train_file, or {", ".join(missing)}')
        base = TrainFile(Train(mass=float(values['train.mass'])), Davis(0.0, 0.0, 0.0))
    sections: dict[str, Any] = {}
    for item in TRAIN_PARAMETERS:
        if item.name in given:
            section = sections.get(item.section, getattr(base, item.section))
            sections[item.section] = replace(section, **{item.field: values[item.name]})
    train_file = replace(base, **sections)
    if train_file.train.mass <= 0.0:
        raise InputError(f'train.mass = {train_file.train.mass:g} kg must be > 0')
    return train_file

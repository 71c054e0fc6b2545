# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes as plain values, the files that give them, and the settings that they make, without ROS.

The metadata of the configurations declare the parameters. Sections of a file that match no node are found, which ROS
ignores. The commented file states all parameters; ``python -m trainid_ros.setup.params_file > config/params.yaml``
updates it.
"""

from __future__ import annotations

import difflib
import math
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, TypeAlias

import yaml

from trainid_ros.estimators.algorithm_registry import Algorithms, Choice
from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineConfig
from trainid_ros.interface.errors import InputError, SettingInfo, setting_info
from trainid_ros.interface.records import INPUT_TOPICS
from trainid_ros.interface.text import listed
from trainid_ros.setup.pipelines import KINDS, EstimatorKind, EstimatorSettings, chosen_algorithms
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.fields import did_you_mean, read_text
from trainid_ros.train.strict_yaml import compose
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

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
    not permitted: plug-ins may add strings, and are only read when one is looked up. A ``required`` one must be
    given where there is no train file.
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
    required: bool = False

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


def _infos(config: Any, fixed: frozenset[str]) -> dict[str, SettingInfo]:
    """Return what is stated of the settings of a configuration that are parameters, by name."""
    infos = {item.name: setting_info(item) for item in fields(config)}
    return {name: info for name, info in infos.items() if info is not None and name not in fixed}


def _train_parameters(section: str, kind: type[Any], *names: str) -> Iterator[ParameterSpec]:
    """Yield parameters for fields of a section; ranges and defaults are stated on the fields."""
    infos = _infos(kind, frozenset())
    defaults: dict[str, Any] = {item.name: item.default for item in fields(kind)}
    for name in names:
        info, required = infos[name], defaults[name] is MISSING
        default = 0.0 if required else float(defaults[name])
        source = 'required without a train file' if required else 'default if set neither here nor in the train file'
        text = f'{info.description} [{info.unit}]; overrides the train file ({source}); {_NEXT}'
        low = min(info.low, default)
        yield ParameterSpec(f'{section}.{name}', default, text, low, info.high, required=required)


TRAIN_PARAMETERS: Final = (
    *_train_parameters('train', Train, 'mass', 'rotary_mass', 'length', 'mass_std', 'force_std'),
    *_train_parameters('resistance', Davis, 'a', 'b', 'c'),
    *_train_parameters('brake', Brake, 'rate', 'time_constant', 'delay', 'timing_std'),
    *_train_parameters('line', Line, 'gradient_std'),
)
"""Parameters that override a field of the train file, of the same name."""


def filed_values(train_file: TrainFile) -> dict[str, float]:
    """Return the values of a train file that parameters override, by name."""
    return {spec.name: float(attrgetter(spec.name)(train_file)) for spec in TRAIN_PARAMETERS}


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
        'time_jump_policy', PipelineConfig().time_jump_policy.value, 'what to do when stamps or /clock jump back',
        choices=tuple(policy.value for policy in TimeJumpPolicy),
    ),
    ParameterSpec(
        'checkpoint_file', '', 'path (.json) of the state, loaded at start and kept up to date', read_only=True
    ),
    ParameterSpec(
        'checkpoint_period', 5.0, 'time between checkpoints, at least 0.1, or 0: only when the node stops [s]',
        0.0, 3600.0, least=0.1,
    ),
    ParameterSpec(
        'record_folder', '', 'folder of bags with the last inputs, written after faults and steps', read_only=True
    ),
    on_configure('record_minutes', 10.0, 'length of these bags [min]', 0.1, 120.0),
    SEED,
    ParameterSpec('diagnostic_period', 1.0, 'time between diagnostics [s]', 0.1, 60.0),
    AUTOSTART,
    TAKEN,
    *TRAIN_PARAMETERS,
)  # fmt: skip


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


def _settings(prefix: str, config: Any, fixed: frozenset[str] = frozenset()) -> Iterator[ParameterSpec]:
    for field, info in _infos(config, fixed).items():
        later = '' if prefix + field in LIVE else f'; {_NEXT}'
        text = f'{info.description} [{info.unit}]{later}'
        yield ParameterSpec(prefix + field, getattr(config, field), text, info.low, info.high)


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


def qos_overrides(resolve: Callable[[str], str], foreign: Iterable[str] = ()) -> list[str]:
    """Return the names of QoS parameters, by full names of topics, and a mapping's topics.

    Nodes of one process are given those of all of them.
    """
    topics = [(name, 'subscription') for name in (*(topic.name for topic in INPUT_TOPICS), *foreign)]
    outputs = dict.fromkeys(topic for kind in KINDS for topic in kind.topics)
    topics += [(name, 'publisher') for topic in outputs for name in (topic.name, topic.last_valid) if name]
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
    return replace(config, **{name: values[prefix + name] for name in _infos(config, fixed)})


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
            name, _, field = item.name.partition('.')
            sections[name] = replace(sections.get(name, getattr(base, name)), **{field: values[item.name]})
    train_file = replace(base, **sections)
    if train_file.train.mass <= 0.0:
        raise InputError(f'train.mass = {train_file.train.mass:g} kg must be > 0')
    return train_file


# Parameter files

# Types as the parser of ROS assigns them; PyYAML has other rules and reads 1e-05 as a string.
_BOOLS: Final = dict.fromkeys(('y', 'yes', 'true', 'on'), True) | dict.fromkeys(('n', 'no', 'false', 'off'), False)
_INTEGER: Final = re.compile(r'[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)')
_REAL: Final = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')
_NOT_FINITE: Final = re.compile(r'[-+]?\.?(nan|inf|infinity)', re.IGNORECASE)


def params_files(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the parameter files named in ROS arguments."""
    return tuple(Path(value) for option, value in pairwise(arguments) if option == '--params-file')


def check_sections(path: Path, node: str, usual_name: str, warn: Callable[[str], object]) -> None:
    """Warn if no section of a file matches a node; InputError if that is certainly an error.

    It is if a section has almost the name of the node, or its usual name, before remapping. A file that cannot be read
    is left to ROS, which reports it.
    """
    try:
        sections = [section for section, _ in _sections(path)]
    except InputError:
        return
    if not sections or any(_pattern(section).fullmatch(node) for section in sections):
        return
    names = {section or 'the root': section.rsplit('/', 1)[-1] for section in sections}
    near = difflib.get_close_matches(node.rsplit('/', 1)[-1], list(names.values()), n=1, cutoff=0.75)  # misspelt
    likely = [section for section, name in names.items() if name == usual_name or name in near]
    if likely:
        raise InputError(f'{path}: section {likely[0]!r} does not apply to this node, did you mean {node!r}?')
    warn(f'{path}: no section for {node!r}; its sections are {listed(list(names), 10)}')


def read_overrides(path: Path, node: str) -> dict[str, object]:
    """Return the values that a file gives to a node, as in ROS: of several matching sections, the last one wins.

    InputError if the file cannot be read or is not a parameter file.
    """
    found: dict[str, object] = {}
    for section, values in _sections(path):
        if _pattern(section).fullmatch(node):
            found |= _flat(path, values, '')
    return found


def _sections(path: Path) -> list[tuple[str, yaml.Node]]:
    """Return the sections of a file with what they give; InputError if it is not a parameter file."""
    tree = compose(read_text(path), str(path))
    return [] if tree is None else list(_sections_below(path, tree, ''))


def _sections_below(path: Path, tree: yaml.Node, prefix: str) -> Iterator[tuple[str, yaml.Node]]:
    if not isinstance(tree, yaml.MappingNode):
        raise InputError(f'{path}: is not a parameter file: {prefix or "it"} has no section with ros__parameters')
    for key, value in tree.value:
        name = _name(path, key, prefix)
        if name != 'ros__parameters':
            yield from _sections_below(path, value, f'{prefix}/{name.strip("/")}'.replace('//', '/'))
        elif isinstance(value, yaml.MappingNode):
            yield prefix, value
        else:
            raise InputError(f'{path}: ros__parameters of {prefix or "the file"} must map names to values')


def _name(path: Path, key: yaml.Node, prefix: str) -> str:
    if isinstance(key, yaml.ScalarNode):
        return str(key.value)
    raise InputError(
        f'{path}: is not a parameter file: a key of {prefix or "it"} is not a name (line {key.start_mark.line + 1})'
    )


def _flat(path: Path, node: yaml.Node, prefix: str) -> dict[str, object]:
    if not isinstance(node, yaml.MappingNode):
        return {prefix: _value(node)}
    found: dict[str, object] = {}
    for key, value in node.value:
        name = _name(path, key, prefix)
        found |= _flat(path, value, f'{prefix}.{name}' if prefix else name)
    return found


def _value(node: yaml.Node) -> object:
    if isinstance(node, yaml.SequenceNode):
        return [_value(item) for item in node.value]
    text = str(node.value)
    return text if getattr(node, 'style', None) in ("'", '"') else _plain(text)


def _plain(text: str) -> object:
    """Return an unquoted scalar as the parser of ROS reads it."""
    if (word := text.lower()) in _BOOLS and text in {word, word.capitalize(), word.upper()}:
        return _BOOLS[word]
    if _INTEGER.fullmatch(text):
        digits = text.lstrip('+-')
        base = 16 if digits[:2].lower() == '0x' else 8 if digits[0] == '0' else 10
        number = int(text, base)
        if -(2**63) <= number < 2**63:  # longer ones are read as real numbers
            return number
    if _NOT_FINITE.fullmatch(text):
        return float(text.replace('.', ''))
    if _REAL.fullmatch(text) and math.isfinite(real := float(text)):
        return real
    return text


def _pattern(section: str) -> re.Pattern[str]:
    wild = {'*': r'/[^/]+', '**': r'(?:/[^/]+)*'}
    return re.compile(''.join(wild.get(token, f'/{re.escape(token)}') for token in section.strip('/').split('/')))


@dataclass(frozen=True, slots=True)
class Setup:
    """Train file and settings that one node would run with."""

    kind: EstimatorKind[Any]
    train_file: TrainFile
    settings: EstimatorSettings

    @property
    def algorithm(self) -> str:
        """Name of the algorithm."""
        return str(getattr(self.settings, self.kind.name).algorithm)

    def aligned(self, values: Mapping[str, Any]) -> Setup:
        """Return it with the alignment in the values of a checkpoint, see ``Provenance``."""
        names = {item.name: f'alignment.{item.name}' for item in fields(AlignmentConfig)}
        stated = {name: values[key] for name, key in names.items() if key in values}
        return replace(self, settings=replace(self.settings, alignment=replace(self.settings.alignment, **stated)))

    def pipeline(
        self, align: Callable[[AlignmentConfig], AlignmentConfig] = lambda stated: stated
    ) -> EstimatorPipeline[Any]:
        """Return the pipeline that the node would run, with a changed alignment such as that which fits a mapping."""
        settings = replace(self.settings, alignment=align(self.settings.alignment))
        return self.kind.pipeline(self.train_file, settings)


def node_setups(
    train_file: TrainFile,
    source: str,
    params: Path | None = None,
    algorithms: Sequence[str] = (),
    *,
    namespace: str = '/',
    foreign: Collection[str] = (),
    warn: Callable[[str], None] = lambda _: None,
) -> tuple[Setup, ...]:
    """Return the train file and settings that the three nodes would run with in a namespace.

    ``source`` names the train file in messages. ``algorithms`` replace those in the parameter file ``params``, see
    :func:`chosen_algorithms`; ``foreign`` are the topics of the mapping. InputError if the file cannot be read, or a
    node would fail to configure; the message names node and reason.
    """
    chosen, setups = chosen_algorithms(algorithms), []
    for kind in KINDS:
        node, overrides = _full(kind.node_name, namespace), dict[str, object]()
        if params is not None:
            overrides = read_overrides(params, node)
            check_sections(params, node, kind.node_name, warn)
        if kind.name in chosen:
            overrides[ALGORITHM] = chosen[kind.name]
        topics = qos_overrides(partial(_full, namespace=namespace), foreign)
        # ROS adds two parameters to every node.
        others = {'use_sim_time', 'start_type_description_service', *topics}
        try:
            algorithm = requested_algorithm(overrides, kind.algorithms)
            specs = {spec.name: spec for spec in estimator_parameters(kind.algorithms, algorithm)}
            given, problems = validate_overrides(overrides, specs, others)
            for name in find_taken(given):
                del given[name]
            fallback = {name: value for name, value in filed_values(train_file).items() if name not in given}
            check_problems(problems)
            check_fallback(fallback, specs, source)
            values = {name: spec.default for name, spec in specs.items()} | fallback | given
            settings = build_settings(values, kind.algorithms, kind.name)
            setups.append(Setup(kind, build_train_file(values, frozenset(given), train_file), settings))
        except InputError as error:
            raise InputError(f'{kind.node_name}: {error}') from None
    return tuple(setups)


def _full(name: str, namespace: str) -> str:
    base = f'/{namespace.strip("/")}'.rstrip('/')
    return name if name.startswith('/') else f'{base}/{name}'


def mapping_in(params: Path | None, namespace: str = '/') -> Path | None:
    """Return the mapping file that the nodes would take from a parameter file, None without one.

    InputError if it cannot be read, or the nodes have different mapping files: a bag is read once for all.
    """
    if params is None:
        return None
    given = (read_overrides(params, _full(kind.node_name, namespace)).get(MAPPING_FILE.name) for kind in KINDS)
    found = sorted({str(value or '') for value in given})
    if len(found) > 1:
        raise InputError(
            f'{params}: nodes with different {MAPPING_FILE.name} ({", ".join(map(repr, found))}): give --map'
        )
    return Path(found[0]).expanduser() if found[0] else None


_WIDTH: Final = 108
_HEAD: Final = """\
# All parameters of the three estimator nodes, with default, unit and range.
# Generated by: python -m trainid_ros.setup.params_file > config/params.yaml
#
#   ros2 run trainid_ros resistance_estimator --ros-args --params-file params.yaml -p train_file:=train.yaml
#   ros2 launch trainid_ros trainid.launch.py params_file:=params.yaml train_file:=train.yaml
#
# /**/ before a node's name makes its section apply in every namespace. A node that finds an unknown key,
# or a section named almost like itself, reports it and does not configure. Changes while a node runs take
# effect on its next configure. QoS of the topics: qos_overrides.<topic>.subscription.* (history, depth,
# reliability) and qos_overrides.<topic>.publisher.* (also deadline, lifespan, liveliness and
# liveliness_lease_duration; durations in ns).
#
# While train, resistance, brake and line are commented out, the values of the train file apply; uncomment
# to override them. The section estimator belongs to the default algorithm; the sections of the other
# algorithms follow, commented out, each to replace it.
"""


def parameter_file() -> str:
    """Return the text of the file."""
    blocks = [_HEAD]
    for kind in KINDS:
        lines = (*_section(estimator_parameters(kind.algorithms)), *_other_algorithms(kind))
        blocks.append('\n'.join((f'/**/{kind.node_name}:', '  ros__parameters:', *lines, '')))
    return '\n'.join(blocks)


def _other_algorithms(kind: EstimatorKind[Any]) -> Iterator[str]:
    for name in kind.algorithms.built_in[1:]:
        specs = estimator_parameters(kind.algorithms, name)
        yield from textwrap.wrap(
            f'{name}: {kind.algorithms[name].summary}', _WIDTH, initial_indent='    # ', subsequent_indent='    #   '
        )
        yield f"    # algorithm: '{name}'"
        yield from _section(tuple(spec for spec in specs if spec.name.startswith('estimator.')), commented=True)


def _section(specs: tuple[ParameterSpec, ...], *, commented: bool = False) -> Iterator[str]:
    group = ''
    for spec in specs:
        if spec is TAKEN:
            continue
        prefix, _, name = spec.name.rpartition('.')
        mark = '# ' if commented or spec in TRAIN_PARAMETERS else ''
        if prefix not in ('', group):
            yield f'    {mark}{prefix}:'
        group = prefix
        indent = f'    {mark}  ' if prefix else '    '
        setting, comment = f'{indent}{name}: {_shown(spec.default)}', f'# {_explained(spec)}'
        if len(setting) + 2 + len(comment) <= _WIDTH:
            yield f'{setting}  {comment}'
        else:
            yield from textwrap.wrap(comment, _WIDTH, initial_indent=indent, subsequent_indent=f'{indent}#   ')
            yield setting


def _explained(spec: ParameterSpec) -> str:
    """Return description and range of a parameter; the head of the file states when changes take effect."""
    text = spec.description.split('; takes effect')[0].split('; overrides')[0]
    if spec.choices:
        return f'{text}: {", ".join(spec.choices)}'
    if isinstance(spec.default, (str, bool)):
        return text
    if isinstance(spec.default, int):
        return f'{text}, {int(spec.low)} to {int(spec.high)}'
    return f'{text}, {spec.low:g} to {spec.high:g}'


def _shown(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}'" if isinstance(value, str) else repr(value)


if __name__ == '__main__':
    sys.stdout.write(parameter_file())

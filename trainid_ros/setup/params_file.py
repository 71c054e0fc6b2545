# SPDX-License-Identifier: Apache-2.0
"""Parameter files: the settings of the three nodes without running them, by the same checks, and the commented file.

Sections that match no node are found, which ROS ignores. The commented file states all parameters that the nodes
declare; ``python -m trainid_ros.setup.params_file > config/params.yaml`` updates it.
"""

from __future__ import annotations

import difflib
import math
import re
import sys
import textwrap
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import yaml

from trainid_ros.interface.errors import InputError
from trainid_ros.setup.parameter_specs import (
    ALGORITHM,
    MAPPING_FILE,
    TAKEN,
    TRAIN_PARAMETERS,
    ParameterSpec,
    Value,
    build_settings,
    build_train_file,
    check_fallback,
    check_problems,
    estimator_parameters,
    find_taken,
    qos_overrides,
    requested_algorithm,
    validate_overrides,
)
from trainid_ros.setup.pipelines import KINDS, chosen_algorithms
from trainid_ros.train.fields import read_text
from trainid_ros.train.strict_yaml import compose

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.setup.pipelines import EstimatorKind, EstimatorSettings
    from trainid_ros.stream.alignment import AlignmentConfig
    from trainid_ros.train.train_file import TrainFile

# Number of sections that a message names.
_MAX_NAMED: Final = 10
# Types as the parser of ROS assigns them; PyYAML has other rules and reads 1e-05 as a string.
_BOOLS: Final = {
    word: value
    for value, words in ((True, ('y', 'yes', 'true', 'on')), (False, ('n', 'no', 'false', 'off')))
    for plain in words
    for word in (plain, plain.capitalize(), plain.upper())
}
_INTEGER: Final = re.compile(r'[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)')
_REAL: Final = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')
_NOT_FINITE: Final = re.compile(r'[-+]?\.?(nan|inf|infinity)', re.IGNORECASE)


def params_files(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the parameter files named in ROS arguments."""
    return tuple(Path(value) for option, value in pairwise(arguments) if option == '--params-file')


def find_mismatch(path: Path, node: str, usual_name: str) -> tuple[str, bool] | None:
    """Return a message, and whether it is certainly an error, if no section of a file matches a node; else None.

    It is certainly an error if a section has almost the name of the node, or its usual name, before remapping. A file
    that cannot be read is left to ROS, which reports it.
    """
    try:
        sections = [section for section, _ in _given_in_file(path)]
    except InputError:
        return None
    if not sections or any(_pattern(section).fullmatch(node) for section in sections):
        return None
    names = {section or 'the root': section.rsplit('/', 1)[-1] for section in sections}
    near = difflib.get_close_matches(node.rsplit('/', 1)[-1], list(names.values()), n=1, cutoff=0.75)  # misspelt
    likely = [section for section, name in names.items() if name == usual_name or name in near]
    if likely:
        return f'{path}: section {likely[0]!r} does not apply to this node, did you mean {node!r}?', True
    more = f' and {len(names) - _MAX_NAMED} more' if len(names) > _MAX_NAMED else ''
    return f'{path}: no section for {node!r}; its sections are {", ".join(list(names)[:_MAX_NAMED])}{more}', False


def read_overrides(path: Path, node: str) -> dict[str, object]:
    """Return the values that a file gives to a node, as in ROS: of several matching sections, the last one wins.

    InputError if the file cannot be read or is not a parameter file.
    """
    found: dict[str, object] = {}
    for section, values in _given_in_file(path):
        if _pattern(section).fullmatch(node):
            found |= _flat(path, values, '')
    return found


def _given_in_file(path: Path) -> Iterator[tuple[str, yaml.Node]]:
    """Yield the sections of a file with what they give; InputError if it is not a parameter file."""
    tree = compose(read_text(path), str(path))
    if tree is not None:
        yield from _given_in_tree(path, tree, '')


def _given_in_tree(path: Path, tree: yaml.Node, prefix: str) -> Iterator[tuple[str, yaml.Node]]:
    if not isinstance(tree, yaml.MappingNode):
        raise InputError(f'{path}: is not a parameter file: {prefix or "it"} has no section with ros__parameters')
    for key, value in tree.value:
        name = _name(path, key, prefix)
        if name != 'ros__parameters':
            yield from _given_in_tree(path, value, f'{prefix}/{name.strip("/")}'.replace('//', '/'))
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
    if text in _BOOLS:
        return _BOOLS[text]
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

    def pipeline(self) -> EstimatorPipeline[Any]:
        """Return the pipeline that the node would run."""
        return self.kind.pipeline(self.train_file, self.settings)

    def realigned(self, change: Callable[[AlignmentConfig], AlignmentConfig]) -> Setup:
        """Return the setup with a changed alignment, such as that which fits a mapping."""
        return replace(self, settings=replace(self.settings, alignment=change(self.settings.alignment)))


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
    """Return the train file and settings that the three nodes would run with.

    Args:
        train_file: Train file of the nodes.
        source: Its name, for messages.
        params: Parameter file, None for defaults.
        algorithms: Algorithms that replace those in the file, see :func:`chosen_algorithms`.
        namespace: Namespace of the nodes.
        foreign: Topics of their mapping.
        warn: Called with each warning.

    Raises:
        InputError: The file cannot be read, or a node would fail to configure; the message names node and reason.
    """
    chosen, setups = chosen_algorithms(algorithms), []
    for kind in KINDS:
        node, overrides = _full(kind.node_name, namespace), dict[str, object]()
        if params is not None:
            overrides = read_overrides(params, node)
            if (found := find_mismatch(params, node, kind.node_name)) is not None:
                message, certain = found
                if certain:
                    raise InputError(message)
                warn(message)
        if kind.name in chosen:
            overrides[ALGORITHM] = chosen[kind.name]
        topics = qos_overrides(kind.topic, partial(_full, namespace=namespace), foreign)
        # ROS adds two parameters to every node.
        others = {'use_sim_time', 'start_type_description_service', *topics}
        setups.append(_setup(kind, train_file, source, overrides, others))
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


def _setup(
    kind: EstimatorKind[Any],
    train_file: TrainFile,
    source: str,
    overrides: Mapping[str, object],
    others: Collection[str],
) -> Setup:
    algorithm = requested_algorithm(overrides, kind.algorithms)
    specs = {spec.name: spec for spec in estimator_parameters(kind.algorithms, algorithm)}
    given, problems = validate_overrides(overrides, specs, others)
    for name in find_taken(given):
        del given[name]
    fallback = {item.name: item.of(train_file) for item in TRAIN_PARAMETERS if item.name not in given}
    try:
        check_problems(problems)
        check_fallback(fallback, specs, source)
        values = {name: spec.default for name, spec in specs.items()} | fallback | given
        settings = build_settings(values, kind.algorithms, kind.name)
        return Setup(kind, build_train_file(values, frozenset(given), train_file), settings)
    except InputError as error:
        raise InputError(f'{kind.node_name}: {error}') from None


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
    train = {item.name for item in TRAIN_PARAMETERS}
    group = ''
    for spec in specs:
        if spec is TAKEN:
            continue
        prefix, _, name = spec.name.rpartition('.')
        mark = '# ' if commented or spec.name in train else ''
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

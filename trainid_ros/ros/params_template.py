# SPDX-License-Identifier: Apache-2.0
"""The commented parameter file, written from what the nodes declare.

``python -m trainid_ros.ros.params_template > config/params.yaml`` brings it up to date.
"""

from __future__ import annotations

import sys
import textwrap
from typing import TYPE_CHECKING, Final

from trainid_ros.ros.jobs import JOBS
from trainid_ros.ros.parameter_specs import TRAIN_PARAMETERS, ParameterSpec, Value, estimator_parameters

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.ros.jobs import Job

_WIDTH: Final = 108
_HEAD: Final = """\
# Parameters of the three estimator nodes: every one, with its default, unit and range.
# Written by: python -m trainid_ros.ros.params_template > config/params.yaml
#
#   ros2 run trainid_ros resistance_estimator --ros-args --params-file params.yaml -p train_file:=train.yaml
#   ros2 launch trainid_ros trainid.launch.py params_file:=params.yaml train_file:=train.yaml
#
# /**/ in front of a node's name makes its section hold in every namespace. A node that finds a key it
# does not know, or a section named almost like itself, says so and refuses to configure. Changes while a
# node runs take effect on its next configure. QoS of the topics: qos_overrides.<topic>.subscription.*
# and qos_overrides.<topic>.publisher.* (history, depth, reliability).
#
# Where train, resistance, brake and line are commented out, the train file holds; take the marks away to
# override it. The section estimator belongs to the default algorithm; below it, commented out, are those
# of the other algorithms, each to be taken in its place.
"""


def parameter_file() -> str:
    """Return the text of the file."""
    blocks = [_HEAD]
    for job in JOBS:
        lines = (*_section(estimator_parameters(job.algorithms)), *_other_algorithms(job))
        blocks.append('\n'.join((f'/**/{job.node_name}:', '  ros__parameters:', *lines, '')))
    return '\n'.join(blocks)


def _other_algorithms(job: Job) -> Iterator[str]:
    """Yield what takes the place of the section estimator with the algorithms that are not the default."""
    for name in job.algorithms.names[1:]:
        specs = estimator_parameters(job.algorithms, name)
        yield from textwrap.wrap(
            f'{name}: {job.algorithms[name].summary}', _WIDTH, initial_indent='    # ', subsequent_indent='    #   '
        )
        yield f"    # algorithm: '{name}'"
        yield from _section(tuple(spec for spec in specs if spec.name.startswith('estimator.')), commented=True)


def _section(specs: tuple[ParameterSpec, ...], *, commented: bool = False) -> Iterator[str]:
    train = {item.name for item in TRAIN_PARAMETERS}
    group = ''
    for spec in specs:
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
    """Return what a parameter is and may be; that all take effect later is said at the top."""
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

# SPDX-License-Identifier: Apache-2.0
"""Arguments of all verbs, apart from their code: help and usage errors come before that is loaded."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

LIVE_NODES: Final = ('resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator')
DEMO_BAGS: Final = {'altrios': 'altrios_manifest', 'yizhuang': 'yizhuang_day'}
"""Chapters of the demo with their bags."""
DEMO_RATE: Final = 70.0
"""Rate at which two cores keep up with four nodes, player and listener [x real time]."""
DEMO_QUICK_S: Final = 300.0
"""Part of each bag that a quick demo plays [s]."""
_MAX_CHUNK_MB: Final = 64
_MAX_MB: Final = 4095  # offsets within a chunk have 32 bits
_NAMESPACE: Final = re.compile(r'/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?', re.ASCII)
_FALSE_ALARM_DAYS: Final = 20_000.0
EXPLAIN_CHAPTER: Final = 'explain'
"""The chapter of the demo that hides and finds an effect."""


def configure_demo(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``demo``."""
    parser.add_argument(
        'bag', nargs='*', type=Path, metavar='BAG', help='bags with train.yaml inside (default: those of the package)'
    )
    parser.add_argument(
        '--rate',
        type=positive,
        default=DEMO_RATE,
        metavar='R',
        help=f'playback rate, x real time (default: {DEMO_RATE:g})',
    )
    parser.add_argument(
        '--out', type=Path, default=Path('out/demo'), metavar='DIR', help='report and logs (default: out/demo)'
    )
    parser.add_argument('--only', choices=(*DEMO_BAGS, EXPLAIN_CHAPTER), help='run only this chapter')
    parser.add_argument('--quick', action='store_true', help=f'only the first {DEMO_QUICK_S:g} s of each bag')
    _add_json(parser)


def configure_run(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``run``."""
    parser.add_argument('--train', type=Path, metavar='T.yaml', help='train file (parameter train_file)')
    _add_map(parser, 'mapping file (parameter mapping_file): inputs from other topics, types and units')
    parser.add_argument(
        '--node', action='append', choices=LIVE_NODES, metavar='NAME', help='run only this node; repeatable'
    )
    _add_ros_args(parser)


def configure_monitor(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``monitor``."""
    parser.add_argument('--namespace', metavar='NAME', help='namespace of the train (default: all trains found)')
    parser.add_argument('--duration', type=positive, default=0.0, metavar='S', help='end after this many seconds')
    _add_ros_args(parser)


def configure_view(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``view``."""
    _add_bag(parser)
    _add_map(parser)
    _add_max_chunk(parser)
    parser.add_argument('--train', type=Path, metavar='T.yaml', help='train file (default: train.yaml in the bag)')
    _add_settings(parser)
    parser.add_argument('--out', type=Path, metavar='FILE.rrd', help='write a recording instead of opening the viewer')
    _add_namespace(parser, 'topics and nodes')


def configure_replay(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``replay``."""
    _add_bags(parser)
    _add_map(parser)
    _add_max_chunk(parser)
    _add_train(parser)
    _add_settings(parser)
    parser.add_argument(
        '--out',
        type=Path,
        metavar='OUT',
        help='write inputs and estimates to a new bag, or estimates to a table if it ends in .parquet or .csv; of '
        'several bags, to one bag each in this folder',
    )
    parser.add_argument(
        '--report',
        type=Path,
        metavar='FILE.html',
        help='write a report with plots; of several bags, one each in this folder',
    )
    parser.add_argument(
        '--truth', type=Path, metavar='FILE', help='truth for the report (default: truth.yaml in the bag, if any)'
    )
    _add_jobs(parser)
    _add_namespace(parser, 'topics and nodes')
    _add_json(parser)


def configure_play(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``play``."""
    _add_bag(parser)
    _add_map(parser, 'mapping file: also play the topics that it names')
    _add_max_chunk(parser)
    parser.add_argument(
        '--rate', type=positive, default=1.0, metavar='R', help='recorded seconds per second (default: 1)'
    )
    parser.add_argument('--start', type=not_negative, default=0.0, metavar='S', help='skip the first seconds')
    parser.add_argument('--duration', type=positive, default=0.0, metavar='S', help='play only this many seconds')
    parser.add_argument('--loop', action='store_true', help='start over at the end')
    parser.add_argument(
        '--wait',
        type=int,
        default=0,
        metavar='N',
        help='wait for this many subscribers on each topic before starting; run with --map subscribes once to each',
    )
    _add_namespace(parser, 'the topics in the bag')
    _add_ros_args(parser)


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``simulate``."""
    # Imported here because other verbs need not load it.
    from trainid_ros.sim.worlds import (  # noqa: PLC0415
        REALISMS,
        UNKNOWNS,
        WORLDS,
    )

    parser.add_argument('out', type=Path, metavar='OUT', help='bag to create')
    parser.add_argument(
        '--train', type=Path, metavar='T.yaml', help='the true train; with --world the train as an engineer states it'
    )
    parser.add_argument('--world', choices=tuple(WORLDS), help='type of railway: train, line and driver')
    parser.add_argument(
        '--realism',
        choices=tuple(REALISMS),
        help='clean: the train file is exact; field: it has errors as on real trains (default: clean)',
    )
    parser.add_argument(
        '--unknown',
        action='append',
        default=[],
        choices=UNKNOWNS,
        metavar='NAME',
        help=f'quantity that is wrong in the train file or missing from it; repeatable: {", ".join(UNKNOWNS)}',
    )
    parser.add_argument(
        '--effect',
        action='append',
        default=[],
        metavar='NAME:key=value',
        help='add an effect to the truth, e.g. tunnel_drag:factor=1.8; repeatable',
    )
    parser.add_argument('--runs', type=int, default=4, metavar='N', help='runs from stop to stop (default: 4)')
    parser.add_argument(
        '--seed', type=whole, default=1, metavar='S', help='seed of the random numbers, >= 0 (default: 1)'
    )
    _add_json(parser)


def configure_fit(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``fit``."""
    _add_bag(parser)
    _add_map(parser)
    _add_max_chunk(parser)
    _add_train(parser)
    parser.add_argument('--start', type=not_negative, default=0.0, metavar='S', help='skip the first seconds')
    parser.add_argument(
        '--duration', type=not_negative, default=math.inf, metavar='S', help='fit only this many seconds'
    )
    _add_namespace(parser)
    _add_json(parser)


def configure_explain(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``explain``."""
    _add_bags(parser)
    _add_map(parser)
    _add_max_chunk(parser)
    _add_train(parser, 'train file: the model to check')
    parser.add_argument(
        '--out', type=Path, metavar='DIR', help='write report.html, report.json and the new train.yaml there'
    )
    _add_namespace(parser)
    _add_json(parser)


def configure_info(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``info``."""
    _add_bags(parser)
    _add_map(parser, 'mapping file: check the inputs that it makes')
    parser.add_argument(
        '--suggest-map', action='store_true', help='print a mapping file for a bag, with reasons as comments'
    )
    parser.add_argument(
        '--train', type=Path, metavar='T.yaml', help='train file: its mass shows units, its line has gradients'
    )
    _add_max_chunk(parser)
    _add_jobs(parser)
    _add_namespace(parser)
    _add_json(parser)


def configure_import(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``import``."""
    parser.add_argument('file', type=Path, metavar='FILE', help='table: .csv, .parquet or .npz')
    parser.add_argument('out', type=Path, metavar='OUT', help='bag to create')
    parser.add_argument(
        '--map', type=Path, required=True, metavar='MAPPING.yaml', help='mapping file: inputs from columns and units'
    )
    parser.add_argument('--train', type=Path, metavar='T.yaml', help='train file, if the gradient comes from its line')
    _add_json(parser)


def configure_fleet(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``fleet``."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='bags, folders that hold bags, or patterns')
    _add_map(parser)
    _add_max_chunk(parser)
    _add_train(parser)
    _add_params(parser)
    parser.add_argument(
        '--out', type=Path, required=True, metavar='TABLE.parquet', help='table to write; .csv needs no pyarrow'
    )
    parser.add_argument(
        '--label',
        metavar='REGEX',
        help='regular expression on the path of a bag; its named groups train, line, weather and day are columns '
        '(default: the train is the folder that holds the bag)',
    )
    parser.add_argument(
        '--scheduler', metavar='ADDRESS', help='replay on the workers of a Dask scheduler, such as tcp://host:8786'
    )
    parser.add_argument(
        '--replace', action='store_true', help='write over a table of other bags, or made with other files'
    )
    _add_jobs(parser, 0)
    _add_namespace(parser)
    _add_json(parser)


def configure_fleet_report(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``fleet report``."""
    parser.add_argument('tables', nargs='+', type=Path, metavar='TABLE', help='tables of trainid fleet')
    parser.add_argument('--out', type=Path, metavar='REPORT.html', help='write a report with plots')
    parser.add_argument(
        '--explain', type=whole, default=0, metavar='N', help='name the cause for the N worst trains, from their bags'
    )
    parser.add_argument(
        '--false-alarm-days',
        type=positive,
        default=_FALSE_ALARM_DAYS,
        metavar='D',
        help=f'train-days for one false alarm (default: {_FALSE_ALARM_DAYS:g})',
    )
    _add_json(parser)


def _add_bag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 directory, .mcap or .db3 file')


def _add_bags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='rosbag2 directory, .mcap or .db3 file')


def _add_max_chunk(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--max-chunk',
        type=megabytes,
        default=_MAX_CHUNK_MB << 20,
        metavar='MB',
        help=f'leave out chunks of a bag that unpack to more than this (default: {_MAX_CHUNK_MB})',
    )


def _add_train(parser: argparse.ArgumentParser, text: str = 'train file') -> None:
    parser.add_argument('--train', type=Path, required=True, metavar='T.yaml', help=text)


def _add_settings(parser: argparse.ArgumentParser) -> None:
    _add_params(parser)
    parser.add_argument(
        '--algorithm',
        action='append',
        default=[],
        metavar='NAME',
        help='algorithm instead of the default, or resistance=NAME and so on; repeatable',
    )


def _add_map(
    parser: argparse.ArgumentParser, text: str = 'mapping file: inputs from other topics, types and units'
) -> None:
    parser.add_argument('--map', type=Path, metavar='MAPPING.yaml', help=text)


def _add_params(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--params',
        type=Path,
        metavar='FILE.yaml',
        help='ROS parameter file, as the nodes take it; its mapping_file counts unless --map is given',
    )


def _add_jobs(parser: argparse.ArgumentParser, default: int = 1) -> None:
    parser.add_argument(
        '--jobs',
        type=whole,
        default=default,
        metavar='N',
        help=f'bags to work on at once, each in its own process; 0 = one per processor (default: {default})',
    )


def _add_namespace(parser: argparse.ArgumentParser, of: str = 'the topics') -> None:
    parser.add_argument('--namespace', type=namespace, default='/', help=f'namespace of {of} (default: /)')


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--json', action='store_true', help='print JSON on standard output and nothing else there')


def _add_ros_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--ros-args',
        nargs=argparse.REMAINDER,
        default=[],
        metavar='...',
        help='remaining arguments are passed to ROS; must come last',
    )


def namespace(text: str) -> str:
    """Return a namespace that ROS allows; ArgumentTypeError for anything else."""
    if _NAMESPACE.fullmatch(text) is None:
        raise argparse.ArgumentTypeError(
            f'{text!r} is no namespace: letters, digits and underscores, parts separated by /'
        )
    return text


def positive(text: str) -> float:
    """Return a finite number above zero; ArgumentTypeError for anything else."""
    return _number(text, 'a number > 0', lambda value: value > 0.0)


def not_negative(text: str) -> float:
    """Return a finite number, zero or above; ArgumentTypeError for anything else."""
    return _number(text, 'a number >= 0', lambda value: value >= 0.0)


def _number(text: str, wanted: str, is_wanted: Callable[[float], bool]) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and is_wanted(value)):
        raise argparse.ArgumentTypeError(f'{text!r} must be {wanted}')
    return value


def whole(text: str) -> int:
    """Return a whole number, zero or above; ArgumentTypeError for anything else."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number >= 0')
    return int(text)


def megabytes(text: str) -> int:
    """Return a size in bytes, given in whole MB from 1 to 4095; ArgumentTypeError for anything else."""
    if not (text.isdecimal() and 1 <= int(text) <= _MAX_MB):
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number of MB from 1 to {_MAX_MB}')
    return int(text) << 20

# SPDX-License-Identifier: Apache-2.0
"""The verbs and their options, apart from their code: help and usage errors come before that is loaded."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

LIVE_NODES: Final = ('resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator')
DEMO_BAGS: Final = {'altrios': 'altrios_manifest', 'yizhuang': 'yizhuang_day'}
"""Chapters of the demo with their bags."""
DEMO_RATE: Final = 70.0
"""Rate at which two cores keep up with four nodes, player and listener [x real time]."""
DEMO_QUICK_S: Final = 300.0
"""Part of each bag that a quick demo plays [s]."""
EXPLAIN_CHAPTER: Final = 'explain'
"""The chapter of the demo that hides and finds an effect."""


def namespace(text: str) -> str:
    """Return a namespace that ROS allows; ArgumentTypeError for anything else."""
    if re.fullmatch(r'/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?', text, re.ASCII) is None:
        raise argparse.ArgumentTypeError(
            f'{text!r} is no namespace: letters, digits and underscores, parts separated by /'
        )
    return text


def _finite(wanted: str, is_wanted: Callable[[float], bool], text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and is_wanted(value)):
        raise argparse.ArgumentTypeError(f'{text!r} must be {wanted}')
    return value


positive: Final = partial(_finite, 'a number > 0', lambda value: value > 0.0)
"""Returns a finite number above zero; ArgumentTypeError for anything else."""
_not_negative: Final = partial(_finite, 'a number >= 0', lambda value: value >= 0.0)


def whole(text: str) -> int:
    """Return a whole number, zero or above; ArgumentTypeError for anything else."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number >= 0')
    return int(text)


def _megabytes(text: str) -> int:
    """Return a size in bytes, given in whole MB; the offsets within a chunk have 32 bits."""
    if not (text.isdecimal() and 1 <= int(text) <= 4095):
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number of MB from 1 to 4095')
    return int(text) << 20


def _path(metavar: str, text: str, **more: Any) -> dict[str, Any]:
    return {'type': Path, 'metavar': metavar, 'help': text, **more}


def _value(kind: Callable[[str], Any], default: Any, metavar: str | None, text: str, **more: Any) -> dict[str, Any]:
    return {'type': kind, 'default': default, 'metavar': metavar, 'help': text, **more}


def _flag(text: str) -> dict[str, Any]:
    return {'action': 'store_true', 'help': text}


def _repeated(text: str, metavar: str = 'NAME', **more: Any) -> dict[str, Any]:
    return {'action': 'append', 'default': [], 'metavar': metavar, 'help': text, **more}


def _namespace(of: str) -> dict[str, Any]:
    return _value(namespace, '/', None, f'namespace of {of} (default: /)')


def _jobs(default: int) -> dict[str, Any]:
    text = f'bags to work on at once, each in its own process; 0 = one per processor (default: {default})'
    return _value(whole, default, 'N', text)


class Verb(NamedTuple):
    """One sub-command."""

    name: str
    help: str
    options: str  # Names of its arguments, see ``OPTIONS``, in the order of its help
    function: str = ''  # Module and function; those of its name and ``run`` if empty


VERBS: Final = (
    Verb(
        'demo', 'play a bag through the live nodes and write a report',
        'bag --rate --out --only --quick --seed --json',
    ),
    Verb('run', 'run the estimator nodes live', '--train --map --node --record --ros-args', 'live.run_nodes'),
    Verb(
        'monitor', 'show inputs, estimates and diagnostics live in a terminal', '--namespace --duration --ros-args',
        'live.monitor',
    ),
    Verb(
        'view', 'show a bag and its estimates in the Rerun viewer',
        'bag --map --max-chunk --train --params --algorithm --out --namespace', 'replay.view',
    ),
    Verb(
        'replay', 'run the estimators over bags, off line',
        'bags --map --max-chunk --train --params --algorithm --checkpoint --out --report --truth --jobs --namespace '
        '--json',
    ),
    Verb(
        'play', "publish a bag's inputs with /clock",
        'bag --map --max-chunk --rate --start --duration --loop --wait --namespace --ros-args', 'live.play',
    ),
    Verb(
        'simulate', 'create a bag with the simulator, or those of a fleet',
        'out --train --world --realism --unknown --effect --fleet --days --fault --runs --seed --json',
        'new_bag.simulate',
    ),
    Verb(
        'fit', 'fit Davis parameters, or the brake, in one batch',
        'bags --map --max-chunk --train --brake --out --etcs --start --duration --namespace --json',
    ),
    Verb(
        'explain', 'find the effects that a train file lacks and add them',
        'bags --map --max-chunk --train --out --propose --watch --namespace --json',
    ),
    Verb(
        'info', 'show what is in bags and whether they can be used',
        'bags --map --suggest-map --train --max-chunk --jobs --namespace --json',
    ),
    Verb(
        'import', 'make a bag of a table: CSV, Parquet or npz', 'file out --map --suggest-map --train --json',
        'new_bag.import_table',
    ),
    Verb(
        'fleet', 'replay the bags of a fleet into a table',
        'bags --map --max-chunk --train --params --out --label --scheduler --replace --jobs --namespace --json',
    ),
    Verb(
        'fleet report', 'find the trains that stand out in a table', 'tables --out --explain --false-alarm-days --json',
        'fleet.report',
    ),
    Verb(
        'train import', 'make a train file of railML or OSRD files', 'files --formation --track --out --json',
        'train.import_files',
    ),
    Verb('train show', 'show a train file: resistance, brake and line', 'train --out --json', 'train.show_file'),
)  # fmt: skip

OPTIONS: Final[dict[str, dict[str, Any]]] = {
    'bag': _path('BAG', 'rosbag2 directory, .mcap or .db3 file'),
    'demo bag': _path('BAG', 'bags with train.yaml inside (default: those of the source tree)', nargs='*'),
    'bags': _path('BAG', 'rosbag2 directory, .mcap or .db3 file', nargs='+'),
    'fleet bags': _path('BAG', 'bags, folders that hold bags, or patterns', nargs='+'),
    'tables': _path('TABLE', 'tables of trainid fleet', nargs='+'),
    'file': _path('FILE', 'table: .csv, .vbo, .parquet or .npz'),
    'files': _path('FILE', 'railML (.xml, .railml), OSRD (.json), or a train file to start from (.yaml)', nargs='+'),
    'train': _path('T.yaml', 'train file'),
    '--formation': _value(str, '', 'ID', 'formation, or vehicle, of a railML file with several'),
    '--track': _value(str, '', 'ID', 'track of a file with several: the line'),
    'out': _path('OUT', 'bag to create'),
    'import out': _path('OUT', 'bag to create', nargs='?'),
    'simulate out': _path('OUT', 'bag to create, or folder for the bags of a fleet'),
    '--map': _path('MAPPING.yaml', 'mapping file: inputs from other topics, types and units'),
    'run --map': _path(
        'MAPPING.yaml', 'mapping file (parameter mapping_file): inputs from other topics, types and units'
    ),
    'play --map': _path('MAPPING.yaml', 'mapping file: also play the topics that it names'),
    'info --map': _path('MAPPING.yaml', 'mapping file: check the inputs that it makes'),
    'import --map': _path('MAPPING.yaml', 'mapping file: inputs from columns and units'),
    '--suggest-map': _flag('print a mapping file for a bag, with reasons as comments'),
    'import --suggest-map': _flag('print a mapping file for the table, with reasons as comments'),
    '--max-chunk': _value(
        _megabytes, 64 << 20, 'MB', 'leave out chunks of a bag that unpack to more than this (default: 64)'
    ),
    '--train': _path('T.yaml', 'train file', required=True),
    'run --train': _path('T.yaml', 'train file (parameter train_file)'),
    'view --train': _path('T.yaml', 'train file (default: train.yaml in the bag)'),
    'simulate --train': _path('T.yaml', 'the true train; with --world the train as an engineer states it'),
    'explain bags': _path('BAG', 'rosbag2 directory, .mcap or .db3 file; with --watch folders of them', nargs='+'),
    'explain --train': _path('T.yaml', 'train file: the model to check', required=True),
    'info --train': _path('T.yaml', 'train file: its mass shows units, its line has gradients'),
    'import --train': _path('T.yaml', 'train file: its line has gradients, its mass shows units for --suggest-map'),
    '--params': _path(
        'FILE.yaml', 'ROS parameter file, as the nodes take it; its mapping_file counts unless --map is given'
    ),
    '--algorithm': _repeated('algorithm instead of the default, or resistance=NAME and so on; repeatable'),
    '--checkpoint': _path('FOLDER', 'start from the checkpoints there, such as those of a recording of run --record'),
    'demo --out': _path('DIR', 'report and logs (default: out/demo)', default=Path('out/demo')),
    'view --out': _path('FILE.rrd', 'write a recording instead of opening the viewer'),
    'replay --out': _path(
        'OUT',
        'write inputs and estimates to a new bag, or estimates to a table if it ends in .parquet or .csv; of several '
        'bags, to one bag each in this folder',
    ),
    'explain --out': _path('DIR', 'write report.html, report.json and the new train.yaml there'),
    '--propose': _path('DIR', 'the same as --out, and a note on the change and a test of the new train file'),
    '--watch': _flag('explain again whenever a bag is added to the folders, and print only what is new'),
    'fleet --out': _path('TABLE.parquet', 'table to write; .csv needs no pyarrow', required=True),
    'fleet report --out': _path('REPORT.html', 'write a report with plots'),
    'train import --out': _path('T.yaml', 'write the train file there instead of on standard output'),
    'train show --out': _path('PAGE.html', 'write a page with plots'),
    '--report': _path('FILE.html', 'write a report with plots; of several bags, one each in this folder'),
    '--truth': _path('FILE', 'truth for the report (default: truth.yaml in the bag, if any)'),
    'demo --rate': _value(positive, DEMO_RATE, 'R', f'playback rate, x real time (default: {DEMO_RATE:g})'),
    'play --rate': _value(positive, 1.0, 'R', 'recorded seconds per second (default: 1)'),
    '--brake': _flag('fit dead time, lag and rate of the brake instead, to one bag or several'),
    'fit bags': _path('BAG', 'rosbag2 directory, .mcap or .db3 file; several only with --brake', nargs='+'),
    'fit --out': _path('FILE', 'with --brake: write the brake section of a train file there'),
    '--etcs': _flag('with --brake: also in the form of ERTMS brake parameters, SUBSET-026-3; no approval'),
    '--start': _value(_not_negative, 0.0, 'S', 'skip the first seconds'),
    'monitor --duration': _value(positive, 0.0, 'S', 'end after this many seconds'),
    'play --duration': _value(positive, 0.0, 'S', 'play only this many seconds'),
    'fit --duration': _value(_not_negative, math.inf, 'S', 'fit only this many seconds'),
    '--loop': _flag('start over at the end'),
    '--wait': _value(
        int,
        0,
        'N',
        'wait for this many subscribers on each topic before starting; run with --map subscribes once to each',
    ),
    '--only': _value(str, None, None, 'run only this chapter', choices=(*DEMO_BAGS, EXPLAIN_CHAPTER)),
    '--quick': _flag(f'only the first {DEMO_QUICK_S:g} s of each bag'),
    '--node': _repeated('run only this node; repeatable', choices=LIVE_NODES),
    '--record': _path(
        'FOLDER', 'write the last minutes of the inputs there after faults, contradictions and steps (record_folder)'
    ),
    '--world': _value(str, None, None, 'type of railway: train, line and driver'),
    '--realism': _value(
        str,
        None,
        None,
        'clean: the train file is exact; field: it has errors as on real trains (default: clean)',
    ),
    '--unknown': _repeated('quantity that is wrong in the train file or missing from it; repeatable: '),
    '--effect': _repeated('add an effect to the truth, e.g. tunnel_drag:factor=1.8; repeatable', 'NAME:key=value'),
    '--fleet': _value(whole, 0, 'N', 'instead of one bag, the bags of a fleet of N trains, one a day and train'),
    '--days': _value(whole, None, 'D', 'number of days of a fleet (default: 10)'),
    '--fault': _repeated(
        'fault of a train of the fleet from a day on, as an effect, e.g. T03:wheel_diameter:ratio=1.02:6; repeatable',
        'TRAIN:EFFECT:key=value:DAY',
    ),
    '--runs': _value(int, 4, 'N', 'runs from stop to stop (default: 4)'),
    'demo --seed': _value(whole, 1, 'S', 'first of three seeds that draw the hidden effects (default: 1)'),
    '--seed': _value(whole, 1, 'S', 'seed of the random numbers, >= 0 (default: 1)'),
    '--label': _value(
        str,
        None,
        'REGEX',
        'regular expression on the path of a bag; its named groups train, line, weather and day are columns (default: '
        'the train is the folder that holds the bag)',
    ),
    '--scheduler': _value(str, None, 'ADDRESS', 'replay on the workers of a Dask scheduler, such as tcp://host:8786'),
    '--replace': _flag('write over a table of other bags, or made with other files'),
    '--explain': _value(whole, 0, 'N', 'name the cause for the N worst trains, from their bags'),
    '--false-alarm-days': _value(positive, 20_000.0, 'D', 'train-days for one false alarm (default: 20000)'),
    '--jobs': _jobs(1),
    'fleet --jobs': _jobs(0),
    '--namespace': _namespace('the topics'),
    'view --namespace': _namespace('topics and nodes'),
    'replay --namespace': _namespace('topics and nodes'),
    'play --namespace': _namespace('the topics in the bag'),
    'monitor --namespace': _value(str, None, 'NAME', 'namespace of the train (default: all trains found)'),
    '--ros-args': {
        **{'nargs': argparse.REMAINDER, 'default': [], 'metavar': '...'},
        'help': 'remaining arguments are passed to ROS; must come last',
    },
    '--json': _flag('print JSON on standard output and nothing else there'),
}
"""The arguments of all verbs by name; where one verb differs, its name stands before."""


def add_options(verb: Verb, parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of a verb."""
    choices: dict[str, tuple[str, ...]] = {}
    if verb.name == 'simulate':
        # Imported here because other verbs need not load it.
        from trainid_ros.sim.worlds import REALISMS, UNKNOWNS, WORLDS  # noqa: PLC0415

        choices = {'--world': tuple(WORLDS), '--realism': tuple(REALISMS), '--unknown': UNKNOWNS}
    for name in verb.options.split():
        settings = OPTIONS.get(f'{verb.name} {name}') or OPTIONS[name]
        if name in choices:
            settings = settings | {'choices': choices[name]}
        if name == '--unknown':
            settings['help'] += ', '.join(choices[name])
        parser.add_argument(name, **settings)

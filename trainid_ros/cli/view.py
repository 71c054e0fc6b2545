# SPDX-License-Identifier: Apache-2.0
"""``trainid view``: inputs and estimates of a bag in the Rerun viewer."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.cli.bags import load_setups, opened
from trainid_ros.cli.output import check_output, progress, show, warn
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError
from trainid_ros.report.viewer import RRD_START, ViewRecorder, switch_off_telemetry, write_recording
from trainid_ros.setup.params_file import mapping_in

if TYPE_CHECKING:
    import argparse

_TRAIN_FILE: Final = 'train.yaml'
_RECORDING: Final = '.rrd'
# Its server is for this machine alone.
_LOCAL: Final = ('--bind', '127.0.0.1', '--port', 'auto')
_DISPLAYS: Final = ('DISPLAY', 'WAYLAND_DISPLAY')


def run(args: argparse.Namespace) -> int:
    """Replay a bag and write a recording or open it in the viewer; return 0.

    Raises:
        InputError: Bag, train file or parameters cannot be used, the output cannot be written, or there is no display.
    """
    if args.out is not None and args.out.suffix != _RECORDING:
        raise InputError(f'{args.out}: the name of a recording must end in {_RECORDING}, or Rerun does not open it')
    args.map = args.map or mapping_in(args.params, args.namespace)
    switch_off_telemetry()
    import rerun  # noqa: F401, PLC0415 - if it is missing, that is said before the replay

    train = _train_file(args)
    if args.out is not None:
        check_output(args.out, (train, args.params, args.bag), RRD_START)
        _write(args, train, args.out)
        show(f'{args.out}: open it with: rerun {shlex.quote(str(args.out))}')
        return 0
    if not any(os.environ.get(name) for name in _DISPLAYS):
        raise InputError(
            'there is no display to open the viewer on: give --out FILE.rrd, and open that where there is one'
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f'{args.bag.resolve().stem}.rrd'
        _write(args, train, path)
        _open_viewer(path)
    return 0


def _open_viewer(path: Path) -> None:
    """Open a recording until the viewer is closed; InputError if it cannot run, as without an X server."""
    command = [sys.executable, '-m', 'rerun', *_LOCAL, str(path)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors='replace', check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        reason = said[-1].rpartition(': ')[2].strip() if said else f'exit code {done.returncode}'
        raise InputError(
            f'the viewer cannot run on this display: {reason}; give --out FILE.rrd, and open that where there is one'
        )


def _train_file(args: argparse.Namespace) -> Path:
    """Return the train file: the one given, or that in the folder of the bag."""
    if args.train is not None:
        return Path(args.train)
    if not args.bag.exists():
        raise InputError(f'{args.bag}: no such bag')
    beside = (args.bag if args.bag.is_dir() else args.bag.parent) / _TRAIN_FILE
    if not beside.is_file():
        raise InputError(f'{args.bag}: there is no {_TRAIN_FILE} beside it: give --train T.yaml')
    return Path(beside)


def _write(args: argparse.Namespace, train: Path, out: Path) -> None:
    """Replay the bag as ``trainid replay`` does, and write the recording."""
    setups = load_setups(args, train, warn)
    with opened(args, mapped_inputs(args.map, setups[0].train_file)) as reader:
        pipelines = Pipelines(*(setup.realigned(reader.mapping.alignment).pipeline() for setup in setups))
        recorder = ViewRecorder(pipelines)
        with progress(f'replaying {args.bag.name}', reader.input_count) as advance:
            replay_through(pipelines, reader, advance, (recorder,))
        for text in reader.warnings:
            warn(text)
    write_recording(recorder, args.bag.resolve().stem, out)

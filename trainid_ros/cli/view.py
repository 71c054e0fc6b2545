# SPDX-License-Identifier: Apache-2.0
"""``trainid view``: inputs and estimates of a bag in the Rerun viewer."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.cli.bags import beside, load_setups, opened
from trainid_ros.cli.output import check_output, progress, show, warn
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError
from trainid_ros.report.viewer import RRD_START, ViewRecorder, switch_off_telemetry, write_recording
from trainid_ros.setup.params_file import mapping_in

if TYPE_CHECKING:
    import argparse


def run(args: argparse.Namespace) -> int:
    """Replay a bag and write a recording or open it in the viewer."""
    if args.out is not None and args.out.suffix != '.rrd':
        raise InputError(f'{args.out}: the name of a recording must end in .rrd, or Rerun does not open it')
    args.map = args.map or mapping_in(args.params, args.namespace)
    switch_off_telemetry()
    import rerun  # noqa: F401, PLC0415 - if it is missing, that is said before the replay

    train = _train_file(args)
    if args.out is not None:
        check_output(args.out, (train, args.params, args.bag), RRD_START)
        _write(args, train, args.out)
        show(f'{args.out}: open it with: rerun {shlex.quote(str(args.out))}')
        return 0
    if not any(map(os.environ.get, ('DISPLAY', 'WAYLAND_DISPLAY'))):
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
    # Its server is for this machine alone.
    command = [sys.executable, '-m', 'rerun', '--bind', '127.0.0.1', '--port', 'auto', str(path)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors='replace', check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        reason = said[-1].rpartition(': ')[2].strip() if said else f'exit code {done.returncode}'
        raise InputError(
            f'the viewer cannot run on this display: {reason}; give --out FILE.rrd, and open that where there is one'
        )


def _train_file(args: argparse.Namespace) -> Path:
    """Return the train file: the one given, or that in the folder of the bag."""
    path: Path = args.train or beside(args.bag, 'train.yaml')
    if args.train is None and not args.bag.exists():
        raise InputError(f'{args.bag}: no such bag')
    if args.train is None and not path.is_file():
        raise InputError(f'{args.bag}: there is no {path.name} beside it: give --train T.yaml')
    return path


def _write(args: argparse.Namespace, train: Path, out: Path) -> None:
    setups = load_setups(args, train, warn)
    with opened(args, mapped_inputs(args.map, setups[0].train_file)) as reader:
        pipelines = Pipelines(*(setup.realigned(reader.mapping.alignment).pipeline() for setup in setups))
        recorder = ViewRecorder(pipelines)
        with progress(f'replaying {args.bag.name}', reader.input_count) as advance:
            replay_through(pipelines, reader, advance, (recorder,))
        for text in reader.warnings:
            warn(text)
    write_recording(recorder, args.bag.resolve().stem, out)

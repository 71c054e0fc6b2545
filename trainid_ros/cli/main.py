# SPDX-License-Identifier: Apache-2.0
"""The ``trainid`` command.

A verb has its arguments in :mod:`trainid_ros.cli.arguments` and a function ``(args) -> exit code``, usually ``run`` in
a module of its own name. That is imported only when the verb is run, so help is fast and a verb that needs no ROS runs
without ROS.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

from trainid_ros import __version__
from trainid_ros.bag import missing_package_error
from trainid_ros.cli import arguments as options
from trainid_ros.cli.output import EXIT_BAD_INPUT, EXIT_NO_ANSWER, report_error
from trainid_ros.interface.errors import InputError, NoAnswerError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

EXIT_INTERRUPTED: Final = 130
EXIT_BROKEN_PIPE: Final = 141


class Verb(NamedTuple):
    """One sub-command."""

    name: str
    help: str
    configure: Callable[[argparse.ArgumentParser], None]
    function: str = ''  # Module and function; those of its name and ``run`` if empty


VERBS: Final = (
    Verb('demo', 'play a bag through the live nodes and write a report', options.configure_demo),
    Verb('run', 'run the estimator nodes live', options.configure_run, 'live.run_nodes'),
    Verb(
        'monitor',
        'show inputs, estimates and diagnostics live in a terminal',
        options.configure_monitor,
        'live.monitor',
    ),
    Verb('view', 'show a bag and its estimates in the Rerun viewer', options.configure_view),
    Verb('replay', 'run the estimators over bags, off line', options.configure_replay),
    Verb('play', "publish a bag's inputs with /clock", options.configure_play, 'live.play'),
    Verb('simulate', 'create a bag with the simulator', options.configure_simulate),
    Verb('fit', 'fit Davis parameters to a bag in one batch', options.configure_fit),
    Verb('explain', 'find the effects that a train file lacks and add them', options.configure_explain),
    Verb('info', 'show what is in bags and whether they can be used', options.configure_info),
    Verb('import', 'make a bag of a table: CSV, Parquet or npz', options.configure_import, 'import_table.run'),
    Verb('fleet', 'replay the bags of a fleet into a table', options.configure_fleet),
    Verb('fleet report', 'find the trains that stand out in a table', options.configure_fleet_report, 'fleet.report'),
)


class _Parser(argparse.ArgumentParser):
    """A parser that reports a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the message and a pointer to the help, and exit with 2."""
        self.exit(EXIT_BAD_INPUT, f'trainid: error: {message} (see {self.prog} --help)\n')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program name; those of the process if None.
    """
    if argv is None:  # stand-alone process: clean up on SIGTERM too
        signal.signal(signal.SIGTERM, _end)
    # The matrices are small: on a busy machine, threads waiting for each other make the work five times slower.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _run(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
    except InputError as error:
        return _report(error, EXIT_BAD_INPUT)
    except NoAnswerError as error:
        return _report(error, EXIT_NO_ANSWER)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _drop_output()
        return EXIT_BROKEN_PIPE
    except OSError as error:
        if error.filename is None:  # standard output is full
            _drop_output()
        return _report(f'{error.filename or "output"}: {error.strerror}', EXIT_BAD_INPUT)
    return code


def _end(number: int, _: object) -> NoReturn:
    raise SystemExit(128 + number)


def _run(arguments: list[str]) -> int:
    """Run a verb; InputError if it needs an optional package that is not installed."""
    try:
        return _dispatch(arguments)
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None


def _dispatch(arguments: list[str]) -> int:
    if arguments[:2] == ['fleet', 'report']:
        arguments = ['fleet report', *arguments[2:]]
    wanted = next((text for text in arguments if not text.startswith('-')), None)
    parser = _Parser(prog='trainid', description='Identify train resistance and brake rate on board.')
    parser.add_argument('--version', action='version', version=f'trainid {__version__}')
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True)
    for verb in VERBS:
        sub = verbs.add_parser(verb.name, help=verb.help, description=f'{verb.help[0].upper()}{verb.help[1:]}.')
        if verb.name == wanted:
            verb.configure(sub)
    args = parser.parse_args(arguments)
    verb = next(verb for verb in VERBS if verb.name == args.verb)
    module, _, function = (verb.function or f'{verb.name}.run').partition('.')
    return int(getattr(import_module(f'trainid_ros.cli.{module}'), function)(args))


def _report(error: object, code: int) -> int:
    """Print an error and return the exit code."""
    report_error(error)
    return code


def _drop_output() -> None:
    """Redirect standard output to the null device, so that closing it at exit does not fail again."""
    with open(os.devnull, 'w', encoding='utf-8') as nothing:  # noqa: PTH123
        os.dup2(nothing.fileno(), sys.stdout.fileno())


if __name__ == '__main__':
    sys.exit(main())

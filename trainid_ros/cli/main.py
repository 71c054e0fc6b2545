# SPDX-License-Identifier: Apache-2.0
"""The ``trainid`` command.

A verb of :mod:`trainid_ros.cli.arguments` has a function ``(args) -> exit code``, usually ``run`` in a module of its
name. That is imported only when the verb is run, so help is fast and a verb that needs no ROS runs without ROS. Its
functions import what takes long to load (linear algebra, matplotlib, rich) or may be missing (ROS) where they use it,
so that wrong inputs are reported without it.

It raises InputError for what cannot be used, and NoAnswerError where the data hold no answer.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from itertools import takewhile
from typing import Any, Final, NoReturn

from trainid_ros import __version__
from trainid_ros.bag import missing_package_error
from trainid_ros.cli.arguments import VERBS, add_options
from trainid_ros.cli.output import EXIT_BAD_INPUT, EXIT_NO_ANSWER, warn
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.train.fields import did_you_mean

EXIT_INTERRUPTED: Final = 130
EXIT_BROKEN_PIPE: Final = 141


class _Parser(argparse.ArgumentParser):
    """A parser that reports a usage error in one line, with the word that may be meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; an option of a verb that does not exist is the error, whatever else is missing."""
        known = [name for name in self._option_string_actions if name.startswith('--')]
        given = takewhile(lambda text: text not in {'--', '--ros-args'}, args if self._subparsers is None else ())
        for name in (text.partition('=')[0] for text in given if text.startswith('--')):
            if not any(option.startswith(name) for option in known):
                self.error(f'{name} is no option; {did_you_mean(name, known)}')
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the message and a pointer to the help, and exit with 2."""
        if choice := re.fullmatch(r"(.*invalid choice: '(.*)') \(choose from (.*)\)", message):
            known = [name.strip("'") for name in choice[3].split(', ')]
            message = f'{choice[1]}; {did_you_mean(choice[2], known)}'
        self.exit(EXIT_BAD_INPUT, f'trainid: error: {message} (see {self.prog} --help)\n')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process if none are given, and return its exit code."""
    if argv is None:  # stand-alone process: clean up on SIGTERM too
        signal.signal(signal.SIGTERM, _end)
    # The matrices are small: on a busy machine, threads waiting for each other make the work five times slower.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
    except (InputError, NoAnswerError) as error:
        warn(error, 'error')
        return EXIT_BAD_INPUT if isinstance(error, InputError) else EXIT_NO_ANSWER
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _drop_output()
        return EXIT_BROKEN_PIPE
    except OSError as error:
        if error.filename is None:  # standard output is full
            _drop_output()
        warn(f'{error.filename or "output"}: {error.strerror}', 'error')
        return EXIT_BAD_INPUT
    return code


def _end(number: int, _: object) -> NoReturn:
    raise SystemExit(128 + number)


def _dispatch(arguments: list[str]) -> int:
    """Run a verb; InputError if it needs an optional package that is not installed."""
    pair, names = ' '.join(arguments[:2]), [verb.name for verb in VERBS]
    if pair in names or (arguments[:1] == ['train'] and not pair.startswith('train -')):
        arguments = [pair, *arguments[2:]]
    wanted = next((text for text in arguments if not text.startswith('-')), None)
    parser = _Parser(prog='trainid', description='Identify train resistance and brake rate on board.')
    parser.add_argument('--version', action='version', version=f'trainid {__version__}')
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True)
    for verb in VERBS:
        sub = verbs.add_parser(verb.name, help=verb.help, description=f'{verb.help[0].upper()}{verb.help[1:]}.')
        if verb.name == wanted:
            add_options(verb, sub)
    args = parser.parse_args(arguments)
    verb = next(verb for verb in VERBS if verb.name == args.verb)
    module, _, function = (verb.function or f'{verb.name}.run').partition('.')
    try:
        return int(getattr(import_module(f'trainid_ros.cli.{module}'), function)(args))
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None


def _drop_output() -> None:
    """Redirect standard output to the null device, so that closing it at exit does not fail again."""
    with open(os.devnull, 'w', encoding='utf-8') as nothing:  # noqa: PTH123
        os.dup2(nothing.fileno(), sys.stdout.fileno())


if __name__ == '__main__':
    sys.exit(main())

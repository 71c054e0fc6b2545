# SPDX-License-Identifier: Apache-2.0
"""Errors a caller may catch; every message names the file, topic or field at fault."""


class TrainIdError(Exception):
    """Base class of all errors raised deliberately by this package."""


class InputError(TrainIdError):
    """A file, a field or an argument cannot be used (exit code 2 on the command line)."""


class NoAnswerError(TrainIdError):
    """The command ran, but the data do not determine a result (exit code 1 on the command line)."""

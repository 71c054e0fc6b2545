# SPDX-License-Identifier: Apache-2.0
"""Run a ``trainid`` command as a child process that ends with its parent, even if that is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

from trainid_ros.cli.main import main

_PR_SET_PDEATHSIG: Final = 1


def die_with(parent: int) -> None:
    """Ask the kernel for SIGTERM when the parent process ends; only Linux supports this."""
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            sys.exit(f'trainid: the parent process {parent} is gone')


if __name__ == '__main__':
    die_with(int(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))

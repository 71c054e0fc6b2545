# SPDX-License-Identifier: Apache-2.0
"""How long a test waits for what must come: it ends as soon as it comes, so that only a hang takes this long."""

from __future__ import annotations

from typing import Final

HANG_S: Final = 600.0
"""Far above what a slow and busy machine needs, and below the time limit of a test in ``pyproject.toml`` [s]."""

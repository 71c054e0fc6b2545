# SPDX-License-Identifier: Apache-2.0
"""Rerun sends usage data by default; here it does not."""

from __future__ import annotations

import os


def switch_off() -> None:
    """Switch the telemetry of Rerun off, in this process and its children; call it before rerun is imported.

    Beside a command that changes a file in the home of the user, its library and viewer know only these variables.
    """
    os.environ['CI'] = 'true'
    os.environ['TELEMETRY_ENABLED'] = 'false'
    os.environ.pop('FORCE_RERUN_ANALYTICS', None)

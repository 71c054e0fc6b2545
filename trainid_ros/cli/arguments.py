# SPDX-License-Identifier: Apache-2.0
"""Argument types shared by several verbs."""

from __future__ import annotations

import argparse
import math


def positive(text: str) -> float:
    """Return a finite number above zero; ArgumentTypeError for anything else."""
    value = not_negative(text)
    if value == 0.0:
        msg = f'{text!r} must be > 0'
        raise argparse.ArgumentTypeError(msg)
    return value


def not_negative(text: str) -> float:
    """Return a finite number, zero or above; ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        msg = f'{text!r} must be a number >= 0'
        raise argparse.ArgumentTypeError(msg)
    return value

# SPDX-License-Identifier: Apache-2.0
"""HTML reports of the identification."""

from __future__ import annotations

from typing import Final

HTML_START: Final = (
    '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><meta name="generator" content="trainid_ros '
)
"""How each report starts, and no other file: the version follows."""

# SPDX-License-Identifier: Apache-2.0
"""Third generator of hidden cases: metro, tram, freight and high speed; traction and brake may act together."""

from __future__ import annotations

from benchmarks.hidden_cases_c.make import LIBRARY, OUTSIDE, draw_cases, make_case

__all__ = ['LIBRARY', 'OUTSIDE', 'draw_cases', 'make_case']

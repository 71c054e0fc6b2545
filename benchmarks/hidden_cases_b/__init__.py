# SPDX-License-Identifier: Apache-2.0
"""Second generator of hidden cases: regional, freight, main line and metro, with independent physics."""

from __future__ import annotations

from benchmarks.hidden_cases_b.case import PAIRS, draw_cases, make_case
from benchmarks.hidden_cases_b.menu import LIBRARY, NEAR, OUTSIDE, SENSOR_EXTRA

__all__ = ['LIBRARY', 'NEAR', 'OUTSIDE', 'PAIRS', 'SENSOR_EXTRA', 'draw_cases', 'make_case']

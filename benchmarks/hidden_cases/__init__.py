# SPDX-License-Identifier: Apache-2.0
"""Hidden cases for the discrepancy workflow: rides of trains that deviate from the assumed train file.

Independent physics: nothing here uses the equations, the simulator or the estimators of the package.
"""

from __future__ import annotations

from benchmarks.hidden_cases.effects import LIBRARY, OUTSIDE
from benchmarks.hidden_cases.make import draw_cases, make_case

__all__ = ['LIBRARY', 'OUTSIDE', 'draw_cases', 'make_case']

# SPDX-License-Identifier: Apache-2.0
"""Drives of five kinds of train from a simulator of its own, with all that is not known on a real train.

It shares no code with the simulator and the estimators of the package: only records and train file are common.
Energy and force balance of the truth, with R the mean radius under the train:
``1000 F / (M g) = w(v) + i + k / R + 1000 (1 + gamma) (dv/dt) / g``, F = traction - brake rate * nominal brake effort.
A nominal brake gives the commanded deceleration to the train with its rotating masses on level straight track
without resistance, after dead time and first-order lag; its effort is reported with the weighed mass.
"""

from benchmarks.worlds.drive import WORLDS, Drive, drive
from benchmarks.worlds.sensing import Rates
from benchmarks.worlds.truth import Truth
from benchmarks.worlds.unknowns import CLEAN, FIELD, UNKNOWNS

__all__ = ['CLEAN', 'FIELD', 'UNKNOWNS', 'WORLDS', 'Drive', 'Rates', 'Truth', 'drive']

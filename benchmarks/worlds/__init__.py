# SPDX-License-Identifier: Apache-2.0
"""Drives of five kinds of train from an independent simulator, with the unknowns of a real train.

It shares no code with the simulator and the estimators of the package except records and train file.
Force balance of the truth, with R the mean curve radius under the train:
``1000 F / (M g) = w(v) + i + k / R + 1000 (1 + gamma) (dv/dt) / g``, F = traction - brake rate * nominal brake effort.
A nominal brake gives the train, including rotating masses, the commanded deceleration on level straight track without
resistance, after dead time and first-order lag; its effort is reported for the weighed mass.
"""

from benchmarks.worlds.drive import WORLDS, Drive, Rates, Truth, drive
from benchmarks.worlds.unknowns import CLEAN, FIELD, UNKNOWNS

__all__ = ['CLEAN', 'FIELD', 'UNKNOWNS', 'WORLDS', 'Drive', 'Rates', 'Truth', 'drive']

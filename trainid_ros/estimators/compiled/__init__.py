# SPDX-License-Identifier: Apache-2.0
"""The kernels of the estimators in machine code, for replays of many days and for many particles.

Needs the extra ``trainid_ros[fast]`` (numba), which loads when the first kernel is compiled. The functions that
are compiled are those that run without it, so the numbers are the same to the bit.
"""

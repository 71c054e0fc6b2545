# SPDX-License-Identifier: Apache-2.0
"""The main job end to end: bags through live nodes in processes of their own, watched, scored, reported."""

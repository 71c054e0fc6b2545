# SPDX-License-Identifier: Apache-2.0
"""Algorithms of the four papers that no driver on a train uses, and references to compare with."""

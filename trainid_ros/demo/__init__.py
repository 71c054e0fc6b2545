# SPDX-License-Identifier: Apache-2.0
"""End-to-end demo: bags played through live nodes in separate processes, monitored, scored and reported."""

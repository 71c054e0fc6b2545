# SPDX-License-Identifier: Apache-2.0
"""Discrepancy workflow: find where simulation and measurement disagree and which physical effect is missing."""

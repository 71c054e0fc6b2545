# SPDX-License-Identifier: Apache-2.0
"""The discrepancy workflow: where simulation and measured data disagree, and which physical effect is missing."""

# SPDX-License-Identifier: Apache-2.0
"""Streaming estimators of resistance, speed model and brake rate."""

# SPDX-License-Identifier: Apache-2.0
"""Shared parts of the streaming estimators of resistance, speed model and brake rate."""

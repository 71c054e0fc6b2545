# SPDX-License-Identifier: Apache-2.0
"""Streaming identification of train resistance, speed model and brake rate."""

__version__ = '0.1.0'

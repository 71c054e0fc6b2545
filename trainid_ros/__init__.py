# SPDX-License-Identifier: Apache-2.0
"""Streaming identification of train resistance, speed model and brake rate."""

from trainid_ros.compiled import choose_modules

__version__ = '0.1.0'

choose_modules()

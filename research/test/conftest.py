# SPDX-License-Identifier: Apache-2.0
"""The fixtures of the product's tests that these tests share."""

from __future__ import annotations

from test.conftest import day, journey, metro, sample, train_file

__all__ = ['day', 'journey', 'metro', 'sample', 'train_file']

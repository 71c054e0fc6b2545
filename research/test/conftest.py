# SPDX-License-Identifier: Apache-2.0
"""Share the fixtures of the product's tests."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

FIXTURES = Path(__file__).parents[2] / 'test' / 'conftest.py'


def pytest_configure(config: pytest.Config) -> None:
    """Register test/conftest.py, which pytest reads by itself only for the folders beside it."""
    spec = spec_from_file_location('product_fixtures', FIXTURES)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    config.pluginmanager.register(module)

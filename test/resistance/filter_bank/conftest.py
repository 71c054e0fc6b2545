# SPDX-License-Identifier: Apache-2.0
"""The small filter bank after five minutes of driving."""

from __future__ import annotations

import pytest

from test.resistance.filter_bank.drives import FILE, SMALL, drive
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.stream.samples import Sample


@pytest.fixture(scope='session')
def minutes() -> list[Sample]:
    """Five minutes of driving."""
    return drive(300.0)


@pytest.fixture(scope='session')
def followed(minutes: list[Sample]) -> tuple[str, list[bool]]:
    """Saved state of the small bank after five minutes, and for each sample whether it was fit to use."""
    bank = FilterBank(FILE, SMALL)
    fit = []
    for item in minutes:
        bank.step(item)
        fit.append(bank.converged)
    return bank.save(), fit


@pytest.fixture(scope='session')
def learned(followed: tuple[str, list[bool]]) -> str:
    """Saved state of the small bank after five minutes."""
    return followed[0]

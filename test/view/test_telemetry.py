# SPDX-License-Identifier: Apache-2.0
"""Rerun does not send usage data."""

from __future__ import annotations

import os

import pytest

from trainid_ros.view import telemetry


def test_telemetry_is_off_for_children(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {'FORCE_RERUN_ANALYTICS': '1', 'CI': '', 'TELEMETRY_ENABLED': 'true'}
    monkeypatch.setattr(os, 'environ', os.environ | before)
    telemetry.switch_off()
    assert os.environ['CI'] == 'true'
    assert os.environ['TELEMETRY_ENABLED'] == 'false'
    assert 'FORCE_RERUN_ANALYTICS' not in os.environ

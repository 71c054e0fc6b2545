# SPDX-License-Identifier: Apache-2.0
"""Settings: one declaration gives default, range and the check."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import pytest

from trainid_ros.estimators.pipeline import PipelineConfig
from trainid_ros.estimators.settings import AmVffRlsConfig, GsmaConfig, VMilsConfig
from trainid_ros.interface.errors import InputError, SettingInfo, check_settings, check_value, setting, setting_info
from trainid_ros.stream.alignment import AlignmentConfig

CONFIGS = (AlignmentConfig(), PipelineConfig(), VMilsConfig(), AmVffRlsConfig(), GsmaConfig())
Config = AlignmentConfig | PipelineConfig | VMilsConfig | AmVffRlsConfig | GsmaConfig


@dataclass(frozen=True, slots=True)
class Example:
    gain: float = setting(2.0, 'gain of something', 'm/s', 1.0, 3.0)
    name: str = 'no setting'


def test_a_setting_keeps_default_and_metadata() -> None:
    gain, name = fields(Example)
    assert Example().gain == 2.0
    assert setting_info(gain) == SettingInfo('gain of something', 'm/s', 1.0, 3.0)
    assert setting_info(name) is None


@pytest.mark.parametrize('value', [1.0, 3.0])
def test_the_range_is_closed(value: float) -> None:
    check_settings(Example(gain=value))


@pytest.mark.parametrize('value', [math.nextafter(1.0, 0.0), math.nextafter(3.0, 4.0), math.nan, math.inf, -math.inf])
def test_an_error_names_field_value_and_range(value: float) -> None:
    with pytest.raises(InputError, match=r'gain = .* m/s is outside \[1, 3\]'):
        check_settings(Example(gain=value))


def test_a_single_value_is_checked_in_the_same_way() -> None:
    info = SettingInfo('x', 's', 0.0, 1.0)
    check_value('x', 0.5, info)
    with pytest.raises(InputError, match=r'x = 2 s is outside \[0, 1\]'):
        check_value('x', 2.0, info)


@pytest.mark.parametrize('config', CONFIGS, ids=lambda config: type(config).__name__)
def test_every_default_lies_in_its_range_and_every_number_is_declared(config: Config) -> None:
    check_settings(config)
    for item in fields(config):
        if isinstance(getattr(config, item.name), int | float):
            info = setting_info(item)
            assert info is not None, item.name
            assert info.description
            assert info.low < info.high

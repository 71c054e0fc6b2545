# SPDX-License-Identifier: Apache-2.0
"""Units by their names in mappings, and as files write them."""

from __future__ import annotations

import pytest

from trainid_ros.inputs.units import find_unit, written_unit


@pytest.mark.parametrize(
    ('text', 'quantity', 'value', 'expected'),
    [
        ('m/s', 'speed', 20.0, 20.0),
        ('km/h', 'speed', 72.0, 20.0),
        ('mph', 'speed', 10.0, 4.4704),
        ('kN', 'force', -1.5, -1500.0),
        ('lbf', 'force', 1.0, 4.4482216152605),
        ('klbf', 'force', 1.0, 4448.2216152605),
        ('daN', 'force', 100.0, 1000.0),
        ('kgf', 'force', 100.0, 980.665),
        ('short_ton', 'mass', 100.0, 90718.474),
        ('percent', 'gradient', 1.2, 12.0),
        ('deg', 'gradient', 1.0, 17.4524064),
        ('rad', 'gradient', 0.01, 9.99983333),
        ('t', 'mass', 194.0, 194e3),
        ('lb', 'mass', 1.0, 0.45359237),
        ('km', 'length', 1.5, 1500.0),
        ('percent_of 300 kN', 'force', 50.0, 150e3),
        ('percent_of 1.2 m/s^2', 'acceleration', -100.0, -1.2),
    ],
)
def test_a_value_is_converted(text: str, quantity: str, value: float, expected: float) -> None:
    assert find_unit(text, quantity).convert(value) == pytest.approx(expected)


@pytest.mark.parametrize(
    ('text', 'quantity', 'hint'),
    [
        ('kmh', 'speed', "did you mean 'km/h'"),
        ('kN', 'speed', 'known: '),
        ('deg', 'speed', 'known: '),
        ('', 'mass', 'known: '),
        ('percent_of', 'force', 'must be like'),
        ('percent_of x kN', 'force', 'must be like'),
        ('percent_of 0 kN', 'force', 'must be like'),
        ('percent_of nan kN', 'force', 'must be like'),
        ('percent_of 300 km/h', 'force', 'must be like'),
    ],
)
def test_an_unknown_unit_is_rejected_with_a_hint(text: str, quantity: str, hint: str) -> None:
    with pytest.raises(ValueError, match=hint.replace('.', r'\.')):
        find_unit(text, quantity)


@pytest.mark.parametrize(
    ('text', 'quantity', 'unit'),
    [
        ('km/h', 'speed', 'km/h'),
        ('KM/H', 'speed', 'km/h'),
        (' kmh ', 'speed', 'km/h'),
        ('velocity kmh', 'speed', 'km/h'),
        ('Meters/second', 'speed', 'm/s'),
        ('千米/小时', 'speed', 'km/h'),
        ('千牛', 'force', 'kN'),
        ('KN', 'force', 'kN'),
        ('‰', 'gradient', 'per_mille'),
        ('%o', 'gradient', 'per_mille'),
        ('°', 'gradient', 'deg'),
        ('ms', 'time', 'ms'),
        ('%', 'force', ''),
        ('km', 'speed', ''),
        ('', 'mass', ''),
    ],
)
def test_a_unit_is_known_as_files_write_it(text: str, quantity: str, unit: str) -> None:
    assert written_unit(text, quantity) == unit

# SPDX-License-Identifier: Apache-2.0
"""Names of parts of the data for use in sentences."""

from __future__ import annotations

from typing import Final

_KINDS: Final = {
    ('mode', 'traction'): 'under traction',
    ('mode', 'coasting'): 'while coasting',
    ('mode', 'braking'): 'while braking',
    ('mode', 'just released'): 'just after the brake is released',
    ('direction', 'rising'): 'towards rising positions',
    ('direction', 'falling'): 'towards falling positions',
    ('tunnel', 'open air'): 'outside tunnels',
    ('tunnel', 'tunnel'): 'in tunnels',
    ('curve', 'straight'): 'on straight track',
    ('curve', 'curve'): 'in curves',
}
_RANGES: Final = {
    'position': 'at {}',
    'position, rising': 'at {} towards rising positions',
    'position, falling': 'at {} towards falling positions',
    'speed': 'at speeds of {}',
    'heat of the brake': 'with {} of heat in the brake',
}


def place_text(axis: str, label: str) -> str:
    """Return one part of an axis of :func:`~trainid_ros.explain.gap_location.locate` as text."""
    return _KINDS.get((axis, label)) or _RANGES.get(axis, f'{axis} {{}}').format(label)

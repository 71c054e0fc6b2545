# SPDX-License-Identifier: Apache-2.0
"""The saved random generator of GSMA."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trainid_ros.brake_rate.gsma import restore_generator
from trainid_ros.interface.errors import InputError


def test_a_restored_generator_continues() -> None:
    rng, other = np.random.default_rng(5001), np.random.default_rng(5002)
    rng.random(7)
    restore_generator(other, json.dumps(rng.bit_generator.state), 'GsmaState')
    assert other.random() == rng.random()


@pytest.mark.parametrize('value', [-1e300, 10**40, 'x', None])
def test_a_damaged_generator_is_named(value: object) -> None:
    rng = np.random.default_rng(5001)
    state = json.dumps({**rng.bit_generator.state, 'has_uint32': value})
    with pytest.raises(InputError, match='saved GsmaState: random cannot be read'):
        restore_generator(rng, state, 'GsmaState')

# SPDX-License-Identifier: Apache-2.0
"""The times of the last contradiction between inputs."""

from __future__ import annotations

import math

from trainid_ros.estimators.contradiction import Contradiction


def test_the_last_contradiction_counts_and_each_has_a_begin_and_an_end() -> None:
    last = Contradiction()
    last.follow('', 1.0)
    assert (last.finding, math.isnan(last.begin_s), math.isnan(last.end_s)) == ('', True, True)
    for now_s, finding in enumerate(['late by 1.0 s', 'late by 1.1 s', '', '', 'wrong sign'], start=2):
        last.follow(finding, float(now_s))
        if now_s == 5:
            assert (last.finding, last.begin_s, last.end_s) == ('late by 1.1 s', 2.0, 4.0)
    assert (last.finding, last.begin_s, math.isnan(last.end_s)) == ('wrong sign', 6.0, True)

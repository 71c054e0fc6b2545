# SPDX-License-Identifier: Apache-2.0
"""Errors and coverage against values calculated by hand, and what a chapter holds of a drive."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from trainid_ros.report.drive_report import resistance_at, resistance_std, score_brake_rate, score_resistance
from trainid_ros.sim.truth import Truth


def test_resistance_and_its_standard_deviation() -> None:
    theta = np.array([[1.0, 0.1, 0.01], [2.0, 0.0, 0.0]])
    np.testing.assert_allclose(resistance_at(theta, 10.0), [3.0, 2.0])
    P = np.array([[4.0, -0.1, 0.0], [-0.1, 0.01, 0.0], [0.0, 0.0, 1e-4]])
    # phi = (1, 10, 100): 4 - 2 * 10 * 0.1 + 100 * 0.01 + 10000 * 1e-4 = 4
    assert resistance_std(P, 10.0) == pytest.approx(2.0)
    assert resistance_std(np.diag([-1e-18, 0.0, 0.0]), 5.0) == 0.0  # negative by rounding


def test_scores_follow_steps_of_the_truth(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(120)
    score = score_resistance(chapter.recording, chapter.truth)
    assert score is not None
    # a = 1.6 throughout, truth 1.5 up to 60 s and 1.7 after; the first 20 s are not usable.
    assert score.outputs == 100
    assert score.bias == pytest.approx((40 * 0.1 - 60 * 0.1) / 100)
    assert score.rms == pytest.approx(0.1)
    assert score.last == pytest.approx(-0.1)
    # std of w at 10 m/s: sqrt(0.04 + 100 * 1e-4 + 1e4 * 1e-8) = 0.224
    assert score.inside_68 == 1.0


def test_coverage_is_the_share_inside_the_band(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(120)
    score = score_brake_rate(chapter.recording, chapter.truth)
    assert score is not None
    # Rate 0.9 with std 0.05: the truth is 1.0 (outside of both bands) for 40 s, then 0.9 for 60 s.
    assert score.inside_68 == score.inside_95 == pytest.approx(0.6)


def test_no_score_without_a_true_brake_rate_or_a_usable_output(make_chapter: Callable[..., Any]) -> None:
    chapter = make_chapter(15)
    assert score_resistance(chapter.recording, chapter.truth) is None
    assert score_brake_rate(make_chapter(120).recording, Truth(0, ((0.0, 1.0, 0.0, 0.0),))) is None


def test_modes_statuses_and_observability_are_spans(make_chapter: Callable[..., Any]) -> None:
    recording = make_chapter(240).recording
    modes = recording.modes
    assert [span.label for span in modes] == ['traction', 'coast', 'brake', 'standstill'] * 2
    assert all(first.end_s == second.start_s for first, second in pairwise(modes))
    assert [span.end_s - span.start_s for span in modes[:-1]] == [30.0] * 7
    assert [span.label for span in recording.resistance.statuses[:3]] == ['CONVERGING', 'VALID', 'HOLDING']
    assert [(span.start_s, span.end_s) for span in recording.observable] == [(60.0, 90.0), (180.0, 210.0)]
    assert recording.duration_s == 239.0

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from trainid_ros.inspection.suggestion import family, score, unit_in, words_of


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('/car1/tractionForce_kN', ('car', '1', 'traction', 'force', 'kn')),
        ('/speed_km_h', ('speed', 'kmh')),
        ('speed.km_per_h', ('speed', 'kmh')),
        ('gradient_per_mille', ('gradient', 'permille')),
    ],
)
def test_names_are_split_into_words(name: str, words: tuple[str, ...]) -> None:
    assert words_of(name) == words


@pytest.mark.parametrize(
    ('quantity', 'topic', 'field', 'points'),
    [
        ('speed', '/odo/twist', 'twist.linear.x', 2.0),
        ('speed', '/odo/twist', 'twist.linear.y', 1.5),
        ('speed', '/odo/twist', 'twist.angular.x', 0.0),
        ('force', '/brakes/pressure', 'data', -2.0),
        ('brake_command', '/desk/notch', 'data', 1.0),
    ],
)
def test_names_speak_for_a_quantity_or_against_it(quantity: str, topic: str, field: str, points: float) -> None:
    assert score(quantity, topic, field) == points


def test_units_are_found_by_the_last_word_that_is_one_of_the_quantity() -> None:
    assert unit_in('/train/speed_kmh data', ('m/s', 'km/h')) == 'km/h'
    assert unit_in('/n/force_kN data', ('N', 'kN')) == 'kN'
    assert unit_in('/force data', ('N', 'kN')) == ''


def test_topics_of_alike_cars_are_one_family() -> None:
    assert family('/car1/force') == family('/car12/force') != family('/car/total_force')
    assert family('/front/effort') == family('/rear/effort')

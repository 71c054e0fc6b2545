# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.fleet.plan import day_of, label_rule
from trainid_ros.interface.errors import InputError

BAG = Path('/depot/line7/T042/2026-01-31_rain')


def test_without_a_pattern_the_train_is_the_folder_unless_the_recording_says_it() -> None:
    rule = label_rule(None)
    assert rule.labels(BAG, {}) == {'train': 'T042', 'line': '', 'weather': '', 'day': ''}
    assert rule.labels(BAG, {'train': 'other', 'line': '7', 'driver': 'x'})['train'] == 'other'


def test_a_pattern_comes_before_what_the_recording_says() -> None:
    rule = label_rule(r'line(?P<line>\d+)/(?P<train>\w+)/(?P<day>[-\d]+)_(?P<weather>\w+)')
    found = rule.labels(BAG, {'train': 'other'})
    assert found == {'train': 'T042', 'line': '7', 'weather': 'rain', 'day': '2026-01-31'}
    with pytest.raises(InputError, match=r'/x: --label .* does not fit the path'):
        rule.labels(Path('/x'), {})


def test_a_namespace_is_the_train_unless_the_user_names_it() -> None:
    rule = label_rule(None, '/train_1')
    assert rule.labels(BAG, {'line': '7'}) == {'train': 'train_1', 'line': '7', 'weather': '', 'day': ''}
    assert rule.labels(BAG, {'train': 'T7'})['train'] == 'T7'
    assert label_rule(r'/(?P<train>T\d+)/', '/train_1').labels(BAG, {'train': 'T7'})['train'] == 'T042'
    assert label_rule(r'line(?P<line>\d+)', '/train_1').labels(BAG, {})['train'] == 'train_1'


def test_a_path_is_matched_as_given_or_with_links_resolved(tmp_path: Path) -> None:
    (tmp_path / 'disk7/T042/bag').mkdir(parents=True)
    (tmp_path / 'depot').mkdir()
    link = tmp_path / 'depot/tram_5'
    link.symlink_to(tmp_path / 'disk7/T042')
    for pattern, train in ((r'depot/(?P<train>\w+)/', 'tram_5'), (r'disk7/(?P<train>\w+)/', 'T042')):
        assert label_rule(pattern).labels(link / 'bag', {})['train'] == train
    assert label_rule(None).labels(link / 'bag', {})['train'] == 'tram_5'


@pytest.mark.parametrize(
    ('pattern', 'problem'),
    [('(', 'unterminated'), ('(?P<depot>x)', "a group 'depot'"), ('x', 'no named group')],
)
def test_a_pattern_that_cannot_be_used_is_an_error(pattern: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        label_rule(pattern)


def test_days_have_one_form() -> None:
    assert day_of('20260131', None, BAG) == day_of('2026_01_31', 0.0, BAG) == '2026-01-31'
    assert day_of('', 86400.0, BAG) == '1970-01-02'
    assert day_of('', None, BAG) is None
    with pytest.raises(InputError, match="label day 'monday' is not a day"):
        day_of('monday', None, BAG)

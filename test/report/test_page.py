# SPDX-License-Identifier: Apache-2.0
"""Style of the figures."""

from __future__ import annotations

from trainid_ros.report.page import styled_figure, to_svg


def test_axes_show_values_and_not_what_to_add_to_them() -> None:
    with styled_figure(2.0) as figure:
        figure.subplots().plot([0.0, 1.0, 2.0], [1.0001, 1.0002, 1.0004])
        text = to_svg(figure, 'wheel ratio')
    assert '1.0002' in text
    assert '+1' not in text

# SPDX-License-Identifier: Apache-2.0
"""Print a figure of a report as a picture of its own (SVG), for a page of the documents.

.venv/bin/python -m tools.report_picture out/fleet/report.html 'Train T03 over the days' > docs/tutorial_depot.svg
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from trainid_ros.report.page import COLOURS, PAPER

_NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


def report_picture(page: str, label: str) -> str:
    """Return the figure with a label, in the colours of light pages, from a report as HTML text.

    Raises:
        ValueError: The report has no such figure, or several.

    """
    found = re.findall(rf'<svg role="img" aria-label="{re.escape(label)}".*?</svg>', page, re.DOTALL)
    if len(found) != 1:
        labels = ', '.join(re.findall(r'aria-label="([^"]*)"', page))
        raise ValueError(f'{len(found)} figures are named {label!r}; the report has: {labels}')
    text = found[0].replace('<svg', f'<svg {_NAMESPACES} font-family="sans-serif"', 1)
    text = re.sub(r'(</defs>)', rf'\1<rect width="100%" height="100%" fill="{PAPER}"/>', text, count=1)
    for variable, light, _ in COLOURS:
        text = text.replace(f'var(--{variable})', light)
    return re.sub(r'\s*\n\s*', '\n', text) + '\n'


if __name__ == '__main__':
    sys.stdout.write(report_picture(Path(sys.argv[1]).read_text(encoding='utf-8'), sys.argv[2]))

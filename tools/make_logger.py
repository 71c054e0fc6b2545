# SPDX-License-Identifier: Apache-2.0
"""Make ``bags/logger.csv``: the bag ``bags/tiny`` as a data logger would have recorded it.

Usage: python tools/make_logger.py bags/tiny bags/logger.csv

One row for each speed; decimal comma, km/h, kN, degrees and percent; a line about the vehicle above the names of the
columns, units below them; the mass once a second. Encoding latin-1.
"""

from __future__ import annotations

import argparse
import math
import sys
from bisect import bisect_right
from pathlib import Path

from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, SPEED, Row

MAX_BRAKE = 1.2  # m/s^2
ROWS_A_MASS = 5
HEAD = ('Fahrzeug;4711', 'Zeit;v;Weg;F;Steigung;Bremse;Masse', 's;km/h;m;kN;°;%;t')


def read(bag: Path) -> list[list[Row]]:
    """Return the records of each topic by stamp."""
    rows: list[list[Row]] = [[] for _ in INPUT_TOPICS]
    with BagReader(bag) as reader:
        for _, row in reader.rows():
            rows[row[0]].append(row)
    return [sorted(some, key=lambda row: row[1]) for some in rows]


def lines(topics: list[list[Row]]) -> list[str]:
    """Return the lines of the file."""
    stamps, start_ns = [[row[1] for row in rows] for rows in topics], topics[SPEED][0][1]
    found = [*HEAD]
    for number, (_, stamp_ns, speed, position, _) in enumerate(topics[SPEED]):
        last = [rows[max(0, bisect_right(at, stamp_ns) - 1)][2] for rows, at in zip(topics, stamps, strict=True)]
        _, force, gradient, brake, mass = last
        slope = math.degrees(math.asin(gradient / 1e3))
        cells = [
            (stamp_ns - start_ns) / NS_PER_S,
            3.6 * speed,
            position,
            force / 1e3,
            slope,
            -100.0 * brake / MAX_BRAKE,
        ]
        texts = [f'{cell:.{digits}f}' for cell, digits in zip(cells, (3, 2, 1, 2, 4, 1), strict=True)]
        texts.append('' if number % ROWS_A_MASS else f'{mass / 1e3:.1f}')
        found.append(';'.join(texts).replace('.', ','))
    return found


def main() -> int:
    """Convert the bag named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('bag', type=Path, help='bag to read')
    parser.add_argument('out', type=Path, help='file to write')
    args = parser.parse_args()
    args.out.write_text('\r\n'.join([*lines(read(args.bag)), '']), encoding='latin-1', newline='')
    return 0


if __name__ == '__main__':
    sys.exit(main())

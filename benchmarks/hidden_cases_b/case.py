# SPDX-License-Identifier: Apache-2.0
"""A hidden case: input of the workflow, and the truth for the scoring only."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.menu import LIBRARY, MENU, OUTSIDE, SENSOR_EXTRA, Context, Draw, wish_for
from benchmarks.hidden_cases_b.quirks import NEUTRAL, Quirks
from benchmarks.hidden_cases_b.recorder import sense
from benchmarks.hidden_cases_b.scene import Scene, draw_scene, drive
from benchmarks.hidden_cases_b.sensing import draw_instruments, flags_of
from benchmarks.hidden_cases_b.visibility import Visible, visible
from trainid_ros.interface.records import Record

Array = NDArray[np.float64]
PAIRS: Final = (
    'headwind+curve_resistance',
    'tunnel_drag+brake_scale',
    'local_drag+traction_scale',
    'gradient_error+brake_delay',
    'resistance_step+curve_resistance',
    'bearing_warmup+brake_scale',
    'mass_error+local_drag',
    'dragging_brake+headwind',
    'starting_resistance+gradient_error',
    'wheel_slip+resistance_step',
    'traction_scale+brake_scale',
    'brake_fade+tunnel_drag',
    'higher_order_drag+local_drag',
    'wheel_diameter+brake_delay',
    'headwind+brake_scale',
    'curve_resistance+gradient_error',
)
NAMES: Final = ('none', *LIBRARY, *SENSOR_EXTRA, *PAIRS, *OUTSIDE)


@dataclass(frozen=True, slots=True)
class Truth:
    """Truth of a case, for the scoring only.

    Attributes:
        kind: none, single, pair or outside.
        effects: Names, those of the interface where it has one.
        parameters: Per effect; empty for effects outside the library.
        exact: Per effect, the parameters whose law equals that of the interface; the others are approximate.
        flags: one_way, contamination and other circumstances.
        visible: Excess of the refitted model's rms speed gap over the noise floor [%], all effects together.
        visible_each: The same for every effect alone in the same scene.
        gap: Details of the gap [m/s].
        davis: True a, b, c [N/kN, v in m/s].
        service: Kind of train.

    """

    kind: str
    effects: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, float]]
    exact: Mapping[str, tuple[str, ...]]
    flags: tuple[str, ...]
    visible: float
    visible_each: Mapping[str, float]
    gap: Visible
    davis: tuple[float, float, float]
    service: str


@dataclass(frozen=True, slots=True)
class Case:
    """Assumed train file (YAML), bags and truth."""

    name: str
    seed: int
    train_yaml: str
    bags: tuple[tuple[Record, ...], ...]
    truth: Truth


def make_case(name: str, seed: int) -> Case:
    """Generate a case.

    Args:
        name: One of ``NAMES``, or any names of single effects joined by '+'.
        seed: Any non-negative integer; equal names and seeds give equal cases.

    Raises:
        KeyError: The name is not known.
        RuntimeError: No drivable scene was found in eight attempts (has not occurred).

    """
    names = () if name == 'none' else tuple(name.split('+'))
    makers = [MENU[each] for each in names]
    root = int(np.random.SeedSequence([seed, zlib.crc32(name.encode())]).generate_state(1)[0])
    for attempt in range(8):
        rng = np.random.default_rng([root, attempt, 3])
        scene = draw_scene(root + 1000003 * attempt, wish_for(names))
        try:
            plain = drive(scene, NEUTRAL)
            at = Context(scene, plain)
            draws = {each: make(rng, at) for each, make in zip(names, makers, strict=True)}
            quirks = _with(draws.values())
            log = drive(scene, quirks) if names else plain
            return _observe(name, seed, scene, quirks, draws, log, np.random.default_rng([root, attempt, 7]))
        except RuntimeError:
            continue
    raise RuntimeError(f'{name} {seed}: no drivable scene found')


def draw_cases(seed: int, count: int) -> list[tuple[str, int]]:
    """Draw names and seeds: 15 % none, 60 % single, 10 % pairs, 15 % outside, all names equally often."""
    rng = np.random.default_rng([seed, 17])
    pools = (['none'], [*LIBRARY, *SENSOR_EXTRA], list(PAIRS), list(OUTSIDE))
    shares = np.array([0.15, 0.60, 0.10, 0.15])
    counts = np.floor(shares * count).astype(int)
    for k in np.argsort(counts - shares * count)[: count - int(counts.sum())]:
        counts[k] += 1
    names: list[str] = []
    for pool, many in zip(pools, counts.tolist(), strict=True):
        queue: list[str] = []
        while len(queue) < many:
            queue += [pool[i] for i in rng.permutation(len(pool))]
        names += queue[:many]
    order = rng.permutation(count)
    return [(names[i], int(s)) for i, s in zip(order.tolist(), rng.integers(0, 2**31, count), strict=True)]


def _with(draws: Iterable[Draw]) -> Quirks:
    quirks = NEUTRAL
    for draw in draws:
        quirks = quirks._replace(**{key: float(value) for key, value in draw.quirks.items()})
    return quirks


def _observe(
    name: str, seed: int, scene: Scene, quirks: Quirks, draws: Mapping[str, Draw], log: Array, rng: np.random.Generator
) -> Case:
    kit = draw_instruments(rng, scene, quirks)
    bags = sense(rng, scene, quirks, kit, log)
    gap = visible(scene, quirks, kit, log)
    each = dict.fromkeys(draws, gap.percent)
    if len(draws) > 1:
        for key, draw in draws.items():
            alone = _with([draw])
            each[key] = visible(scene, alone, kit, drive(scene, alone)).percent
    kind = 'none' if not draws else 'pair' if len(draws) > 1 else 'outside' if name in OUTSIDE else 'single'
    stock = scene.stocks[0]
    truth = Truth(
        kind,
        tuple(draws),
        {key: dict(draw.parameters) for key, draw in draws.items()},
        {key: draw.exact for key, draw in draws.items()},
        (*scene.flags, *flags_of(kit, quirks)),
        gap.percent,
        each,
        gap,
        (stock.a, stock.b, stock.c),
        scene.service,
    )
    return Case(name, seed, assumed_yaml(scene, rng), tuple(tuple(bag) for bag in bags), truth)


def assumed_yaml(scene: Scene, rng: np.random.Generator) -> str:
    """Return the assumed train file as YAML: Davis coefficients off by up to 15 %, nominal brake, onboard map."""
    stock, ground = scene.stocks[0], scene.ground
    a, b, c = (value * (1.0 + float(rng.uniform(-0.15, 0.15))) for value in (stock.a, stock.b, stock.c))
    detailed = bool(rng.random() < 0.75)

    def rows(pairs: tuple[tuple[float, float], ...]) -> str:
        return '[' + ', '.join(f'[{x}, {y}]' for x, y in pairs) + ']'

    lines = [
        f'train: {{mass: {scene.assumed_mass:.1f}, rotary_mass: {stock.gamma}, length: {stock.length}, '
        f'cars: {scene.cars}}}',
        f'resistance: {{a: {a:.4f}, b: {b:.6f}, c: {c:.7f}}}',
        f'brake: {{rate: 1.0, time_constant: {stock.lag}, delay: {stock.delay:.2f}}}',
        'line:',
        f'  stops: [{", ".join(str(stop) for stop in ground.stops)}]',
    ]
    if detailed:
        lines += [
            f'  gradient: {rows(ground.gradient)}',
            f'  curve: {rows(ground.curve)}',
            f'  tunnel: {rows(ground.tunnel)}',
        ]
    lines.append('effects: []')
    return '\n'.join(lines) + '\n'

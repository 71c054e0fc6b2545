# SPDX-License-Identifier: Apache-2.0
"""A hidden case: input of the workflow, and the truth for the scoring only, with the visibility of its effects.

The gap e = simulated - measured speed obeys e' = -g / (1000 (1 + gamma)) (r + w'(v) e), where r [N/kN] is the
residual of the assumed balance on the true ride. Refitting a, b, c and the initial speed of each leg is linear in e.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_case import Answer, Case, HiddenEffect, assumed_yaml
from benchmarks.hidden_cases_b.menu import LIBRARY, MENU, NEAR, OUTSIDE, SENSOR_EXTRA, Context, Draw, wish_for
from benchmarks.hidden_cases_b.motion import (
    FLAW,
    GRAV,
    GUST,
    LEG,
    NEUTRAL,
    NOM,
    PULL,
    REAL,
    WAY,
    WEIGHED,
    Quirks,
    T,
    V,
    X,
)
from benchmarks.hidden_cases_b.scene import Scene, draw_scene, drive
from benchmarks.hidden_cases_b.sensing import (
    Instruments,
    contamination_of,
    draw_instruments,
    flags_of,
    map_gradient,
    sense,
    slip_bursts,
)

Array = NDArray[np.float64]
PAIRS: Final = (
    'headwind+curve_resistance', 'tunnel_drag+brake_scale', 'local_drag+traction_scale', 'gradient_error+brake_delay',
    'resistance_step+curve_resistance', 'bearing_warmup+brake_scale', 'mass_error+local_drag',
    'dragging_brake+headwind', 'starting_resistance+gradient_error', 'wheel_slip+resistance_step',
    'traction_scale+brake_scale', 'brake_fade+tunnel_drag', 'higher_order_drag+local_drag',
    'wheel_diameter+brake_delay', 'headwind+brake_scale', 'curve_resistance+gradient_error',
)  # fmt: skip


@njit(cache=True)
def _gaps(load: Array, damping: Array, dt: float) -> Array:
    """Integrate columns of load [m/s^2] with de/dt = load - damping e; shape (n, k)."""
    out = np.zeros(load.shape)
    for i in range(1, load.shape[0]):
        keep = 1.0 - dt * damping[i]
        for j in range(load.shape[1]):
            out[i, j] = keep * out[i - 1, j] + 0.5 * dt * (load[i - 1, j] + load[i, j])
    return out


def _loads(scene: Scene, kit: Instruments, log: Array) -> tuple[Array, Array, Array]:
    """Return weighed and true mass without the effect mass_error [kg], and the brake reported [m/s^2]."""
    loaded: Array = np.array([s.loaded for s in scene.stocks])[log[:, LEG].astype(int)]
    return log[:, WEIGHED], loaded, log[:, REAL] if kit.force_carries_delay else log[:, NOM]


def balance_residual(scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> Array:
    """Return the residual r of the assumed balance, without gusts, map and weighing errors [N/kN]."""
    stock = scene.stocks[0]
    gamma = stock.gamma
    time = log[:, T]
    # The true load, so that the specific force has no weighing error.
    weighed, loaded, effort = _loads(scene, kit, log)
    pull = log[:, PULL] / loaded
    bite = (1.0 + gamma) * effort * weighed / loaded
    specific = 1000.0 / GRAV * np.interp(time - quirks.force_late, time, pull + bite)
    v = quirks.wheel * log[:, V]
    slope = map_gradient(scene, log[:, X] + log[:, WAY] * quirks.map_ahead, log[:, WAY])
    rise = np.gradient(v, 0.1)
    balance = specific - (stock.a + stock.b * v + stock.c * v * v) - slope
    r: Array = balance - 1000.0 / GRAV * (1.0 + gamma) * rise - log[:, GUST] - log[:, FLAW]
    return r


def weighing_residual(scene: Scene, kit: Instruments, log: Array) -> Array:
    """Return the residual of the assumed balance due to the weighing error, part of the floor [N/kN]."""
    weighed, loaded, effort = _loads(scene, kit, log)
    force = log[:, PULL] + (1.0 + scene.stocks[0].gamma) * effort * weighed
    error: Array = 1000.0 / GRAV * force * (1.0 / weighed - 1.0 / loaded)
    return error


def visible(scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> tuple[float, float]:
    """Return the rise of the rms speed gap of the refitted model due to the effects [%], and its floor [m/s]."""
    stock = scene.stocks[0]
    r = balance_residual(scene, quirks, kit, log)
    noise = log[:, GUST] + log[:, FLAW] + weighing_residual(scene, kit, log)
    slip = slip_bursts(np.random.default_rng([kit.base_ns % 2**31, 5]), log, quirks.slip_share, quirks.slip_speed)
    scale = -GRAV / (1000.0 * (1.0 + stock.gamma))
    blocks: list[Array] = []
    for leg in np.unique(log[:, LEG]):
        rows = np.flatnonzero(log[:, LEG] == leg)
        moving = rows[log[rows, V] > 0.5]
        rows = np.arange(moving[0] + 3, moving[-1] - 2)
        v = log[rows, V]
        damping = -scale * (stock.b + 2.0 * stock.c * v)
        load = scale * np.column_stack([r[rows], noise[rows], np.ones(len(v)), v, v * v, np.zeros(len(v))])
        gaps = _gaps(load, damping, 0.1)
        start = np.exp(-np.cumsum(damping) * 0.1)
        gaps[:, 0] -= slip[rows]
        gaps[:, 5] = start
        inside = gaps[:, :5] - np.outer(start, start @ gaps[:, :5]) / float(start @ start)
        blocks.append(inside[::2])
    stack = np.vstack(blocks)
    base = stack[:, 2:5] / np.linalg.norm(stack[:, 2:5], axis=0)
    fitted = np.linalg.lstsq(base, stack[:, :2], rcond=None)[0]
    rest = stack[:, :2] - base @ fitted
    effect, drift = np.sqrt(np.mean(rest**2, axis=0)).tolist()
    floor = float(np.sqrt(drift**2 + kit.speed_noise**2 + kit.quantum**2 / 12.0))
    return 100.0 * (float(np.hypot(effect, floor)) / floor - 1.0), floor


def make_case(name: str, seed: int) -> Case:
    """Generate a case, of no effect ('none') or some joined by '+'; equal names and seeds give equal cases.

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
            return _observe(name, scene, quirks, draws, log, np.random.default_rng([root, attempt, 7]))
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
    name: str, scene: Scene, quirks: Quirks, draws: Mapping[str, Draw], log: Array, rng: np.random.Generator
) -> Case:
    kit = draw_instruments(rng, scene, quirks)
    bags = sense(rng, scene, quirks, kit, log)
    percent, floor = visible(scene, quirks, kit, log)
    each = dict.fromkeys(draws, percent)
    if len(draws) > 1:
        for key, draw in draws.items():
            alone = _with([draw])
            each[key], _ = visible(scene, alone, kit, drive(scene, alone))
    kind = 'none' if not draws else 'pair' if len(draws) > 1 else 'outside' if name in OUTSIDE else 'single'
    effects = tuple(
        HiddenEffect(key, tuple((of, draw.parameters[of]) for of in draw.exact), NEAR.get(key, ()), each[key])
        for key, draw in draws.items()
    )
    flags = scene.service, *scene.flags, *flags_of(kit, quirks)
    answer = Answer(kind, effects, percent, floor, scene.one_way, contamination_of(kit), flags)
    return Case(_assumed_file(scene, rng), tuple(tuple(bag) for bag in bags), answer)


def _assumed_file(scene: Scene, rng: np.random.Generator) -> str:
    """Return the assumed train file as YAML: Davis coefficients off by up to 15 %, nominal brake, onboard map."""
    stock, ground = scene.stocks[0], scene.ground
    a, b, c = (value * (1.0 + float(rng.uniform(-0.15, 0.15))) for value in (stock.a, stock.b, stock.c))
    train = {
        'mass': f'{scene.assumed_mass:.1f}',
        'rotary_mass': stock.gamma,
        'length': stock.length,
        'cars': scene.cars,
    }
    sections = {'gradient': ground.gradient, 'curve': ground.curve, 'tunnel': ground.tunnel}
    if rng.random() >= 0.75:
        sections = {}
    davis, brake = (f'{a:.4f}', f'{b:.6f}', f'{c:.7f}'), (stock.lag, stock.delay)
    return assumed_yaml(train, davis, brake, ground.stops, sections, str)

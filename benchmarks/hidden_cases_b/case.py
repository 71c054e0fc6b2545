# SPDX-License-Identifier: Apache-2.0
"""A hidden case: input of the workflow, and the truth for the scoring only, with the visibility of its effects.

The gap e = simulated - measured speed obeys e' = -g / (1000 (1 + gamma)) (r + w'(v) e), where r [N/kN] is the
residual of the assumed balance on the true ride. Refitting a, b, c and the initial speed of each leg is linear in e.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_case import Answer, Case, HiddenEffect, assumed_yaml, kind_of
from benchmarks.hidden_cases_b.menu import LIBRARY, MENU, NEAR, OUTSIDE, SENSOR_EXTRA, Context, Draw, wish_for
from benchmarks.hidden_cases_b.motion import (
    CMD,
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
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

Array = NDArray[np.float64]
_STRAIGHT: Final = 1e-4  # 1/m
PAIRS: Final = (
    'headwind+curve_resistance', 'tunnel_drag+brake_scale', 'local_drag+traction_scale', 'gradient_error+brake_delay',
    'resistance_step+curve_resistance', 'bearing_warmup+brake_scale', 'mass_error+local_drag',
    'dragging_brake+headwind', 'starting_resistance+gradient_error', 'wheel_slip+resistance_step',
    'traction_scale+brake_scale', 'brake_fade+tunnel_drag', 'higher_order_drag+local_drag',
    'wheel_diameter+brake_delay', 'headwind+brake_scale', 'curve_resistance+gradient_error',
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Instruments:
    """Sensor parameters of one case, in SI units."""

    period: float
    speed_noise: float
    quantum: float
    force_noise: float
    stamp_jitter: float
    corrected: bool
    odo_scale: float
    odo_walk: float
    lookup_measured: bool
    point_gradient: bool
    flags_late: float
    force_carries_delay: bool
    outliers: float
    dropouts: float
    slip_share: float
    slip_speed: float
    base_ns: int


def draw_instruments(rng: np.random.Generator, scene: Scene, quirks: Quirks) -> Instruments:
    """Draw sensors; about a quarter of the cases are contaminated."""
    corrected = bool(rng.random() < 0.65)
    slips = rng.random() < 0.1 and quirks.slip_share == 0.0
    return Instruments(
        period=scene.stocks[0].tick * 0.02, speed_noise=float(rng.uniform(0.01, 0.05)),
        quantum=float(rng.choice([0.01, 0.03, 0.1])) / 3.6, force_noise=float(rng.uniform(0.1, 0.4)),
        stamp_jitter=float(rng.uniform(0.0, 0.002)), corrected=corrected,
        odo_scale=float(rng.standard_normal()) * (0.001 if corrected else 0.0002),
        odo_walk=float(rng.uniform(0.01, 0.05)), lookup_measured=bool(corrected and rng.random() < 0.5),
        point_gradient=bool(rng.random() < 0.15),
        flags_late=float(rng.uniform(0.0, 8.0)) if rng.random() < 0.6 else 0.0,
        force_carries_delay=bool(rng.random() < 0.5), outliers=0.05 if rng.random() < 0.1 else 0.0,
        dropouts=0.03 if rng.random() < 0.1 else 0.0, slip_share=float(rng.uniform(0.005, 0.02)) if slips else 0.0,
        slip_speed=float(rng.uniform(0.5, 2.5)) if slips else 0.0,
        base_ns=1_700_000_000_000_000_000 + int(rng.integers(0, 10**15)),
    )  # fmt: skip


def contamination_of(kit: Instruments) -> tuple[str, ...]:
    shares = {'outliers': kit.outliers, 'dropouts': kit.dropouts, 'slip': kit.slip_share}
    return tuple(word for word, share in shares.items() if share > 0.0)


def flags_of(kit: Instruments, quirks: Quirks) -> tuple[str, ...]:
    """Return the names of further circumstances that the scoring may distinguish."""
    words = {
        'point_gradient': kit.point_gradient,
        'late_flags': kit.flags_late > 0.0,
        'pure_odometry': not kit.corrected,
        'lookup_measured': kit.lookup_measured,
        'force_carries_delay': kit.force_carries_delay and quirks.late > 0.0,
        '10_hz': kit.period < 0.15,
    }
    return tuple(word for word, holds in words.items() if holds)


def slip_bursts(rng: np.random.Generator, log: Array, share: float, speed: float) -> Array:
    """Return the slip speed (wheel minus train) [m/s]: bursts of 0.8 to 3 s, likelier at high specific force."""
    out = np.zeros(len(log))
    push = log[:, PULL] / log[:, WEIGHED] + log[:, NOM]
    moving = np.flatnonzero((log[:, V] > 1.0) & (np.abs(push) > 0.05))
    if share <= 0.0 or len(moving) == 0:
        return out
    goal = share * float(np.count_nonzero(log[:, V] > 0.5))
    odds = np.abs(push[moving])
    odds = odds / odds.sum()
    done = 0.0
    while done < goal:
        width = int(rng.integers(8, 31))
        at = int(rng.choice(moving, p=odds))
        hump = np.sin(np.linspace(0.1, np.pi - 0.1, width)) ** 0.5 * float(rng.uniform(0.3, 1.0)) * speed
        end = min(at + width, len(log))
        same = log[at:end, LEG] == log[at, LEG]
        room = np.abs(hump[: end - at]) * np.sign(push[at]) * same * (log[at:end, V] > 0.3)
        out[at:end] = np.where(out[at:end] == 0.0, room, out[at:end])
        done += width
    return out


def odometer_error(rng: np.random.Generator, log: Array, kit: Instruments, wheel: float, slip: Array) -> Array:
    """Return measured minus true position [m] along the log."""
    step = np.diff(log[:, X], prepend=log[0, X])
    fresh = np.abs(step) > 20.0
    step[fresh] = 0.0
    walk = kit.odo_walk * np.sqrt(0.1) * rng.standard_normal(len(log)) * (log[:, V] > 0.0)
    grown = np.cumsum(step * (wheel * (1.0 + kit.odo_scale) - 1.0) + log[:, WAY] * 0.1 * slip + walk)
    index = np.arange(len(log))
    anchors = (log[:, V] == 0.0) if kit.corrected else np.zeros(len(log), bool)
    anchors = anchors | fresh
    anchors[0] = True
    last = np.maximum.accumulate(np.where(anchors, index, 0))
    error: Array = grown - grown[last]
    return error


def map_gradient(scene: Scene, front: Array, way: Array, *, point: bool = False) -> Array:
    """Return the map gradient in the direction of travel [per mille], averaged under the train or at its middle."""
    ground, length = scene.ground, scene.stocks[0].length
    if not point:
        return ground.signed_mean_under(ground.climb, front, way, length)
    middle = front - way * 0.5 * length
    return way * (ground.at(ground.climb, middle + 1.0) - ground.at(ground.climb, middle - 1.0)) / 2.0


def sense(rng: np.random.Generator, scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> list[list[Record]]:
    """Return the records of every bag in the order of their stamps."""
    share, speed = (kit.slip_share, kit.slip_speed) if kit.slip_share else (quirks.slip_share, quirks.slip_speed)
    slip = slip_bursts(np.random.default_rng([kit.base_ns % 2**31, 5]), log, share, speed)
    error = odometer_error(rng, log, kit, quirks.wheel, slip)
    bag_of = np.array([leg.bag for leg in scene.legs])[log[:, LEG].astype(int)]
    bags = []
    for bag in range(int(bag_of.max()) + 1):
        rows = np.flatnonzero(bag_of == bag)
        recorder = _Recorder(rng, scene, quirks, kit, log[rows], error[rows], slip[rows])
        records = [*recorder.speed(), *recorder.force(), *recorder.track(), *recorder.brake(), *recorder.mass()]
        bags.append(sorted(records, key=lambda record: record.stamp_ns))
    return bags


@dataclass(frozen=True, slots=True)
class _Recorder:
    """Records of one bag; the methods share one random generator, so their order matters."""

    rng: np.random.Generator
    scene: Scene
    quirks: Quirks
    kit: Instruments
    log: Array
    odometer: Array  # measured minus true position [m]
    slip: Array  # [m/s]

    def speed(self) -> list[Record]:
        kit, rng = self.kit, self.rng
        at = self._grid(kit.period, float(rng.uniform(0.0, 0.04)))
        true = self._of(V, at)
        raw = self.quirks.wheel * true + self._between(self.slip, at) + kit.speed_noise * rng.standard_normal(len(at))
        outlier = rng.random(len(at)) < kit.outliers
        raw = np.where(outlier, raw + rng.choice([-1.0, 1.0], len(at)) * rng.uniform(1.0, 8.0, len(at)), raw)
        seen = np.maximum(np.round(raw / kit.quantum) * kit.quantum, 0.0)
        seen = np.where((true <= 0.0) & ~outlier, 0.0, seen)
        place = self._of(X, at) + self._between(self.odometer, at)
        ok = self._kept(at)
        rows = zip(self._stamps(at), seen.tolist(), place.tolist(), ok, strict=True)
        return [SpeedRecord(s, v, x) for s, v, x, k in rows if k]

    def force(self) -> list[Record]:
        kit, rng = self.kit, self.rng
        at = self._fast_grid()
        then = at - self.quirks.force_late
        mass = self._held(WEIGHED, then)
        effort = self._of(REAL if kit.force_carries_delay else NOM, then)
        force = self._of(PULL, then) + mass * (1.0 + self.scene.stocks[0].gamma) * effort
        force = force + kit.force_noise * mass * GRAV / 1000.0 * rng.standard_normal(len(at))
        force = force * (1.0 + 0.002 * rng.standard_normal(len(at)))
        ok = self._kept(at)
        return [ForceRecord(s, f) for s, f, k in zip(self._stamps(at), force.tolist(), ok, strict=True) if k]

    def track(self) -> list[Record]:
        kit, ground, length = self.kit, self.scene.ground, self.scene.stocks[0].length
        at = self._fast_grid()
        way = self._held(WAY, at)
        front = self._of(X, at) + (self._between(self.odometer, at) if kit.lookup_measured else 0.0)
        slope = map_gradient(self.scene, front + way * self.quirks.map_ahead, way, point=kit.point_gradient)
        behind = front - way * kit.flags_late
        bend = ground.mean_under(ground.bend, behind, way, length)
        radius = np.where(bend > _STRAIGHT, 1.0 / np.maximum(bend, _STRAIGHT), 0.0)
        dark = ground.mean_under(ground.bore, behind, way, length) >= 0.5
        ok = self._kept(at)
        rows = zip(self._stamps(at), slope.tolist(), radius.tolist(), dark.tolist(), ok, strict=True)
        return [GradientRecord(s, g, r, d) for s, g, r, d, k in rows if k]

    def brake(self) -> list[Record]:
        at = self._grid(self.kit.period, 0.0)
        ok = self._kept(at)
        command = self._held(CMD, at) + 0.0
        rows = zip(self._stamps(at, exact=True), command.tolist(), ok, strict=True)
        return [BrakeRecord(s, u, emergency=False) for s, u, k in rows if k]

    def mass(self) -> list[Record]:
        if not self.scene.mass_topic:
            return []
        at = self._grid(1.0, float(self.rng.uniform(0.0, 0.5)))
        ok = self._kept(at)
        weighed = self._held(WEIGHED, at)
        return [MassRecord(s, m) for s, m, k in zip(self._stamps(at), weighed.tolist(), ok, strict=True) if k]

    def _grid(self, period: float, phase: float) -> Array:
        return np.arange(float(self.log[0, T]) + phase, float(self.log[-1, T]) - 0.01, period)

    def _fast_grid(self) -> Array:
        return self._grid(self.kit.period, float(self.rng.uniform(0.0, 0.19)) % self.kit.period)

    def _stamps(self, at: Array, *, exact: bool = False) -> list[int]:
        if not exact:
            at = at + np.clip(self.kit.stamp_jitter * self.rng.standard_normal(len(at)), -0.004, 0.004)
        return [self.kit.base_ns + int(ns) for ns in np.round(at * 1e9).tolist()]

    def _kept(self, at: Array) -> list[bool]:
        kept: list[bool] = (self.rng.random(len(at)) >= self.kit.dropouts).tolist()
        return kept

    def _of(self, column: int, at: Array) -> Array:
        return self._between(self.log[:, column], at)

    def _between(self, signal: Array, at: Array) -> Array:
        return np.interp(at, self.log[:, T], signal)

    def _held(self, column: int, at: Array) -> Array:
        row = np.clip(np.searchsorted(self.log[:, T], at + 1e-6, side='right') - 1, 0, len(self.log) - 1)
        picked: Array = self.log[row, column]
        return picked


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
            return _observe(scene, quirks, draws, log, np.random.default_rng([root, attempt, 7]))
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


def _observe(scene: Scene, quirks: Quirks, draws: Mapping[str, Draw], log: Array, rng: np.random.Generator) -> Case:
    kit = draw_instruments(rng, scene, quirks)
    bags = sense(rng, scene, quirks, kit, log)
    percent, floor = visible(scene, quirks, kit, log)
    each = dict.fromkeys(draws, percent)
    if len(draws) > 1:
        for key, draw in draws.items():
            alone = _with([draw])
            each[key], _ = visible(scene, alone, kit, drive(scene, alone))
    kind = kind_of(list(draws), OUTSIDE)
    effects = tuple(HiddenEffect(key, draw.parameters, NEAR.get(key, ()), each[key]) for key, draw in draws.items())
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

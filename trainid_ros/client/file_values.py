# SPDX-License-Identifier: Apache-2.0
"""What a train file says to a client: values with their standard deviations, effects, and resistance over the line.

The estimators remove the effects of the train file from their estimates; the client adds them again. Time and history
are not known there, and place only to some answers. So effects are evaluated on level, open, straight track, long after
the last brake release, with warm bearings and at the start of the record: what depends on anything else adds nothing.
The exceptions are a hot brake, which is the worst case of a bound, and answers at a place on the line.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import replace
from functools import cache
from operator import sub
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.motion_model import MotionModel
from trainid_ros.client.live_estimate import Normal, Parameter
from trainid_ros.client.stopping import EXTRA_SPEEDS, MAX_SPEED, RateShape
from trainid_ros.estimators.settings import prior_variances
from trainid_ros.interface.errors import InputError
from trainid_ros.train.effects import TrackPoint, effect_value, resistance_terms
from trainid_ros.train.forces import G
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import MAX_RATE, MIN_RATE

if TYPE_CHECKING:
    from trainid_ros.estimators.settings import BrakeRateConfig, PriorSettings
    from trainid_ros.train.train_file import TrainFile

# A position beyond all lines [m].
_ANYWHERE: Final = 1e9
# Traction or braking force for which shares are calculated: effects are (nearly) linear in it [N/kN].
_REFERENCE: Final = 100.0


class StatedEffects:
    """The effects of a train file that act at a speed; InputError for one not known or that cannot be evaluated.

    ``brake_scale`` and ``brake_delay`` are part of the brake, see ``brake_rate.motion_model.true_brake``.
    """

    def __init__(self, train_file: TrainFile) -> None:
        effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
        self._terms, self._davis = resistance_terms(effects), train_file.resistance
        self._names = ', '.join(effect.name for effect in effects)
        self._length = train_file.train.length
        self.profile = profile_of(train_file)
        # Where line or effects change for a point of the train [m], and by how much gradients are read too early [m].
        line = train_file.line
        self._edges = {x for x, _ in (*line.gradient, *line.curve)}
        self._edges |= {value for effect in effects for key, value in effect.parameters if key in {'start', 'end'}}
        self._shift = effect_value(effects, 'map_shift', 'distance', 0.0)

    def resistance(self, speed: float, direction: int) -> float:
        """Return what they add to the running resistance [N/kN] at a speed [m/s]."""
        return math.fsum(self._values(speed, direction))

    def traction_share(self, speed: float, direction: int) -> float:
        """Return the share of the reported traction that they leave [1]."""
        before, after = self._values(speed, direction), self._values(speed, direction, traction=_REFERENCE)
        return 1.0 - math.fsum(map(sub, after, before)) / _REFERENCE

    def brake_share(self, speed: float, *, hot: bool = False) -> float:
        """Return the share of the brake force that they leave [1], of a hot brake if less; InputError if nothing."""
        shares = []
        for heat in (0.0, 1e6) if hot else (0.0,):  # J/kg: with the latter any brake fades fully
            before, after = self._values(speed, 1, heat=heat), self._values(speed, 1, brake=-_REFERENCE, heat=heat)
            shares.append(1.0 + math.fsum(map(sub, after, before)) / _REFERENCE)
        share = min(shares)
        if share <= 0.0:
            raise InputError(
                f'effects ({self._names}) of the train file leave no brake force at {speed:g} m/s: share {share:.2f}'
            )
        return share

    def along(self, direction: int) -> tuple[list[float], list[float], list[float]]:
        """Return places on the line in a direction, and z and y of ``stopping`` for a train there.

        Places are the positions of its front times the direction, rising [m]. Between two, z [N/kN] and y [N/kN per
        (m/s)^2] are linear, exactly so for the effects built in but for a tunnel, which begins within half a metre.
        """
        profile, reach = self.profile, direction * self._length
        joints = [joint if direction > 0 else joint - self._length for joint in profile.joints]
        shifts = [joint + shift for joint in joints for shift in (0.0, direction * self._shift)]
        fronts = {x + shift for x in self._edges for shift in shifts}
        tunnels = (x for pair in profile.line.tunnel for x in pair)
        fronts |= {x + 0.5 * reach + side for x in tunnels for side in (-0.25, 0.25)}
        places, z, y = sorted({-_ANYWHERE, _ANYWHERE, *(direction * x for x in fronts)}), [], []
        for place in places:
            position = direction * place
            still, fast = (
                math.fsum(map(sub, self._values(v, direction, position=position), self._values(v, direction)))
                for v in (0.0, MAX_SPEED)
            )
            z.append(profile.gradient(position, direction) + still)
            y.append((fast - still) / MAX_SPEED**2)
        return places, z, y

    def _values(
        self,
        speed: float,
        direction: int,
        *,
        position: float = math.nan,
        traction: float = 0.0,
        brake: float = 0.0,
        heat: float = 0.0,
    ) -> list[float]:
        """Return the resistance of each effect with a traction and a braking force [N/kN]."""
        if not self._terms:
            return []
        point = TrackPoint(
            0.0, position, direction, speed, length=self._length,
            distance_run=1e12,  # any bearing is warm
            traction=traction, brake=brake, heat=heat,
            # As in the live estimators, which shift the dead time instead.
            brake_before=lambda _: brake, traction_before=lambda _: traction,
        )  # fmt: skip
        if not math.isnan(position):
            point.curve_radius = self.profile.curve_radius(position, direction)
            point.tunnel = self.profile.tunnel(position, direction)
            point.gradient_ahead = lambda ahead: self.profile.gradient(position + direction * ahead, direction)
        return [term(self._davis, point) for term in self._terms]


DAVIS: Final = 'a, b, c'  # name of the running resistance among the parameters [N/kN, v in m/s]
FORCE_SCALE: Final = 'force scale'  # name of the actual over the reported force [1]
BRAKE_RATE: Final = 'brake rate'  # name of the brake rate, or of the factor on its table [1]
MIN_SCALE: Final = 0.1  # least actual over reported force, whichever reads wrong [1]
# Speeds at which moves of the resistance are measured, and changes of the brake by effects, as shares of the highest.
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


class FileValues:
    """Values and standard deviations of a train file, as the estimators start with them.

    Attributes:
        k: Deceleration by a resistance of 1 N/kN, g0 / (1000 (1 + gamma)) [m/s^2].
        brake: Brake with the effects ``brake_scale`` and ``brake_delay`` of the train file applied.
        effects: Its other effects.
        timing_stds: Standard deviations of dead time and time constant [s].
    """

    def __init__(self, train_file: TrainFile, prior: PriorSettings, config: BrakeRateConfig) -> None:
        self.train_file, self.config, self._prior = train_file, config, prior
        model = MotionModel(train_file, config)
        self.brake, self.timing_stds = model.brake, train_file.brake.timing_stds
        self.k = G / (1000.0 * (1.0 + train_file.train.rotary_mass))
        self.effects = StatedEffects(train_file)
        self._speeds = tuple(share * train_file.train.max_speed for share in _SHARES)
        self._shape = self._rate_shape([], hot=False)
        self._along = cache(self.effects.along)
        self._worst = {}
        for direction in (1, -1):
            extra = [self.effects.resistance(speed, direction) for speed in EXTRA_SPEEDS]
            self._worst[direction] = self._rate_shape(extra if any(extra) else [], hot=True)

    def _rate_shape(self, extra: list[float], *, hot: bool) -> RateShape:
        """Return the brake rate over speed, with a cold or a hot brake, and an extra resistance [N/kN]."""
        table = self.brake.rate_table or tuple((speed, 1.0) for speed in self._speeds)
        speeds, rates = [v for v, _ in table], [rate * self.effects.brake_share(v, hot=hot) for v, rate in table]
        if not self.brake.rate_table and len(set(rates)) == 1:
            # Does not depend on speed: one row, or none if there is nothing to state.
            speeds, rates = ([], []) if rates[0] == 1.0 else ([0.0], rates[:1])
        return RateShape(speeds, rates, self.train_file.train.max_speed, self.config.blend_speed, self.k, extra)

    def stop_shape(self, direction: int, position: float | None = None) -> RateShape:
        """Return what bounds assume: brake rate of a hot brake, extra resistance over speed, and the line ahead.

        InputError for a position [m] that is not on the line.
        """
        shape = self._worst[direction]
        if position is None:
            return shape
        self.check_place('position', position)
        (places, *along), place = self._along(direction), direction * position
        first = bisect_right(places, place) - 1
        ahead, (z, y) = [x - place for x in places[first:]], (values[first:] for values in along)
        return replace(shape, ahead=ahead, at_place=z, by_square=y)

    def check_place(self, name: str, position: float) -> None:
        """Raise InputError unless a position [m] of this name is on the line, and its gradients are known."""
        line = self.effects.profile
        if not line.line.gradient:
            raise InputError('line.gradient of the train file is missing, so an answer at a position cannot be given')
        if not line.first <= position <= line.last:
            raise InputError(f'{name} = {position:g} m is not on the line, {line.first:g} to {line.last:g} m')

    def beyond_line(self, way: float, direction: int, position: float | None) -> str:
        """Return what to add to the reason of an answer if a way [m] from a position [m] leads off the line."""
        line, known = self.effects.profile, self.train_file.line.gradient
        first, last, end = line.first, line.last, 'end of the line'
        if math.isinf(last) and len(known) > 1:  # no stops; a single gradient is that of any place
            first, last, end = known[0][0], known[-1][0], 'gradients of the line, which end'
        if position is None or first <= position + direction * way <= last:
            return ''
        return f'; beyond the {end} at {last if direction > 0 else first:.10g} m'

    def motion_shape(self, direction: int, position: float | None) -> RateShape:
        """Return the same for a cold brake."""
        cold = self._shape
        return replace(self.stop_shape(direction, position), speeds=cold.speeds, rates=cold.rates)

    def resistance(self) -> dict[str, Parameter]:
        """Return (a, b, c) and the force scale."""
        w, train = self.train_file.resistance, self.train_file.train
        a, b, c = prior_variances((w.a, w.b, w.c), self._prior)
        davis = Normal((w.a, w.b, w.c), (a, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c))
        scale = Normal((1.0,), (math.hypot(train.mass_std, train.force_std) ** 2,))
        probes = tuple((1.0, v, v * v) for v in self._speeds)
        # No a, b or c of a train is outside -20 to 200 [N/kN and per m/s, (m/s)^2], nor is its resistance [N/kN].
        return {
            DAVIS: Parameter(davis, probes, -20.0, 200.0, max_std=200.0),
            FORCE_SCALE: Parameter(scale, ((1.0,),), MIN_SCALE, 10.0),
        }

    def brake_rate(self) -> dict[str, Parameter]:
        """Return the brake rate, or the factor on its table."""
        rate = Normal((self.brake.rate,), (self.config.prior_std**2,))
        return {BRAKE_RATE: Parameter(rate, ((1.0,),), MIN_RATE, MAX_RATE)}

    def rate_direction(self, speed: float | None) -> tuple[float, float]:
        """Return s(v), and the standard deviation of e p(v) + h m(v) [1]; see ``stopping``.

        Without a speed, s is 1 but for the effects of the train file at medium speed.
        """
        if speed is None:
            return self.effects.brake_share(self._speeds[len(_SHARES) // 2]), 0.0
        s, p, m = self._shape.parts(speed)
        return s, math.hypot(self.config.slope_std * p, self.config.blend_std * m)

# SPDX-License-Identifier: Apache-2.0
"""The filter of one row of the table of faults: how a train with that fault moves, and what is unusual about it.

With specific forces [N/kN], m = 1000 (1 + gamma)/g0, F the reported force, B the brake command after exact dead time
and lag as a force, r the brake rate and (a, b, c) the resistance of the train file, i gradient and effects:

    (1)  m dv/dt = gain (T + force_late dT/dt) + brake r (B - brake_late (delay + lag) dB/dt)
                   - i - (a + b v + c v (v + 2 wind)) - offset + noise,     T = F - B
    (2)  distance by position = distance by speed / (1 + wheel) + lag * step of the speed + noise

Traction and brake act together: power braking, and dynamic braking without a command, are no exceptions. The states
[v, offset, wind, gain, brake, force_late, brake_late] and the wheel return to what is usual, and stop at ``RANGE``
standard deviations of it, so that no row explains everything away.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

from trainid_ros.interface.state import State, declare, definite, unknown
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.stream.fault_table import (
    BRAKE,
    BRAKE_LATE,
    FORCE_LATE,
    GAIN,
    OFFSET,
    TABLE,
    USUAL,
    WHEEL,
    WIND,
    Input,
    Row,
    Usual,
    V,
)
from trainid_ros.stream.input_blocks import KEPT, MOVING, UNKNOWN, Block
from trainid_ros.stream.known_force import KnownForce

STATES: Final[i64] = 7
"""Number of states of the filter."""

# Decision

_APPLICATION: Final = 5.0  # nats: the most that one application of the brake counts: none is suspected by one

# Scores: assumed costs of one block, next to its likelihood; benchmarks/healthy.py and faults.py show that they fit.

MAX_COST: Final = 4.0  # nats: the most that one block of one score can cost (slip, a jump of the position)

# Noise: assumed sizes of healthy trains where no source is named; benchmarks/healthy.py shows that they cover them.

_FORCE_STD: Final = 0.6  # N/kN, white: ripple of the resistance within a block
_SLACK: Final = 4.0  # N/kN: jerks of couplers and of the friction brake of a train that hardly moves ...
_SLACK_SHARE: Final = 0.3  # share of the brake: the same, where electric brakes hand over to friction ...
_SLACK_SPEED: Final = 4.0  # m/s: ... slower than this
_TRACTION_SHARE: Final = 0.03  # share of the traction, white: ripple within a block
_BRAKE_SHARE: Final = 0.10  # the same of the brake
_OVERLAP_SHARE: Final = 0.1  # share of traction beside a brake, which is the difference of two forces
_JITTER_S: Final = 0.12  # s: error of the times of a force that changes
_TIMING_SHARE: Final = 0.2  # share of dead time and lag: the same of a brake that changes
_ANY_FORCE: Final = 40.0  # N/kN: traction that is not known ...
_ANY_FORCE_BRAKED: Final = 8.0  # ... and beside a brake
_MIN_POSITION_STD: Final = 0.1  # m: least such noise
_LAG_STD: Final = 0.1  # s, white: by which position and speed are apart at random
_DISTANCE_SHARE: Final = 0.01  # share of a distance by which positions are off between balises
MIN_BRAKE: Final = 3.0  # N/kN: a weaker brake is not compared with the force
_REPORTED_STD: Final = 3.0  # N/kN: error of the reported force of a brake ...
_REPORTED_SHARE: Final = 0.25  # ... and its share of that force
_RELEASING: Final = 0.2  # 1/s: a brake that falls faster is being released, and a driver may pull already

_NU: Final = 4.0  # degrees of freedom of Student's t: tails of sensors with rare outliers

# What is usual, and how far a row may depart from it

RANGE: Final = 2.5  # standard deviations: healthy trains do not go further
LASTING_S: Final = 1000.0  # s: time in which a fault, once there, varies
# Std of the wind over the speed [1]: drag 40 % off, by tunnels that no file states, gusts or the file ...
_DRAG_WIND: Final = 0.2
_TUNNEL_WIND: Final = 0.5  # ... and in a tunnel: drag up to 3.5 times that in the open


class Prior:
    """A row of the table as numbers: what its filter assumes.

    Attributes:
        row: The row.
        mean: Usual values of the states, shape (7,); that of v is not used.
        std: Their standard deviations, shape (7,).
        own: 1 where it has its own opinion of a state, else 0, shape (7,).
        anew: 1 where it does not start from what another row has learned, else 0, shape (7,).
    """

    def __init__(self, row: Row) -> None:
        self.row = row
        self.mean = vec[float]([0.0] + [usual.mean for usual in USUAL])
        self.std = vec[float]([0.0] + [usual.std for usual in USUAL])
        self.own = vec[float]([0.0] * STATES)
        for place, mean, std in row.unusual:
            self.mean[place], self.std[place], self.own[place] = mean, std, 1.0
        for place, is_own in (
            (GAIN, row.force != 1.0),
            (BRAKE, row.command != 1.0),
            (FORCE_LATE, row.late in {Input.FORCE, Input.SPEED}),
            (BRAKE_LATE, row.late in {Input.COMMAND, Input.BRAKE}),
        ):
            if is_own:
                self.own[place] = 1.0
        self.anew = self.own[:]
        self.ignores_speed = Input.SPEED in row.ignores
        self.ignores_position = Input.POSITION in row.ignores
        self.ignores_force = Input.FORCE in row.ignores
        self.ignores_command = Input.COMMAND in row.ignores
        self.ignores_braking = Input.BRAKING in row.ignores
        self.ignores_gradient = Input.GRADIENT in row.ignores
        self.ignores_line = self.ignores_gradient or Input.LINE in row.ignores
        # Inputs that are read from an earlier block: all but the late one, or the early one alone.
        late, others = row.late, row.late is not None and not row.early and row.late is not Input.BRAKE
        self.delays_speed = others and late is not Input.SPEED
        self.delays_force = (others and late is not Input.FORCE) or row.early
        self.delays_command = (others and late is not Input.COMMAND) or late is Input.BRAKE
        self.delays_gradient = others
        self.held = row.holds_resistance + row.holds_brake_rate  # number of kinds of estimates that must wait
        self.is_of_times, self.is_of_wheel = row.is_of_times, row.is_of_wheel
        self.is_of_scale = (self.own[GAIN] > 0.0 and not row.misread) or row.is_of_odometer
        self.is_of_brake = late in {Input.COMMAND, Input.BRAKE}
        self.is_of_odometer = row.is_of_odometer
        self.is_of_line = (self.ignores_line and not row.is_of_odometer) or row.gradient != 1.0
        if self.ignores_gradient or row.gradient != 1.0:
            self.anew[OFFSET] = 1.0

    def by_position(self, block: Block) -> float:
        """Return the distance by position over a block [m]; one in km does not show the direction of travel."""
        scale, distance = self.row.position, block.by_position
        return distance if scale == 1.0 else scale * abs(distance)


PRIORS: Final = [Prior(row) for row in TABLE]


def diagonal(place: i64) -> i64:
    """Return where the variance of a state is in the upper triangle of a covariance."""
    return place * STATES - place * (place - 1) // 2


def student_t(z2: float, spread: float) -> tuple[float, float]:
    """Return log likelihood [nats] and weight of a residual by Student's t.

    Args:
        z2: Its square over its variance [1].
        spread: That variance over the one of the measurement alone [1].
    """
    score = -0.5 * (_NU + 1.0) * math.log(1.0 + z2 / _NU) - 0.5 * math.log(spread)
    return max(score, -MAX_COST), min((_NU + 1.0) / (_NU + z2), 1.0)


def wind_std(speed: float, tunnel: bool) -> float:
    """Return the standard deviation of the wind over healthy trains at a speed [m/s]."""
    return max((_TUNNEL_WIND if tunnel else _DRAG_WIND) * speed, USUAL[WIND - 1].std)


class Trial:
    """One row of the table with its filter.

    Attributes:
        row: Place of the row.
        shift: Blocks by which the inputs of the row are apart.
        x: Mean of the states, shape (7,).
        P: Upper triangle of their covariance, row by row, 28 numbers.
        centre: Values to which they return, shape (7,).
        wheel: Mean of the wheel [1].
        wheel_var: Its variance.
        wheel_centre: Value to which it returns [1].
        scores: Log likelihoods of the last blocks by their number, NaN where there is none [nats].
        total: S against the accepted row up to the present application of the brake [nats].
        part: S since then [nats].
        age_s: Time since its fresh start [s].
        rise_s: Time in motion since S was last below one nat [s].
        odd_s: Time for which the speed has been odd [s].
    """

    STATE: ClassVar[State] = declare(
        'row', 'shift', 'x', definite('P'), 'centre', 'wheel', 'wheel_var', 'wheel_centre', unknown('scores'), 'total',
        'part', 'age_s', 'rise_s', 'odd_s',
    )  # fmt: skip

    def __init__(self, row: int = 0) -> None:
        self.row, self.shift = row, 0
        self.centre = PRIORS[row].mean[:]
        self.x = self.centre[:]
        self.P = vec[float]([0.0] * (STATES * (STATES + 1) // 2))
        self.wheel = self.wheel_centre = 0.0
        self.wheel_var = WHEEL.std * WHEEL.std
        self.scores = vec[float]([math.nan] * KEPT)
        self.total = self.part = self.age_s = self.rise_s = self.odd_s = 0.0
        self._f = vec[float]([0.0] * STATES)
        self._row = vec[float]([0.0] * STATES)

    @property
    def back(self) -> i64:
        """By how many blocks the one of its speed is back."""
        return self.shift if PRIORS[self.row].delays_speed else 0

    @property
    def sum(self) -> float:
        """S of (4) in :mod:`input_check` [nats]."""
        return self.total + min(self.part, _APPLICATION)

    def start(self, other: Trial, shift: int) -> None:
        """Start afresh from what another row knows, but for what either of the two has its own opinion of."""
        prior, theirs = PRIORS[self.row], PRIORS[other.row]
        self.shift = shift
        k: i64 = 0
        for i in range(STATES):
            is_mine = prior.anew[i] + theirs.anew[i] > 0.0
            self.x[i] = prior.mean[i] if is_mine else other.x[i]
            self.centre[i] = prior.mean[i]
            for j in range(i, STATES):
                if is_mine or prior.anew[j] + theirs.anew[j] > 0.0:
                    self.P[k] = prior.std[i] * prior.std[i] if i == j else 0.0
                else:
                    self.P[k] = other.P[k]
                k += 1
        is_mine = prior.is_of_wheel or theirs.is_of_wheel
        std = prior.row.wheel_std
        self.wheel, self.wheel_var = (0.0, std * std) if is_mine else (other.wheel, other.wheel_var)
        self.wheel_centre = 0.0
        for n in range(KEPT):
            self.scores[n] = math.nan
        self.total = self.part = self.age_s = self.rise_s = self.odd_s = 0.0

    def copy_estimate(self, other: Trial) -> None:
        """Take over the estimate of another one."""
        self.row, self.shift, self.x, self.P = other.row, other.shift, other.x[:], other.P[:]
        self.wheel, self.wheel_var = other.wheel, other.wheel_var

    def measure(self, at: Block) -> None:
        """Take the speed at the end of a block as measured; keep the parameters."""
        factor = PRIORS[self.row].row.speed
        self.x[V], self.P[V] = factor * at.speed, factor * factor * at.variance
        for j in range(1, STATES):
            self.P[j] = 0.0

    def predict(self, forces: Forces, block: Block, decay: vec[float], *, accepted: bool) -> None:
        """Predict to the end of a block by (1)."""
        x, P, f, fP = self.x, self.P, self._f, self._row
        self._relax(PRIORS[self.row], block, decay, accepted=accepted)
        v, h, rate = x[V], block.seconds / forces.inertia, forces.timing * forces.brake_rate
        x[V] = max(v + h * forces.balance(x, v), 0.0)
        # Row v of the Jacobian.
        f[V] = 1.0 - h * (forces.slope(v) + x[WIND] * 2.0 * forces.drag)
        f[OFFSET], f[WIND] = -h, -h * 2.0 * forces.drag * v
        f[GAIN] = h * (forces.traction + x[FORCE_LATE] * forces.traction_rate)
        f[BRAKE] = h * (forces.brake - x[BRAKE_LATE] * rate)
        f[FORCE_LATE], f[BRAKE_LATE] = h * x[GAIN] * forces.traction_rate, -h * x[BRAKE] * rate
        # P = F P F' + Q, where F is 1 but for its row f of v.
        for i in range(STATES):
            fP[i] = 0.0
        k: i64 = 0
        for i in range(STATES):
            f_i, sum_i = f[i], fP[i] + f[i] * P[k]
            k += 1
            for j in range(i + 1, STATES):
                sum_i += f[j] * P[k]
                fP[j] += f_i * P[k]
                k += 1
            fP[i] = sum_i
        variance = h * h * forces.variance
        for j in range(STATES):
            variance += fP[j] * f[j]
            P[j] = fP[j]
        P[V] = variance

    def _relax(self, prior: Prior, block: Block, decay: vec[float], *, accepted: bool) -> None:
        """Let the parameters return to what is usual; a fault, once found, keeps its size."""
        x, P, std, own, centre = self.x, self.P, prior.std, prior.own, self.centre
        lasting, d = decay[V], self._f
        d[V] = 1.0
        for i in range(1, STATES):
            is_own = own[i] > 0.0
            d[i] = lasting if is_own else decay[i]
            if is_own and accepted and self.row > 0:
                centre[i] += (1.0 - lasting) * (x[i] - centre[i])
            x[i] = centre[i] + d[i] * (x[i] - centre[i])
        k: i64 = 0
        for i in range(STATES):
            s = std[i]
            if own[i] > 0.0 and accepted:
                s = min(s, PRIORS[0].std[i])
            elif i == WIND:
                s = wind_std(x[V], block.tunnel)
            P[k] = d[i] * d[i] * P[k] + (1.0 - d[i] * d[i]) * s * s
            k += 1
            for j in range(i + 1, STATES):
                P[k] *= d[i] * d[j]
                k += 1
        # Inside, the drag stays as it is: wind that may always be anything explains the noise of the speed.
        if block.is_at_portal:
            k = diagonal(WIND)
            P[k] = max(P[k], _TUNNEL_WIND * _TUNNEL_WIND * x[V] * x[V])

    def correct(self, speed: float, R: float) -> float:
        """Correct with a measured speed [m/s] of variance R [(m/s)^2]; return its log likelihood [nats]."""
        x, P, column = self.x, self.P, self._row
        S, nu = P[V] + R, speed - x[V]
        score, weight = student_t(nu * nu / S, S / R)
        # K = P e_v / (P_vv + R / weight);  x += K nu;  P -= K e_v' P
        gain = 1.0 / (P[V] + R / weight)
        for j in range(STATES):
            column[j] = P[j]
        k: i64 = 0
        for i in range(STATES):
            K = gain * column[i]
            x[i] += K * nu
            for j in range(i, STATES):
                P[k] -= K * column[j]
                k += 1
        return score

    def limit(self, tunnel: bool, *, accepted: bool) -> None:
        """Keep the parameters where healthy trains, or those with the fault, have them."""
        prior = PRIORS[self.row]
        for i in range(1, STATES):
            if accepted and prior.own[i] > 0.0:
                continue
            most = RANGE * (wind_std(self.x[V], tunnel) if i == WIND else prior.std[i])
            self.x[i] = min(max(self.x[i], prior.mean[i] - most), prior.mean[i] + most)

    def compare_distances(self, block: Block, lag: Lasting, learned: float, *, accepted: bool) -> float:
        """Correct the wheel with the distance by position, by (2); return its log likelihood [nats]."""
        prior, std = PRIORS[self.row], PRIORS[self.row].row.wheel_std
        by_speed = prior.row.speed * block.by_speed
        # First-order Gauss-Markov process about the centre.
        time_s = LASTING_S if prior.is_of_wheel else WHEEL.time_s
        share = block.seconds / time_s
        if accepted and prior.is_of_wheel:
            self.wheel_centre += share * (self.wheel - self.wheel_centre)
            std = min(std, WHEEL.std)
        self.wheel += share * (self.wheel_centre - self.wheel)
        self.wheel_var += 2.0 * share * (std * std - self.wheel_var)
        step = prior.row.speed * block.speed_step
        # A position in km is no noisier for its unit.
        scale = min(prior.row.position, 1.0)
        R = scale * scale * position_variance(block, learned) + lag.variance * step * step
        nu, H = prior.by_position(block) - by_speed / (1.0 + self.wheel) - lag.mean * step, -by_speed
        S = R + H * H * self.wheel_var
        score, weight = student_t(nu * nu / S, S / R)
        K = H * self.wheel_var / (H * H * self.wheel_var + R / weight)
        self.wheel += K * nu
        self.wheel_var -= K * H * self.wheel_var
        if not (accepted and prior.is_of_wheel):
            most = RANGE * prior.row.wheel_std
            self.wheel = min(max(self.wheel, -most), most)
        return score


class Lasting:
    """A lasting quantity that all rows share, as the one state of a Kalman filter.

    Attributes:
        mean: Its mean.
        variance: Its variance.
        usual: What is usual: a first-order Gauss-Markov process about its mean.
    """

    STATE: ClassVar[State] = declare('mean', 'variance')

    def __init__(self, usual: Usual) -> None:
        self.usual = usual
        self.mean, self.variance = usual.mean, usual.std * usual.std

    def correct(self, y: float, H: float, R: float, seconds: float) -> None:
        """Correct with a measurement y = H times the quantity + noise of variance R, over a time [s].

        Only times with a measurement count.
        """
        usual = self.usual
        d = math.exp(-seconds / usual.time_s)
        self.mean = usual.mean + d * (self.mean - usual.mean)
        self.variance = d * d * self.variance + (1.0 - d * d) * usual.std * usual.std
        nu, P = y - H * self.mean, self.variance
        _, weight = student_t(nu * nu / (H * H * P + R), 1.0)
        K = H * P / (H * H * P + R / weight)
        self.mean += K * nu
        self.variance -= K * H * P

    @property
    def excess(self) -> float:
        """How far its mean is above what is usual, in standard deviations of healthy trains."""
        return (self.mean - self.usual.mean) / self.usual.std


def force_lead(timing: float) -> Usual:
    """Return how far the force is usually ahead of a brake with a dead time and lag together [s]."""
    late, brake = USUAL[FORCE_LATE - 1], USUAL[BRAKE_LATE - 1]
    std = math.hypot(late.std, brake.std * timing)
    return Usual('ato/force ahead of the brake', -late.mean, std, brake.time_s)


def learn_lead(lead: Lasting, before: Block, block: Block, after: Block) -> None:
    """Learn how far the reported force is ahead of the brake that the command gives, in braking, between two blocks.

    With m the mean over a block, and the steps of B to the blocks beside it:

        (3)  F_m - B_m = lead dB/dt + noise,    lead = brake earlier than stated - force_late

    The balance (1) does not show it, since F = T + B is right also where B is not.
    """
    if before.state != MOVING or block.state != MOVING or after.state == UNKNOWN or block.force > 0.0:
        return
    H = (after.brake - before.brake) / (block.seconds + 0.5 * (before.seconds + after.seconds))
    if abs(H) >= MIN_BRAKE:
        # Student's t is for braking without a command.
        noise = _REPORTED_STD + _REPORTED_SHARE * max(abs(block.brake), abs(block.force))
        lead.correct(block.force - block.brake, H, noise * noise, block.seconds)


def position_variance(block: Block, learned: float) -> float:
    """Return the variance of the distance by position over a block [m^2]."""
    lag = _LAG_STD * block.speed_step
    drift = _DISTANCE_SHARE * block.by_speed
    return max(learned, _MIN_POSITION_STD * _MIN_POSITION_STD) + lag * lag + drift * drift


class Forces:
    """The train, and the inputs of one block as a row corrects them: forces [N/kN] and their rates [N/kN/s].

    Attributes:
        inertia: m of (1) [N/kN per m/s^2].
        drag: c of (1) [N/kN per (m/s)^2]; of the wind only the linear term counts.
        timing: Dead time and lag of the brake [s].
        traction: T of (1), and its rate.
        brake: r B, and its rate.
        gradient: i [per mille].
        extra: Resistance of the effects of the train file.
        variance: Variance of the white noise of all [(N/kN)^2].
        effort: |F| + |B| as they came.
        mismatch: Reported force less that of the brake in standard deviations, 0 where they are not compared.
    """

    def __init__(self, known: KnownForce) -> None:
        resistance, brake = known.train_file.resistance, known.brake
        self.inertia, self.timing = known.inertia, brake.delay + brake.time_constant
        self._a, self._b, self.drag = resistance.a, resistance.b, resistance.c
        self.traction = self.traction_rate = self.brake = self.brake_rate = self.gradient = self.extra = 0.0
        self.variance = self.effort = self.mismatch = 0.0

    def resistance(self, v: float) -> float:
        """Return a + b v + c v^2 [N/kN]."""
        return self._a + v * (self._b + v * self.drag)

    def slope(self, v: float) -> float:
        """Return its derivative [N/kN per m/s]."""
        return self._b + 2.0 * v * self.drag

    def balance(self, x: vec[float], v: float) -> float:
        """Return the right side of (1) for parameters in a state of shape (7,) and a speed [N/kN]."""
        pull = self.traction + x[FORCE_LATE] * self.traction_rate
        slow = self.brake - x[BRAKE_LATE] * self.timing * self.brake_rate
        track = self.gradient + self.extra + self.resistance(v) + 2.0 * self.drag * v * x[WIND] + x[OFFSET]
        return x[GAIN] * pull + x[BRAKE] * slow - track

    def correct(self, prior: Prior, at: Block, force: Block, command: Block) -> None:
        """Correct force and brake, each from its own block; ``at`` is that of the speed."""
        row = prior.row
        # Where a brake builds up, the step of a force without sign is wrong for one block, and counts as jitter.
        factor = -row.force if row.signless and command.brake < -MIN_BRAKE else row.force
        F, dF = factor * force.force, factor * force.force_step / force.seconds
        scale = 0.0 if prior.ignores_command else row.command
        B, dB = scale * command.brake, scale * command.brake_step / command.seconds
        T, dT = F - B, dF - dB
        # A driver who pulls after a command pulls also if the brake acts later.
        is_braked = min(command.brake, at.brake if row.late is Input.BRAKE else 0.0) < -MIN_BRAKE
        self.mismatch = 0.0
        if is_braked and command.brake_step <= _RELEASING * abs(command.brake) * command.seconds:
            self.mismatch = T / (_REPORTED_STD + _REPORTED_SHARE * max(abs(B), abs(F)) + 0.5 * abs(dB))
        self.effort = abs(force.force) + abs(command.brake)
        # No row may seem sharper because it makes an input small.
        effort = max(max(abs(B), abs(command.brake)), -T)  # noqa: PLW3301 - of two numbers it is compiled
        effort_rate = max(abs(dB), abs(command.brake_step) / command.seconds)
        if prior.ignores_braking and (B < 0.0 or dB != 0.0):
            # What is reported beside a brake is that brake; what is released pulls no more than it says.
            T, dT = max(F, 0.0), 0.0
            effort = max(abs(B), abs(F))
        slow = max(1.0 - at.speed / _SLACK_SPEED, 0.0)
        pull, overlap = _TRACTION_SHARE * max(T, force.force), _OVERLAP_SHARE * min(abs(T), abs(B))
        slack, share = _SLACK * slow, (_BRAKE_SHARE + _SLACK_SHARE * slow) * effort
        jitter, brake_jitter = _JITTER_S * dT, (2.0 * _JITTER_S + _TIMING_SHARE * self.timing) * effort_rate
        q = _FORCE_STD * _FORCE_STD + slack * slack + share * share + overlap * overlap + brake_jitter * brake_jitter
        if prior.ignores_force:
            T = dT = 0.0
            pull = _ANY_FORCE_BRAKED if is_braked else _ANY_FORCE
        self.traction, self.traction_rate, self.variance = T, dT, q + pull * pull + jitter * jitter
        self.brake, self.brake_rate = command.rate * B, command.rate * dB

# SPDX-License-Identifier: Apache-2.0
"""One check of all inputs against each other: which row of the table of faults explains them best.

Samples become blocks of at least half a second. Each row of :data:`~trainid_ros.stream.fault_table.TABLE` corrects the
inputs as it says, and one and the same Kalman filter predicts the next block from them. With specific forces [N/kN],
m = 1000 (1 + gamma)/g0, F the reported force, B the brake command after exact dead time and lag as a force, r the brake
rate and (a, b, c) the resistance of the train file, i gradient and effects:

    (1)  m dv/dt = gain (T + force_late dT/dt) + brake r (B - brake_late (delay + lag) dB/dt)
                   - i - (a + b v + c v (v + 2 wind)) - offset + noise,     T = F - B
    (2)  distance by position = distance by speed / (1 + wheel) + noise

Traction and brake act together: power braking, and dynamic braking without a command, are no exceptions. The states
[v, offset, wind, gain, brake, force_late, brake_late] and the wheel return to what is usual, and stop at ``_RANGE``
standard deviations of it, so that no row explains everything away. A block has four scores [nats]: of speed and
position by Student's t, of the reported force against B, of the gradient against the line.

One row is accepted, at first that all is well. For each other row

    (3)  S = sum of log likelihoods of its blocks - the same of the accepted row,

from a fresh start whenever S < ``_GIVE_UP``: a repeated sequential probability ratio test, or a generalised likelihood
ratio over the time of onset. S > ``_SUSPECT``: suspected. S > ``_FIND``, the best by ``_LEAD``: accepted, a finding.
S of the first row > ``_CLEAR`` for ``_LEAD_S``: all is well again. Delays are scored by applications of the brake,
since the errors within one are the same. What holds back an estimator is not replaced by what does not.

A row is followed only from the first block on that the accepted row explains badly, from what that knew before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, definite, several, stored, unknown
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
    V,
)
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeActuator
from trainid_ros.train.line import LineProfile

_STATES: Final[i64] = 7  # number of states
_WIND_WIND: Final = 13  # place of the variance of the wind in the upper triangle of a covariance
_GAIN_GAIN: Final = 18  # that of the gain

# Decision

_SUSPECT: Final = 6.0  # nats: exp(-6) = 1/400
_FIND: Final = 14.0  # nats: 1e-6 for each fresh start, of which there are some 1e4 a day
_CLEAR: Final = 8.0  # nats: health is the more probable state, so less is asked for
_LEAD: Final = 3.0  # nats before the second best row, so that the right one is named ...
_LEAD_S: Final = 10.0  # s ... but for at most this time; a fault has to be gone for as long
_TIE: Final = 1.0  # nats within which rows explain the inputs alike: then that which comes first in the table is right
_DELAYS: Final = 2.0  # times the delay for which one must have been seen: an onset of anything looks like one at first
_CREDIBLE: Final = 2.0  # standard deviations of healthy trains: no fault is found or suspected that is smaller
_GIVE_UP: Final = -2.0  # nats: a row that is this improbable starts afresh
_FOLLOWED_S: Final = 5.0  # s: a shorter application of the brake confirms nothing ...
_AGREES: Final = 2.0  # nats: ... nor does one that another row explains better by more
_APPLICATION: Final = 5.0  # nats: the most that one application of the brake counts: none is suspected by one
_START: Final = -0.6  # nats: a block that the accepted row explains worse starts the others
_START_SHARE: Final = 0.5  # share of the variance of a speed by which its square error must fall to start a row
_START_MISMATCH: Final = 0.7  # standard deviations of force against brake that start all of them
_HOPELESS_S: Final = 10.0  # s after which a row that has gained less than one nat starts afresh

# Scores

_ODD: Final = 4.0  # nats: the most that one block of one score can cost (slip, a jump of the position)
_BLANK: Final = 2.0  # nats: what an ignored input costs a block (it is not predicted at all)
_NO_LINE: Final = 1.0  # nats per length of the line: the same if it is not compared with the gradient of the topic
_FROZEN: Final = 0.5  # nats: the same if its value has not changed at all
_STILL_S: Final = 5.0  # s: an input that has not changed for so long may be stuck
_NU: Final = 4.0  # degrees of freedom of Student's t: tails of sensors with rare outliers
_SLIP: Final = 1.0  # nats: what a block of an odd speed costs the accepted row while ...
_SLIP_S: Final = 2.5  # s: ... it has not lasted longer (then the speed is taken as measured), and ...
_SLIPS: Final = 15.0  # N/kN: ... wheels transmit more: slip and slide end soon
_JUMP_SHARE: Final = 0.5  # share of a jump of the speed that a row must explain, or the jump says nothing of it
_SLIP_SHARE: Final = 0.5  # s by which that time falls per second without slip: wheels do not slip for ever
_LOST: Final = 3.0  # standard deviations from the measured speed at which another row starts from that instead
_BOTH: Final = 1.0  # nats: what a block of force beside a brake command costs: rare, but it lasts
_GRADIENT_M: Final = 100.0  # m: distance in which errors of a map repeat themselves
_PLACES: Final = 0.2  # share of blocks in which the line is looked up in the wrong place
_GRADIENTS: Final = 40.0  # per mille: range of all gradients

# Blocks

_BLOCK_S: Final = 0.5  # s: a few samples, shorter than any lag of interest
_GAP_S: Final = 1.6  # s: samples further apart are no neighbours
MIN_SPEED: Final = 1.0  # m/s: slower trains stand, shunt, or stop with a jerk
_KEPT: Final = 8  # blocks kept: the longest delay, and the one before
_PLACE_M: Final = 30.0  # m: error of the place on the line at first ...
_MIN_PLACE_M: Final = 5.0  # m: ... and at least, once learned from the gradient ...
_PLACE_SHARE: Final = 0.006  # ... and by which share of the distance it grows, by worn wheels
_DRIVEN: Final = 0.3  # m/s: a train whose position changes faster moves, ...
_SURE: Final = 32.0  # times the variance of a position: ... if it has moved by four standard deviations of a difference
_NEAR_ZERO: Final = 1e-4  # m/s^2: a brake is released

# Noise

_SPEED_STD: Final = 0.02  # m/s: least noise of a speed
_FORCE_STD: Final = 0.6  # N/kN, white: ripple of the resistance within a block
_SLACK: Final = 4.0  # N/kN: jerks of couplers and of the friction brake of a train that hardly moves ...
_SLACK_SHARE: Final = 0.3  # share of the brake: the same, where electric brakes hand over to friction ...
_SLACK_SPEED: Final = 4.0  # m/s: ... slower than this
_TRACTION_SHARE: Final = 0.03  # share of the traction, white: ripple within a block
_BRAKE_SHARE: Final = 0.10  # the same of the brake
_OVERLAP_SHARE: Final = 0.1  # share of traction beside a brake, which is the difference of two forces
_JITTER_S: Final = 0.12  # s: error of the times of a force that changes
_TIMING_SHARE: Final = 0.2  # share of dead time and lag: the same of a brake that changes
_ANY_FORCE: Final = 40.0  # N/kN: traction that is not known
_POSITION_STD: Final = 0.5  # m: noise of a distance by position, before it is learned
_MIN_POSITION_STD: Final = 0.1  # m: least such noise
_POSITION_LAG: Final = 0.1  # s by which position and speed are apart
_COARSEST_M: Final = 20.0  # m: positions that change in longer steps are corrected, as at balises
_DISTANCE_SHARE: Final = 0.01  # share of a distance by which positions are off between balises
BRAKES: Final = 3.0  # N/kN: a weaker brake is not compared with the force
_REPORTED_STD: Final = 3.0  # N/kN: error of the reported force of a brake ...
_REPORTED_SHARE: Final = 0.25  # ... and its share of that force
_RELEASING: Final = 0.2  # 1/s: a brake that falls faster is being released, and a driver may pull already
_GRADIENT_STD: Final = 0.3  # per mille: least error of the gradient of the topic against that of the line

# What is usual, and how far a row may depart from it

_RANGE: Final = 2.5  # standard deviations: healthy trains do not go further
_LIMIT: Final = 2.4  # standard deviations: a quantity so far off may be farther off
_LASTING_S: Final = 1000.0  # s: time in which a fault, once there, varies
_TUNNEL_WIND: Final = 0.5  # std of the wind in a tunnel over the speed [1]: drag up to 3.5 times that in the open
_BOARDING: Final = 0.05  # share of the mass by which it may change at a stop, if it is not weighed ...
_BOARDING_S: Final = 30.0  # s ... in this time
_LEARNED: Final = 0.01  # weight of a new square in the learned noise of position and gradient: 100 blocks ...
_FIRST: Final = 10.0  # blocks ... of which its first value counts for so many
_CAPPED_MEAN: Final = 0.51606  # E min(z^2, 1) of a standard normal z: Huber's proposal 2

MOVING: Final = 0
"""State of a block: the train moves, and all inputs are known."""
STANDING: Final = 1
"""It stands."""
UNKNOWN: Final = 2
"""Nothing can be compared."""


@dataclass(slots=True)
class Block:
    """The inputs over about half a second."""

    seconds: float = 0.0  # Its length [s]
    state: int = UNKNOWN  # What can be compared
    speed: float = 0.0  # Speed at its end [m/s]
    speed_step: float = 0.0  # Change of the speed over the block [m/s]
    variance: float = 0.0  # Variance of that speed [(m/s)^2]
    by_speed: float = 0.0  # Distance by speed [m]
    by_position: float = stored(0.0, may_be_nan=True)  # Distance by position [m], NaN if unknown
    force: float = 0.0  # Mean reported force F [N/kN]
    force_step: float = 0.0  # Its change over the block [N/kN]
    brake: float = 0.0  # Mean force B of a nominal brake [N/kN, <= 0]
    brake_step: float = 0.0  # Its change over the block [N/kN]
    rate: float = 1.0  # Brake rate of the train file [1]
    gradient: float = 0.0  # Mean gradient of the topic [per mille]
    line: float = math.nan  # Gradient of the line at its end [per mille], NaN if unknown
    steepness: float = 0.0  # Change of that gradient with the position [per mille/m]
    miss: float = math.nan  # Speed at its end less what the accepted row gives from its start [m/s]
    least: float = math.nan  # Least gradient of the line nearby [per mille]
    most: float = math.nan  # Greatest one
    extra: float = 0.0  # Resistance of the effects of the train file [N/kN]
    tunnel: bool = False  # Whether it ends in a tunnel
    is_frozen: bool = False  # Whether the speed is exactly that of the block before

    @property
    def is_known(self) -> bool:
        """True if inputs can be compared."""
        return self.state != UNKNOWN


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
        self.own = vec[float]([0.0] * _STATES)
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
        if row.gradient != 1.0:
            self.anew[OFFSET] = 1.0
        self.ignores_speed = Input.SPEED in row.ignores
        self.ignores_position = Input.POSITION in row.ignores
        self.ignores_force = Input.FORCE in row.ignores
        self.ignores_command = Input.COMMAND in row.ignores
        self.ignores_gradient = Input.GRADIENT in row.ignores
        # Inputs that are read from an earlier block: all but the late one, or the early one alone.
        late, others = row.late, row.late is not None and not row.early and row.late is not Input.BRAKE
        self.delays_speed = others and late is not Input.SPEED
        self.delays_force = (others and late is not Input.FORCE) or row.early
        self.delays_command = (others and late is not Input.COMMAND) or late is Input.BRAKE
        self.delays_gradient = others
        self.held = row.holds_resistance + row.holds_brake_rate  # number of kinds of estimates that must wait
        self.is_of_times, self.has_speed = row.is_of_times, row.has_speed
        self.is_of_brake = late in {Input.COMMAND, Input.BRAKE}
        self.is_of_line = self.ignores_gradient or row.gradient != 1.0


_PRIORS: Final = [Prior(row) for row in TABLE]


def student_t(z2: float, spread: float) -> tuple[float, float]:
    """Return log likelihood [nats] and weight of a residual by Student's t.

    Args:
        z2: Its square over its variance [1].
        spread: That variance over the one of the measurement alone [1].
    """
    score = -0.5 * (_NU + 1.0) * math.log(1.0 + z2 / _NU) - 0.5 * math.log(spread)
    return max(score, -_ODD), min((_NU + 1.0) / (_NU + z2), 1.0)


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
        self.centre = _PRIORS[row].mean[:]
        self.x = self.centre[:]
        self.P = vec[float]([0.0] * (_STATES * (_STATES + 1) // 2))
        self.wheel = self.wheel_centre = 0.0
        self.wheel_var = WHEEL.std * WHEEL.std
        self.scores = vec[float]([math.nan] * _KEPT)
        self.total = self.part = self.age_s = self.rise_s = self.odd_s = 0.0
        self._f = vec[float]([0.0] * _STATES)
        self._row = vec[float]([0.0] * _STATES)

    @property
    def sum(self) -> float:
        """S of (3) [nats]."""
        return self.total + min(self.part, _APPLICATION)

    def start(self, other: Trial, shift: int) -> None:
        """Start afresh from what another row knows, but for what either of the two has its own opinion of."""
        prior, theirs = _PRIORS[self.row], _PRIORS[other.row]
        self.shift = shift
        k: i64 = 0
        for i in range(_STATES):
            is_mine = prior.anew[i] + theirs.anew[i] > 0.0
            self.x[i] = prior.mean[i] if is_mine else other.x[i]
            self.centre[i] = prior.mean[i]
            for j in range(i, _STATES):
                if is_mine or prior.anew[j] + theirs.anew[j] > 0.0:
                    self.P[k] = prior.std[i] * prior.std[i] if i == j else 0.0
                else:
                    self.P[k] = other.P[k]
                k += 1
        is_mine = prior.has_speed or theirs.has_speed
        std = prior.row.wheel_std
        self.wheel, self.wheel_var = (0.0, std * std) if is_mine else (other.wheel, other.wheel_var)
        self.wheel_centre = 0.0
        for n in range(_KEPT):
            self.scores[n] = math.nan
        self.total = self.part = self.age_s = self.rise_s = self.odd_s = 0.0

    def copy(self, other: Trial) -> None:
        """Take over the estimate of another one."""
        self.row, self.shift, self.x, self.P = other.row, other.shift, other.x[:], other.P[:]
        self.wheel, self.wheel_var = other.wheel, other.wheel_var

    def measure(self, speed: float, variance: float) -> None:
        """Take the speed [m/s] as measured, with its variance; keep the parameters."""
        self.x[V], self.P[V] = speed, variance
        for j in range(1, _STATES):
            self.P[j] = 0.0

    def predict(self, forces: Forces, block: Block, decay: vec[float], *, accepted: bool) -> None:
        """Predict to the end of a block by (1)."""
        x, P, f, fP = self.x, self.P, self._f, self._row
        self._relax(_PRIORS[self.row], block, decay, accepted=accepted)
        v, h, rate = x[V], block.seconds / forces.inertia, forces.timing * forces.brake_rate
        x[V] = max(v + h * forces.balance(x, v), 0.0)
        # Row v of the Jacobian.
        f[V] = 1.0 - h * (forces.slope(v) + x[WIND] * 2.0 * forces.drag)
        f[OFFSET], f[WIND] = -h, -h * 2.0 * forces.drag * v
        f[GAIN] = h * (forces.traction + x[FORCE_LATE] * forces.traction_rate)
        f[BRAKE] = h * (forces.brake - x[BRAKE_LATE] * rate)
        f[FORCE_LATE], f[BRAKE_LATE] = h * x[GAIN] * forces.traction_rate, -h * x[BRAKE] * rate
        # P = F P F' + Q, where F is 1 but for its row f of v.
        for i in range(_STATES):
            fP[i] = 0.0
        k: i64 = 0
        for i in range(_STATES):
            f_i, sum_i = f[i], fP[i] + f[i] * P[k]
            k += 1
            for j in range(i + 1, _STATES):
                sum_i += f[j] * P[k]
                fP[j] += f_i * P[k]
                k += 1
            fP[i] = sum_i
        variance = h * h * forces.variance
        for j in range(_STATES):
            variance += fP[j] * f[j]
            P[j] = fP[j]
        P[V] = variance

    def _relax(self, prior: Prior, block: Block, decay: vec[float], *, accepted: bool) -> None:
        """Let the parameters return to what is usual; a fault, once found, keeps its size."""
        x, P, std, own, centre = self.x, self.P, prior.std, prior.own, self.centre
        lasting, d = decay[V], self._f
        d[V] = 1.0
        for i in range(1, _STATES):
            is_own = own[i] > 0.0
            d[i] = lasting if is_own else decay[i]
            if is_own and accepted and self.row > 0:
                centre[i] += (1.0 - lasting) * (x[i] - centre[i])
            x[i] = centre[i] + d[i] * (x[i] - centre[i])
        k: i64 = 0
        for i in range(_STATES):
            s = std[i]
            if own[i] > 0.0 and accepted:
                s = min(s, _PRIORS[0].std[i])
            elif i == WIND and block.tunnel:
                s = max(s, _TUNNEL_WIND * x[V])
            P[k] = d[i] * d[i] * P[k] + (1.0 - d[i] * d[i]) * s * s
            k += 1
            for j in range(i + 1, _STATES):
                P[k] *= d[i] * d[j]
                k += 1
        if block.tunnel:
            P[_WIND_WIND] = max(P[_WIND_WIND], _TUNNEL_WIND * _TUNNEL_WIND * x[V] * x[V])

    def correct(self, speed: float, R: float, most: float = math.inf) -> float:
        """Correct with a measured speed [m/s] of variance R [(m/s)^2]; return its log likelihood [nats].

        Where it differs by more than ``most`` [m/s] wheels slip, and nothing is corrected.
        """
        x, P, column = self.x, self.P, self._row
        S, nu = P[V] + R, speed - x[V]
        score, weight = student_t(nu * nu / S, S / R)
        if abs(nu) > most:
            return score
        # K = P e_v / (P_vv + R / weight);  x += K nu;  P -= K e_v' P
        gain = 1.0 / (P[V] + R / weight)
        for j in range(_STATES):
            column[j] = P[j]
        k: i64 = 0
        for i in range(_STATES):
            K = gain * column[i]
            x[i] += K * nu
            for j in range(i, _STATES):
                P[k] -= K * column[j]
                k += 1
        return score

    def limit(self, tunnel: bool, *, accepted: bool) -> None:
        """Keep the parameters where healthy trains, or those with the fault, have them."""
        prior = _PRIORS[self.row]
        for i in range(1, _STATES):
            if accepted and prior.own[i] > 0.0:
                continue
            most = _RANGE * (max(_TUNNEL_WIND * self.x[V], prior.std[i]) if i == WIND and tunnel else prior.std[i])
            self.x[i] = min(max(self.x[i], prior.mean[i] - most), prior.mean[i] + most)

    def compare_distances(self, block: Block, learned: float, *, accepted: bool) -> float:
        """Correct the wheel with the distance by position, by (2); return its log likelihood [nats]."""
        prior, std = _PRIORS[self.row], _PRIORS[self.row].row.wheel_std
        by_speed = prior.row.speed * block.by_speed
        # First-order Gauss-Markov process about the centre.
        time_s = _LASTING_S if prior.has_speed else WHEEL.time_s
        share = block.seconds / time_s
        if accepted and prior.has_speed:
            self.wheel_centre += share * (self.wheel - self.wheel_centre)
            std = min(std, WHEEL.std)
        self.wheel += share * (self.wheel_centre - self.wheel)
        self.wheel_var += 2.0 * share * (std * std - self.wheel_var)
        scale = prior.row.position
        R = scale * scale * position_variance(block, learned)
        nu, H = scale * block.by_position - by_speed / (1.0 + self.wheel), -by_speed
        S = R + H * H * self.wheel_var
        score, weight = student_t(nu * nu / S, S / R)
        K = H * self.wheel_var / (H * H * self.wheel_var + R / weight)
        self.wheel += K * nu
        self.wheel_var -= K * H * self.wheel_var
        if not (accepted and prior.has_speed):
            most = _RANGE * prior.row.wheel_std
            self.wheel = min(max(self.wheel, -most), most)
        return score


def position_variance(block: Block, learned: float) -> float:
    """Return the variance of the distance by position over a block [m^2]."""
    lag = _POSITION_LAG * block.speed_step
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
        F, dF = row.force * force.force, row.force * force.force_step / force.seconds
        scale = 0.0 if prior.ignores_command else row.command
        B, dB = scale * command.brake, scale * command.brake_step / command.seconds
        T, dT = F - B, dF - dB
        # A driver who pulls after a command pulls also if the brake acts later.
        is_braked = min(command.brake, at.brake if row.late is Input.BRAKE else 0.0) < -BRAKES
        self.mismatch = 0.0
        if is_braked and command.brake_step <= _RELEASING * abs(command.brake) * command.seconds:
            self.mismatch = T / (_REPORTED_STD + _REPORTED_SHARE * max(abs(B), abs(F)) + 0.5 * abs(dB))
        self.effort = abs(force.force) + abs(command.brake)
        # No row may seem sharper because it makes an input small.
        effort = max(max(abs(B), abs(command.brake)), -T)  # noqa: PLW3301 - of two numbers it is compiled
        effort_rate = max(abs(dB), abs(command.brake_step) / command.seconds)
        slow = max(1.0 - at.speed / _SLACK_SPEED, 0.0)
        pull, overlap = _TRACTION_SHARE * max(T, force.force), _OVERLAP_SHARE * min(abs(T), abs(B))
        slack, share = _SLACK * slow, (_BRAKE_SHARE + _SLACK_SHARE * slow) * effort
        jitter, brake_jitter = _JITTER_S * dT, (2.0 * _JITTER_S + _TIMING_SHARE * self.timing) * effort_rate
        q = _FORCE_STD * _FORCE_STD + slack * slack + share * share + overlap * overlap + brake_jitter * brake_jitter
        if prior.ignores_force:
            T = dT = 0.0
            q += _ANY_FORCE * _ANY_FORCE * (0.04 if is_braked else 1.0)
        self.traction, self.traction_rate, self.variance = T, dT, q + pull * pull + jitter * jitter
        self.brake, self.brake_rate = command.rate * B, command.rate * dB


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the check says."""

    finding: str = ''  # What is wrong, empty if all is well
    suspicion: str = ''  # What may be wrong, empty if nothing is suspected
    row: int = 0  # Row of the finding
    suspect: int = 0  # Row of the suspicion


class InputCheck:
    """Check the inputs sample by sample.

    Attributes:
        verdict: What it says after the last sample.
        noise: Noise of the speed.
        count: Number of full blocks.
        is_brake_confirmed: Whether the brake of a moving train has acted as the train file says for some seconds.
    """

    STATE: ClassVar[State] = declare(
        several('_blocks', Block), '_filling', 'count', '_actuator', 'noise', '_stamp_ns', '_direction',
        unknown('_speed'), unknown('_position'), unknown('_force'), '_brake', '_still', '_position_var',
        '_position_step', '_is_held', '_compared', '_accepted', several('_others', Trial), '_waited_s',
        '_usual_s', '_is_weighed', '_place', '_place_std', '_gradient_var', '_off', unknown('_braked_s'),
        'is_brake_confirmed', 'verdict',
    )  # fmt: skip

    def __init__(self, known: KnownForce) -> None:
        brake, line = known.brake, known.train_file.line
        self._known = known
        self._line = LineProfile(line, known.train_file.train.length) if line.gradient else None
        # Error of the gradient of the topic [per mille^2].
        self._gradient_var = (_GRADIENT_STD + line.gradient_std) * (_GRADIENT_STD + line.gradient_std)
        self._forces = Forces(known)
        self._decay = vec[float]([0.0] * _STATES)
        self._decay_s = 0.0
        self._spare = [Trial(row) for row in range(len(TABLE))]
        self._before = Trial(0)
        self._blocks = [Block() for _ in range(_KEPT)]
        self._filling = Block()
        self.count = 0
        self._actuator = BrakeActuator(brake)
        self.noise = SpeedNoise.declared(_SPEED_STD, robust=True)
        self._stamp_ns, self._direction = 0, 1
        self._speed = self._position = self._force = math.nan
        self._brake = 0.0
        # Time for which speed, position, force and command have not changed [s].
        self._still = vec[float]([0.0, 0.0, 0.0, 0.0])
        self._position_var = _POSITION_STD * _POSITION_STD
        self._position_step, self._is_held = 0.0, False  # Step of the position [m]; whether it waits for the next one
        self._compared = 0  # Number of distances from which it was learned
        self._accepted = Trial(0)
        k = 0
        for i in range(_STATES):
            self._accepted.P[k] = _PRIORS[0].std[i] * _PRIORS[0].std[i]
            k += _STATES - i
        self._others = list[Trial]()
        self._waited_s = self._usual_s = 0.0
        self._is_weighed = False
        self._place, self._place_std = 0.0, _PLACE_M  # Place on the line less the position, and its error [m]
        self._scratch = vec[float]([0.0] * _STATES)
        self._mismatch = self._distance_score = self._line_score = 0.0
        self._off = 0.0  # Distance by position less that by speed of the last block [m]
        self._slips = False  # Whether the wheels seem to slip or slide in the last block
        self._braked_s = math.nan  # Time for which the brake has acted on a moving train [s], NaN at a stand
        self.is_brake_confirmed = False
        self.verdict = Verdict()

    def take(self, sample: Sample) -> Verdict:
        """Take in a sample; return what is found and suspected after it."""
        self.noise.add(sample.speed, sample.dt)
        impulse = self._follow_brake(sample)
        if self._add(sample, impulse):
            self._close(sample)
            self._judge()
        return self.verdict

    def at_limit(self, places: tuple[int, ...]) -> str:
        """Return which of some quantities is as far from usual as a healthy train can have it, empty if none is."""
        trial = self._accepted
        for place in places:
            usual = USUAL[place - 1]
            is_own = _PRIORS[trial.row].own[place] > 0.0
            if not is_own and abs(trial.x[place] - usual.mean) > _LIMIT * usual.std:
                return f'{usual.name} is at the limit of what is usual'
        return ''

    # Blocks

    def _follow_brake(self, sample: Sample) -> float:
        """Return the impulse of a nominal brake since the last sample [N/kN s]."""
        actuator, start_ns = self._actuator, self._stamp_ns
        self._stamp_ns = sample.stamp_ns
        actuator.commands.follow(sample.brake_changes)
        self._still[3] = 0.0 if sample.brake_changes or not sample.dt > 0.0 else self._still[3] + sample.dt
        if not 0 < start_ns <= sample.stamp_ns:
            return 0.0
        changes = actuator.commands.changes
        is_released = not changes or (len(changes) == 1 and changes[0].target_acceleration == 0.0)
        if is_released and actuator.output > -_NEAR_ZERO:
            actuator.output = 0.0
            return 0.0
        return actuator.advance(start_ns, sample.stamp_ns) * self._known.inertia

    def _add(self, sample: Sample, impulse: float) -> bool:
        """Add a sample to the block that is being filled; return whether it is full."""
        block, dt, known = self._filling, sample.dt, self._known
        before, position, direction = self._speed, self._position, self._direction
        self._speed, self._position, self._direction = sample.speed, sample.position, sample.direction
        is_known = 0.0 < dt < _GAP_S and sample.direction == direction and not (sample.emergency or sample.brake_gap)
        if not (is_known and is_finite(sample.force_mean) and is_finite(sample.gradient_mean)
                and is_finite(before) and is_finite(sample.brake_command)):  # fmt: skip
            return True
        block.seconds += dt
        block.by_speed += 0.5 * (before + sample.speed) * dt
        block.by_position += sample.direction * (sample.position - position)
        self._learn_step(abs(sample.position - position), sample.speed)
        block.force += known.traction(sample.force_mean, sample) * dt
        block.brake += impulse
        block.gradient += sample.gradient_mean * dt
        block.extra += (known.track(sample) - sample.gradient_mean) * dt
        return block.seconds >= _BLOCK_S

    def _learn_step(self, moved: float, speed: float) -> None:
        """Learn the step in which a position counts [m]: that after samples in which a moving train stood still."""
        if moved == 0.0:
            self._is_held = self._is_held or speed >= MIN_SPEED
            return
        if self._is_held and moved < _COARSEST_M:
            self._position_step = max(self._position_step, moved)
        elif moved < 0.9 * self._position_step:
            self._position_step = 0.0
        self._is_held = False

    def _close(self, sample: Sample) -> None:
        """Complete the block; its place is taken by the oldest one."""
        block, known = self._filling, self._known
        force, brake = known.traction(sample.force, sample), known.inertia * self._actuator.output
        last = self.block(0)
        if block.seconds > 0.0:
            seconds = block.seconds
            block.force, block.brake = block.force / seconds, block.brake / seconds
            block.gradient, block.extra = block.gradient / seconds, block.extra / seconds
            block.force_step = force - self._force if is_finite(force - self._force) else 0.0
            block.brake_step = brake - self._brake
        quantum = self.noise.quantum
        block.speed, block.is_frozen = sample.speed, sample.speed == last.speed
        block.speed_step = sample.speed - last.speed
        # Blocks between two steps of a speed share the error of its rounding.
        share = sample.dt / block.seconds if block.seconds > 0.0 and sample.dt > 0.0 else 0.0
        rounding = self.noise.rounding * min(share, 1.0)
        block.variance = max(self.noise.learned, _SPEED_STD * _SPEED_STD) + max(rounding, quantum * quantum / 6.0)
        block.tunnel = sample.tunnel
        block.rate = 1.0
        if brake < 0.0 or block.brake < 0.0:
            block.rate = known.train_file.brake.rate_at(sample.speed) * known.brake_share(sample)
        self._look_up(block, sample)
        block.state = self._state(block, force)
        if block.seconds > 0.0:
            self._count_still(block, last)
        self._force, self._brake, self._is_weighed = force, brake, sample.weighed
        self.count += 1
        self._filling = self._blocks[self.count % _KEPT]
        self._blocks[self.count % _KEPT] = block
        block = self._filling
        block.seconds = block.by_speed = block.by_position = 0.0
        block.force = block.brake = block.gradient = block.extra = block.force_step = block.brake_step = 0.0

    def _state(self, block: Block, force: float) -> int:
        """Return what can be compared in a full block."""
        if block.seconds < _BLOCK_S or not is_finite(force):
            return UNKNOWN
        if block.speed >= MIN_SPEED:
            return MOVING
        moved = sum(other.by_position for other in self._blocks)
        is_driven = abs(block.by_position) > _DRIVEN * block.seconds and moved * moved > _SURE * self._position_var
        return MOVING if is_driven else STANDING

    def _count_still(self, block: Block, last: Block) -> None:
        """Count for how long speed and position of a moving train, and any force, have not changed."""
        still, moved_s = self._still, block.seconds if block.state == MOVING else 0.0
        still[0] = still[0] + moved_s if self._speed == last.speed else 0.0
        still[1] = still[1] + moved_s if block.by_position == 0.0 else 0.0
        still[2] = still[2] + block.seconds if block.force == last.force else 0.0

    def _look_up(self, block: Block, sample: Sample) -> None:
        """Look up the line in the middle of the block, and on either side of it where that may be."""
        line, direction, std = self._line, sample.direction, self._place_std
        here = sample.position - 0.5 * direction * block.by_speed + self._place
        block.line = block.least = block.most = math.nan
        if line is None or not line.first <= here <= line.last or not block.by_speed > 0.0:
            return
        # From where the front enters to where half of the train has left.
        front = here + 0.5 * direction * line.length
        block.tunnel = block.tunnel or line.tunnel(here, direction) or line.tunnel(front, direction)
        block.line = line.gradient(here, direction)
        before, after = line.gradient(here - std, direction), line.gradient(here + std, direction)
        block.least, block.most = min(before, after, block.line), max(before, after, block.line)
        if not block.least <= block.gradient <= block.most:
            before2, after2 = line.gradient(here - 2.0 * std, direction), line.gradient(here + 2.0 * std, direction)
            block.least, block.most = min(before2, after2, block.least), max(before2, after2, block.most)
        block.steepness = 0.5 * (after - before) / std

    def block(self, back: int) -> Block:
        """Return one of the last eight blocks by how far it is back; 0 is the last one."""
        return self._blocks[(self.count - back) % _KEPT]

    # Scores

    def _judge(self) -> None:
        """Score the last block by the accepted row, by those that are followed, and decide."""
        block, accepted = self.block(0), self._accepted
        if block.seconds != self._decay_s and block.seconds > 0.0:
            self._decay_s = block.seconds
            self._decay[V] = math.exp(-block.seconds / _LASTING_S)
            for i in range(1, _STATES):
                self._decay[i] = math.exp(-block.seconds / USUAL[i - 1].time_s)
        self._before.copy(accepted)
        self._mismatch = self._distance_score = self._line_score = 0.0
        self._slips = False
        score = self._score(accepted, accepted=True)
        for other in self._others:
            self._score(other, accepted=False)
        if score < _START and not self._slips:
            self._start_others(block.seconds, score)
        self._learn_position(block)
        self._learn_place(block)
        self._sum(block)
        self._decide(block.seconds)

    def _correct(self, prior: Prior, shift: int) -> Block | None:
        """Correct the inputs as a row says; return the block of its speed, None if they cannot be compared."""
        now = self.block(0)
        then = self.block(shift) if shift else now
        at, before = then if prior.delays_speed else now, self.block(shift + 1 if prior.delays_speed else 1)
        force = then if prior.delays_force else now
        command = then if prior.delays_command else now
        slope = then if prior.delays_gradient else now
        if at.state != MOVING or max(max(now.state, then.state), before.state) == UNKNOWN:  # noqa: PLW3301
            return None
        forces = self._forces
        forces.correct(prior, at, force, command)
        forces.gradient, forces.extra = prior.row.gradient * slope.gradient, slope.extra
        return at

    def _miss(self, prior: Prior, known: vec[float], at: Block, back: int) -> float:
        """Return how far a speed is from what corrected inputs and known parameters, shape (7,), give [m/s].

        It is that of the block ``at``, which is so far back.
        """
        factor, forces = prior.row.speed, self._forces
        v = factor * self.block(back + 1).speed
        return factor * at.speed - v - at.seconds / forces.inertia * forces.balance(known, v)

    def _promises(self, prior: Prior, shift: int, score: float) -> bool:
        """Return whether a row may explain the last block better than the accepted one, whose score it is [nats]."""
        if prior.has_speed or prior.row.ignores:
            is_line_off = prior.is_of_line and self._line_score < _START
            is_distance_off = (prior.has_speed or prior.ignores_position) and self._distance_score < _START
            is_braked_off = prior.ignores_command and self._mismatch > _START_MISMATCH
            return is_line_off or is_distance_off or is_braked_off or (score < -0.5 * _ODD and not prior.is_of_line)
        if self._accepted.row > 0:
            return True
        if prior.own[OFFSET] > 0.0:
            return score < 2.0 * _START
        at = self._correct(prior, shift)
        if at is None or prior.is_of_line:
            return at is not None and self._line_score < _START
        known, theirs = self._scratch, self._before.x
        for i in range(1, _STATES):
            known[i] = prior.mean[i] if prior.anew[i] > 0.0 else theirs[i]
        miss = self._miss(prior, known, at, shift if prior.delays_speed else 0)
        return self._mismatch > _START_MISMATCH or miss * miss < at.miss * at.miss - _START_SHARE * at.variance

    def _score(self, trial: Trial, *, accepted: bool) -> float:
        """Predict and correct one row; return the log likelihood of its block [nats], NaN without one."""
        prior, forces = _PRIORS[trial.row], self._forces
        back = trial.shift if prior.delays_speed else 0
        place = (self.count - back) % _KEPT
        trial.scores[place] = math.nan
        at = self._correct(prior, trial.shift)
        if at is None:
            self._rest(trial, self.block(back))
            return math.nan
        was, gradient, mismatch = trial.x[V], forces.gradient, forces.mismatch
        # No error of the forces changes the speed by more: only wheels that slip do.
        most = math.inf
        if accepted:
            at.miss, self._mismatch = self._miss(prior, trial.x, at, back), abs(mismatch)
            most = at.seconds * (forces.effort + _SLIPS) / forces.inertia + 4.0 * math.sqrt(at.variance)
        says_nothing = not accepted and self._says_nothing(trial, prior, at, back)
        trial.predict(forces, at, self._decay, accepted=accepted)
        score = self._score_motion(trial, prior, at, was, most, accepted=accepted)
        if accepted:
            score = self._forgive_slip(trial, at, score, most)
        trial.limit(at.tunnel, accepted=accepted)
        if says_nothing:
            return math.nan
        if mismatch != 0.0:
            is_stuck = prior.ignores_command and self._still[3] > _STILL_S
            is_blank = prior.ignores_force or prior.ignores_command
            score -= _FROZEN if is_stuck else _BOTH if is_blank else min(0.5 * mismatch * mismatch, _BOTH)
        if is_finite(at.line):
            cost = _NO_LINE if prior.ignores_gradient else _off_line(gradient, at, self._gradient_var)
            self._line_score = -cost if accepted else self._line_score
            score -= cost * min(1.0, max(at.by_speed, 0.0) / _GRADIENT_M)
        trial.scores[place] = score
        return score

    def _says_nothing(self, trial: Trial, prior: Prior, at: Block, back: int) -> bool:
        """Return whether a block, which is so far back, says nothing of a row that is not accepted.

        Late commands show while the train brakes. A jump that forces do not explain much better is slip.
        """
        if prior.is_of_brake and min(self._forces.brake, at.brake) > -BRAKES:
            return True
        jump = at.seconds * _SLIPS / self._forces.inertia + 4.0 * math.sqrt(at.variance)
        if prior.ignores_speed or prior.ignores_force or not abs(at.miss) > jump:
            return False
        return abs(self._miss(prior, trial.x, at, back)) > max(jump, _JUMP_SHARE * abs(at.miss))

    def _forgive_slip(self, trial: Trial, at: Block, score: float, most: float) -> float:
        """Return the score of the accepted row: an odd speed under effort costs little, for a while."""
        is_odd = score < -0.5 * _ODD
        self._slips = is_odd and trial.odd_s < _SLIP_S and self._forces.effort > _SLIPS
        trial.odd_s = trial.odd_s + at.seconds if is_odd else max(trial.odd_s - _SLIP_SHARE * at.seconds, 0.0)
        speed = at.speed * _PRIORS[trial.row].row.speed
        if is_odd and trial.odd_s > _SLIP_S and abs(speed - trial.x[V]) > most:
            trial.measure(speed, at.variance)
        if not self._slips:
            return score
        # Wheels that slip say nothing about forces; the speed is followed as it comes.
        for i in range(1, _STATES):
            trial.x[i] = self._before.x[i]
        return max(score, -_SLIP)

    def _score_motion(self, trial: Trial, prior: Prior, at: Block, was: float, most: float, *, accepted: bool) -> float:
        """Correct a row with speed and position; return the log likelihood of both [nats]."""
        factor, has_position = prior.row.speed, is_finite(at.by_position)
        if prior.ignores_speed:
            score = -_FROZEN if at.is_frozen else -_BLANK
            if prior.ignores_position:
                return score - (_FROZEN if at.by_position == 0.0 else _BLANK)
            if has_position:  # the mean speed by position, half a block ago
                R = position_variance(at, self._distance_var()) / (at.seconds * at.seconds)
                score += trial.correct(at.by_position / at.seconds + 0.5 * (trial.x[V] - was), R)
            return score
        score = trial.correct(at.speed * factor, at.variance * factor * factor, most)
        if not has_position:
            return score
        if prior.ignores_position:
            return score - (_FROZEN if at.by_position == 0.0 else _BLANK)
        # Slip shows in both alike.
        distance_score = trial.compare_distances(at, self._distance_var(), accepted=accepted)
        self._distance_score = distance_score if accepted else self._distance_score
        return max(score + distance_score, -_ODD)

    def _rest(self, trial: Trial, at: Block) -> None:
        """Take the speed of a block as measured; a load that is not weighed may change at a stop."""
        prior = _PRIORS[trial.row]
        trial.measure(at.speed * prior.row.speed, at.variance * prior.row.speed * prior.row.speed)
        if at.state == STANDING and not self._is_weighed:
            std = max(prior.std[GAIN], _BOARDING)
            more = _BOARDING * _BOARDING * at.seconds / _BOARDING_S
            trial.P[_GAIN_GAIN] = min(trial.P[_GAIN_GAIN] + more, std * std)

    def _start_others(self, seconds: float, score: float) -> None:
        """Start all rows that are not followed from what the accepted one knew before the last block."""
        others, accepted, theirs = self._others, self._accepted.row, _PRIORS[self._before.row]
        n, place, started = len(others), 0, list[Trial]()
        last = self.block(1)
        scale = theirs.row.speed
        off = self._before.x[V] - scale * last.speed
        is_lost = theirs.delays_speed or off * off > _LOST * _LOST * scale * scale * last.variance
        for row in range(len(TABLE)):
            if place < n and others[place].row == row:
                started.append(others[place])
                place += 1
                continue
            prior = _PRIORS[row]
            shift = round(prior.row.late_s / seconds)
            if row == accepted or (prior.row.late is not None and not 0 < shift < _KEPT - 1):
                continue
            if not self._promises(prior, shift, score):
                continue
            trial = self._spare[row]
            trial.start(self._before, shift)
            # Where it is another block, or another unit, or the accepted row has lost it, the speed is as measured.
            if is_lost or prior.delays_speed or prior.row.speed != theirs.row.speed:
                last = self.block((shift if prior.delays_speed else 0) + 1)
                trial.measure(last.speed * prior.row.speed, last.variance * prior.row.speed * prior.row.speed)
            self._score(trial, accepted=False)
            started.append(trial)
        self._others = started

    def _distance_var(self) -> float:
        """Return the variance of a distance by position without its drift: as learned, and of rounding at both ends."""
        return self._position_var + self._position_step * self._position_step / 6.0

    def _learn_position(self, block: Block) -> None:
        """Learn the noise of the distance by position from the accepted row."""
        trial = self._accepted
        prior = _PRIORS[trial.row]
        if block.state != MOVING or not is_finite(block.by_position) or prior.ignores_speed or prior.ignores_position:
            return
        # From one block to the next, where an error of the scale is the same.
        off = prior.row.position * block.by_position - prior.row.speed * block.by_speed / (1.0 + trial.wheel)
        change, self._off = off - self._off, off
        square = min(0.5 * change * change, self._position_var) / _CAPPED_MEAN
        self._compared += 1
        self._position_var += max(_LEARNED, 1.0 / (_FIRST + self._compared)) * (square - self._position_var)

    def _learn_place(self, block: Block) -> None:
        """Learn the place on the line, and the error of the gradient, from the gradient of the topic."""
        if not is_finite(block.line) or _PRIORS[self._accepted.row].is_of_line:
            return
        off = max(block.gradient - block.most, block.least - block.gradient, 0.0)
        square = off * off / self._gradient_var
        if square < _NU:
            # One error of the gradient for each length in which errors of a map repeat themselves.
            H, P = block.steepness, self._place_std * self._place_std
            R = self._gradient_var * max(_GRADIENT_M / block.by_speed, 1.0)
            K = H * P / (H * H * P + R)
            self._place += K * (block.gradient - block.line)
            self._place_std = max(math.sqrt((1.0 - K * H) * P), _MIN_PLACE_M)
        self._place_std += _PLACE_SHARE * block.by_speed
        if any(_PRIORS[other.row].is_of_line and other.sum > 1.0 for other in self._others):
            return  # what may be a fault is not learned as noise
        change = min(square, 1.0) / _CAPPED_MEAN - 1.0
        self._gradient_var = max((1.0 + _LEARNED * change) * self._gradient_var, _GRADIENT_STD * _GRADIENT_STD)

    # Decision

    def _sum(self, block: Block) -> None:
        """Add the last block to the sums; rows that are improbable are followed no more."""
        accepted = self._accepted
        theirs = _PRIORS[accepted.row]
        later = accepted.shift if theirs.delays_speed else 0
        is_stuck = self._is_stuck(theirs)
        is_released = block.brake > -BRAKES and self._brake > -BRAKES
        kept, rival = list[Trial](), -math.inf
        moved_s = block.seconds if block.state == MOVING else 0.0
        for other in self._others:
            prior = _PRIORS[other.row]
            place = (self.count - max(later, other.shift if prior.delays_speed else 0)) % _KEPT
            gain = other.scores[place] - accepted.scores[place]
            other.age_s += block.seconds
            if is_finite(gain) and not (is_stuck and other.row == 0):
                other.part += gain
            if is_released or not (prior.is_of_times or theirs.is_of_times):
                other.total, other.part = other.sum, 0.0
            S = other.sum
            other.rise_s = other.rise_s + moved_s if S > 1.0 else 0.0
            rival = max(rival, S)
            if S >= _GIVE_UP and not (S < 1.0 and other.age_s > _HOPELESS_S):
                kept.append(other)
        self._others = kept
        if block.state == STANDING:
            self._braked_s = math.nan  # a train that departs with its brake on shows nothing
        elif block.state == MOVING:
            self._braked_s = 0.0 if is_released else self._braked_s + block.seconds
            self.is_brake_confirmed = self.is_brake_confirmed or (
                self._braked_s > _FOLLOWED_S and rival < _AGREES and theirs.held == 0
            )

    def _is_stuck(self, prior: Prior, seconds: float = _STILL_S) -> bool:
        """Return whether no input that a row ignores has changed for some time [s]."""
        still, ignores = self._still, prior.row.ignores
        return bool(ignores) and not (
            (prior.ignores_speed and still[0] <= seconds)
            or (prior.ignores_position and still[1] <= seconds)
            or (prior.ignores_force and still[2] <= seconds)
            or (prior.ignores_command and still[3] <= seconds)
            or prior.ignores_gradient
        )

    def _decide(self, seconds: float) -> None:
        """Accept the best row if it is good enough; health is more probable, so less is asked for."""
        first, second, best, health = -math.inf, -math.inf, self._accepted, -math.inf
        for other in self._others:
            score = self._evidence(other)
            if other.row == 0:
                health = other.sum
            elif score > first:
                first, second, best = score, first, other
            elif score > second:
                second = score
        self._waited_s = self._waited_s + seconds if first > _FIND else 0.0
        self._usual_s = self._usual_s + seconds if self._size(self._accepted) < 1.0 else 0.0
        if self._usual_s > _LEAD_S:
            self._spare[0].start(self._accepted, 0)
            self._accept(self._spare[0])
        elif health > _CLEAR and health > first - _LEAD and self._others[0].rise_s > _LEAD_S:
            self._accept(self._others[0])
        elif first > _FIND and first - second > _LEAD:
            self._accept(best)
        elif self._waited_s > _LEAD_S:
            # The first row of the table that explains the inputs as well as the best one.
            self._accept(next(other for other in self._others if self._evidence(other) > first - _TIE))
        else:
            row, now = best.row if first > _SUSPECT else 0, self.verdict
            if row != now.suspect:
                self.verdict = Verdict(now.finding, _told(best, row), now.row, row)

    def _evidence(self, trial: Trial) -> float:
        """Return S of a row less what is asked of it beforehand [nats]."""
        prior, score = _PRIORS[trial.row], trial.sum
        if trial.row > 0 and prior.held < _PRIORS[self._accepted.row].held:
            return -math.inf  # a fault seldom becomes a lesser one: all has to be well before
        if not self._is_stuck(prior, max(trial.age_s - _HOPELESS_S, _STILL_S)):
            score -= prior.row.asks
        is_open = trial.rise_s < _DELAYS * prior.row.late_s or self._size(trial) < _CREDIBLE
        return min(score, _SUSPECT) if is_open else score

    def _size(self, trial: Trial) -> float:
        """Return the size of the fault of a row in standard deviations of healthy trains, infinite without one."""
        prior, healthy = _PRIORS[trial.row], _PRIORS[0].std
        if prior.own[OFFSET] > 0.0:
            return abs(trial.x[OFFSET]) / healthy[OFFSET]
        if prior.row.unusual:
            return abs(prior.row.force * trial.x[GAIN] - 1.0) / healthy[GAIN]
        return abs(trial.wheel) / WHEEL.std if prior.row.wheel_std != WHEEL.std else math.inf

    def _accept(self, trial: Trial) -> None:
        """Accept a row, which keeps the size of its fault: all others start afresh."""
        prior, accepted = _PRIORS[trial.row], Trial(trial.row)
        accepted.copy(trial)
        for i in range(1, _STATES):
            if prior.own[i] > 0.0:
                accepted.centre[i] = trial.x[i]
        accepted.wheel_centre = trial.wheel if prior.has_speed else 0.0
        self._accepted, self._others, self._waited_s, self._usual_s = accepted, [], 0.0, 0.0
        self.verdict = Verdict(_told(trial, trial.row), '', trial.row, 0)


def _told(trial: Trial, place: int) -> str:
    """Return the sentence of a row with the size of the fault by a trial."""
    row = TABLE[place]
    return row.sentence.format(gain=trial.x[GAIN] * row.force, offset=trial.x[OFFSET], wheel=trial.wheel)


def _off_line(gradient: float, at: Block, variance: float) -> float:
    """Return what a gradient [per mille] costs that the line does not have here [nats]."""
    off = max(gradient - at.most, at.least - gradient)
    if off <= 0.0:
        return 0.0
    elsewhere = _PLACES * math.sqrt(variance) / _GRADIENTS
    return -math.log(
        ((1.0 - _PLACES) * math.exp(-0.5 * off * off / variance) + elsewhere) / (1.0 - _PLACES + elsewhere)
    )

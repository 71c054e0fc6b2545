# SPDX-License-Identifier: Apache-2.0
"""One check of all inputs against each other: which row of the table of faults explains them best.

Samples become blocks of at least half a second. Each row of :data:`~trainid_ros.stream.fault_table.TABLE` corrects the
inputs as it says, and one and the same Kalman filter, :class:`~trainid_ros.stream.fault_filter.Trial`, predicts the
next block from them. A block has four scores [nats]: of speed and position by Student's t, of the reported force
against the brake, of the gradient against the line.

One row is accepted, at first that all is well. For each other row

    (4)  S = sum of log likelihoods of its blocks - the same of the accepted row,

from a fresh start whenever S < ``_GIVE_UP``: a repeated sequential probability ratio test, or a generalised likelihood
ratio over the time of onset. S > ``_SUSPECT``: suspected. S > ``_FIND``, the best by ``_LEAD``, ahead of health too:
accepted, a finding. S of the first row > ``_CLEAR``, and above one nat for ``_LEAD_S`` of motion: all is well again.
Delays, and a wrong size of the force while all was well, are scored by applications of the brake, since the errors
within one are the same. What holds back an estimator is not replaced by what holds back fewer, but for rows of the
line.

Wheels that slip say nothing about forces: for a while, the accepted row follows an odd speed, and learns nothing from
it. Other rows are scored on a jump that forces cannot explain only if they explain half of it, or ignore speed or
force.

A row is followed only from the first block on that the accepted row explains badly, from what that knew before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, several, unknown
from trainid_ros.interface.vectors import vec
from trainid_ros.stream.adhesion import MIN_SLIP
from trainid_ros.stream.fault_filter import (
    LASTING_S,
    MAX_COST,
    MIN_BRAKE,
    PRIORS,
    RANGE,
    STATES,
    Forces,
    Lasting,
    Prior,
    Trial,
    diagonal,
    force_lead,
    learn_lead,
    position_variance,
    wind_std,
)
from trainid_ros.stream.fault_table import BRAKE, GAIN, LAG, OFFSET, SLOPE, TABLE, USUAL, WHEEL, WIND, Input, V
from trainid_ros.stream.input_blocks import AT_STOP, ERROR_M, KEPT, MOVING, Block, InputBlocks
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Sample

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
_START: Final = -0.6  # nats: a block that the accepted row explains worse starts the others
_START_OFFSET: Final = -1.2  # nats: the same for a force or gradient that is off, which explains most of them
_START_SHARE: Final = 0.5  # share of the variance of a speed by which its square error must fall to start a row
_START_MISMATCH: Final = 0.7  # standard deviations of force against brake that start all of them
_HOPELESS_S: Final = 10.0  # s after which a row that has gained less than one nat starts afresh
_ONSET_S: Final = 10.0  # s that a row may be followed before the input it ignores is stuck

# Scores: assumed costs of one block, next to its likelihood; benchmarks/healthy.py and faults.py show that they fit.

_BLANK: Final = 2.0  # nats: what an ignored input costs a block (it is not predicted at all)
_LINE_M: Final = 100.0  # m: the line counts once in it
_NO_LINE: Final = 2.0  # nats in that distance: the same if it is not compared with the gradient of the topic
_FROZEN: Final = 0.5  # nats: the same if its value has not changed at all
_STILL_S: Final = 5.0  # s: an input that has not changed for so long may be stuck
_SLIP_COST: Final = 1.0  # nats: what a block of an odd speed costs the accepted row ...
_SLIP_S: Final = 2.5  # s: ... for so long at most: slip and slide end soon ...
_SLIP_EFFORT: Final = 15.0  # N/kN: ... while traction and brake, as they came, are more than this
_ODD: Final = -2.0  # nats: half of the most that a block can cost: its speed is odd
_JUMP_FORCE: Final = 15.0  # N/kN: the most by which forces are off, but for faults: a speed that jumps is off by more
_JUMP_SHARE: Final = 0.5  # share of a jump of the speed that a row must explain, or the jump says nothing of it
_FORGET_SLIP: Final = 0.5  # s by which the time of an odd speed falls per second without one
_BOTH: Final = 1.0  # nats: what a block of force beside a brake command costs: rare, but it lasts
_PLACES: Final = 0.2  # share of blocks in which the line is looked up in the wrong place
_GRADIENTS: Final = 40.0  # per mille: range of all gradients

# What is usual, and how far a row may depart from it

_LIMIT: Final = RANGE - 0.1  # standard deviations: a quantity so far off may be farther off
_BOARDING: Final = 0.05  # share of the mass by which it may change at a stop, if it is not weighed ...
_BOARDING_S: Final = 30.0  # s ... in this time


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
        blocks: The inputs, block by block.
        is_brake_confirmed: Whether the brake of a moving train has acted as the train file says for some seconds.
    """

    STATE: ClassVar[State] = declare(
        'blocks', '_accepted', several('_others', Trial), '_waited_s', '_usual_s', unknown('_braked_s'),
        'is_brake_confirmed', '_lead', '_lag', '_slope', 'verdict', '_speed_score',
    )  # fmt: skip

    def __init__(self, known: KnownForce) -> None:
        self.blocks = InputBlocks(known)
        self._forces = Forces(known)
        self._lead, self._lag = Lasting(force_lead(self._forces.timing)), Lasting(LAG)
        self._slope = Lasting(SLOPE)
        self._decay = vec[float]([0.0] * STATES)
        self._decay_s = 0.0
        self._spare = [Trial(row) for row in range(len(TABLE))]
        self._before = Trial(0)
        self._accepted = Trial(0)
        k = 0
        for i in range(STATES):
            self._accepted.P[k] = PRIORS[0].std[i] * PRIORS[0].std[i]
            k += STATES - i
        self._others = list[Trial]()
        self._waited_s = self._usual_s = 0.0
        self._scratch = vec[float]([0.0] * STATES)
        self._mismatch = self._speed_score = self._distance_score = self._line_score = 0.0
        self._now = self._last = Block()  # The last block, and the one before
        self._slips = False  # Whether the wheels seem to slip or slide in the last block
        self._braked_s = math.nan  # Time for which the brake has acted on a moving train [s], NaN at a stand
        self.is_brake_confirmed = False
        self.verdict = Verdict()

    def take(self, sample: Sample) -> Verdict:
        """Take in a sample; return what is found and suspected after it."""
        if self.blocks.take(sample):
            self._judge()
        return self.verdict

    def at_limit(self, places: tuple[int, ...]) -> str:
        """Return which of some quantities is as far from usual as a healthy train can have it, empty if none is."""
        trial = self._accepted
        if abs(trial.wheel) > _LIMIT * WHEEL.std and not PRIORS[trial.row].is_of_wheel:
            return f'{WHEEL.name} is at the limit of what is usual'
        for place in places:
            usual = USUAL[place - 1]
            is_own = PRIORS[trial.row].own[place] > 0.0
            if not is_own and abs(trial.x[place] - usual.mean) > _LIMIT * usual.std:
                return f'{usual.name} is at the limit of what is usual'
        return ''

    def resistance_objection(self) -> str:
        """Return by how much the resistance is not that of a healthy train, empty if it may be.

        A constant error of force or gradient looks like it. Rain, wind and tunnels differ by less.
        """
        trial, drag = self._accepted, 2.0 * self._forces.drag * self._accepted.x[V]
        excess = trial.x[OFFSET] + drag * trial.x[WIND]
        std = math.hypot(PRIORS[0].std[OFFSET], drag * wind_std(trial.x[V], self._now.tunnel))
        if abs(excess) < _LIMIT * std:
            return ''
        return f'the resistance is {excess:+.0f} N/kN off that of the train file: is ato/force or ato/gradient off?'

    def scale_objection(self) -> str:
        """Return by how much the position runs off the line, empty if by no more than on healthy trains.

        Speed and position of one odometer are off alike, which nothing but the line shows.
        """
        scale, std = self.blocks.scale, math.sqrt(self.blocks.scale_var)
        if abs(scale) > _CREDIBLE * WHEEL.std + std:
            off = scale / (1.0 - scale)
            return f'ato/speed and its position are {off:+.0%} off by line.gradient: is the wheel diameter right?'
        return ''

    def slope_objection(self) -> str:
        """Return by how much the gradient is off the line on average, empty if by no more than on healthy trains."""
        if abs(self._slope.excess) < _CREDIBLE:
            return ''
        return f'ato/gradient is {self._slope.mean:+.1f} per mille off line.gradient of the train file on average'

    @property
    def gain(self) -> float:
        """Traction over what force and mass give [1]."""
        return PRIORS[self._accepted.row].row.force * self._accepted.x[GAIN]

    @property
    def is_speed_odd(self) -> bool:
        """True while the speed, whatever the position, is as odd as where wheels slip or slide."""
        return self._accepted.odd_s > 0.0 and self._speed_score < _ODD

    def timing_objection(self) -> str:
        """Return by how much the force is ahead of the brake command, empty if no more than on healthy trains.

        Brakes later than stated are frequent, and states of the filter. None acts before its command.
        """
        if self._lead.excess < _CREDIBLE:
            return ''
        return f'ato/force brakes {self._lead.mean:.1f} s before it should by ato/brake_command and brake.delay'

    # Scores

    def _judge(self) -> None:
        """Score the last block by the accepted row, by those that are followed, and decide."""
        block, accepted = self.blocks.block(0), self._accepted
        self._now, self._last = block, self.blocks.block(1)
        if block.seconds != self._decay_s and block.seconds > 0.0:
            self._decay_s = block.seconds
            self._decay[V] = math.exp(-block.seconds / LASTING_S)
            for i in range(1, STATES):
                self._decay[i] = math.exp(-block.seconds / USUAL[i - 1].time_s)
        self._find_speed()
        self._before.copy_estimate(accepted)
        self._mismatch = self._speed_score = self._distance_score = self._line_score = 0.0
        self._slips = False
        score = self._score(accepted, accepted=True)
        for other in self._others:
            self._score(other, accepted=False)
        if score < _START and not self._slips:
            self._start_others(block.seconds, score)
        self._learn(block)
        self._sum(block)
        self._decide(block.seconds)

    def _find_speed(self) -> None:
        """Take the speed before the last block as measured where the accepted row is off it by more than noise.

        So it is after slip, and where it misses by a fault.
        """
        trial, prior = self._accepted, PRIORS[self._accepted.row]
        begin = self.blocks.block(trial.back + 1)
        off = trial.x[V] - prior.row.speed * begin.speed
        if not prior.ignores_speed and abs(off) > prior.row.speed * max(MIN_SLIP, self.blocks.most_noise):
            trial.measure(begin)

    def _correct(self, prior: Prior, shift: int) -> Block | None:
        """Correct the inputs as a row says; return the block of its speed, None if they cannot be compared."""
        now = self._now
        then = self.blocks.block(shift) if shift else now
        at = then if prior.delays_speed else now
        before = self.blocks.block(shift + 1) if shift and prior.delays_speed else self._last
        force = then if prior.delays_force else now
        command = then if prior.delays_command else now
        slope = then if prior.delays_gradient else now
        # Sensors that see no slow motion jump as the train departs.
        if max(max(now.state, then.state), max(at.state, before.state)) != MOVING:  # noqa: PLW3301
            return None
        forces = self._forces
        forces.correct(prior, at, force, command)
        forces.gradient, forces.extra = prior.row.gradient * slope.gradient, slope.extra
        if prior.ignores_gradient and is_finite(at.line):
            forces.gradient = at.line
        return at

    def _miss(self, prior: Prior, known: vec[float], at: Block, back: int) -> float:
        """Return how far a speed is from what corrected inputs and known parameters, shape (7,), give [m/s].

        It is that of the block ``at``, which is so far back.
        """
        factor, forces = prior.row.speed, self._forces
        v = factor * (self.blocks.block(back + 1) if back else self._last).speed
        return factor * at.speed - v - at.seconds / forces.inertia * forces.balance(known, v)

    def _promises(self, prior: Prior, shift: int, score: float) -> bool:
        """Return whether a row may explain the last block better than the accepted one, whose score it is [nats]."""
        if prior.is_of_wheel or (prior.row.ignores and not prior.is_of_odometer):
            is_line_off = prior.is_of_line and self._line_score < _START
            is_distance_off = (prior.is_of_wheel or prior.ignores_position) and self._distance_score < _START
            is_braked_off = (prior.ignores_command or prior.ignores_braking) and self._mismatch > _START_MISMATCH
            return is_line_off or is_distance_off or is_braked_off or (score < _ODD and not prior.is_of_line)
        if self._accepted.row > 0:
            return True
        if prior.own[OFFSET] > 0.0:
            return score < _START_OFFSET
        at = self._correct(prior, shift)
        if at is None or prior.is_of_line:
            return at is not None and self._line_score < _START
        known, theirs = self._scratch, self._before.x
        for i in range(1, STATES):
            known[i] = prior.mean[i] if prior.anew[i] > 0.0 else theirs[i]
        miss = self._miss(prior, known, at, shift if prior.delays_speed else 0)
        return self._mismatch > _START_MISMATCH or miss * miss < at.miss * at.miss - _START_SHARE * at.variance

    def _score(self, trial: Trial, *, accepted: bool) -> float:
        """Predict and correct one row; return the log likelihood of its block [nats], NaN without one."""
        prior, forces = PRIORS[trial.row], self._forces
        back = trial.back
        place = (self.blocks.count - back) % KEPT
        trial.scores[place] = math.nan
        at = self._correct(prior, trial.shift)
        if at is None:
            self._rest(trial, self.blocks.block(back))
            return math.nan
        was, mismatch = trial.x[V], forces.mismatch
        # A place that is off looks like a speed that is late: the line says nothing about times.
        gradient = at.gradient if prior.is_of_times else forces.gradient
        if accepted:
            at.miss, self._mismatch = self._miss(prior, trial.x, at, back), abs(mismatch)
        says_nothing = not accepted and self._says_nothing(trial, prior, at, back)
        trial.predict(forces, at, self._decay, accepted=accepted)
        score = self._score_motion(trial, prior, at, was, accepted=accepted)
        if accepted:
            score = self._forgive_slip(trial, at, score)
        trial.limit(at.tunnel, accepted=accepted)
        if says_nothing:
            return math.nan
        if mismatch != 0.0:
            is_stuck = prior.ignores_braking or (prior.ignores_command and self.blocks.still[3] > _STILL_S)
            is_blank = prior.ignores_force or prior.ignores_command
            score -= _FROZEN if is_stuck else _BOTH if is_blank else min(0.5 * mismatch * mismatch, _BOTH)
        if is_finite(at.line):
            cost = _NO_LINE if prior.ignores_line else _off_line(gradient, at, self.blocks.gradient_var)
            self._line_score = -cost if accepted else self._line_score
            score -= cost * min(1.0, max(at.by_speed, 0.0) / _LINE_M)
        trial.scores[place] = score
        return score

    def _least_jump(self, at: Block) -> float:
        """Return the least miss of a speed after a block that may be slip [m/s]."""
        return at.seconds * _JUMP_FORCE / self._forces.inertia + self.blocks.most_noise

    def _says_nothing(self, trial: Trial, prior: Prior, at: Block, back: int) -> bool:
        """Return whether a block, which is so far back, says nothing of a row that is not accepted.

        Late commands show while the train brakes. A jump that forces do not explain much better is slip.
        """
        if prior.is_of_brake and min(self._forces.brake, at.brake) > -MIN_BRAKE:
            return True
        jump = self._least_jump(at)
        if prior.ignores_speed or prior.ignores_force or not abs(at.miss) > jump:
            return False
        return abs(self._miss(prior, trial.x, at, back)) > max(jump, _JUMP_SHARE * abs(at.miss))

    def _forgive_slip(self, trial: Trial, at: Block, score: float) -> float:
        """Return the score of the accepted row: an odd speed under effort costs little, for a while."""
        prior = PRIORS[trial.row]
        # A position that is ignored costs the same in every block, odd or not.
        blank = _BLANK if prior.ignores_position else 0.0
        is_odd = score + blank < _ODD and not prior.ignores_speed
        self._slips = is_odd and trial.odd_s < _SLIP_S and self._forces.effort > _SLIP_EFFORT
        trial.odd_s = trial.odd_s + at.seconds if is_odd else max(trial.odd_s - _FORGET_SLIP * at.seconds, 0.0)
        if not self._slips:
            return score
        # Wheels that slip say nothing about forces; the speed is followed as it comes.
        for i in range(1, STATES):
            trial.x[i] = self._before.x[i]
        return max(score, -_SLIP_COST)

    def _score_motion(self, trial: Trial, prior: Prior, at: Block, was: float, *, accepted: bool) -> float:
        """Correct a row with speed and position; return the log likelihood of both [nats]."""
        factor, has_position = prior.row.speed, is_finite(at.by_position)
        if prior.ignores_speed:
            score = -_FROZEN if at.is_frozen else -_BLANK
            self._speed_score = 0.0 if accepted else self._speed_score
            if prior.ignores_position:
                return score - (_FROZEN if at.by_position == 0.0 else _BLANK)
            if has_position:  # the mean speed by position, half a block ago
                R = position_variance(at, self.blocks.distance_var()) / (at.seconds * at.seconds)
                score += trial.correct(at.by_position / at.seconds + 0.5 * (trial.x[V] - was), R)
            return score
        score = trial.correct(at.speed * factor, at.variance * factor * factor)
        self._speed_score = score if accepted else self._speed_score
        if not has_position:
            return score
        if prior.ignores_position:
            return score - (_FROZEN if at.by_position == 0.0 else _BLANK)
        # Slip shows in both alike.
        distance_score = trial.compare_distances(at, self._lag, self.blocks.distance_var(), accepted=accepted)
        self._distance_score = distance_score if accepted else self._distance_score
        return max(score + distance_score, -MAX_COST)

    def _rest(self, trial: Trial, at: Block) -> None:
        """Take the speed of a block as measured; a load that is not weighed may change at a stop."""
        trial.measure(at)
        if at.state == AT_STOP and not self.blocks.is_weighed:
            prior = PRIORS[trial.row]
            std = max(prior.std[GAIN], _BOARDING)
            more = _BOARDING * _BOARDING * at.seconds / _BOARDING_S
            k = diagonal(GAIN)
            trial.P[k] = min(trial.P[k] + more, std * std)

    def _start_others(self, seconds: float, score: float) -> None:
        """Start all rows that are not followed from what the accepted one knew before the last block."""
        others, accepted, theirs = self._others, self._accepted.row, PRIORS[self._before.row]
        n, place, started = len(others), 0, list[Trial]()
        for row in range(len(TABLE)):
            if place < n and others[place].row == row:
                started.append(others[place])
                place += 1
                continue
            prior = PRIORS[row]
            shift = round(prior.row.late_s / seconds)
            if row == accepted or (prior.row.late is not None and not 0 < shift < KEPT - 1):
                continue
            if not self._promises(prior, shift, score):
                continue
            trial = self._spare[row]
            trial.start(self._before, shift)
            # Where it is another block, another unit, or that of a row without it, the speed is as measured.
            is_other = theirs.ignores_speed or theirs.delays_speed or prior.delays_speed
            if is_other or prior.row.speed != theirs.row.speed:
                trial.measure(self.blocks.block(trial.back + 1))
            self._score(trial, accepted=False)
            started.append(trial)
        self._others = started

    def _learn(self, block: Block) -> None:
        """Learn the noise of position and gradient, where the accepted row uses them."""
        trial, blocks = self._accepted, self.blocks
        prior = PRIORS[trial.row]
        if trial.row == 0:
            learn_lead(self._lead, blocks.block(2), self._last, block)
        if not (prior.ignores_speed or prior.ignores_position):
            by_speed = prior.row.speed * block.by_speed / (1.0 + trial.wheel)
            by_position, step = prior.by_position(block), prior.row.speed * block.speed_step
            if block.state == MOVING and is_finite(by_position) and not self._slips:
                slack = by_speed * WHEEL.std
                R = position_variance(block, blocks.distance_var()) + slack * slack
                self._lag.correct(by_position - by_speed, step, R, block.seconds)
            blocks.learn_position(block, by_position - self._lag.mean * step, by_speed)
        if not is_finite(block.line) or (Input.POSITION in prior.row.condemns and not prior.is_of_line):
            return
        # One error for each length in which errors of a map repeat themselves, that of the place included.
        spread = 0.5 * (block.most - block.least)
        R = (blocks.gradient_var + spread * spread) * max(ERROR_M / block.by_speed, 1.0)
        self._slope.correct(block.gradient - block.line, 1.0, R, block.seconds)
        if not prior.is_of_line:
            # What may be a fault is not learned as noise.
            is_line_odd = any(PRIORS[other.row].is_of_line and other.sum > 1.0 for other in self._others)
            blocks.learn_place(block, is_line_right=not is_line_odd)

    # Decision

    def _sum(self, block: Block) -> None:
        """Add the last block to the sums; rows that are improbable are followed no more."""
        accepted = self._accepted
        theirs = PRIORS[accepted.row]
        is_stuck = self._is_stuck(theirs)
        is_released = block.brake > -MIN_BRAKE and self.blocks.brake > -MIN_BRAKE
        kept, rival = list[Trial](), -math.inf
        moved_s = block.seconds if block.state == MOVING else 0.0
        for other in self._others:
            prior = PRIORS[other.row]
            place = (self.blocks.count - max(accepted.back, other.back)) % KEPT
            gain = other.scores[place] - accepted.scores[place]
            other.age_s += block.seconds
            if is_finite(gain) and not (is_stuck and not theirs.row.ignores <= prior.row.ignores):
                other.part += gain
            is_of_times = prior.is_of_times or theirs.is_of_times
            if is_released or not (is_of_times or (prior.is_of_scale and accepted.row == 0)):
                other.total, other.part = other.sum, 0.0
            S = other.sum
            other.rise_s = other.rise_s + moved_s if S > 1.0 else 0.0
            rival = max(rival, S)
            if S >= _GIVE_UP and not (S < 1.0 and other.age_s > _HOPELESS_S):
                kept.append(other)
        self._others = kept
        if block.state == AT_STOP:
            self._braked_s = math.nan  # a train that departs with its brake on shows nothing
        elif block.state == MOVING:
            self._braked_s = 0.0 if is_released else self._braked_s + block.seconds
            self.is_brake_confirmed = self.is_brake_confirmed or (
                self._braked_s > _FOLLOWED_S and rival < _AGREES and theirs.held == 0
            )

    def _is_stuck(self, prior: Prior, seconds: float = _STILL_S) -> bool:
        """Return whether no input that a row ignores has changed for some time [s]."""
        still, ignores = self.blocks.still, prior.row.ignores
        return bool(ignores) and not (
            (prior.ignores_speed and still[0] <= seconds)
            or (prior.ignores_position and still[1] <= seconds)
            or (prior.ignores_force and still[2] <= seconds)
            or (prior.ignores_command and still[3] <= seconds)
            or prior.ignores_line
            or prior.ignores_braking
        )

    def _decide(self, seconds: float) -> None:
        """Accept the best row if it is good enough, and far ahead of the second or long the best.

        Health is more probable, so less is asked for.
        """
        first, second, best = -math.inf, -math.inf, self._accepted
        health, healthy = -math.inf, self._accepted
        for other in self._others:
            score = self._evidence(other)
            if other.row == 0:
                health, healthy = other.sum, other
            elif score > first:
                first, second, best = score, first, other
            elif score > second:
                second = score
        self._waited_s = self._waited_s + seconds if first > _FIND else 0.0
        self._usual_s = self._usual_s + seconds if self._size(self._accepted) < 1.0 else 0.0
        if self._usual_s > _LEAD_S:
            self._spare[0].start(self._accepted, 0)
            self._accept(self._spare[0])
        elif health > _CLEAR and health > first - _LEAD and healthy.rise_s > _LEAD_S:
            self._accept(healthy)
        elif first > _FIND and first - max(second, health) > _LEAD:
            self._accept(best)
        elif self._waited_s > _LEAD_S:
            # The first row of the table that explains the inputs as well as the best one.
            self._accept(next(other for other in self._others if self._evidence(other) >= first - _TIE))
        else:
            row, now = best.row if first > _SUSPECT else 0, self.verdict
            if row != now.suspect:
                self.verdict = Verdict(now.finding, _told(best, row), now.row, row)

    def _evidence(self, trial: Trial) -> float:
        """Return S of a row less what is asked of it beforehand [nats]."""
        prior, score = PRIORS[trial.row], trial.sum
        theirs = PRIORS[self._accepted.row]
        if trial.row > 0 and prior.held < theirs.held and not (prior.is_of_line and theirs.is_of_line):
            return -math.inf  # a fault seldom becomes a lesser one: all has to be well before
        if prior.is_of_odometer:
            # A force that is stuck explains as much, and a wrong mass or force nearly as much: both are more frequent.
            score -= prior.row.asks if self.blocks.still[2] > _STILL_S else _LEAD
        elif not self._is_stuck(prior, max(trial.age_s - _ONSET_S, _STILL_S)):
            score -= prior.row.asks
        is_early = trial.rise_s < _DELAYS * prior.row.late_s
        return min(score, _SUSPECT) if is_early or self._size(trial) < _CREDIBLE else score

    def _size(self, trial: Trial) -> float:
        """Return the size of the fault of a row in standard deviations of healthy trains, infinite without one."""
        prior, healthy = PRIORS[trial.row], PRIORS[0].std
        if prior.own[OFFSET] > 0.0:
            return abs(trial.x[OFFSET]) / healthy[OFFSET]
        if prior.row.unusual:
            return abs(prior.row.force * trial.x[GAIN] - 1.0) / healthy[GAIN]
        command = prior.row.command
        if command != 1.0 and abs(command * trial.x[BRAKE] - 1.0) < 0.5 * abs(command - 1.0):
            return 0.0  # nearer to a healthy brake than to the fault
        return abs(trial.wheel) / WHEEL.std if prior.row.wheel_std != WHEEL.std else math.inf

    def _accept(self, trial: Trial) -> None:
        """Accept a row, which keeps the size of its fault: all others start afresh."""
        prior, accepted = PRIORS[trial.row], Trial(trial.row)
        accepted.copy_estimate(trial)
        for i in range(1, STATES):
            if prior.own[i] > 0.0:
                accepted.centre[i] = trial.x[i]
        accepted.wheel_centre = trial.wheel if prior.is_of_wheel else 0.0
        self._accepted, self._others, self._waited_s, self._usual_s = accepted, [], 0.0, 0.0
        self.verdict = Verdict(_told(trial, trial.row), '', trial.row, 0)


def _told(trial: Trial, place: int) -> str:
    """Return the sentence of a row with the size of the fault by a trial."""
    row = TABLE[place]
    return row.sentence.format(
        gain=trial.x[GAIN] * row.force,
        brake=trial.x[BRAKE] * row.command,
        offset=trial.x[OFFSET],
        wheel=trial.wheel,
    )


def _off_line(gradient: float, at: Block, variance: float) -> float:
    """Return what a gradient [per mille] costs that the line does not have here [nats]."""
    off = max(gradient - at.most, at.least - gradient)
    if off <= 0.0:
        return 0.0
    elsewhere = _PLACES * math.sqrt(variance) / _GRADIENTS
    return -math.log(
        ((1.0 - _PLACES) * math.exp(-0.5 * off * off / variance) + elsewhere) / (1.0 - _PLACES + elsewhere)
    )

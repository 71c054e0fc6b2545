# SPDX-License-Identifier: Apache-2.0
"""One check of all inputs: its filter against matrices, its state, and one drive for each row of the table."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.state import encode, restore
from trainid_ros.stream.fault_filter import MIN_BRAKE, Forces, Lasting, Prior, Trial, force_lead, learn_lead, student_t
from trainid_ros.stream.fault_table import BRAKE, GAIN, OFFSET, TABLE, USUAL, Input, Row
from trainid_ros.stream.input_blocks import MOVING, Block
from trainid_ros.stream.input_check import InputCheck, Verdict
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import BrakeCommandChange, G
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

Array = NDArray[np.float64]

START: Final = 1_700_000_000_000_000_000
MASS, GAMMA, LENGTH = 200e3, 0.08, 100.0
# Gradients of the line [per mille], every 400 m.
GRADIENTS: Final = tuple((400.0 * k, 7.0 * math.sin(2.4 * k) - 0.5) for k in range(60))
FILE: Final = TrainFile(
    Train(MASS, GAMMA, LENGTH), Davis(1.5, 0.03, 0.004), Brake(1.0, 0.4, 0.6), Line(gradient=GRADIENTS)
)
DT: Final = 0.2


@dataclass
class Drive:
    """What really happened, and what is reported of it, at 5 Hz."""

    speed: Array
    position: Array
    force: Array  # [N/kN]
    gradient: Array
    command: Array
    pulled: Array = field(default_factory=lambda: np.zeros(0))  # What acted in traction [N/kN]


def driven(seconds: float, *, traction: float = 1.0, offset: float = 0.0, delay: float = 0.6) -> Drive:
    """Return a drive of traction, cruising, coasting and braking; traction acts so many times as reported."""
    n, sub = round(seconds / DT), 8
    rng = np.random.default_rng(28)
    inertia = 1000.0 * (1.0 + GAMMA) / G
    profile = LineProfile(FILE.line, LENGTH)
    v, x, force, lagged = 0.5, 500.0, 0.0, 0.0
    commands = [0.0] * (round(delay / DT * sub) + 1)
    rows = []
    phase, since = 'pull', 0.0
    for _ in range(n):
        since += DT
        if phase == 'pull' and v > 18.0:
            phase, since = 'hold', 0.0
        elif phase == 'hold' and since > 12.0:
            phase, since = 'coast', 0.0
        elif phase == 'coast' and since > 10.0:
            phase, since = 'brake', 0.0
        elif phase == 'brake' and v < 4.0:
            phase, since = 'pull', 0.0
        command = {'brake': -0.9 if since < 6.0 else -0.5}.get(phase, 0.0)
        effort = {'pull': min(70.0, 700.0 / max(v, 1.0)), 'hold': max(20.0 * (18.0 - v) + 4.0, 0.0)}.get(phase, 0.0)
        effort = effort if lagged > -0.05 else 0.0
        slope = profile.gradient(x, 1)
        for _ in range(sub):
            h = DT / sub
            force += (effort - force) * h / 0.4
            commands.append(command)
            lagged += (commands[-len(commands[: round(delay / DT * sub) + 1])] - lagged) * (1.0 - math.exp(-h / 0.4))
            w = 1.5 + v * (0.03 + v * 0.004)
            v = max(v + h * ((traction * force - slope - w - offset) / inertia + lagged), 0.0)
            x += h * v
        rows.append((v + 0.02 * rng.normal(), x, force + lagged * inertia + 0.2 * rng.normal(), slope, command, force))
    return Drive(*np.array(rows).T)


def shifted(values: Array, seconds: float) -> Array:
    """Return values that come later by a time [s]."""
    k = round(seconds / DT)
    return np.concatenate((np.full(k, values[0]), values[:-k])) if k > 0 else np.concatenate(
        (values[-k:], np.full(-k, values[-1]))
    )  # fmt: skip


def samples_of(drive: Drive) -> Iterator[Sample]:
    """Yield the samples of a drive."""
    newton, before = MASS * G / 1000.0, math.nan
    for k in range(len(drive.speed)):
        stamp = START + k * NS_PER_S // 5
        sample = coasting_sample(stamp, DT if k else math.nan, max(float(drive.speed[k]), 0.0))
        command = float(drive.command[k])
        last = max(k - 1, 0)
        yield replace(
            sample,
            position=float(drive.position[k]),
            force=float(drive.force[k]) * newton,
            force_mean=0.5 * float(drive.force[k] + drive.force[last]) * newton,
            gradient=float(drive.gradient[k]),
            gradient_mean=0.5 * float(drive.gradient[k] + drive.gradient[last]),
            brake_command=command,
            brake_changes=() if command == before else (BrakeCommandChange(stamp - NS_PER_S // 5, command),),
            mass=MASS,
        )
        before = command


# A command that comes late is like a brake that acts late.
_ALIKE: Final = frozenset({Input.COMMAND, Input.BRAKE})


def faulty(row: Row) -> Drive:
    """Return a drive with just the fault of a row."""
    gain = next((mean for place, mean, _ in row.unusual if place == GAIN), 1.0) if row.force == 1.0 else 1.0
    offset = 10.0 if any(place == OFFSET for place, _, _ in row.unusual) else 0.0
    # What the brake alone shows takes several applications.
    seconds = 1800.0 if row.late in _ALIKE else 900.0
    drive = driven(seconds, traction=gain, offset=offset, delay=0.6 + (row.late_s if row.late is Input.BRAKE else 0.0))
    drive.force = np.abs(drive.force) if row.signless else drive.force / row.force
    drive.gradient = drive.gradient / row.gradient
    drive.command = drive.command / row.command
    drive.position = drive.position / row.position
    drive.speed = drive.speed / row.speed * (1.06 if row.wheel_std > 0.01 else 1.0)
    # The usual force is a little late.
    later = -row.late_s if row.early else row.late_s + 0.2
    if row.late is Input.FORCE:
        drive.force = shifted(drive.force, later)
    elif row.late is Input.SPEED:
        drive.speed, drive.position = shifted(drive.speed, later), shifted(drive.position, later)
    elif row.late is Input.COMMAND:
        drive.command = shifted(drive.command, later)
    half = len(drive.speed) // 3
    if Input.SPEED in row.ignores:
        drive.speed[half:] = drive.speed[half]
    if Input.POSITION in row.ignores:
        drive.position[half:] = drive.position[half]
    if Input.FORCE in row.ignores:
        drive.force[half:] = drive.force[half]
    if Input.BRAKING in row.ignores:
        drive.force = np.maximum(drive.force, 0.0)
    if Input.COMMAND in row.ignores:
        drive.command[half:] = 0.0
    if Input.LINE in row.ignores:
        drive.position = drive.position + 1500.0
    if Input.GRADIENT in row.ignores:
        drive.gradient = -3.0 + 0.0 * drive.gradient
    return drive


@cache
def verdicts(place: int) -> tuple[Verdict, ...]:
    """Return all verdicts on the drive with the fault of a row."""
    check = InputCheck(KnownForce(FILE))
    return tuple({check.take(sample): None for sample in samples_of(faulty(TABLE[place]))})


def test_a_healthy_drive_has_no_finding_and_no_suspicion() -> None:
    assert verdicts(0) == (Verdict(),)


@pytest.mark.parametrize('place', range(1, len(TABLE)), ids=lambda k: TABLE[k].sentence)
def test_each_row_is_found_on_a_drive_with_just_that_fault(place: int) -> None:
    row = TABLE[place]
    if row.ignores == frozenset({Input.COMMAND}):
        pytest.skip('a command stuck at zero looks like dynamic braking')
    found = [verdict for verdict in verdicts(place) if verdict.finding]
    assert found, row.sentence
    condemned = frozenset[Input]().union(*(TABLE[verdict.row].condemns for verdict in found))
    assert condemned & (row.condemns | (_ALIKE if row.condemns & _ALIKE else frozenset[Input]())), found
    if row.misread and not row.ignores & {Input.SPEED, Input.POSITION}:
        assert found[-1].row == place


def test_a_position_that_is_off_is_no_fault_and_a_small_error_of_the_gradient_is_found() -> None:
    """The gradient of the topic shows the place on the line, 25 m from the position; then it is 2.5 per mille high."""
    drive = driven(900.0)
    drive.position += 25.0
    half = len(drive.gradient) // 2
    drive.gradient[half:] += 2.5
    check = InputCheck(KnownForce(FILE))
    said = [check.take(sample) for sample in samples_of(drive)]
    assert {verdict.finding for verdict in said[:half]} == {''}
    assert any(Input.GRADIENT in TABLE[verdict.row].condemns for verdict in said[half : half + 500])


def test_a_position_in_steps_of_10_m_is_no_fault() -> None:
    drive = driven(900.0)
    drive.position = 10.0 * np.floor(drive.position / 10.0)
    check = InputCheck(KnownForce(FILE))
    assert {check.take(sample) for sample in samples_of(drive)} == {Verdict()}


def test_a_brake_is_confirmed_by_five_seconds_that_fit_its_command() -> None:
    """Each braking of these drives lasts for more than ten seconds."""
    for factor, is_confirmed in ((1.0, True), (2.0, False)):
        drive, check = driven(120.0), InputCheck(KnownForce(FILE))
        drive.command = factor * drive.command
        braked_s = 0.0
        for sample in samples_of(drive):
            check.take(sample)
            braked_s += DT if sample.brake_command < 0.0 else 0.0
            assert not check.is_brake_confirmed or braked_s > 5.0
        assert check.is_brake_confirmed is is_confirmed


def test_a_quantity_at_the_limit_of_what_is_usual_is_named() -> None:
    check = InputCheck(KnownForce(FILE))
    check._accepted.x[GAIN] = 1.0 - 2.45 * USUAL[GAIN - 1].std
    assert check.at_limit((GAIN,)) == 'the traction by ato/force and ato/mass is at the limit of what is usual'
    assert check.at_limit((BRAKE,)) == ''


def test_a_resistance_that_no_healthy_train_has_is_told() -> None:
    """The force is 6 N/kN too large, which looks like that; the drag in the train file is a quarter too small."""
    for drive, is_told in ((driven(300.0), False), (driven(300.0, offset=6.0), True)):
        check, told = InputCheck(KnownForce(FILE)), ''
        for sample in samples_of(drive):
            check.take(sample)
            told = told or check.resistance_objection()
        assert ('off that of the train file' in told) is is_told, told


@pytest.mark.parametrize(('factor', 'told'), [(1.05, ' +5% off'), (0.93, ' -7% off'), (1.015, '')])
def test_a_wheel_that_scales_speed_and_position_alike_shows_on_the_line(factor: float, told: str) -> None:
    drive, check = driven(900.0), InputCheck(KnownForce(FILE))
    drive.speed *= factor
    drive.position = drive.position[0] + factor * (drive.position - drive.position[0])
    for sample in samples_of(drive):
        check.take(sample)
    assert told in check.scale_objection() if told else check.scale_objection() == ''
    assert check.verdict.finding == ''


@pytest.mark.parametrize(('off', 'is_told'), [(1.0, True), (-0.8, True), (0.2, False)])
def test_a_gradient_off_the_line_on_average_is_told(off: float, is_told: bool) -> None:
    """As by the zero of an inclinometer; errors of a map that change along the line do not matter."""
    drive, check = driven(900.0), InputCheck(KnownForce(replace(FILE, line=replace(FILE.line, gradient_std=0.2))))
    drive.gradient += off + 0.3 * np.sin(2.0 * math.pi * drive.position / 800.0)
    for sample in samples_of(drive):
        check.take(sample)
    assert ('per mille off line.gradient' in check.slope_objection()) is is_told
    assert check._slope.mean == pytest.approx(off, abs=0.3)
    assert check.verdict.finding == ''


def test_a_speed_behind_a_low_pass_is_not_off_its_position() -> None:
    drive, gain = driven(900.0), 1.0 - math.exp(-DT / 0.4)
    drive.speed = lfilter([gain], [1.0, gain - 1.0], drive.speed)
    check = InputCheck(KnownForce(FILE))
    verdicts = {check.take(sample) for sample in samples_of(drive)}
    assert not [said for said in verdicts if 'position' in said.finding + said.suspicion]
    assert check._lag.mean == pytest.approx(0.4, abs=0.1)


def test_the_noise_of_a_position_makes_no_speed_odd_and_no_fault() -> None:
    drive, check = driven(600.0), InputCheck(KnownForce(FILE))
    drive.position += np.random.default_rng(5).normal(0.0, 3.0, drive.position.size)  # m, as of satellites
    verdicts, odd = set(), []
    for sample in samples_of(drive):
        verdicts.add(check.take(sample).finding)
        odd.append(check.is_speed_odd)
    assert verdicts == {''}
    assert np.mean(odd) < 0.15  # as without the noise, by the jerks of this drive


def test_the_noise_of_a_speed_shows_soon_and_is_kept_at_a_stand() -> None:
    drive, check = driven(40.0), InputCheck(KnownForce(FILE))
    drive.speed += 0.1 * np.random.default_rng(7).standard_normal(drive.speed.size)
    verdicts, stds = set(), []
    for sample in samples_of(drive):
        verdicts.add(check.take(sample))
        stds.append(check.blocks.noise.std)
    assert stds[round(20.0 / DT)] > 0.04
    assert verdicts == {Verdict()}
    for k in range(150):
        check.take(coasting_sample(START + (200 + k) * NS_PER_S // 5, DT, 0.0))
    assert check.blocks.noise.std == stds[-1]


@pytest.mark.parametrize(('late_s', 'expected'), [(0.0, ''), (1.0, ' before it should'), (-0.8, '')])
def test_a_force_that_brakes_before_its_command_is_told(late_s: float, expected: str) -> None:
    """The balance of forces is the same for all three: the reported force is right."""
    drive, check = driven(300.0), InputCheck(KnownForce(FILE))
    drive.command = np.roll(drive.command, round(late_s / DT))
    told = set()
    for sample in samples_of(drive):
        check.take(sample)
        told.add(check.timing_objection())
    assert any(expected in text for text in told) if expected else told == {''}


def test_the_lead_of_a_force_against_regression_and_with_braking_without_a_command() -> None:
    """Without outliers nearly the mean of least squares with the prior; blocks without a command change nothing."""
    rng, lead, used = np.random.default_rng(1), 0.8, Lasting(force_lead(0.5))
    prior = used.variance
    brakes = np.repeat(rng.uniform(-90.0, -20.0, 60), 4)
    blocks = [Block(seconds=0.5, state=MOVING, brake=b) for b in brakes]
    sum_HH, sum_Hy = 1.0 / prior, used.usual.mean / prior
    for before, block, after in zip(blocks, blocks[1:], blocks[2:], strict=False):
        H = after.brake - before.brake
        block.force = block.brake + lead * H + rng.normal(0.0, 1.0)
        weight = (3.0 + 0.25 * max(abs(block.brake), abs(block.force))) ** -2
        if abs(H) >= MIN_BRAKE and block.force <= 0.0:
            sum_HH, sum_Hy = sum_HH + weight * H * H, sum_Hy + weight * H * (block.force - block.brake)
        learn_lead(used, before, block, after)
    assert used.mean == pytest.approx(sum_Hy / sum_HH, abs=0.05)
    assert 1.0 / sum_HH < used.variance < prior / 4.0
    mean, free = used.mean, Block(seconds=0.5, state=MOVING)
    learn_lead(used, free, Block(seconds=0.5, state=MOVING, force=-60.0), free)
    assert used.mean == mean


def test_a_finding_that_holds_an_estimator_is_not_replaced_by_one_that_does_not() -> None:
    """A speed that drifts against its position at last explains it worse than a position that follows nothing."""
    drive = driven(900.0)
    drive.speed = drive.speed + 0.02 * DT * np.arange(len(drive.speed))
    check = InputCheck(KnownForce(FILE))
    found = [check.take(sample) for sample in samples_of(drive)]
    first = next(k for k, verdict in enumerate(found) if verdict.finding)
    assert all(Input.SPEED in TABLE[verdict.row].condemns for verdict in found[first:])


@pytest.mark.parametrize('phase', range(3))
def test_a_gap_at_any_place_of_a_block_leaves_a_state_that_can_be_restored(phase: int) -> None:
    check = InputCheck(KnownForce(FILE))
    for k, sample in enumerate(samples_of(driven(30.0))):
        sample.dt = math.nan if k == 90 + phase else sample.dt
        check.take(sample)
        if k >= 90:
            other = InputCheck(KnownForce(FILE))
            restore(other, encode(check))
            assert encode(other) == encode(check)


def test_a_driver_who_pulls_against_a_new_command_is_no_late_brake() -> None:
    """Also by a row that has no brake yet, traction beside the command that was given costs something."""
    late = next(k for k, row in enumerate(TABLE) if row.late is Input.BRAKE)
    forces, known = Forces(KnownForce(FILE)), Prior(TABLE[late])
    now, before = Block(seconds=0.5, speed=10.0, force=5.0, brake=-30.0), Block(seconds=0.5, speed=10.0, force=35.0)
    forces.correct(known, now, now, before)
    assert forces.mismatch == pytest.approx(5.0 / (3.0 + 0.25 * 5.0))


def test_a_state_in_the_middle_continues_as_if_nothing_had_happened() -> None:
    """Also while rows are followed, and while a fault is found."""
    drive = faulty(next(row for row in TABLE if row.sentence == 'ato/force is in lbf'))
    whole, moments = InputCheck(KnownForce(FILE)), (77, 400, 1501)
    continued: list[InputCheck] = []
    for k, sample in enumerate(samples_of(drive)):
        whole.take(sample)
        for other in continued:
            other.take(sample)
        if k in moments:
            continued.append(InputCheck(KnownForce(FILE)))
            restore(continued[-1], encode(whole))
    assert whole.verdict.finding
    for other in continued:
        assert encode(other) == encode(whole)
        assert other.verdict == whole.verdict


def test_a_state_that_does_not_fit_changes_nothing() -> None:
    check = InputCheck(KnownForce(FILE))
    before = encode(check)
    with pytest.raises(InputError, match='InputCheck'):
        restore(check, before.replace('"_place"', '"_spot"'))
    assert encode(check) == before


def test_a_force_off_in_braking_alone_does_not_hold_the_resistance() -> None:
    drive = driven(600.0)
    force = np.where(drive.force < 0.0, 0.7 * drive.force, drive.force)
    check = InputCheck(KnownForce(FILE))
    held = [TABLE[check.take(sample).row].holds_resistance for sample in samples_of(replace(drive, force=force))]
    assert not any(held)


def test_unknown_inputs_are_no_fault() -> None:
    check = InputCheck(KnownForce(FILE))
    for k, sample in enumerate(samples_of(driven(120.0))):
        name = ('position', 'force_mean', 'gradient_mean', 'brake_command', 'dt', 'force')[k // 50 % 6]
        setattr(sample, name, math.nan)
        assert check.take(sample) == Verdict()
    restore(InputCheck(KnownForce(FILE)), encode(check))


def reference(trial: Trial, forces: Forces, block: Block) -> tuple[Array, Array]:
    """Return the predicted mean and covariance of a healthy row by matrices."""
    x, P = np.array(list(trial.x)), full(list(trial.P))
    d = np.array([1.0, *(math.exp(-block.seconds / usual.time_s) for usual in USUAL)])
    mean, std = np.array([0.0, *(u.mean for u in USUAL)]), np.array([0.0, *(u.std for u in USUAL)])
    x[1:] = mean[1:] + d[1:] * (x[1:] - mean[1:])
    P = np.diag(d) @ P @ np.diag(d) + np.diag((1.0 - d * d) * std * std)

    def after(state: Array) -> float:
        v, offset, wind, gain, brake, force_late, brake_late = state
        w = 1.5 + 0.03 * v + 0.004 * v * (v + 2.0 * wind)
        pull = forces.traction + force_late * forces.traction_rate
        slow = forces.brake - brake_late * (0.6 + 0.4) * forces.brake_rate
        total = gain * pull + brake * slow - forces.gradient - forces.extra - w - offset
        return float(v + block.seconds * G / (1000.0 * (1.0 + GAMMA)) * total)

    F, step = np.eye(7), 1e-4
    F[0] = [(after(x + step * row) - after(x - step * row)) / (2.0 * step) for row in np.eye(7)]
    x[0] = after(x)
    h = block.seconds * G / (1000.0 * (1.0 + GAMMA))
    return x, F @ P @ F.T + np.diag([h * h * forces.variance, 0, 0, 0, 0, 0, 0])


def full(upper: list[float]) -> Array:
    """Return a symmetric matrix of shape (7, 7) from its upper triangle."""
    P = np.zeros((7, 7))
    P[np.triu_indices(7)] = upper
    return P + np.triu(P, 1).T


def test_one_step_of_the_filter_by_matrices() -> None:
    rng, trial = np.random.default_rng(3), Trial(0)
    root = rng.normal(size=(7, 7)) * 0.05
    fill(trial.x, [12.0, 0.7, 0.1, 1.05, 0.9, 0.15, -0.1])
    fill(trial.P, (root @ root.T)[np.triu_indices(7)].tolist())
    block = Block(seconds=0.6, speed=12.3, speed_step=0.3, force=55.0, force_step=12.0, brake=-9.0, brake_step=-5.0)
    forces = Forces(KnownForce(FILE))
    forces.correct(Prior(TABLE[0]), block, block, block)
    forces.gradient, forces.extra = 4.0, 0.5
    x, P = reference(trial, forces, block)
    decay = trial.x[:]
    fill(decay, [1.0, *(math.exp(-block.seconds / usual.time_s) for usual in USUAL)])
    trial.predict(forces, block, decay, accepted=False)
    np.testing.assert_allclose(list(trial.x), x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(full(list(trial.P)), P, rtol=1e-5, atol=1e-8)
    # Student's t with 4 degrees of freedom, whose weight inflates the variance of the measurement.
    R, nu = 0.01, 12.35 - x[0]
    S = P[0, 0] + R
    score = -2.5 * math.log(1.0 + nu * nu / S / 4.0) - 0.5 * math.log(S / R)
    weight = min(5.0 / (4.0 + nu * nu / S), 1.0)
    K = P[:, 0] / (P[0, 0] + R / weight)
    assert trial.correct(12.35, R) == pytest.approx(score, rel=1e-5)
    np.testing.assert_allclose(list(trial.x), x + K * nu, rtol=1e-5)
    np.testing.assert_allclose(full(list(trial.P)), P - np.outer(K, P[0]), rtol=1e-4, atol=1e-8)


def fill(vector: Any, values: list[float]) -> None:
    """Set the numbers of a vector."""
    for k, value in enumerate(values):
        vector[k] = value


def test_forces_by_hand() -> None:
    """A brake of 30 N/kN and a reported force of -20 N/kN: the driver pulls 10 N/kN against it."""
    forces = Forces(KnownForce(FILE))
    block = Block(seconds=0.5, speed=10.0, force=-20.0, force_step=2.0, brake=-30.0, brake_step=-1.0, rate=0.9)
    forces.correct(Prior(TABLE[0]), block, block, block)
    assert forces.traction == pytest.approx(10.0)
    assert forces.traction_rate == pytest.approx((2.0 + 1.0) / 0.5)
    assert forces.brake == pytest.approx(0.9 * -30.0)
    assert forces.mismatch == pytest.approx(10.0 / (3.0 + 0.25 * 30.0 + 0.5 * 2.0))
    in_g = Prior(next(row for row in TABLE if row.sentence == 'ato/brake_command is in g'))
    forces.correct(in_g, block, block, block)
    assert forces.traction == pytest.approx(-20.0 + G * 30.0)


def test_students_t() -> None:
    assert student_t(0.0, 1.0) == (0.0, 1.0)
    score, weight = student_t(1e6, 1.0)
    assert score == -4.0
    assert weight == pytest.approx(5e-6, rel=1e-3)


def test_a_row_keeps_its_own_opinion() -> None:
    """The row of a force that is too small does not take over the gain that was learned without it."""
    small = next(k for k, row in enumerate(TABLE) if row.force == 2.0)
    healthy, trial = Trial(0), Trial(small)
    fill(healthy.x, [10.0, 1.0, 0.1, 1.1, 0.8, 0.2, 0.1])
    trial.start(healthy, 0)
    assert trial.x[GAIN] == 1.0
    assert trial.x[BRAKE] == 0.8

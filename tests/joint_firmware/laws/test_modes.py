"""What each mode asks of the motor, and that no change of mode or gains lets it jump."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from joint_firmware.config import LAW_NAMES
from joint_firmware.laws import signals as law
from tests.joint_firmware.laws.rig import ANKLE, DT, HIP, KNEE, MODES, Drive, Held
from tests.joint_firmware.laws.test_sensing import f

JOINTS = {"valve": KNEE}


def settled(drive, counts, u, ticks=400):
    for _ in range(ticks):
        drive(counts, u)
    return drive


# --- steady states --------------------------------------------------------------------------------------------------


def test_open_loop_gives_the_motor_what_is_commanded_whatever_is_sensed():
    drive = Drive()
    settled(drive, drive.counts(0.1, 33.0), drive.command("open loop", torque=12.0))
    assert drive.effort == pytest.approx(12.0, abs=drive.resolution)


def test_open_loop_is_within_limits_of_size_rate_and_soft_stops():
    drive, high = Drive(), HIP.limits[1]
    steps = []
    for _ in range(8):
        before = drive.effort
        drive(drive.counts(), drive.command("open loop", torque=40.0))
        steps.append(drive.effort - before)
    assert max(steps) <= 20000.0 * DT + 2 * drive.resolution and drive.effort == pytest.approx(40.0, abs=0.1)
    settled(drive, drive.counts(), drive.command("open loop", torque=400.0, limit=25.0))
    assert drive.effort == pytest.approx(25.0, abs=drive.resolution)
    settled(drive, drive.counts(high + 0.1), drive.command("open loop"), 2000)
    assert drive.effort == pytest.approx(-20.0, abs=drive.resolution) and drive.y[law.Y_LIMITED]


@given(st.floats(-0.9, 0.4), st.floats(-15, 15), st.floats(-0.02, 0.02))
@settings(max_examples=20)
def test_motor_position_through_the_linkage(q, torque, error):
    """Kim 2018 (5.22), (5.23): stiffness on the motor's position, which leads by the deflection under the torque."""
    drive, k = Drive(ANKLE), ANKLE.actuator.stiffness
    ratio = (f(ANKLE, q + 1e-6) - f(ANKLE, q - 1e-6)) / 2e-6
    effort = torque / ratio
    phi = f(ANKLE, q) + effort / k + error  # the joint at q bears the torque, the motor is ahead by ``error``
    measured = phi - effort / k
    settled(drive, drive.counts(phi, effort), drive.command("motor position", torque=torque, position=q), 3000)
    at = (f(ANKLE, drive.y[law.Y_POSITION_SI] + 1e-6) - f(ANKLE, drive.y[law.Y_POSITION_SI] - 1e-6)) / 2e-6
    lead = f(ANKLE, q) + torque / at / k
    expected = torque / at + drive.config.position_stiffness * (lead - phi)
    assert f(ANKLE, drive.y[law.Y_POSITION_SI]) == pytest.approx(measured, abs=1e-9)
    assert drive.effort == pytest.approx(np.clip(expected, -150.0 / at, 150.0 / at), abs=drive.resolution + 1e-6)


@pytest.mark.parametrize("mode, which", [("joint position", "joint"), ("impedance", "impedance")])
def test_joint_loops_are_a_spring_and_damper_at_the_joint_around_the_torque_loop(mode, which):
    drive = Drive()
    c = drive.counts(0.3 + 5.0 / HIP.actuator.stiffness, 5.0)  # the joint at 0.3, its spring bears 5 N m
    u = drive.command(mode, torque=4.0, position=0.35, velocity=0.2, kp=2.0, kd=0.0)
    settled(drive, c, u)
    stiffness, damping = (getattr(drive.config, f"{which}_{part}") for part in ("stiffness", "damping"))
    wanted = 4.0 + stiffness * 0.05 + damping * 0.2
    assert drive.state("torque_reference") == pytest.approx(wanted)
    assert drive.effort == pytest.approx(wanted + 2.0 * (wanted - 5.0), abs=drive.resolution)


def test_a_torque_command_of_a_linkage_is_followed_at_the_joint():
    """At rest the actuator's effort times the linkage's ratio is the commanded torque, whatever the posture."""
    for q in (-0.9, 0.0, 0.5):
        drive, held = Drive(ANKLE, rate="5kHz", report_rate="1kHz"), Held(ANKLE, 1 / 5000)
        output = f(ANKLE, q)
        for _ in range(15000):
            drive(drive.counts(output + held.x[0], held.torque), drive.command(torque=30.0, kp=4.0, ki=300.0, kd=94.0))
            held.step(drive.effort)
        assert drive.y[law.Y_TORQUE_SI] == pytest.approx(30.0, abs=0.05)
        assert drive.y[law.Y_POSITION_SI] == pytest.approx(q, abs=1e-6)


# --- anti-windup ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["PID_m", "PD_m+DOB", "cascade", "valve"])
def test_after_a_second_at_its_limit_the_effort_comes_back_when_the_torque_is_there(name):
    joint = JOINTS.get(name, HIP)
    drive = Drive(joint, law=name, torque_limit="500N m", velocity_integral=20.0)
    u = drive.command(torque=140.0, kp=2.0, ki=20.0, kd=1.0)
    settled(drive, drive.counts(), u, 3000)
    assert drive.effort == pytest.approx(drive.full, abs=drive.resolution) and drive.y[law.Y_LIMITED]
    # now the torque is 60 N m above what is wanted: an effort without memory would be 140 − 2 · 60 or less
    for _ in range(150):  # 50 ms, the observer's time
        drive(drive.counts(0.0, 200.0), u)
    assert drive.effort < drive.full - 60.0


# --- bumpless -------------------------------------------------------------------------------------------------------

gains = st.fixed_dictionaries({
    "kp": st.floats(0, 6), "ki": st.sampled_from([0.0, 20.0]), "kd": st.floats(0, 15),
})  # fmt: skip
commands = st.fixed_dictionaries({
    "torque": st.floats(-30, 30), "position": st.floats(-0.3, 0.3), "velocity": st.floats(-0.5, 0.5),
})  # fmt: skip


def motion(drive, modes, command, before, after, phi, effort, velocity):
    """Efforts in the tick before a change and in its own, of a drive in ``motion`` that goes from mode to mode."""
    for n in range(121):
        c = drive.counts(phi + velocity * DT * n, effort + 10.0 * math.sin(0.1 * n))
        last = drive.effort
        mode, gain_set = (modes[0], before) if n < 120 else (modes[1], after)
        drive(c, drive.command(mode, **command, limit=40.0, **gain_set))
    return last, drive.effort


@pytest.mark.parametrize("name", LAW_NAMES)
@given(
    st.sampled_from([*itertools.permutations(MODES, 2), *((mode, mode) for mode in MODES)]),
    commands, gains, gains, st.tuples(st.floats(-0.2, 0.2), st.floats(-20, 20), st.floats(-0.3, 0.3)),
)  # fmt: skip
@settings(max_examples=60)
def test_no_change_of_mode_or_gains_moves_the_motor_by_more_than_the_rate_limit(
    name, modes, command, before, after, moving
):
    drive, stays = (Drive(JOINTS.get(name, HIP), law=name) for _ in range(2))
    last, now = motion(drive, modes, command, before, after, *moving)
    rate = drive.config.torque_rate * DT
    if modes[0] != modes[1] and {"none", "damping"} & set(modes):  # begins or ends to control: on from where it was
        assert abs(now - last) <= max(rate, drive.full * DT / 0.01) + 2 * drive.resolution
        return
    # beside a drive in the same motion that stays as it is, set-points may have gone apart by the rate limit; the
    # torque loop makes (1 + kp) of that, a valve's kp
    _, beside = motion(stays, (modes[0], modes[0]), command, before, before, *moving)
    gain = 1.01 * (1 + max(before["kp"], after["kp"]))
    explained = 0.0 if modes[0] == modes[1] else 2 * gain * rate
    assert abs(now - beside) <= explained + 2 * drive.resolution


def test_an_inner_integral_whose_gain_is_taken_away_fades():
    drive = Drive(law="cascade", velocity_integral=20.0)
    c, u = drive.counts(0.0, 10.0), drive.command(torque=15.0, kp=1.0, kd=0.0)
    settled(drive, c, u, 900)
    before = drive.state("velocity_integral")
    drive.configure(velocity_integral=0.0)
    settled(drive, c, u, 300)
    assert before == pytest.approx(20.0 * 5.0 * 0.3, rel=0.01)
    assert drive.state("velocity_integral") == pytest.approx(before * math.exp(-1.0), rel=0.01)


@pytest.mark.parametrize("name", LAW_NAMES)
def test_what_a_change_of_gains_carries_on_fades_in_10_ms(name):
    joint = JOINTS.get(name, HIP)
    drive = Drive(joint, law=name)
    c = drive.counts(0.0, 10.0)
    settled(drive, c, drive.command(torque=15.0, kp=2.0))
    drive(c, drive.command(torque=15.0, kp=4.0))
    carried = drive.state("carry")
    if name != "PD_m+DOB":  # its observer has made more of the error that stays
        assert carried == pytest.approx((2.0 - 4.0) * 5.0, rel=0.05)  # a thirtieth of it has faded
    settled(drive, c, drive.command(torque=15.0, kp=4.0), 30)
    assert drive.state("carry") == pytest.approx(carried * math.exp(-1.0), rel=0.02)

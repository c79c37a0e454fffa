"""What the drive senses through a linkage and a load cell, against its geometry and finite differences."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from joint_firmware.laws import signals as law
from joint_firmware.laws.sensing import ThroughLinkage
from tests.joint_firmware.laws.rig import ANKLE, DT, KNEE, Drive

joints = st.sampled_from([ANKLE, KNEE])
MAPS = {joint.name: ThroughLinkage(joint.actuator.linkage) for joint in (ANKLE, KNEE)}


def f(joint, q):
    return float(ca.DM(MAPS[joint.name].to_motor(q)))


@given(joints, st.floats(0, 1))
def test_the_map_is_the_triangle_of_the_linkage(joint, share):
    """The side opposite to the angle at the joint, by its end points."""
    low, high = joint.limits
    q, link = low + share * (high - low), joint.actuator.linkage
    side = [math.dist((link.base, 0.0), (link.crank * math.cos(a), link.crank * math.sin(a)))
            for a in (q + link.offset, link.nominal + link.offset)]  # fmt: skip
    assert f(joint, q) * joint.actuator.nominal_arm == pytest.approx(side[0] - side[1], abs=1e-12)


@given(joints, st.floats(-4.0, 4.0))
def test_the_map_is_inverted_and_differentiated_also_beyond_its_range(joint, q):
    joint_map, h = MAPS[joint.name], 1e-6
    assert float(ca.DM(joint_map.to_joint(f(joint, q)))) == pytest.approx(q, abs=1e-6)
    slope = (f(joint, q + h) - f(joint, q - h)) / (2 * h)
    assert float(ca.DM(joint_map.ratio(q))) == pytest.approx(slope, abs=1e-5)


@given(joints, st.floats(0, 1), st.floats(-50, 50))
def test_position_and_torque_of_the_joint_behind_its_linkage(joint, share, effort):
    """Torque is the derivative of the actuator's length by the joint's angle, times its force (virtual work)."""
    low, high = joint.limits
    q, h = low + share * (high - low), 1e-6
    drive = Drive(joint)
    deflection = effort / joint.actuator.stiffness if joint is ANKLE else 0.0
    y = drive(drive.counts(f(joint, q) + deflection, effort), drive.command("none")).y
    arm = (f(joint, q + h) - f(joint, q - h)) / (2 * h) * joint.actuator.nominal_arm
    assert y[law.Y_POSITION_SI] == pytest.approx(q, abs=1e-9)
    assert y[law.Y_TORQUE_SI] == pytest.approx(effort / joint.actuator.nominal_arm * arm, rel=1e-6, abs=1e-9)
    assert f(joint, y[law.Y_RELAXED_SI]) == pytest.approx(f(joint, q) + deflection, abs=1e-9)


@pytest.mark.parametrize("joint", [ANKLE, KNEE], ids=lambda j: j.name)
def test_velocity_of_the_joint_behind_its_linkage(joint):
    drive, q, dq = Drive(joint), joint.limits[0], 1.5
    for n in range(600):
        q += dq * DT
        drive(drive.counts(f(joint, q)), drive.command("none"))
        if n > 60:
            assert drive.y[law.Y_VELOCITY] * 1e-5 == pytest.approx(dq, rel=5e-3)


@given(joints, st.lists(st.integers(-(2**31), 2**31 - 1), min_size=9, max_size=9), st.sampled_from(sorted(range(8))))
def test_no_count_makes_the_law_s_numbers_infinite_or_undefined(joint, counts, mode):
    drive = Drive(joint)
    names = ["torque", "position", "damping", "open loop", "motor position", "joint position", "impedance", "none"]
    for _ in range(2):
        drive(np.array(counts, float), drive.command(names[mode], torque=1.0, position=0.3))
    assert np.isfinite(drive.x).all() and np.isfinite(drive.y).all()

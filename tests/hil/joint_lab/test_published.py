"""Printed gains as a drive is set to them."""

import pytest

from hil.joint_lab import published
from robots import description

HUME, VLCA = description.load("hume"), description.load("vlca")


def test_damping_of_the_screw_becomes_that_of_the_joint(experiment):
    """At r0, effort r0 F and angle x / r0: K_d,m N_m dx/dt is (K_d,m N_m r0²) dphi/dt / r0."""
    setup = experiment("vlca", "ankle")
    r0 = VLCA.joints[0].actuator.linkage.nominal_arm
    assert setup.firmware.stance.kd == pytest.approx(15 * 3316 * r0**2)
    assert (setup.firmware.stance.kp, setup.firmware.stance.ki) == (4.0, 300.0)
    assert setup.firmware.observer_cutoff == 15.0


def test_tables_name_every_joint_of_hume():
    for table in published.HUME.values():
        for gains in table.values():
            assert set(gains) == set(HUME.joint_names)


def test_numbers_are_those_of_tables_2_1_and_7_1():
    """Kim 2018, each printed number once."""
    swing, stance = published.HUME["7.1"]["swing"], published.HUME["7.1"]["stance"]
    assert [swing[j] for j in ("left_abduction", "right_hip", "left_hip", "right_knee", "left_knee")] == [
        (3.09, 0.19), (58.57, 5.86), (32.70, 3.48), (49.75, 6.85), (26.1, 4.15)
    ]  # fmt: skip
    assert [stance[f"right_{j}"] for j in ("abduction", "hip", "knee")] == [(2.84, 0.15), (43, 0), (22, 0)]
    swing, stance = published.HUME["2.1"]["swing"], published.HUME["2.1"]["stance"]
    assert [swing[j] for j in ("right_hip", "left_hip", "right_knee", "left_knee")] == [
        (200, 22), (180, 15), (260, 35), (255, 30)
    ]  # fmt: skip
    assert set(stance.values()) == {(65, 0)}


def test_meka_s_gains_ask_the_motor_for_velocity():
    """1 N m of error asks for K_P rad/s of the motor, K_P / gear of the joint; the inner loop makes kd N m of each."""
    knee = HUME.joint("left_knee")
    gains = published.MekaGains(122.0, 12.2).of_cascade(knee, kd=10.0)
    assert (gains.kp, gains.ki, gains.kd) == pytest.approx((10.0, 1.0, 10.0))


def test_other_actuators_have_no_such_gains():
    with pytest.raises(ValueError, match="tables are Hume's"):
        published.MekaGains(1.0, 0.0).of_cascade(VLCA.joints[0], kd=10.0)
    assert published.settings(HUME.joints[0]) == []

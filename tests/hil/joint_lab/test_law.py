"""Linearised laws against hand-derived z-transfer functions, the firmware's own function, and continuous time."""

import math

import casadi as ca
import numpy as np
import pytest

from bus.messages import GainSet, Mode
from hil.joint_lab.continuous import FEEDBACKS
from hil.joint_lab.law import gains_of, sampled_law, without_rounding
from hil.joint_lab.sampled import response
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import drive_law, signals
from joint_firmware.protection_config import UNPROTECTED
from robots import description, pins

KNEE = description.load("hume").joint("left_knee")
ANKLE = description.load("vlca").joint("ankle")
GAINS = {"kp": 4.0, "ki": 20.0, "kd": "10 N m s/rad"}
OMEGA = np.geomspace(1.0, 3000.0, 40)


def config(law, **more):
    return FirmwareConfig.model_validate({"law": law, "stance": GAINS, "swing": GAINS, **more})


def transfer(joint, firmware, **more):
    law = sampled_law(joint, firmware, GainSet.SWING, **more)
    z = np.exp(1j * OMEGA * law.period)
    return z, response(law.system, z)[:, 0]


def velocity(z, firmware):
    """Differenced encoder behind the first-order filter, over the angle."""
    pole, dt = math.exp(-2 * math.pi * firmware.velocity_cutoff / firmware.rate), 1 / firmware.rate
    return (1 - pole) / (1 - pole / z) * (1 - 1 / z) / dt


@pytest.mark.parametrize("joint", [KNEE, ANKLE], ids=["sea", "vlca"])
@pytest.mark.parametrize("law", ["PD_m", "PID_m"])
def test_pid_is_the_hand_derived_one(joint, law):
    firmware = config(law)
    z, found = transfer(joint, firmware)
    integral = 20.0 / firmware.rate / (z - 1) if law == "PID_m" else 0 * z
    k = joint.actuator.stiffness
    by_hand = np.stack([-10.0 * velocity(z, firmware), -k * (4.0 + integral), 5.0 + integral], axis=1)
    np.testing.assert_allclose(found, by_hand, rtol=1e-9, atol=1e-7)


def test_pd_f_is_the_hand_derived_one():
    """Tustin's method, prewarped: s becomes (z − 1)/(z + 1) / h, h = tan(w dt/2) / w."""
    firmware = config("PD_f", torque_rate_cutoff="60Hz")
    z, found = transfer(KNEE, firmware)
    w = 2 * math.pi * 60.0
    s = (z - 1) / (z + 1) * w / math.tan(0.5 * w / firmware.rate)
    low = w**2 / (s**2 + math.sqrt(2) * w * s + w**2)
    np.testing.assert_allclose(found[:, 1], -KNEE.actuator.stiffness * 4.0 - 10.0 * s * low, rtol=1e-9)
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-9)


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade"])
@pytest.mark.parametrize("joint", [KNEE, ANKLE], ids=["sea", "vlca"])
def test_at_a_high_rate_every_law_is_that_of_the_source(law, joint):
    firmware = config(law, rate="1MHz", report_rate="1MHz", velocity_cutoff="100kHz")
    _, found = transfer(joint, firmware)
    actuator = _linear(joint)
    feedback, s = FEEDBACKS[law](actuator, gains_of(joint, firmware, GainSet.SWING)), 1j * OMEGA
    expected = -feedback.deflection(s) / feedback.denominator(s)
    np.testing.assert_allclose(found[:, 1], expected, rtol=0.01)
    damping = -s * feedback.velocity(s) / feedback.denominator(s)
    np.testing.assert_allclose(found[:, 0], damping, rtol=0.02, atol=1e-6)


def _linear(joint):
    from hil.joint_lab.setup import linear_actuator
    from plant.bench import Locked

    return linear_actuator(joint, Locked())


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade"])
def test_the_firmware_s_own_function_does_what_its_linear_model_says(law):
    """Random encoder counts and commands, far from every limit: the demands are equal but for the rounding."""
    firmware = config(law, torque_rate="1e9 N m/s", torque_limit="1e6 N m", protection=UNPROTECTED)
    joint = KNEE.model_copy(update={"actuator": KNEE.actuator.model_copy(update={"current_limit": 1e9})})
    drive, model = drive_law(joint, firmware), sampled_law(joint, firmware, GainSet.SWING).system
    parameters, u = drive.values(joint, firmware), np.zeros(signals.INPUT_SIZE)
    u[[signals.U_LIMIT, signals.U_TORQUE_MODE, signals.U_ENABLED]] = 1e9, 1.0, 1.0
    u[[signals.U_KP, signals.U_KI, signals.U_KD]] = 4.0, 20.0, 10.0
    x = np.zeros(len(drive.states))
    for _ in range(20):  # to rest
        x = np.array(drive.function(np.zeros(pins.N_INPUTS), x, u, parameters)[0]).ravel()
    state, random = np.zeros(len(model.a)), np.random.default_rng(3)
    for _ in range(200):
        counts = np.zeros(pins.N_INPUTS)
        counts[pins.MOTOR_ENCODER], counts[pins.SPRING_ENCODER] = random.integers(-50, 50, 2)
        u[signals.U_TORQUE] = random.normal()
        x_next, y = drive.function(counts, x, u, parameters)
        x = np.array(x_next).ravel()
        sensed = np.array([
            counts[pins.MOTOR_ENCODER] / joint.sensor.encoder,
            counts[pins.SPRING_ENCODER] / joint.spring_counts_per_rad,
            u[signals.U_TORQUE],
        ])  # fmt: skip
        amperes = (model.c @ state + model.d @ sensed)[0] / joint.actuator.torque_per_ampere
        state = model.a @ state + model.b @ sensed
        assert abs(float(y[signals.Y_DEMAND]) - amperes / joint.actuator.ampere_per_count) <= 0.5 + 1e-6


def test_without_its_torque_loop_a_drive_passes_the_torque_on():
    _, found = transfer(KNEE, config("PD_m"), mode=Mode.OPEN_LOOP)
    np.testing.assert_allclose(found, np.tile([0.0, 0.0, 1.0], (len(OMEGA), 1)), atol=1e-9)


def test_gains_of_the_other_set_and_of_one_joint_count():
    other = {**GAINS, "kp": 1.0}
    firmware = config("PD_m", stance=other, joints={"left_knee": {"stance": {"kp": 7.0}}})
    assert gains_of(KNEE, firmware, GainSet.STANCE).kp == 7.0
    law = sampled_law(KNEE, firmware, GainSet.STANCE)
    assert law.system.d[0, 2] == pytest.approx(8.0)


def test_only_floors_are_taken_out():
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.vertcat(ca.floor(3 * x[0] + 0.5), ca.fmin(ca.sin(x[1]), 0.2), -(x[0] ** 3))])
    smooth = without_rounding(function)
    found = np.array(smooth([0.3, 0.1])).ravel()
    np.testing.assert_allclose(found, [1.4, math.sin(0.1), -0.027])
    np.testing.assert_allclose(np.array(smooth([0.0, 1.0])).ravel(), [0.5, 0.2, 0.0])


def test_an_estimator_that_has_no_slope_at_rest_is_refused():
    """M/T holds its velocity while no edge comes: there is nothing to linearise."""
    for estimator in ("M", "T", "M/T"):
        with pytest.raises(ValueError, match="has no derivative"):
            sampled_law(KNEE, config("PD_m", velocity_estimator=estimator), GainSet.STANCE)

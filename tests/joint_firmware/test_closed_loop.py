"""One drive on the plant's actuator with the joint held: the torque loop against its continuous differential
equation and its steady state."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bus.messages import GainSet
from joint_firmware.drive import DriveState
from plant.actuators.bank import Symbols
from plant.actuators.model import ActuatorModel
from robots import pins

ISR = 3000
STEPS = 4  # of physics per interrupt


def held_joint(drive, ticks, friction=1.0, start=(0.0, 0.0), silent=False, **setpoint):
    """Run ``drive`` on its actuator, joint at zero. Returns rotor (angle, velocity) before every tick."""
    a = drive.joint.actuator
    model = ActuatorModel.of(a)
    step = Symbols([model], 1.0 / (ISR * STEPS)).step()
    p = np.array([
        value * (friction if name in model.friction else 1.0) for name, value in model.parameters().items()
    ])  # fmt: skip
    state, rows, demand = np.array([*start, *list(model.rest(0.0).values())[2:]]), [], 0.0
    for tick in range(ticks):
        rows.append(state[:2])
        drive.inputs[pins.MOTOR_ENCODER] = np.rint(drive.joint.sensor.encoder * state[0])
        drive.inputs[pins.SPRING_ENCODER] = np.rint(drive.joint.spring_counts_per_rad * state[0])
        drive.tick(*([] if silent or tick % 2 else [drive.frame(0x0F, **setpoint)]))
        for _ in range(STEPS):
            state = np.array(step(state, demand * drive.enabled, a.supply_voltage, 0.0, 0.0, p)[0]).ravel()
        # takes effect at the next interrupt
        demand = drive.outputs[pins.CURRENT_DEMAND] * pins.AMPERE_PER_COUNT
    return np.array(rows)


def continuous(drive, gains, wanted, times):
    """The loop as a differential equation: rotor, velocity filter, integral, reference at its rate limit."""
    a, config = drive.joint.actuator, drive.config
    cutoff = 2 * np.pi * config.velocity_cutoff

    def flow(t, z):
        theta, dtheta, filtered, integral = z
        reference = min(wanted, config.torque_rate * t)
        error = reference - a.stiffness * theta
        motor = reference + gains.kp * error + integral - gains.kd * filtered
        ddtheta = (motor - a.stiffness * theta - (a.damping + a.viscous) * dtheta) / a.rotor_inertia
        return [dtheta, ddtheta, cutoff * (dtheta - filtered), gains.ki * error]

    solution = solve_ivp(flow, (0.0, times[-1]), np.zeros(4), t_eval=times, rtol=1e-8, max_step=1e-3)
    return a.stiffness * solution.y[0]


@pytest.mark.parametrize("joint", ["right_abduction", "right_hip", "left_knee"])
@pytest.mark.parametrize(("gain_set", "name"), [(GainSet.STANCE, "stance"), (GainSet.SWING, "swing")])
def test_a_step_of_torque_follows_the_continuous_loop(bench, joint, gain_set, name):
    drive = bench(joint).enable(gain_set=gain_set)
    rows = held_joint(drive, 900, friction=0.0, torque=15.0, gain_set=gain_set)
    torque = drive.joint.actuator.stiffness * rows[:, 0]
    expected = continuous(drive, getattr(drive.config, name), 15.0, np.arange(900) / ISR)
    # a sample, a shadow register and half a hold: the real loop is about two interrupts late
    slope = np.abs(np.diff(expected)).max()
    assert np.abs(torque - expected).max() < 2.5 * slope + 0.1
    assert torque[-100:] == pytest.approx(expected[-100:], abs=0.1)


@pytest.mark.parametrize("law", ["PD_f", "PD_m", "PID_m", "PD_m+DOB", "cascade"])
def test_without_friction_the_torque_settles_at_its_reference(bench, law):
    drive = bench(law=law).enable()
    rows = held_joint(drive, 1500, friction=0.0, torque=20.0)
    count = abs(drive.joint.sensor.torque_resolution)
    assert drive.joint.actuator.stiffness * rows[-1, 0] == pytest.approx(20.0, abs=count + drive.resolution)
    assert drive.state is DriveState.OPERATION_ENABLED
    assert drive.report.torque == pytest.approx(20.0, abs=2 * count)


@pytest.mark.parametrize("torque", [15.0, 40.0])
def test_with_friction_the_error_stays_within_what_friction_can_hold_against_the_gain(bench, torque):
    """At rest |tau_m − tau| <= static + load tau, and tau_m − tau = (1 + kp)(tau_d − tau)."""
    drive = bench().enable()
    rows = held_joint(drive, 1500, torque=torque)
    a = drive.joint.actuator
    sensed = a.stiffness * rows[-1, 0]
    assert rows[-1, 1] == 0.0
    assert abs(torque - sensed) <= (a.static + a.load_friction * sensed) / (1.0 + drive.config.stance.kp) + 0.1


@pytest.mark.parametrize("law", ["PD_m+DOB", "cascade"])
def test_the_observer_and_the_inner_integral_take_away_what_friction_holds_without_ki(bench, law):
    """On the mean of a third of a second: against stiction they hunt."""
    drives = [bench(law=name).enable() for name in ("PD_m", law)]
    errors = [
        abs(drive.joint.actuator.stiffness * held_joint(drive, 3000, torque=5.0)[-1000:, 0].mean() - 5.0)
        for drive in drives
    ]
    assert errors[1] < 0.5 * errors[0] and errors[0] > 0.5


def test_the_integral_breaks_friction_at_its_time_and_without_it_the_rotor_stays(bench):
    """1.5 N m: (1 + kp) tau_d is below the hip's static 9 N m in both gain sets; ki tau_d t adds the rest."""
    stance, swing = (
        held_joint(bench().enable(gain_set=s), 900, torque=1.5, gain_set=s)
        for s in (GainSet.STANCE, GainSet.SWING)
    )
    assert (stance == 0.0).all()
    moves = np.flatnonzero(swing[:, 0])[0] / ISR
    assert moves == pytest.approx((9.0 - 5.0 * 1.5) / (20.0 * 1.5), abs=0.06 / (20.0 * 1.5) + 3 / ISR)
    assert 360.0 * swing[-1, 0] > 0.5


@pytest.mark.parametrize("velocity", [-6.0, 6.0])
def test_a_drive_without_controller_brings_its_rotor_to_rest(bench, velocity):
    """Watchdog at 5 ms, damping until it is still: far faster than friction alone would do it."""
    drive = bench().enable()
    rows = held_joint(drive, 600, start=(0.0, velocity), friction=0.0, silent=True)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE
    a = drive.joint.actuator
    energy = 0.5 * a.rotor_inertia * rows[:, 1] ** 2 + 0.5 * a.stiffness * rows[:, 0] ** 2
    assert (np.diff(energy[60:]) <= 1e-6 * energy[0]).all()
    # overdamped: the slow eigenvalue is about −k/D = −12 1/s
    slow = np.roots([a.rotor_inertia, 30.0 + a.damping + a.viscous, a.stiffness]).max()
    assert rows[599, 0] / rows[299, 0] == pytest.approx(np.exp(slow * 0.1), rel=0.1)

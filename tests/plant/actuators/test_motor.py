"""Voltage, heat and the supply of a motor against closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq

from plant.actuators.bank import ActuatorBank
from robots import description

HUME, VLCA = description.load("hume"), description.load("vlca")
COPPER = 0.00393  # 1/K


def alone(robot, index=0, **change):
    """One joint's actuator as a bank of its own; returns it and the joint's angle and velocity."""
    joint = robot.joints[index]
    joint = joint.model_copy(update={"actuator": joint.actuator.model_copy(update=change)})
    robot = robot.model_copy(update={"joints": (joint,), "feet": ()})
    robot.__dict__.pop("joint_names", None)
    q, dq = np.zeros(1), np.zeros(1)
    return ActuatorBank(robot, 1e-4, 0.0, lambda f: f, q, dq), q, dq


def spin(bank, current, seconds, hold=None):
    """Run; the output turns freely with the motor unless ``hold`` says otherwise. Returns the last observation."""
    bank.current[:] = current
    for _ in range(round(seconds * 1e4)):
        bank.step()
    return bank.observe()


def free(robot, index=0):
    """Without spring and losses: a rotor alone."""
    bank = alone(robot, index)[0]
    for name in ("stiffness", "damping", "viscous"):
        bank.set(0, name, 0.0)
    return bank


def test_the_no_load_speed_is_that_of_the_data_sheet():
    """EC-max 40 (283870): 10100 rpm at 48 V with its no-load current; without friction V / k_tau."""
    bank, a = free(VLCA), VLCA.joints[0].actuator
    bank.set(0, "supply_power", 1e6)
    phi = spin(bank, 40.0, 1.0).motor_velocity[0]
    motor = phi * a.reduction * a.nominal_arm
    assert motor == pytest.approx(48.0 / 0.0448, rel=1e-3)
    assert motor * 60 / (2 * np.pi) == pytest.approx(10100, rel=0.02)
    assert bank.observe().current[0] == pytest.approx(0.0, abs=0.05)


def test_speed_falls_with_torque_as_the_data_sheet_says():
    """EC-max 40 (283870): 4.89 rpm per mN m."""
    bank, a = free(VLCA), VLCA.joints[0].actuator
    bank.set(0, "supply_power", 1e6)
    bank.set(0, "winding_capacity", 1e12)  # stays at 25 °C
    speeds = []
    for load in (0.0, 0.1):  # N m at the motor, as a viscous load that takes it
        speed = speeds[0] if speeds else 1.0
        ratio = a.reduction * a.nominal_arm
        bank.set(0, "viscous", load / speed * ratio**2)
        speeds.append(spin(bank, 40.0, 3.0).motor_velocity[0] * ratio)
    torque = 0.1 * speeds[1] / speeds[0]
    # without friction the model transmits the share eta of the torque (the linear loss)
    gradient = (speeds[0] - speeds[1]) * 60 / (2 * np.pi) / (torque / a.efficiency * 1e3)
    assert gradient == pytest.approx(4.89, rel=0.01)


def test_a_light_rotor_at_the_voltage_limit_runs_up_without_ringing():
    bank = alone(HUME, 1)[0]
    for name in ("stiffness", "damping"):
        bank.set(0, name, 0.0)
    bank.current[:] = 20.0
    speeds = []
    for _ in range(3000):
        bank.step()
        speeds.append(bank.observe().motor_velocity[0])
    assert (np.diff(speeds) >= -1e-9).all()
    a = HUME.joints[1].actuator
    # V = R i + k w with k i = b w
    k, r = a.torque_per_ampere, a.motor.resistance
    assert speeds[-1] == pytest.approx(a.supply_voltage / (k + r * a.viscous / k), rel=1e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_stalled_motor_takes_what_voltage_current_limit_and_supply_leave(sign):
    bank = alone(VLCA)[0]
    cold = VLCA.joints[0].actuator.motor.resistance
    cases = (
        ("current_limit", 10.0, 48.0, 10.0, 48.0),
        ("current_limit", 100.0, 20.0, 20.0 / cold, 20.0),
        ("supply_power", 500.0, 48.0, (500.0 / cold) ** 0.5, (500.0 * cold) ** 0.5),
    )
    for name, value, supply, current, sagged in cases:
        bank = alone(VLCA)[0]
        bank.set(0, "winding_capacity", 1e12)
        bank.set(0, "stiffness", 1e5)
        bank.set(0, "creep", 0.0)
        bank.set(0, "current_limit", 100.0)
        bank.set(0, "supply_power", 1e6)
        bank.set(0, name, value)
        bank.supply[:] = supply
        seen = spin(bank, sign * 1e3, 1.0)
        assert seen.current[0] == pytest.approx(sign * current, rel=1e-4)
        assert seen.supply[0] == pytest.approx(sagged, rel=1e-4)


def test_the_supply_s_power_is_never_exceeded_on_the_way_up():
    bank, limit = alone(VLCA)[0], 300.0
    bank.set(0, "stiffness", 0.0)
    bank.set(0, "supply_power", limit)
    bank.current[:] = 40.0
    constant = bank.get(0, "torque_per_ampere")
    powers = []
    for _ in range(3000):
        bank.step()
        seen = bank.observe()
        resistance = bank.get(0, "resistance") * (1 + COPPER * (seen.temperature[0] - 25))
        powers.append(seen.current[0] * (resistance * seen.current[0] + constant * seen.motor_velocity[0]))
    assert max(powers) <= limit * 1.001
    assert max(powers) > 0.99 * limit  # it was the limit that held


def steady(current, thermal, resistance):
    """Winding temperature where heat in equals heat out, with resistance that rises with it."""
    total = thermal.winding_to_housing + thermal.housing_to_ambient
    return brentq(lambda t: t - 25 - total * resistance * (1 + COPPER * (t - 25)) * current**2, 25, 1000)


def heated(robot, current, seconds, dt=0.05, **change):
    """Winding temperatures every ``dt`` of a held motor: only the thermal part matters, so the step may be long."""
    joint = robot.joints[0]
    robot = robot.model_copy(update={
        "joints": (joint.model_copy(update={"actuator": joint.actuator.model_copy(update=change)}),)
    })  # fmt: skip
    q, dq = np.zeros(1), np.zeros(1)
    bank = ActuatorBank(robot, dt, 0.0, lambda f: f, q, dq)
    for name in ("stiffness", "damping", "torque_per_ampere"):
        bank.set(0, name, 0.0)
    bank.set(0, "supply_power", 1e6)
    bank.supply[:] = 1e3
    bank.current[:] = current
    rows = []
    for _ in range(round(seconds / dt)):
        bank.step()
        rows.append(bank.observe().temperature[0])
    return np.array(rows)


def test_the_winding_settles_where_heat_in_equals_heat_out():
    a = VLCA.joints[0].actuator
    for current in (5.0, 12.0):
        assert heated(VLCA, current, 1200.0)[-1] == pytest.approx(steady(current, a.thermal, 1.03), abs=0.2)


def test_the_step_response_has_the_data_sheet_s_two_time_constants():
    """With little current (resistance all but constant): first the winding's, then, much later, the housing's."""
    rows = heated(VLCA, 0.5, 8000.0, cooling="air") - 25.0
    thermal = VLCA.joints[0].actuator.motor.thermal
    power = 1.03 * 0.25
    # the network's exact answer, by its two eigenvalues
    cw, ch = thermal.winding_capacity, thermal.housing_capacity
    g, h = 1 / thermal.winding_to_housing, 1 / thermal.housing_to_ambient
    values, vectors = np.linalg.eig(np.array([[-g / cw, g / cw], [g / ch, -(g + h) / ch]]))
    end = np.array([power / g + power / h, power / h])
    weights = np.linalg.solve(vectors, -end)
    times = 0.05 * np.arange(1, len(rows) + 1)
    exact = end[0] + (vectors[0] * weights) @ np.exp(np.outer(values, times))
    assert np.abs(rows - exact).max() < 0.01 * end[0]
    # and the data sheet's names for them are good to a few per cent
    assert sorted(-1 / values)[0] == pytest.approx(3.96, rel=0.1)
    assert sorted(-1 / values)[1] == pytest.approx(1240.0, rel=0.1)


def test_liquid_lets_3_59_times_the_current_flow_to_the_same_155_degrees():
    """Kim 2018 §5.3.1, §5.4.3: 0.701 N m of continuous motor torque."""
    a = VLCA.joints[0].actuator
    liquid = 0.701 / a.torque_constant
    for cooling, current in (("air", liquid / 3.59), ("liquid", liquid)):
        cooled = a.model_copy(update={"cooling": cooling})
        assert steady(current, cooled.thermal, 1.03) == pytest.approx(155.0, abs=1.0)
    assert heated(VLCA, liquid, 900.0)[-1] == pytest.approx(155.0, abs=1.0)


def test_a_warm_winding_takes_less_current_from_the_same_voltage():
    bank = alone(VLCA)[0]
    bank.set(0, "supply_power", 1e6)
    bank.supply[:] = 10.0
    at = bank.symbols.state_index[0]["winding"]
    bank.state[at] = 155.0
    bank.set(0, "winding_capacity", 1e12)
    seen = spin(bank, 40.0, 1.0)
    assert seen.current[0] == pytest.approx(10.0 / (1.03 * (1 + COPPER * 130)), rel=1e-3)


@pytest.mark.parametrize("enabled", [0.0, 5.0])
def test_a_motor_that_is_driven_too_fast_feeds_the_supply_through_the_bridge(enabled):
    """Also with the power stage off (no current demanded): its diodes conduct once the back-EMF exceeds the supply."""
    bank = free(VLCA)
    bank.set(0, "inertia", 1e9)
    constant, cold = bank.get(0, "torque_per_ampere"), bank.get(0, "resistance")
    for sign in (1, -1):
        bank.state[bank.symbols.state_index[0]["dphi"]] = sign * 60.0 / constant
        bank.current[0] = sign * enabled
        bank.step()
        assert bank.observe().current[0] == pytest.approx(-sign * 12.0 / cold, rel=1e-3)

"""The VLCA against the transfer functions of its source, closed forms and energy."""

import numpy as np
import pytest

from plant.actuators.bank import ActuatorBank
from robots import description
from robots.actuators import MATERIALS, Elastomer

ROBOT = description.load("vlca")
A = ROBOT.joints[0].actuator
LINKAGE, R0 = A.linkage, A.nominal_arm


class Stand:
    """The actuator on a load of ``inertia`` [kg m²] under ``weight(q)`` [N m]; None: the output is held."""

    def __init__(self, dt, friction=0.0, inertia=None, weight=lambda q: 0.0, at=0.0, actuator=A, **parameters):
        joint = ROBOT.joints[0].model_copy(update={"actuator": actuator})
        self.q, self.dq, self.dt, self.inertia, self.weight = np.array([at]), np.zeros(1), dt, inertia, weight
        robot = ROBOT.model_copy(update={"joints": (joint,)})
        self.bank = ActuatorBank(robot, dt, friction, lambda f: f, self.q, self.dq)
        for name, value in parameters.items():
            self.bank.set(0, name, value)

    def step(self, current):
        self.bank.current[0] = current
        torque = self.bank.step()[0]
        if self.inertia is not None:
            self.dq[0] += self.dt * (torque - self.weight(self.q[0])) / self.inertia
            self.q[0] += self.dt * self.dq[0]
        return torque


def response(stand, hertz, amplitude=1.0, settle=0.5, periods=10):
    """Complex amplitude of the rubber's deflection [m] per ampere."""
    steps = round(1 / hertz / stand.dt)
    omega = 2 * np.pi / (steps * stand.dt)
    skip = -(-round(settle / stand.dt) // steps) * steps
    total = 0j
    for k in range(skip + periods * steps):
        t = k * stand.dt
        stand.step(amplitude * np.cos(omega * t))
        if k >= skip:  # the state is that at the end of the step
            total += stand.bank.observe().deflection[0] * R0 * np.exp(-1j * omega * (t + stand.dt))
    # a current that is held over the step lags by half a step
    held = np.exp(-0.5j * omega * stand.dt) * np.sinc(omega * stand.dt / (2 * np.pi))
    return omega, 2 * total / (periods * steps) / amplitude / held


def plants(omega, arm=None, load=None):
    """P_m, P_r, P_l of Kim 2018 (5.10) from Table 5.1."""
    s = 1j * omega
    i_m, b_m, m_r, b_r, k_r = 3.5e-5, 2.0e-4, 1.3, 2.0e4, 5.5e6
    return 1 / (i_m * s**2 + b_m * s), 1 / (m_r * s**2 + b_r * s + k_r), 1 / (load / arm**2 * s**2) if load else 0.0


@pytest.mark.parametrize("hertz", [2.0, 10.0, 19.0, 40.0, 100.0])
@pytest.mark.parametrize("at", [0.0, -0.8])
def test_with_the_output_fixed_it_is_the_source_s_transfer_function(hertz, at):
    """Kim 2018 (5.11), whatever the posture."""
    omega, measured = response(Stand(1e-5, at=at, creep=0.0), hertz, periods=4)
    s = 1j * omega
    eta, k_tau, n_m = 0.9, 0.0448, 3316.0
    exact = eta * k_tau * n_m / ((3.5e-5 * n_m**2 + 1.3) * s**2 + (2.0e-4 * n_m**2 + 2.0e4) * s + 5.5e6)
    assert abs(measured - exact) < 0.01 * abs(exact)


@pytest.mark.parametrize("mass", [1500.0, 2500.0])
@pytest.mark.parametrize("hertz", [5.0, 15.0, 25.0, 60.0])
def test_with_a_free_load_it_is_the_source_s_transfer_function(hertz, mass):
    """Kim 2018 (5.9); 1500 to 2500 kg is what 10 kg at the link's end reflect."""
    stand = Stand(1e-5, creep=0.0, inertia=mass * R0**2)
    omega, measured = response(stand, hertz, periods=4)
    p_m, p_r, p_l = plants(omega, R0, mass * R0**2)
    exact = 0.9 * 0.0448 * (p_m * p_r / 3316.0) / (p_m / 3316.0**2 + p_l + p_r)
    assert abs(measured - exact) < 0.015 * abs(exact)


@pytest.mark.parametrize("material", MATERIALS)
def test_the_force_relaxes_by_the_material_s_creep(material):
    """A step of deflection, against the standard linear solid; Kim 2018 Table C.2 gives the share."""
    given = {"creep": 0.2} if MATERIALS[material].creep is None else {}
    elastomer = Elastomer(material=material, creep_time_constant=2.0, **given)
    stand = Stand(1e-3, actuator=A.model_copy(update={"elastomer": elastomer}), inertia=None)
    # a very heavy, undriven rotor holds the far end; the joint steps to a new angle and stays
    stand.bank.set(0, "inertia", 1e15)
    stand.q[0] = -0.05
    deflection = -float(LINKAGE.motor_coordinate(-0.05))
    times, force = [], []
    for k in range(6000):
        force.append(stand.bank.observe().effort[0] / R0)
        times.append(k * 1e-3)
        stand.step(0.0)
    share = elastomer.creep
    exact = elastomer.stiffness * R0 * deflection * (1 - share * (1 - np.exp(-np.array(times) / 2.0)))
    np.testing.assert_allclose(force, exact, rtol=1e-3 * max(share, 1e-3))


def test_the_table_s_gaps_are_asked_for():
    with pytest.raises(ValueError, match=r"creep: .* none for reinforced silicone 70A: give one"):
        Elastomer(material="reinforced silicone 70A")
    with pytest.raises(ValueError, match="no material 'rubber'; there is: spring steel"):
        Elastomer(material="rubber")
    assert MATERIALS["silicone 90A"].compression_set is None
    assert len(MATERIALS) == 8


def test_torques_and_speeds_over_posture_are_those_of_the_test_bed():
    """Kim 2018 §5.3.3: about 270 N m at the peak, 91 N m continuous at the highest advantage, 7.5 to 20+ rad/s."""
    low, high = ROBOT.joints[0].limits
    arms = np.array([float(LINKAGE.arm(q)) for q in np.linspace(low, high, 500)])
    force = 0.9 * 0.0448 * 3316.0
    assert force * (0.701 / 0.0448) * arms.max() == pytest.approx(91.0, rel=0.01)
    stall = min(A.current_limit, 48.0 / A.motor.resistance)
    assert force * stall * arms.max() == pytest.approx(270.0, rel=0.02)
    assert force * stall < A.force_limit == 7300.0
    screw = 48.0 / 0.0448 / 3316.0  # m/s without load
    assert screw / arms.max() == pytest.approx(7.5, rel=0.02)
    assert screw / arms.min() > 20.0


def test_the_reflected_rotor_inertia_is_that_of_the_source():
    """Kim 2018 (5.25): n² I with n = N_l N_m. A rigid elastomer makes rotor and load one body."""
    for at in (0.0, -0.9):
        arm = float(LINKAGE.arm(at))
        load = 0.2
        stand = Stand(1e-6, inertia=load, at=at, creep=0.0, stiffness=1e7, damping=2e3, viscous=0.0)
        for _ in range(3000):
            stand.step(2.0)
        torque = 0.9 * 0.0448 * 3316.0 * arm * 2.0
        expected = torque / (load + (arm * 3316.0) ** 2 * 3.5e-5 + 1.3 * arm**2)
        assert stand.dq[0] / 3e-3 == pytest.approx(expected, rel=0.01)


def test_what_goes_in_electrically_comes_out_or_is_lost_or_stored():
    dt = 2e-5
    stand = Stand(dt, friction=1.0, inertia=2.0, weight=lambda q: 60.0 * np.sin(q), at=-0.3)
    bank = stand.bank
    k, c, time = bank.get(0, "stiffness"), bank.get(0, "creep"), bank.get(0, "creep_time_constant")
    names = bank.symbols.state_index[0]
    joules = dict.fromkeys(("in", "out", "copper", "screw", "viscous", "rubber"), 0.0)

    def stored():
        seen, z = bank.observe(), bank.state[names["relaxed"]]
        x = seen.deflection[0]
        kinetic = 0.5 * bank.get(0, "inertia") * seen.motor_velocity[0] ** 2
        return kinetic + 0.5 * k * (1 - c) * x**2 + 0.5 * k * c * (x - z) ** 2

    begin = stored()
    for step in range(75000):
        before, rate = bank.observe(), stand.dq[0]
        effort, x = before.effort[0], before.deflection[0]
        z = bank.state[names["relaxed"]]
        resistance = 1.03 * (1 + 0.00393 * (before.temperature[0] - 25))
        slip = before.motor_velocity[0] - float(LINKAGE.ratio(stand.q[0])) * rate
        torque = stand.step(9.0 + 9.0 * np.sin(6.0 * step * dt))
        after = bank.observe()
        i, omega = after.current[0], after.motor_velocity[0]
        power = {
            "in": i * (resistance * i + bank.get(0, "torque_per_ampere") * omega),
            "out": torque * 0.5 * (rate + stand.dq[0]),
            "copper": resistance * i**2,
            "screw": (1 - 0.9) / 0.9 * abs(effort) * abs(omega),
            "viscous": bank.get(0, "viscous") * omega**2,
            "rubber": bank.get(0, "damping") * slip**2 + k * c * (x - z) ** 2 / time,
        }
        for name, watts in power.items():
            joules[name] += dt * watts
    assert min(abs(v) for v in joules.values()) > 0.05  # each takes part
    spent = sum(v for name, v in joules.items() if name != "in") + stored() - begin
    assert spent == pytest.approx(joules["in"], rel=0.01)


@pytest.mark.parametrize(("sign", "share"), [(1, 0.9), (-1, 1 / (2 - 1 / 0.9))])
def test_the_screw_s_loss_depends_on_where_the_power_goes(sign, share):
    """Driving, the share η of the motor's force arrives; driven, it holds against 1/(2 − 1/η) of its own."""
    stand = Stand(1e-4, friction=1.0, creep=0.0, viscous=0.0)
    current = 10.0
    # the output moves at a constant, low speed, out of or into the actuator
    speed = -0.02 * sign
    for _ in range(20000):
        stand.dq[0] = -speed
        stand.q[0] -= speed * stand.dt
        stand.step(current)
    motor = 0.0448 * 3316.0 * R0 * current
    assert stand.bank.observe().motor_velocity[0] * sign > 0
    assert stand.bank.observe().effort[0] == pytest.approx(share * motor, rel=0.01)


def lift(duration, dt=1e-4):
    """Lift 23 kg by 0.3 m on a lever in ``duration``: shares of the motor's and of the supply's work at the joint.

    Integrals while the mechanical power is positive, as the source takes them (App. D).
    """
    mass, lever, settle = 23.0, 0.4, 0.5
    low, high = -0.45, -0.45 + 0.3 / lever
    stand = Stand(dt, friction=1.0, inertia=mass * lever**2, weight=lambda q: mass * 9.81 * lever, at=low)
    bank, per_ampere = stand.bank, 0.9 * 0.0448 * 3316.0 * R0
    hold = mass * 9.81 * lever / float(LINKAGE.ratio(low))
    bank.state[bank.symbols.state_index[0]["phi"]] += hold / A.stiffness
    work = np.zeros(3)
    for k in range(round((duration + settle) / dt)):
        s = max(k * dt - settle, 0.0) / duration
        wanted = low + (high - low) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        rate = (high - low) * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        acceleration = (high - low) * (60 * s - 180 * s**2 + 120 * s**3) / duration**2
        ratio = float(LINKAGE.ratio(stand.q[0]))
        torque = (mass * lever**2 + A.rotor_inertia * ratio**2) * acceleration + mass * 9.81 * lever
        torque += 3000.0 * (wanted - stand.q[0]) + 300.0 * (rate - stand.dq[0])
        torque_on_joint = stand.step(torque / ratio / per_ampere)
        seen = bank.observe()
        mechanical = torque_on_joint * stand.dq[0]
        if rate > 0 and mechanical > 0:
            i, omega = seen.current[0], seen.motor_velocity[0]
            motor = 0.0448 * i * omega * 3316.0 * R0
            resistance = 1.03 * (1 + 0.00393 * (seen.temperature[0] - 25))
            work += dt * np.array([mechanical, motor, motor + resistance * i**2])
    assert stand.q[0] == pytest.approx(high, abs=0.05)
    assert seen.temperature[0] < 155.0
    return work[0] / work[1:]


def test_lifting_23_kg_has_about_the_efficiency_of_the_source():
    """Kim 2018 App. D measures a drivetrain efficiency of about 0.93 over five durations.

    The model has the η = 0.9 that the source's control uses, and takes the motor's viscous friction (b_m of Table 5.1)
    from the rest: on the way of least jerk that is 10/7 of what a constant speed would lose.
    """
    durations = np.array([0.6, 0.8, 1.0, 1.4, 2.0])
    drivetrain, supply = np.array([lift(duration) for duration in durations]).T
    work, stroke = 23.0 * 9.81 * 0.3, float(LINKAGE.length(0.3) - LINKAGE.length(-0.45))
    viscous = 2.0e-4 * 3316.0**2 * stroke**2 * 10 / 7 / durations
    np.testing.assert_allclose(drivetrain, work / (work / 0.9 + viscous), rtol=0.01)
    assert (supply < drivetrain).all()
    assert (np.diff(supply) < 0).all()  # the slower, the more of it is spent on holding

"""The control law against a difference equation written from the sources, and against analytic answers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from joint_firmware.config import FirmwareConfig, TorqueGains
from joint_firmware.laws import drive_law
from joint_firmware.laws import signals as law
from joint_firmware.protection_config import UNPROTECTED
from robots import description, pins

HIP = description.load("hume").joint("right_hip")
CONFIG = FirmwareConfig(protection=UNPROTECTED)
DT = 1.0 / 3000.0
AMPERE = HIP.actuator.torque_per_ampere
LAW = drive_law(HIP, CONFIG)
P = LAW.values(HIP, CONFIG)


def counts(position=0.0, torque=0.0, current=0.0):
    """Counts, not rounded, of a joint at ``position`` [rad] under ``torque`` [N m]."""
    deflection = torque / HIP.actuator.stiffness
    c = np.zeros(pins.N_INPUTS)
    c[pins.MOTOR_ENCODER] = (position + deflection) * HIP.sensor.encoder
    c[pins.SPRING_ENCODER] = torque / HIP.sensor.torque_resolution
    c[pins.CURRENT_ADC] = current / pins.AMPERE_PER_COUNT
    return c


def command(mode="torque", torque=0.0, position=0.0, velocity=0.0, limit=500.0, kp=1.0, ki=0.0, kd=0.0):
    u = np.zeros(law.INPUT_SIZE)
    u[[law.U_TORQUE, law.U_POSITION, law.U_VELOCITY, law.U_LIMIT]] = torque, position, velocity, limit
    u[[law.U_KP, law.U_KI, law.U_KD]] = kp, ki, kd
    u[law.U_ENABLED] = mode != "off"
    modes = {"torque": law.U_TORQUE_MODE, "position": law.U_POSITION_MODE, "damping": law.U_DAMPING_MODE}
    if mode in modes:
        u[modes[mode]] = 1.0
    return u


class Loop:
    """The law with its state, one call per tick."""

    def __init__(self, p=P):
        self.x, self.p = np.zeros(len(LAW.states)), p

    def __call__(self, counts, u):
        x, y = LAW.function(counts, self.x, u, self.p)
        self.x, self.y = np.array(x).ravel(), np.array(y).ravel()
        return self

    def state(self, name):
        return self.x[LAW.states.index(name)]

    @property
    def motor_torque(self):
        return self.y[law.Y_DEMAND] * pins.AMPERE_PER_COUNT * AMPERE

    @property
    def limited(self):
        return bool(self.y[law.Y_LIMITED])


HALF = 0.5 * pins.AMPERE_PER_COUNT * AMPERE + 1e-9  # N m, the rounding of the demand


def settled(c, u, ticks=300):
    loop = Loop()
    for _ in range(ticks):
        loop(c, u)
    return loop


# --- an independent difference equation ---------------------------------------------------------------------


class Reference:
    """Kim 2018 §5.1.1 as a difference equation in SI units, with plain ``if``s."""

    def __init__(self):
        self.before = None  # theta, q, dtheta, dq
        self.running = None  # reference, integral, carry, gains
        self.regime, self.demand, self.ramp = "none", 0.0, 0.0
        self.alpha = math.exp(-2 * math.pi * CONFIG.velocity_cutoff * DT)

    def __call__(self, c, mode, torque, position, velocity, limit, kp, ki, kd):
        theta = c[0] / HIP.sensor.encoder
        tau = c[1] * HIP.sensor.torque_resolution
        q = theta - tau / HIP.actuator.stiffness
        if self.before is None:
            dtheta = dq = 0.0
        else:
            old_theta, old_q, dtheta, dq = self.before
            dtheta = self.alpha * dtheta + (1 - self.alpha) * (theta - old_theta) / DT
            dq = self.alpha * dq + (1 - self.alpha) * (q - old_q) / DT
        self.before = theta, q, dtheta, dq
        motor, limited = 0.0, False
        if mode in ("torque", "position"):
            motor, limited = self._closed(
                mode, tau, q, theta, dtheta, torque, position, velocity, limit, kp, ki, kd
            )
        else:
            self.running = None
            if mode == "damping":
                motor = -CONFIG.quick_stop_damping * dtheta
        ampere = self._ramped(mode, motor) / AMPERE
        return [q / 1e-6, dq / 1e-5, tau / 1e-4, c[2], dtheta / 1e-3, ampere / pins.AMPERE_PER_COUNT], limited

    def _ramped(self, mode, motor):
        full = HIP.actuator.current_limit * AMPERE
        motor = max(-full, min(full, motor))
        regime = {"torque": "active", "position": "active", "off": "none"}.get(mode, mode)
        if regime != self.regime:
            self.regime, self.ramp = regime, self.demand - motor
        step = CONFIG.torque_rate * DT  # faster than full effort in 10 ms
        self.ramp = 0.0 if mode == "off" or abs(self.ramp) < step else self.ramp - math.copysign(step, self.ramp)
        self.demand = max(-full, min(full, motor + self.ramp))
        return self.demand

    def _closed(self, mode, tau, q, theta, dtheta, torque, position, velocity, limit, kp, ki, kd):
        wanted = torque
        if mode == "position":
            wanted += CONFIG.position_stiffness * (position - theta) + CONFIG.position_damping * (velocity - dtheta)
        low, high = HIP.limits
        if q > high:
            wanted -= CONFIG.soft_stop_stiffness * (q - high)
        if q < low:
            wanted += CONFIG.soft_stop_stiffness * (low - q)
        limit = min(limit, CONFIG.torque_limit)
        reference, integral, carry, old = self.running or (tau, 0.0, 0.0, (kp, ki, kd))
        step = min(max(wanted, -limit), limit) - reference
        reference += math.copysign(min(abs(step), CONFIG.torque_rate * DT), step)
        error = reference - tau
        held = [reference + p * error - d * dtheta + (integral if i > 0 else 0.0) for p, i, d in (old, (kp, ki, kd))]
        full = HIP.actuator.current_limit * AMPERE
        carry = max(-4 * full, min(4 * full, carry + held[0] - held[1]))
        motor = held[1] + carry
        saturated = abs(motor) > HIP.actuator.current_limit * AMPERE
        limited = (
            abs(wanted) > limit or abs(step) > CONFIG.torque_rate * DT or saturated or not low <= q <= high
        )
        if ki == 0:
            integral = 0.0
        elif not (saturated and motor * error > 0):
            integral += ki * error * DT
        self.running = reference, integral, carry * (1 - DT / 0.01), (kp, ki, kd)
        return motor, limited


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 3.0), st.floats(1.0, 200.0))
def test_the_law_is_the_difference_equation(seed, travel, effort):
    """Gains, modes and set-points jump every few ticks; counts walk across the joint's whole range."""
    rng = np.random.default_rng(seed)
    loop, reference = Loop(), Reference()
    q, tau = 0.0, 0.0
    for n in range(60):
        if n % 7 == 0:
            mode = rng.choice(["torque", "position", "damping", "none", "off"], p=[0.5, 0.2, 0.1, 0.1, 0.1])
            choices = {"kp": [0.0, 1.0, 2.0, 4.0], "ki": [0.0, 10.0], "kd": [0.0, 5.0]}
            gains = {name: rng.choice(values) for name, values in choices.items()}
            wish = {
                "torque": effort * rng.normal(), "position": rng.normal(), "velocity": rng.normal(),
                "limit": rng.choice([5.0, 500.0]),
            }  # fmt: skip
        q = np.clip(q + 0.02 * travel * rng.normal(), -1.9, 1.9)
        tau = 0.9 * tau + 0.2 * effort * rng.normal()
        c = np.rint(counts(q, tau, 10.0 * rng.normal()))
        loop(c, command(mode, **wish, **gains))
        expected, limited = reference(c, mode, **wish, **gains)
        names = ("q", "dq", "tau", "i", "dtheta", "demand")
        for name, got, value in zip(names, loop.y, expected, strict=False):
            bound = 32767 if name in ("i", "dtheta") else math.inf
            assert abs(got - np.clip(value, -bound, bound)) <= 0.5 + 1e-6 * abs(value), f"{name} in tick {n}"
        assert loop.limited == limited, f"tick {n}"


# --- sensing ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", description.load("hume").joints, ids=lambda j: j.name)
def test_position_and_torque_come_from_the_counts_by_the_joint_s_own_signed_scales(joint):
    p = LAW.values(joint, CONFIG)
    theta, spring = 0.7, 20.0 / joint.actuator.stiffness
    c = np.zeros(pins.N_INPUTS)
    c[pins.MOTOR_ENCODER], c[pins.SPRING_ENCODER] = theta * joint.sensor.encoder, spring * joint.spring_counts_per_rad
    c[pins.CURRENT_ADC] = -123.0
    y = Loop(p)(c, command("none")).y
    assert y[law.Y_POSITION_SI] == pytest.approx(theta - spring)
    assert y[law.Y_TORQUE_SI] == pytest.approx(20.0)
    assert y[law.Y_POSITION] == pytest.approx(1e6 * (theta - spring), abs=0.5)
    assert y[law.Y_TORQUE] == pytest.approx(20e4, abs=0.5)
    assert y[law.Y_CURRENT] == -123.0


def test_velocities_start_at_zero_and_settle_with_the_filter_s_time_constant():
    loop = Loop()(counts(0.5), command("none"))  # where the joint stands at power-on is no movement
    assert loop.state("motor_velocity") == loop.state("deflection_velocity") == 0.0
    for n in range(1, 40):
        loop(counts(0.5 + 2.0 * n * DT), command("none"))
        expected = 2.0 * (1 - math.exp(-2 * math.pi * 200.0 * n * DT))
        assert loop.state("motor_velocity") == pytest.approx(expected, rel=1e-9)
        assert loop.y[law.Y_VELOCITY] == pytest.approx(expected / 1e-5, abs=0.5)


def test_motor_and_joint_velocity_are_told_apart():
    loop = Loop()
    for n in range(60):  # the joint is held, the motor winds the spring up
        loop(counts(0.0, HIP.actuator.stiffness * 0.5 * n * DT), command("none"))
    assert loop.y[law.Y_MOTOR_VELOCITY] == 500
    assert abs(loop.y[law.Y_VELOCITY]) <= 1


COUNTS = st.lists(st.integers(-(2**31), 2**31 - 1), min_size=pins.N_INPUTS, max_size=pins.N_INPUTS)


@given(COUNTS, COUNTS)
def test_outputs_fit_their_fields_whatever_the_sensors_say(first, second):
    loop = Loop()
    for c in (first, second):
        loop(c, command("torque", 10.0, kp=4.0, ki=10.0, kd=5.0))
        for index in (law.Y_POSITION, law.Y_VELOCITY, law.Y_TORQUE):
            assert abs(loop.y[index]) <= 2**31 - 1
        for index in (law.Y_CURRENT, law.Y_MOTOR_VELOCITY):
            assert abs(loop.y[index]) <= 2**15 - 1
        assert abs(loop.y[law.Y_DEMAND]) <= HIP.actuator.current_limit / pins.AMPERE_PER_COUNT


# --- torque loop --------------------------------------------------------------------------------------------


@given(st.floats(0, 4), st.floats(-30, 30), st.floats(-30, 30))
def test_proportional_part(kp, wanted, sensed):
    loop = settled(counts(0.0, sensed), command(torque=wanted, kp=kp), ticks=20)
    expected = np.clip(wanted + kp * (wanted - sensed), -165.0, 165.0)  # 27.5 A
    assert loop.motor_torque == pytest.approx(expected, abs=HALF)


def test_motor_velocity_is_damped_and_joint_velocity_is_not():
    moving, winding = Loop(), Loop()
    for n in range(60):
        moving(counts(1.5 * n * DT), command(kp=0.0, kd=5.0))
        winding(counts(-1.5 * n * DT, HIP.actuator.stiffness * 1.5 * n * DT), command(kp=0.0, kd=5.0))
    assert moving.motor_torque == pytest.approx(-5.0 * 1.5, abs=HALF)
    assert winding.motor_torque == pytest.approx(0.0, abs=HALF)  # motor still, joint moving


def test_the_integral_grows_by_ki_times_the_error():
    loop, c, u = Loop(), counts(0.0, 5.0), command(torque=8.0, kp=2.0, ki=10.0)
    for _ in range(3001):
        loop(c, u)  # the reference starts at 5 and is at 8 in the first tick
    assert loop.motor_torque == pytest.approx(8.0 + 2.0 * 3.0 + 10.0 * 3.0 * 1.0, abs=HALF)


def test_without_integral_gain_what_was_integrated_fades_within_its_time():
    loop, c = Loop(), counts(0.0, 5.0)
    for _ in range(3000):
        loop(c, command(torque=8.0, kp=2.0, ki=10.0))
    before = loop.motor_torque
    for _ in range(31):  # 10 ms, and the tick that takes over
        loop(c, command(torque=8.0, kp=2.0))
    end = 8.0 + 2.0 * 3.0
    assert before - end == pytest.approx(30.0, abs=HALF)
    assert loop.motor_torque - end == pytest.approx(30.0 * math.exp(-1.0), rel=2e-2, abs=HALF)


def test_a_saturated_drive_does_not_wind_up():
    full = HIP.actuator.current_limit * AMPERE
    loop, u = Loop(), command(torque=100.0, kp=2.0, ki=10.0)
    for _ in range(3000):
        loop(counts(), u)
    assert loop.motor_torque == pytest.approx(full, abs=HALF) and loop.limited
    assert loop.state("integral") < 10.0  # a second of 10 x 100 N m/s would be 1000 N m
    loop(counts(0.0, 120.0), u)  # the error turns round: the demand leaves its limit at once
    assert loop.motor_torque < full - 50.0


def test_a_saturated_drive_integrates_out_of_saturation():
    loop = Loop()
    for _ in range(300):
        loop(counts(), command(torque=40.0, kp=0.0, ki=200.0))
    before = loop.state("integral")
    for _ in range(10):  # 80 N m sensed, 40 wanted; demand still at its limit
        loop(counts(0.0, 80.0), command(torque=40.0, kp=0.0, ki=200.0))
    assert loop.state("integral") == pytest.approx(before - 10 * 200.0 * 40.0 * DT, rel=1e-6)


# --- bumpless switching -------------------------------------------------------------------------------------

gains = st.floats(0, 4)


@given(gains, gains, st.sampled_from([0.0, 10.0]), st.floats(-30, 30), st.floats(-30, 30))
def test_switching_the_proportional_gain_does_not_move_the_motor(kp, next_kp, ki, wanted, sensed):
    c = counts(0.0, sensed)
    stays, switches = (settled(c, command(torque=wanted, kp=kp), 20) for _ in range(2))
    stays(c, command(torque=wanted, kp=kp))
    switches(c, command(torque=wanted, kp=next_kp, ki=ki))
    assert abs(switches.y[law.Y_DEMAND] - stays.y[law.Y_DEMAND]) <= 1


def test_after_the_switch_the_new_gain_reacts():
    c, u = counts(), command(torque=10.0, kp=2.0)
    loop = settled(c, command(torque=10.0, kp=1.0), 20)
    for _ in range(300):  # until what was carried on has faded
        loop(c, u)
    before = loop.motor_torque
    loop(counts(0.0, 1.0), u)
    assert loop.motor_torque - before == pytest.approx(-2.0, abs=0.1 + 2 * HALF)


@pytest.mark.parametrize("mode", ["none", "damping"])
@pytest.mark.parametrize("held", [-60.0, 60.0])
def test_switched_on_the_reference_starts_from_what_the_spring_holds_and_the_motor_from_what_it_gave(mode, held):
    c, step = counts(0.0, held), CONFIG.torque_rate * DT
    loop = settled(c, command(mode), 20)
    for n in range(1, 15):
        loop(c, command(torque=held, kp=2.0))
        assert loop.motor_torque == pytest.approx(math.copysign(min(n * step, 60.0), held), abs=HALF)
        assert loop.state("torque_reference") == pytest.approx(held) and not loop.limited


def test_a_mode_that_asks_for_nothing_lets_go_at_the_rate_limit_and_a_stop_at_once():
    c = counts(0.0, 5.0)
    for mode, first in (("none", 50.0 - CONFIG.torque_rate * DT), ("off", 0.0), ("damping", 50.0 - 20.0 / 3.0)):
        loop = settled(c, command(torque=50.0, kp=0.0), 300)
        loop(c, command(mode))
        assert loop.motor_torque == pytest.approx(first, abs=HALF)
        for _ in range(10):
            loop(c, command(mode))
        assert loop.motor_torque == 0.0 and not loop.limited


def test_switching_off_forgets_reference_and_integral():
    c = counts(0.0, 5.0)
    loop = settled(c, command(torque=50.0, kp=2.0, ki=10.0), 3000)
    loop(c, command("off"))
    assert loop.motor_torque == 0.0 and not loop.limited
    loop(c, command(torque=5.0, kp=2.0))
    assert loop.motor_torque == pytest.approx(5.0, abs=HALF)


# --- limits -------------------------------------------------------------------------------------------------


@given(st.floats(-1000, 1000), st.floats(0, 500))
def test_the_reference_stays_within_the_smaller_torque_limit(wanted, limit):
    bound = min(limit, 150.0)
    loop = settled(counts(), command(torque=wanted, limit=limit), 30)
    assert loop.state("torque_reference") == pytest.approx(min(max(wanted, -bound), bound), abs=1e-9)
    expected = min(max(2 * loop.state("torque_reference"), -165.0), 165.0)
    assert loop.motor_torque == pytest.approx(expected, abs=HALF)
    assert loop.limited == (abs(wanted) > bound or abs(2 * loop.state("torque_reference")) > 165.0)


def test_the_reference_moves_by_the_rate_limit_per_tick_and_no_more():
    loop = settled(counts(), command(torque=0.0), 3)
    steps = []
    for _ in range(10):
        before = loop.state("torque_reference")
        loop(counts(), command(torque=-30.0))
        steps.append(before - loop.state("torque_reference"))
        assert loop.limited == (len(steps) < 5)
    full = 20000.0 / 3000.0
    assert steps == pytest.approx([full] * 4 + [30.0 - 4 * full] + [0.0] * 5, abs=1e-9)


@pytest.mark.parametrize("sign", [-1, 1])
def test_current_is_limited_to_the_count(sign):
    loop = settled(counts(), command(torque=sign * 150.0, kp=4.0), 60)
    assert loop.y[law.Y_DEMAND] == sign * HIP.actuator.current_limit / pins.AMPERE_PER_COUNT
    assert loop.limited


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("mode", ["torque", "position"])
def test_a_soft_stop_pushes_back_from_the_limit_on(side, mode):
    edge, outward = HIP.limits[side], (-1, 1)[side]
    u = command(mode, position=edge + outward * 0.05, kp=0.0)
    inside = settled(counts(edge - outward * 1e-3), command(kp=0.0), 60)
    assert inside.motor_torque == 0.0 and not inside.limited
    beyond = settled(counts(edge + outward * 0.05), u, 60)
    assert beyond.motor_torque == pytest.approx(-outward * 200.0 * 0.05, abs=HALF) and beyond.limited


# --- other modes --------------------------------------------------------------------------------------------


def test_position_mode_is_a_spring_and_damper_around_the_torque_loop():
    loop = settled(counts(0.3), command("position", torque=4.0, position=0.35, velocity=0.2, kp=0.0), 60)
    assert loop.motor_torque == pytest.approx(4.0 + 300.0 * 0.05 + 10.0 * 0.2, abs=HALF)
    for n in range(60):
        loop(counts(0.3 + 0.2 * (n + 1) * DT), command("position", position=0.3, velocity=0.2, kp=0.0))
    assert loop.motor_torque == pytest.approx(-300.0 * 0.2 * 60 * DT, abs=0.02 + HALF)


def test_damping_mode_brakes_with_its_own_gain_within_the_current_limit():
    slow, fast = Loop(), Loop()
    for n in range(60):
        slow(counts(2.0 * n * DT), command("damping", torque=50.0, kd=5.0))
        fast(counts(20.0 * n * DT), command("damping", torque=50.0, kd=5.0))
    assert slow.motor_torque == pytest.approx(-60.0, abs=HALF)
    assert fast.motor_torque == pytest.approx(-165.0, abs=HALF)


def test_parameters_are_in_si_whatever_unit_the_configuration_uses():
    config = FirmwareConfig(
        rate="1kHz", report_rate="500Hz", torque_limit="80N m", stance=TorqueGains(kp=1.0, kd="2 N m s/rad")
    )
    p = dict(zip(LAW.parameters, LAW.values(HIP, config), strict=True))
    assert p["dt"] == 1e-3 and p["torque_limit"] == 80.0 and p["torque_step"] == pytest.approx(20.0)
    assert p["velocity_blend"] == pytest.approx(1 - math.exp(-2 * math.pi * 0.2))

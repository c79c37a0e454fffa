"""The controller's node: sequence, messages, state, and the loop it closes over rigid dynamics."""

from __future__ import annotations

import pickle
import time
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import least_squares

from bus import messages
from bus.messages import Controlword, GainSet, Mode, State, Statusword
from central_controller.behaviours.behaviour import Phase
from central_controller.config import ControllerConfig, InternalForceConfig, PathConfig
from central_controller.controller import IMU_SOURCE, Controller, telemetry_fields
from central_controller.model import RobotModel
from central_controller.wbosc import whole_body_control
from hil.compiled import compile_function
from robots import description, imu

ROBOT = description.load("hume")
FIELDS = telemetry_fields(ROBOT, ControllerConfig())
TICK_NS = 666_667
LAG_S = 0.005  # of the ideal drives
FEET = np.array([[0.25, -0.1, 0.0], [-0.25, 0.1, 0.0]])
_NEXT = {
    (Statusword.SWITCH_ON_DISABLED, Controlword.SHUTDOWN): Statusword.READY_TO_SWITCH_ON,
    (Statusword.READY_TO_SWITCH_ON, Controlword.SWITCH_ON): Statusword.SWITCHED_ON,
    (Statusword.SWITCHED_ON, Controlword.ENABLE_OPERATION): Statusword.OPERATION_ENABLED,
}


def stance(model: RobotModel, roll: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """Coordinates with the feet at FEET, hips at 0.7 m."""
    base = np.array([0.0, 0.0, 0.73535])
    turn = pin.Quaternion(pin.rpy.rpyToMatrix(roll, pitch, 0.0)).coeffs()

    def error(joints: np.ndarray) -> np.ndarray:
        model.update(np.concatenate([base, turn, joints]), np.zeros(12))
        return (model.feet - FEET).ravel()

    solution = least_squares(error, [0.1, -0.9, 1.2, -0.1, -0.3, 1.2], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(solution.fun).max() < 1e-9
    return np.concatenate([base, turn, solution.x])


class Rig:
    """Robot with ideal drives: torques follow by a lag; held until the controller bears the weight.

    Lateral motion and yaw are constrained, as by a planarizer.
    """

    def __init__(self, settings: ControllerConfig, q: np.ndarray, gain: float = 1.0) -> None:
        self.controller = Controller(ROBOT, settings, compile=compile_function)
        self.model = RobotModel(ROBOT)
        self.q, self.v, self.acceleration = q.copy(), np.zeros(12), np.zeros(12)
        self.y = q[1]
        self.feet: np.ndarray | None = None
        self.command, self.torque = np.zeros(6), np.zeros(6)
        self.status = [Statusword.SWITCH_ON_DISABLED] * 6
        self.counter, self.now = 0, 0
        self.blend, self.gain = 1.0 - np.exp(-TICK_NS * 1e-9 / LAG_S), gain
        self.force = np.zeros(6)
        self.sent: list[tuple[int, int, bytes]] = []

    def field(self, name: str) -> float:
        return float(self.controller.telemetry[FIELDS.index(name)])

    def fields(self, *names: str) -> list[float]:
        return [self.field(name) for name in names]

    def report(self) -> None:
        self.counter = (self.counter + 1) & 0xFFFF
        for j, joint in enumerate(ROBOT.joints):
            q, dq = self.q[7 + j], self.v[6 + j]
            state = State(self.counter, self.status[j], q, dq, self.torque[j], 0, 0, 0, 0, 25)
            data = messages.encode_state(state)
            self.controller.receive(self.now, j // 3, messages.STATE + joint.node_id, data)
        rotation = pin.Quaternion(self.q[3:7]).matrix()
        specific = self.acceleration[:3] + np.cross(self.v[3:6], self.v[:3]) + rotation.T @ [0.0, 0.0, 9.81]
        self.controller.receive(self.now, IMU_SOURCE, 0, imu.encode(self.v[3:6], specific, ROBOT.imu))

    def step(self) -> None:
        self.report()
        self.sent = self.controller.tick(self.now + 270_000)
        for bus, _, data in self.sent:
            for slot in range(3):
                j, point = 3 * bus + slot, messages.decode_setpoint(data, slot)
                self.status[j] = _NEXT.get((self.status[j], point.controlword), self.status[j])
                self.command[j] = point.torque if point.mode == Mode.TORQUE else 0.0
        self.torque += self.blend * (self.gain * self.command - self.torque)
        self.now += TICK_NS
        if self.field("phase") == Phase.ON:
            self.move()

    def move(self) -> None:
        model, dt = self.model, TICK_NS * 1e-9
        model.update(self.q, self.v)
        rotation = pin.Quaternion(self.q[3:7]).matrix()
        lateral, turn = np.zeros((1, 12)), np.zeros((1, 12))
        lateral[0, :3], turn[0, 3:6] = rotation[1], rotation[2]
        J = np.vstack([model.Js, lateral, turn])
        omega = self.v[3:6]
        bias = np.concatenate([model.Jsdot_dq, [rotation[1] @ np.cross(omega, self.v[:3]), 0.0]])
        if self.feet is None:
            self.feet = model.feet.copy()
        position = np.concatenate([(model.feet - self.feet).ravel(), [self.q[1] - self.y, model.rpy[2]]])
        bias += 100.0 * (J @ self.v) + 2500.0 * position  # drift of the constraints (Baumgarte)
        matrix = np.block([[model.A, J.T], [J, np.zeros((8, 8))]])
        right = np.concatenate([np.concatenate([np.zeros(6), self.torque]) - model.h, -bias])
        solution = np.linalg.solve(matrix, right)
        self.acceleration, self.force = solution[:12], solution[12:18]
        self.v += dt * self.acceleration
        self.q = pin.integrate(model.model, self.q, dt * self.v)

    def internal(self) -> float:
        line = self.model.feet[0] - self.model.feet[1]
        line /= np.linalg.norm(line)
        return float(line @ (self.force[:3] - self.force[3:]))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            self.step()


def config(**changes: Any) -> ControllerConfig:
    return ControllerConfig(**{"stand_at": "0.4s", "weight_ramp": "0.2s", **changes})


def setpoints(sent: list[tuple[int, int, bytes]]) -> list[messages.Setpoint]:
    assert [(bus, can_id) for bus, can_id, _ in sent] == [(0, messages.COMMAND), (1, messages.COMMAND)]
    return [messages.decode_setpoint(data, slot) for _, _, data in sent for slot in range(3)]


@pytest.fixture(scope="module")
def upright() -> np.ndarray:
    return stance(RobotModel(ROBOT))


def test_telemetry_fields() -> None:
    head = [
        "com.x", "com.y", "com.z", "com_velocity.x", "com_velocity.y", "com_velocity.z", "com_reference.x",
        "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference", "internal_force",
        "internal_force_reference",
    ]  # fmt: skip
    joints = [f"{w}.{j}" for w in ("torque_command", "torque_sensed", "q", "dq") for j in ROBOT.joint_names]
    assert [*head, *joints, "state_age", "phase", "missed_states", "malformed"] == FIELDS


def test_silence_and_malformed_payloads_leave_the_drives_off(upright) -> None:
    rig = Rig(config(), upright)
    for length in (0, 1, 11, 13, 23, 25, 64):
        rig.controller.receive(0, IMU_SOURCE, 0, bytes(length))
        rig.controller.receive(0, 0, messages.STATE + 1, bytes(length))
    for k in range(3):
        for point in setpoints(rig.controller.tick(2_000_000_000 + k * TICK_NS)):
            assert point.controlword == Controlword.DISABLE_VOLTAGE and point.torque == 0.0
    assert rig.field("malformed") == 14


def test_drives_are_walked_up_one_state_at_a_time_and_the_torque_grows(upright) -> None:
    rig, words, modes, growth = Rig(config(), upright), [], [], []
    while rig.field("phase") != Phase.ON:
        rig.step()
        points = setpoints(rig.sent)
        words.append(points[0].controlword)
        assert all(p.state_counter == rig.counter for p in points)
        assert all(p.gain_set == GainSet.STANCE for p in points)
        if words[-1] != Controlword.DISABLE_VOLTAGE:
            modes.append(points[0].mode)
            assert all(p.mode == modes[-1] for p in points)
            assert [p.position for p in points] == pytest.approx(list(upright[7:]), abs=1e-6)
        growth.append(np.abs([p.torque for p in points]).max())
    assert list(dict.fromkeys(words)) == [
        Controlword.SHUTDOWN,
        Controlword.SWITCH_ON,
        Controlword.ENABLE_OPERATION,
    ]
    assert list(dict.fromkeys(modes)) == [Mode.POSITION, Mode.TORQUE]  # held where they were, until it stands
    standing = next(i for i, torque in enumerate(growth) if torque > 0.0)
    assert standing * TICK_NS * 1e-9 == pytest.approx(0.4, abs=0.002)
    assert words.index(Controlword.ENABLE_OPERATION) < 5
    ramp = growth[-300:]  # ticks in the ramp's 0.2 s
    assert ramp[149] / ramp[299] == pytest.approx(0.5, abs=0.02)


def test_a_drive_whose_counter_jumped_back_is_heard_again() -> None:
    """Or the known one was wrong, as from a corrupted frame: its states look old, for up to 22 s."""
    node_id = ROBOT.joints[0].node_id
    controller = Controller(ROBOT, config())

    def receive(now_ms: float, counter: int) -> bool:
        data = messages.encode_state(State(counter, 0, 0, 0, 0, 0, 0, 0, 0, 25))
        controller.receive(round(now_ms * 1e6), 0, messages.STATE + node_id, data)
        return controller._counters[0] == counter

    assert receive(0, 5) and not receive(1, 4)  # reordered
    assert receive(2, 30_000)
    assert not any(receive(2 + n, 6 + n) for n in range(50))
    assert receive(52, 56) and receive(53, 57)


def test_a_fault_is_never_reset_and_a_lost_drive_is_not_brought_back(upright) -> None:
    rig = Rig(config(), upright)
    rig.status[4] = Statusword.FAULT
    rig.run(0.5)
    assert setpoints(rig.sent)[4].controlword == Controlword.DISABLE_VOLTAGE
    assert rig.field("phase") == Phase.ENABLING
    rig = Rig(config(), upright)
    rig.run(0.5)
    rig.status[2] = Statusword.SWITCH_ON_DISABLED
    rig.step()
    expected = [Controlword.ENABLE_OPERATION] * 6
    expected[2] = Controlword.DISABLE_VOLTAGE
    assert [p.controlword for p in setpoints(rig.sent)] == expected


def test_torque_that_is_not_finite_becomes_damping_of_all_drives(upright) -> None:
    rig = Rig(config(), upright)
    rig.run(0.7)
    rig.controller._behaviour.gains[0] = np.nan
    rig.step()
    assert all(p.mode == Mode.DAMPING and p.torque == 0.0 for p in setpoints(rig.sent))


def test_the_path_starts_from_the_captured_centre_of_mass(upright) -> None:
    path = PathConfig(kind="ellipse", semi_x="3cm", semi_z="2cm", period="2s", start="0.8s")
    rig = Rig(config(path=path), upright)
    rig.run(0.75)
    start = [rig.field("com_reference.x"), rig.field("com_reference.z")]
    assert start == pytest.approx([rig.field("com.x"), rig.field("com.z")], abs=1e-3)
    rig.run(0.6)
    moved = np.hypot(rig.field("com_reference.x") - start[0], rig.field("com_reference.z") - start[1])
    assert 1e-3 < moved < 0.03


def test_a_path_that_was_to_start_before_the_robot_stands_does_not_jump(upright) -> None:
    path = PathConfig(kind="ellipse", semi_x="3cm", semi_z="2cm", period="2s", start="0.1s")
    rig = Rig(config(path=path), upright)
    rig.run(0.45)
    start = np.array(rig.fields("com_reference.x", "com_reference.z"))
    last, moved = start, 0.0
    for _ in range(900):
        rig.step()
        reference = np.array(rig.fields("com_reference.x", "com_reference.z"))
        if rig.field("phase") == Phase.RAMP:
            assert np.array_equal(reference, start)
        assert np.abs(reference - last).max() < 2.0 * np.pi / 2.0 * 0.03 * TICK_NS * 1e-9  # its speed on the ellipse
        last, moved = reference, max(moved, np.abs(reference - start).max())
    assert moved > 1e-3


def test_the_tick_is_the_control_law_at_the_estimated_state(upright) -> None:
    """The torque is that of (2.9)-(2.18) at q and v with the base's own position and velocity."""
    rig = Rig(config(internal_force=InternalForceConfig(reference="100N")), upright)
    rig.run(0.65)
    rig.v[:3] += [0.3, -0.2, 0.4]
    rig.v[6:] += np.random.default_rng(0).uniform(-1, 1, 6)
    rig.run(0.02)
    rig.report()
    controller, model = rig.controller, RobotModel(ROBOT)
    integral, felt_force = controller._memory[10:14].copy(), controller._memory[15]
    controller.tick(rig.now + 270_000)
    q, v = controller._space.q.copy(), controller._space.v.copy()
    model.update(q, v)
    q[:3] = -model.feet.mean(axis=0)
    v[:3] = -np.linalg.lstsq(np.vstack([model.Js[:3, :3], model.Js[3:, :3]]), model.Js @ v, rcond=None)[0]
    assert np.abs(v[:3]).max() > 0.1
    model.update(q, v)
    assert rig.fields("com.x", "com.y", "com.z") == pytest.approx(model.com, abs=1e-12)
    velocity = rig.fields("com_velocity.x", "com_velocity.y", "com_velocity.z")
    assert velocity == pytest.approx(model.com_velocity, abs=1e-12)
    kp, kd, ki_dt = controller._behaviour.gains
    error = np.array([*controller._behaviour.start, 0.0, 0.0]) - model.task
    u = kp * error - kd * model.task_velocity + integral + ki_dt * error
    line = model.feet[0] - model.feet[1]
    out = whole_body_control(2, 4)(
        model.A, model.h, model.Js, model.Jsdot_dq, model.Jt, model.Jtdot_dq, u,
        rig.fields(*(f"torque_sensed.{j}" for j in ROBOT.joint_names)), line / np.linalg.norm(line),
        100.0 + 3.0 * (100.0 - felt_force),
    )  # fmt: skip
    torque = np.array(rig.fields(*(f"torque_command.{j}" for j in ROBOT.joint_names)))
    assert torque == pytest.approx(np.array(out[0]).ravel(), rel=1e-8, abs=1e-8)
    internal = float(out[3])
    assert rig.field("internal_force") == pytest.approx(internal, rel=1e-8)
    # (5.2): what is fed back is the sensed force behind a first-order low-pass of 5 Hz
    blend = 1.0 - np.exp(-2.0 * np.pi * 5.0 / 1500.0)
    assert felt_force != internal
    assert controller._memory[15] == pytest.approx(felt_force + blend * (internal - felt_force), rel=1e-12)


def test_compiled_and_interpreted_controllers_are_the_same_to_the_bit(upright) -> None:
    path = PathConfig(kind="ellipse", semi_x="3cm", semi_z="2cm", period="2s", start="0.7s")
    settings = config(internal_force=InternalForceConfig(reference="100N"), path=path)
    rig, twin = Rig(settings, upright), Controller(ROBOT, settings)
    receive = rig.controller.receive

    def both(*measurement: Any) -> None:
        receive(*measurement)
        twin.receive(*measurement)

    rig.controller.receive = both
    for _ in range(1500):
        rig.step()
        assert twin.tick(rig.now - TICK_NS + 270_000) == rig.sent
        assert twin.telemetry.tobytes() == rig.controller.telemetry.tobytes()
    assert rig.field("phase") == Phase.ON


@pytest.mark.parametrize("seconds", [0.0, 0.2, 0.4027, 0.5, 0.9])
def test_a_restored_controller_continues_bit_for_bit(upright, seconds) -> None:
    internal = InternalForceConfig(reference="100N")
    rig = Rig(config(internal_force=internal), upright)
    rig.run(seconds)
    twin = Rig(config(internal_force=internal), upright)
    twin.controller.restore(pickle.loads(pickle.dumps(rig.controller.snapshot())))
    for name, value in vars(rig).items():
        if name not in ("controller", "model"):
            setattr(twin, name, value.copy() if hasattr(value, "copy") else value)
    assert np.array_equal(rig.controller.telemetry, twin.controller.telemetry)
    for _ in range(20):
        rig.step()
        twin.step()
        assert rig.sent == twin.sent
        assert rig.controller.telemetry.tobytes() == twin.controller.telemetry.tobytes()


def test_states_that_came_twice_do_not_hide_states_that_did_not_come(upright) -> None:
    rig = Rig(config(), upright)
    rig.run(0.5)
    before = rig.field("missed_states")
    rig.report()
    rig.report()
    rig.controller.tick(rig.now)
    rig.controller.tick(rig.now + TICK_NS)
    assert rig.field("missed_states") - before == 6


def test_error_decays_and_internal_force_is_the_reference() -> None:
    q = stance(RobotModel(ROBOT), roll=0.02, pitch=0.03)
    rig = Rig(config(internal_force=InternalForceConfig(reference="100N")), q)
    rig.run(0.65)
    worst = 0.0
    for _ in range(3000):
        rig.step()
        worst = max(worst, abs(rig.field("com.x") - rig.field("com_reference.x")))
    assert worst < 0.005
    assert abs(rig.field("com.x") - rig.field("com_reference.x")) < 1e-3
    assert abs(rig.field("com.z") - rig.field("com_reference.z")) < 1e-3
    assert abs(rig.model.rpy[1]) < 1e-3
    assert rig.internal() == pytest.approx(100.0, rel=0.02)
    # The planarizer's lateral force is no part of the controller's model: it pushes the torso in roll, and
    # only the integral works against that, at the rate ki/kp of its slow pole.
    before = rig.model.rpy[0]
    rig.run(4.0)
    gains = rig.controller._config.tasks.roll
    assert rig.model.rpy[0] / before == pytest.approx(np.exp(-4.0 * gains.ki / gains.kp), rel=0.1)


def test_force_feedback_reduces_the_effect_of_weak_drives(upright) -> None:
    errors = []
    for feedback in (False, True):
        internal = InternalForceConfig(reference="100N", feedback=feedback, gain=3.0)
        rig = Rig(config(internal_force=internal), upright, gain=0.8)
        rig.run(2.0)
        errors.append(abs(rig.internal() - 100.0))
    assert errors[0] > 10.0 and errors[1] < 0.5 * errors[0]


def test_the_estimate_is_that_of_the_robot() -> None:
    q = stance(RobotModel(ROBOT), roll=0.02, pitch=0.03)
    rig = Rig(config(), q)
    rig.run(1.0)
    truth = rig.model
    truth.update(rig.q, rig.v)
    assert rig.fields("roll", "pitch", "yaw") == pytest.approx(truth.rpy, abs=2e-3)
    com, com_velocity = (rig.fields(*(f"{what}.{axis}" for axis in "xyz")) for what in ("com", "com_velocity"))
    assert com == pytest.approx(truth.com, abs=2e-3)  # the feet's midpoint is the origin of both
    assert com_velocity == pytest.approx(truth.com_velocity, abs=0.02)


def test_a_tick_is_short(upright) -> None:
    rig = Rig(config(), upright)
    rig.run(0.7)
    times = []
    for _ in range(500):
        rig.report()
        start = time.perf_counter_ns()
        rig.controller.tick(rig.now)
        times.append(time.perf_counter_ns() - start)
        rig.now += TICK_NS
    assert min(times) < 667e3  # must fit into its own period

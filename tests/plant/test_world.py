"""The world node: statics, dynamics against another library, sensors, state."""

import pickle

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from hil.streams import streams
from plant.config import (
    HoistConfig,
    PlanarizerConfig,
    PushConfig,
    SensorConfig,
    StanceConfig,
    TerrainConfig,
    WorldConfig,
)
from plant.world import World
from robots import description, imu, pins

ROBOT = description.load("hume")
SPLIT = TerrainConfig(kind="split", panel_angle="45deg")
APART = StanceConfig(feet_apart="0.5m", feet_width="0.2m", hip_height="0.7m")
QUIET = SensorConfig(noise=0.0, bias=0.0)
SHORT = HoistConfig(hold="0.1s", release="0.2s")


def world(terrain=SPLIT, sensors=QUIET, pushes=(), seed=1, **config):
    config.setdefault("hoist", SHORT)
    return World(ROBOT, WorldConfig(**config), terrain, APART, sensors, pushes, streams(seed))


def hold(node, steps, rows=None, every=30):
    """Position control of the rotors through the pins, damped enough to quiet the bouncing on the springs."""
    actuators = [joint.actuator for joint in ROBOT.joints]
    constant = np.array([a.torque_per_ampere for a in actuators])
    encoder = np.array([joint.sensor.encoder for joint in ROBOT.joints])
    if not hasattr(node, "goal"):
        node.sample()
        node.goal = node.pins_in[:, pins.MOTOR_ENCODER] / encoder
        node.before = node.goal.copy()
    node.pins_out[:, pins.ENABLE] = 1
    for i in range(steps):
        node.sample()
        angle = node.pins_in[:, pins.MOTOR_ENCODER] / encoder
        torque = 800.0 * (node.goal - angle) - 30.0 * (angle - node.before) * 3000.0
        node.before = angle
        node.pins_out[:, pins.CURRENT_DEMAND] = np.rint(torque / constant / pins.AMPERE_PER_COUNT)
        node.latch()
        node.step()
        if rows is not None and i % every == 0:
            rows.append(node.truth().copy())


def column(node, rows, *names):
    return np.array(rows)[:, [node.truth_fields.index(name) for name in names]]


@pytest.mark.parametrize("terrain", [TerrainConfig(), SPLIT], ids=["flat", "split"])
def test_standing_robot_rests_on_the_ground_with_its_weight(terrain):
    node = world(terrain, friction_scale=0.0)  # stuck rotors would let it bounce on its springs for seconds
    hold(node, 15000)
    rows, samples = [], []
    for _ in range(1200):  # long enough for what is left of the bouncing to average out
        hold(node, 5, rows, every=5)
        samples.append(np.concatenate(imu.decode(node.imu(), ROBOT.imu)))
    vertical = column(node, rows, "contact.right_foot.z", "contact.left_foot.z").sum(axis=1)
    horizontal = column(node, rows, "contact.right_foot.x", "contact.left_foot.x")
    weight = ROBOT.mass * ROBOT.gravity
    assert vertical.mean() == pytest.approx(-weight, rel=1e-3)
    assert horizontal.sum(axis=1).mean() == pytest.approx(0.0, abs=0.01 * weight)
    assert column(node, rows, "hoist").max() == 0.0
    assert not node.fallen()
    pitch = column(node, rows, "base.pitch").ravel()
    force = np.mean(samples, axis=0)[3:]
    expected = ROBOT.gravity * np.array([-np.sin(pitch).mean(), 0.0, np.cos(pitch).mean()])
    np.testing.assert_allclose(force, expected, atol=0.05)
    turned = np.trapezoid(np.array(samples)[:, 1], dx=5 / 3000.0)
    assert turned == pytest.approx(pitch[-1] - pitch[0], abs=1e-3)
    node.sample()
    assert node.pins_in[[2, 5], pins.SWITCHES].tolist() == [pins.FOOT_SWITCH] * 2
    assert node.pins_in[[0, 1, 3, 4], pins.SWITCHES].tolist() == [0] * 4


def test_vertical_momentum_balances():
    node = world()
    hold(node, 1000)  # the hoist has let go, the robot bounces
    before, rows = node.truth().copy(), []
    hold(node, 900, rows, every=1)
    impulse = -column(node, rows, "contact.right_foot.z", "contact.left_foot.z").sum() / 3000.0
    velocity = column(node, [before, rows[-1]], "com_velocity.z").ravel()
    assert np.ptp(column(node, rows, "com_velocity.z")) > 0.01
    expected = ROBOT.mass * (ROBOT.gravity * 900 / 3000.0 + velocity[1] - velocity[0])
    assert impulse == pytest.approx(expected, rel=1e-3)


def test_internal_force_is_the_force_along_the_line_from_left_to_right():
    node = world()
    hold(node, 3000)
    truth = dict(zip(node.truth_fields, node.truth().tolist(), strict=True))
    foot, force = (
        {s: np.array([truth[f"{what}.{s}_foot.{axis}"] for axis in "xyz"]) for s in ("right", "left")}
        for what in ("foot", "contact")
    )
    line = foot["right"] - foot["left"]
    expected = line / np.linalg.norm(line) @ (force["right"] - force["left"])
    assert truth["internal_force"] == pytest.approx(expected, rel=1e-12)
    assert expected > 0.0  # standing in a valley pushes the panels apart


def test_an_unpowered_robot_falls_when_the_hoist_lets_go():
    node = world()
    assert not node.fallen()
    for _ in range(4500):
        node.step()
    assert node.fallen()


def test_the_hoist_carries_the_torso():
    node = world(hoist=HoistConfig(hold="2s", release="0s"))
    start = node.data.qpos[:4].copy()
    for _ in range(3000):
        node.step()
    np.testing.assert_allclose(node.data.qpos[:4], start, atol=2e-3)


def _pinocchio(robot):
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")

    def inertia(link):
        return pin.Inertia(link.mass, np.array(link.com), np.diag(link.inertia))

    model.appendBodyToJoint(root, inertia(robot.base), pin.SE3.Identity())
    ids = {robot.base.name: root}
    for joint in robot.joints:
        placement = pin.SE3(np.eye(3), np.array(joint.position))
        revolute = pin.JointModelRevoluteUnaligned(np.array(joint.axis))
        ids[joint.name] = model.addJoint(ids[joint.parent], revolute, placement, joint.name)
        model.appendBodyToJoint(ids[joint.name], inertia(joint.link), pin.SE3.Identity())
    return model


@pytest.mark.parametrize("variant", [None, "srlib"])
def test_mass_matrix_and_weight_are_pinocchios(variant):
    node = world(planarizer=PlanarizerConfig(enabled=False), variant=variant)
    model = _pinocchio(description.load("hume", variant))
    model.gravity.linear = np.array([0.0, 0.0, -ROBOT.gravity])
    data = model.createData()
    rng = np.random.default_rng(5)
    for _ in range(5):
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        position, joints = rng.normal(size=3), rng.uniform(-0.8, 0.8, 6)
        node.data.qpos[:] = [*position, *quaternion, *joints]
        node.data.qvel[:] = 0.0
        mujoco.mj_forward(node.model, node.data)
        mass = np.zeros((12, 12))
        mujoco.mj_fullM(node.model, node.data, mass)
        q = np.array([*position, *quaternion[[1, 2, 3, 0]], *joints])
        turn = np.eye(12)  # MuJoCo's base velocity is linear in the world's frame, Pinocchio's in the base's
        turn[:3, :3] = pin.XYZQUATToSE3(q[:7]).rotation.T
        expected = pin.crba(model, data, q)
        expected = np.triu(expected) + np.triu(expected, 1).T
        np.testing.assert_allclose(mass, turn.T @ expected @ turn, atol=1e-10)
        gravity = pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(node.data.qfrc_bias, turn.T @ gravity, atol=1e-9)


PUSH = PushConfig(at="50ms", duration="40ms", ramp="10ms", force=("40N", "0N", "-5N"))


@pytest.mark.parametrize(
    "planarizer", [PlanarizerConfig(), PlanarizerConfig(lock_x=True), PlanarizerConfig(enabled=False)],
    ids=["sliding", "locked", "none"],
)  # fmt: skip
def test_a_restored_world_continues_bit_for_bit(planarizer):
    def record(node):
        rows, samples = [], []
        for i in range(240):
            hold(node, 1, rows, every=1)
            if i % 2 == 0:
                samples.append(node.imu())
        return np.array(rows), samples

    config = {"planarizer": planarizer, "pushes": [PUSH], "sensors": SensorConfig()}
    node = world(**config)
    hold(node, 200)
    node.imu()
    saved = pickle.dumps(node.snapshot())
    goal, before = node.goal, node.before
    rows, samples = record(node)
    for other in (node, world(**config)):
        other.restore(pickle.loads(saved))
        other.goal, other.before = goal, before
        again, samples_again = record(other)
        assert (again == rows).all()
        assert samples_again == samples


def test_runs_of_one_seed_are_equal_and_of_another_differ_in_noise_only():
    same, twin, other = (world(sensors=SensorConfig(), seed=seed) for seed in (1, 1, 2))
    assert same.imu() == twin.imu() != other.imu()
    assert (same.truth() == other.truth()).all()


def test_a_locked_slider_stays_where_it_is():
    """200 N for 0.1 s would move 28 kg that are free by 35 mm; the hoist's springs are off by then."""
    push = PushConfig(at="50ms", duration="100ms", force=("200N", "0N", "0N"))
    moved = {}
    for locked in (False, True):
        node = world(
            pushes=[push], hoist=HoistConfig(hold="0s", release="0s"), planarizer=PlanarizerConfig(lock_x=locked)
        )
        rows = []
        hold(node, 450, rows, every=1)
        moved[locked] = np.ptp(column(node, rows, "base.x"))
    assert moved[True] < 1e-4 < 2e-3 < moved[False]


@pytest.mark.parametrize("ramp", ["0s", "10ms"])
def test_push_has_its_impulse(ramp):
    push = PUSH.model_copy(update={"ramp": PushConfig(at=0, duration=0, ramp=ramp, force=(0, 0, 0)).ramp})
    node = world(pushes=[push])
    rows = []
    hold(node, 600, rows, every=1)
    impulse = column(node, rows, "push.x", "push.y", "push.z").sum(axis=0) / 3000.0
    np.testing.assert_allclose(impulse, np.array(push.force) * (push.duration + push.ramp), rtol=1e-6)


def test_imu_noise_has_its_density():
    node = world(sensors=SensorConfig(bias=0.0))
    samples = np.array([np.concatenate(imu.decode(node.imu(), ROBOT.imu)) for _ in range(4000)])
    deviation = samples.std(axis=0)
    np.testing.assert_allclose(deviation[:3], ROBOT.imu.gyro_noise_density * 1500**0.5, rtol=0.05)
    np.testing.assert_allclose(deviation[3:], ROBOT.imu.accelerometer_noise_density * 1500**0.5, rtol=0.05)


def test_pins_carry_the_scales_of_the_electronics():
    node = world()
    inputs, outputs = np.zeros((6, pins.N_INPUTS), np.int32), np.zeros((6, pins.N_OUTPUTS), np.int32)
    node.attach_pins(inputs, outputs)
    start = dict(zip(node.truth_fields, node.truth().tolist(), strict=True))
    outputs[:, pins.CURRENT_DEMAND] = [100, -200, 300, -5000, 5000, 7]
    outputs[:, pins.ENABLE] = [1, 1, 1, 1, 1, 0]
    node.latch()
    node.step()
    node.sample()
    assert inputs[:, pins.CURRENT_ADC].tolist() == [100, -200, 300, -1300, 2750, 0]
    assert (inputs[:, pins.SUPPLY_ADC] == 4800).all() and (inputs[:, pins.TEMPERATURE_ADC] == 250).all()
    for _ in range(100):
        node.step()
    node.sample()
    truth = dict(zip(node.truth_fields, node.truth().tolist(), strict=True))
    for joint, row in zip(ROBOT.joints, inputs, strict=True):
        theta, q, zero = truth[f"motor.{joint.name}"], truth[f"q.{joint.name}"], start[f"motor.{joint.name}"]
        turned = joint.sensor.encoder * theta, joint.sensor.encoder * zero
        assert row[pins.MOTOR_ENCODER] == round(turned[0]) - round(turned[1])  # from zero at power-on
        assert row[pins.SPRING_ENCODER] == round(joint.spring_counts_per_rad * (theta - q))
        assert row[pins.JOINT_ENCODER] == round(joint.sensor.joint_encoder * q)
        assert row[pins.TEMPERATURE_ADC] == round(truth[f"winding.{joint.name}"] / pins.KELVIN_PER_COUNT)
        assert row[pins.FORCE_ADC] == 0  # Hume has no load cells


def test_origin_is_the_midpoint_of_the_feet_and_the_right_foot_is_in_front():
    node = world()
    truth = dict(zip(node.truth_fields, node.truth().tolist(), strict=True))
    for axis, apart in zip("xyz", (0.5, -0.2, 0.0), strict=True):
        right, left = truth[f"foot.right_foot.{axis}"], truth[f"foot.left_foot.{axis}"]
        assert right + left == pytest.approx(0.0, abs=1e-9)
        assert right - left == pytest.approx(apart, abs=1e-9)


def test_sensors_of_the_joints_have_the_described_bias_and_noise():
    """The spring's zero is off by a constant, the current by a constant and white noise; encoders only quantise."""
    true, sensed = world(sensors=QUIET), [world(sensors=SensorConfig(), seed=seed) for seed in range(40)]
    true.sample()
    exact = true.pins_in.copy()
    off = []
    for node in sensed:
        rows = []
        for _ in range(60):
            node.sample()
            rows.append(node.pins_in - exact)
        rows = np.array(rows, float)
        assert not rows[:, :, [pins.MOTOR_ENCODER, pins.TEMPERATURE_ADC, pins.SUPPLY_ADC]].any()
        assert not np.ptp(rows[:, :, pins.SPRING_ENCODER], axis=0).any()
        off.append((rows[0, :, pins.SPRING_ENCODER], rows[:, :, pins.CURRENT_ADC].mean(0), rows.std(0)[:, 2]))
    resolution = np.array([joint.sensor.torque_resolution for joint in ROBOT.joints])
    torque, current, noise = (np.array(kind) for kind in zip(*off, strict=True))
    # 240 draws: the deviation of a deviation is 1/sqrt(2 n), 5 %
    assert (torque * resolution).std() == pytest.approx(0.2, rel=0.2)
    assert (current * pins.AMPERE_PER_COUNT).std() == pytest.approx(0.1, rel=0.2)
    assert (noise * pins.AMPERE_PER_COUNT).mean() == pytest.approx(0.05, rel=0.05)

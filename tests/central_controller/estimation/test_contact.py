"""Forces at the feet from torques: against inverse dynamics by pinocchio, and against the physics of a run."""

import numpy as np
import pinocchio as pin
import pytest

from bus import messages
from central_controller.behaviours.behaviour import Workspace
from central_controller.config import ControllerConfig
from central_controller.estimation.contact import Contact, fields
from central_controller.model import BASE, RobotModel
from hil.run import Request, assemble, run
from hil.scenario import load
from robots import description

ROBOT = description.load("hume")
RATE = 1500.0
BENT = np.array([0.1, -0.5, 1.1, -0.08, -0.6, 1.2])
STRAIGHT = np.array([0.0, 0.0, 0.0, 0.0, -0.6, 1.2])  # thigh and shank of the right leg in line


class Rig:
    """A robot that moves as told, its torques by inverse dynamics, in front of the estimator."""

    def __init__(self, contact: str = "force", **config: object) -> None:
        n = len(ROBOT.joints)
        self.model = RobotModel(ROBOT)
        self.space = Workspace(
            ROBOT, ControllerConfig.model_validate({"contact": contact, "contact_force": config}), self.model,
            counts=np.zeros(3 * n), gyro=np.zeros(3), force=np.zeros(3), contacts=np.zeros(2),
            q=np.zeros(BASE + 1 + n), v=np.zeros(BASE + n),
        )  # fmt: skip
        self.contact = Contact(self.space, np.zeros(3), lambda function: function)
        self.names = fields(ROBOT)

    def feel(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, forces: np.ndarray, switches: tuple = (0, 0)) -> None:
        """One tick in state ``q``, ``v`` (pinocchio's) with accelerations ``a`` and ``forces`` (2, 3) on the ground."""
        model, space = self.model, self.space
        torque = pin.rnea(model.model, model.data, q, v, a)
        model.update(q, v)
        torque = (torque + model.Js.T @ forces.ravel())[BASE:]
        space.counts[:] = np.concatenate([
            q[7:] / messages.RADIAN, v[6:] / messages.RADIAN_PER_SECOND, torque / messages.NEWTON_METRE
        ])  # fmt: skip
        spin, lever = v[3:6], np.array(ROBOT.imu.position)
        linear = a[:3] + np.cross(spin, v[:3])  # classical acceleration of the origin
        up = pin.Quaternion(q[3:7]).toRotationMatrix().T @ [0.0, 0.0, ROBOT.gravity]
        space.force[:] = linear + up + np.cross(a[3:6], lever) + np.cross(spin, np.cross(spin, lever))
        space.gyro[:] = spin
        space.contacts[:] = switches
        space.q[:], space.v[:] = q, v
        space.q[:3], space.v[:3] = 0.0, 0.0  # the controller does not know where it is, nor how fast
        model.compute(space.q, space.v)
        self.contact.tell()

    def hold(self, joints: np.ndarray, press: tuple[float, float], ticks: int = 60, **more: tuple) -> None:
        """Stand still, both feet pressing down with so many N."""
        forces = np.array([[0.0, 0.0, -press[0]], [0.0, 0.0, -press[1]]])
        quaternion = pin.Quaternion(pin.rpy.rpyToMatrix(0.05, -0.1, 0.7)).coeffs()
        q = np.concatenate([np.zeros(3), quaternion, joints])
        for _ in range(ticks):
            self.feel(q, np.zeros(12), np.zeros(12), forces, **more)

    def told(self, what: str) -> np.ndarray:
        return np.array([self.contact.telemetry[self.names.index(f"{what}.{foot.name}")] for foot in ROBOT.feet])


def test_at_rest_the_forces_are_those_that_the_torques_hold() -> None:
    rig = Rig()
    rig.hold(BENT, (120.0, 55.0))
    assert rig.told("foot_press") == pytest.approx([120.0, 55.0], abs=0.05)
    q = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0], BENT])
    sideways = np.array([[30.0, -12.0, -90.0], [5.0, 8.0, 0.0]])
    for _ in range(60):
        rig.feel(q, np.zeros(12), np.zeros(12), sideways)
    np.testing.assert_allclose(rig.contact._forces.T, sideways, atol=0.05)


def _swaying(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All joints and the base swing at 0.6 to 4 Hz; q, v, a at ``t``, in pinocchio's coordinates by differences."""
    model, d = RobotModel(ROBOT).model, 1e-4

    def place(t: float) -> np.ndarray:
        rotation = pin.rpy.rpyToMatrix(0.08 * np.sin(8 * t), 0.1 * np.sin(6 * t + 1), 0.2 * np.sin(4 * t))
        base = [0.05 * np.sin(6 * t), 0.04 * np.sin(9 * t), 0.8 + 0.03 * np.sin(12 * t)]
        joints = BENT + 0.3 * np.sin(np.array([16, 19, 25, 15, 18, 24]) * t + np.arange(6))
        return np.concatenate([base, pin.Quaternion(rotation).coeffs(), joints])

    def velocity(t: float) -> np.ndarray:
        return pin.difference(model, place(t - d), place(t + d)) / (2 * d)

    return place(t), velocity(t), (velocity(t + d) - velocity(t - d)) / (2 * d)


def test_a_leg_that_swings_while_the_torso_sways_feels_nothing_and_a_step_of_force_at_once() -> None:
    """Swinging takes up to tens of N m; without accelerations that would be taken for tens of N."""
    rig = Rig()
    free, loaded, static = [], [], []
    ticks = 450
    for k in range(2 * ticks):
        q, v, a = _swaying(k / RATE)
        pressing = k >= ticks
        rig.feel(q, v, a, np.array([[0.0, 0.0, -60.0 * pressing], [0.0, 0.0, 0.0]]))
        if k >= 60:
            (loaded if pressing else free).append(rig.told("foot_press"))
            torque = pin.rnea(rig.model.model, rig.model.data, q, np.zeros(12), np.zeros(12))
            gravity_alone = messages.NEWTON_METRE * rig.space.counts[12:] - torque[BASE:]
            rig.model.update(q, v)
            leg = rig.model.Js[:3, BASE : BASE + 3]
            static.append(-np.linalg.solve(leg.T, gravity_alone[:3])[2])
    free_forces, loaded_forces = np.array(free), np.array(loaded)
    assert np.abs(free_forces).max() < 1.0 < 20.0 < np.abs(static[: len(free)]).max()
    right, left = loaded_forces.T
    assert np.abs(left).max() < 1.0
    assert np.argmax(right > 20.0) <= 4  # ticks: 2.7 ms
    assert right[60:] == pytest.approx(60.0, abs=1.0)


def test_contact_begins_and_ends_with_hysteresis() -> None:
    rig = Rig(press="40N", release=0.5)
    for press, expected in ((30.0, 0), (45.0, 1), (30.0, 1), (15.0, 0), (30.0, 0)):
        rig.hold(BENT, (press, 100.0), switches=(0, 0))
        assert rig.space.contacts.tolist() == [expected, 1]
        assert rig.told("foot_contact").tolist() == [expected, 1] and rig.told("foot_switch").tolist() == [0, 0]


@pytest.mark.parametrize(("switch", "press", "contact"), [(0, 60, 0), (1, 0, 0), (1, 60, 1), (0, 0, 0)])
def test_both_must_say_so(switch: int, press: float, contact: int) -> None:
    rig = Rig("both")
    rig.hold(BENT, (press, press), switches=(switch, switch))
    assert rig.space.contacts.tolist() == [contact, contact]


@pytest.mark.parametrize("press", [0.0, 80.0])
def test_a_straight_leg_keeps_what_was_believed(press: float) -> None:
    """No torque tells what presses along a straight leg; the other one still does."""
    rig = Rig()
    rig.hold(BENT, (press, 0.0))
    before = rig.space.contacts[0]
    assert before == (press > 0.0)
    rig.hold(_aligned(), (80.0 - press, 80.0), ticks=300)
    assert rig.space.contacts.tolist() == [before, 1]
    assert np.isfinite(rig.contact.telemetry).all()


def _aligned() -> np.ndarray:
    """Joints of which the right knee puts its foot on the line from the hip through the knee."""
    knee, foot = np.array(ROBOT.joints[2].position), np.array(ROBOT.feet[0].position)
    bend = np.arctan2(knee[0], -knee[2]) - np.arctan2(foot[0], -foot[2])
    joints = STRAIGHT.copy()
    joints[2] = -bend
    return joints


def test_it_goes_on_from_a_snapshot() -> None:
    rig = Rig()
    rig.hold(BENT, (60.0, 0.0), ticks=7)
    state = rig.contact.snapshot()
    ends = []
    for _ in range(2):
        rig.hold(BENT, (0.0, 60.0), ticks=9)
        ends.append(rig.contact.telemetry.copy())
        rig.contact.restore(state)
    assert np.array_equal(*ends)


def test_touch_downs_of_a_run_are_felt_within_three_milliseconds_and_none_in_the_air() -> None:
    """By the physics' own contact forces, with the drives' noise, biases and delays."""
    outcome = run(Request(load("balance", ["duration=2.8s", "controller.contact=force"]), 0, "inline", report=False))
    controller, world = outcome.tables["controller"], outcome.tables["world"]
    after = controller.seconds > 1.45  # stepping has begun
    rows = world.latest_before(controller.times - 470_000)  # the tick before the answer
    touched = 0
    for foot in ("right_foot", "left_foot"):
        true, believed = -world[f"contact.{foot}.z"][rows], controller[f"foot_contact.{foot}"]
        number = np.arange(len(true))
        last = np.maximum.accumulate(np.where(true > 0.0, number, -1000))
        in_the_air = after & (number - last > 0.02 * RATE)
        assert in_the_air.sum() > 300 and believed[in_the_air].max() == 0.0
        for row in np.flatnonzero(after[1:] & (true[1:] > 0.0) & in_the_air[:-1]) + 1:
            assert believed[row : row + 5].max() == 1.0
            touched += 1
    assert touched >= 2
    pressed = (controller["phase"] == 3) & (controller.seconds < 1.2)  # standing
    error = controller["foot_press.left_foot"][pressed] + world["contact.left_foot.z"][rows][pressed]
    assert np.sqrt(np.mean(error**2)) < 8.0


def test_a_run_with_it_goes_on_from_a_snapshot() -> None:
    with assemble(Request(load("balance", ["duration=3s", "controller.contact=both"]), 0, "inline")) as assembly:
        system = assembly.system
        system.run_until(1_650_000_000)
        before = system.snapshot()
        ends = []
        for _ in range(2):
            system.run_until(1_750_000_000)
            ends.append(system.controller.finish()[1].copy())
            system.restore(before)
        assert np.array_equal(*ends, equal_nan=True)

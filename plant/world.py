"""The world node: physics, actuators and sensors behind the pins."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import mujoco
import numpy as np

from plant import stance as stances
from plant.actuators.bank import ActuatorBank
from plant.config import MotionCaptureConfig, PushConfig, SensorConfig, StanceConfig, TerrainConfig, WorldConfig
from plant.joint_faults import FaultyJoints
from plant.model import bends, build, coordinates, initial_qpos
from plant.motion_capture import MotionCaptureSystem
from plant.sensors import ImuSensor, JointSensors
from robots import description, pins
from robots.description import Robot

# The hoist carries the robot's weight; its stiffness and damping keep the torso in place meanwhile.
_HOIST_LINEAR = (2e4, 1.5e3)  # N/m, N s/m
_HOIST_ANGULAR = (2e3, 1e2)  # N m/rad, N m s/rad


def _identity(function: ca.Function) -> ca.Function:
    return function


class World:
    """Physics of one robot on its terrain.

    ``pins_in`` and ``pins_out`` are the drives' pins, int32 (joints, ``N_INPUTS`` or ``N_OUTPUTS``).
    Origin: the midpoint of the feet's centres at the start; x forward, z up.
    """

    def __init__(
        self,
        robot: Robot,
        config: WorldConfig,
        terrain: TerrainConfig,
        stance: StanceConfig,
        sensors: SensorConfig,
        pushes: Sequence[PushConfig],
        streams: Callable[[str], Any],
        compile: Callable[[ca.Function], ca.Function] = _identity,
        imu_rate: float = 1500.0,
        motion_capture: MotionCaptureConfig = MotionCaptureConfig(),
    ) -> None:
        if config.variant is not None:
            robot = description.load(robot.source, config.variant)
        if config.mass_error:
            robot = robot.with_masses(1.0 + config.mass_error)
        self.robot = robot
        self._config = config
        self._pushes = tuple((push, np.array(push.force)) for push in pushes)
        start = stances.initial(robot, stance)
        if robot.imu is None:
            raise stances.StanceError(f"standing needs an IMU in the torso; {robot.name} has none")
        self.model = build(
            robot, start, terrain, config.planarizer, config.rate, config.shank_stiffness, motion_capture.enabled
        )
        self.data = mujoco.MjData(self.model)
        n = len(robot.joints)
        self._dt = 1.0 / config.rate
        self.data.qpos[:] = initial_qpos(self.model, robot, start)
        self._start = self.data.qpos.copy()
        self._at = at = coordinates(self.model, robot.joint_names)
        self._base_dofs = at.base
        # views where the joints lie together, for MuJoCo never moves its arrays; else copies, see _follow
        self._q, self._dq = self.data.qpos[at.positions], self.data.qvel[at.velocities]
        self._copied = not isinstance(at.positions, slice)
        self._bends = bends(self.model, robot)
        self._bend_at = [int(self.model.joint(name).qposadr[0]) for name in self._bends]
        self._applied = self.data.qfrc_applied
        self._hoisted = True  # whether the hoist's force is, or may be, among what is applied
        self._torso = self.model.body(robot.base.name).id
        self._push = self.data.xfrc_applied[self._torso]
        self._rotation = self.data.xmat[self._torso]
        self._sensed = self.data.sensordata
        self._sensed_items: memoryview[float] = memoryview(self._sensed)  # faster to read one by one
        self._motion = self._sensed[21:27]  # of the IMU
        stages = np.repeat(self.model.sensor_needstage, self.model.sensor_dim)
        self._of_the_step_before = stages == mujoco.mjtStage.mjSTAGE_ACC  # forces and accelerations
        self._actuators = ActuatorBank(robot, self._dt, config.friction_scale, compile, self._q, self._dq)
        self._joint_sensors = JointSensors(robot, sensors, streams, compile, self._actuators)
        self.faults = FaultyJoints(robot, self._actuators, streams)
        self._imu = ImuSensor(robot.imu, sensors, imu_rate, streams)
        self.motion_capture: MotionCaptureSystem | None = None
        if motion_capture.enabled:
            if robot.motion_capture is None:
                raise ValueError(f"{robot.name} has no LEDs for motion capture")
            self.motion_capture = MotionCaptureSystem(
                robot.motion_capture, motion_capture, sensors, self.model, self.data, streams
            )
        self.attach_pins(np.zeros((n, pins.N_INPUTS), np.int32), np.zeros((n, pins.N_OUTPUTS), np.int32))
        self._ampere_per_count = np.array([joint.actuator.ampere_per_count for joint in robot.joints])
        self._steps = 0
        self._state_size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(self.model, self.data)
        self._support = self.data.qfrc_bias[: self._base_dofs].copy()  # generalised weight at the start
        self._hoist_base(self._hoist(0.0))  # the accelerometer's first sample is not that of a free fall
        mujoco.mj_forward(self.model, self.data)

        self.truth_fields = self._name_truth()
        self._truth = np.zeros(len(self.truth_fields))
        self._angles, self._between, self._share = np.zeros(3), np.zeros(1), np.zeros(1)
        self._bent = np.zeros(len(self._bends))
        seen = self._actuators.observe()
        self._truth_parts = (
            self._q, self._dq, seen.motor, seen.motor_velocity, seen.torque, seen.current, seen.temperature,
            self._sensed[0:3], self._angles, self._sensed[3:21], self._between, self._push[:3], self._share,
            self.data.qpos, self._bent,
        )  # fmt: skip

    def attach_pins(self, pins_in: np.ndarray, pins_out: np.ndarray) -> None:
        """Use these arrays as the pins, e.g. in memory shared with the drives."""
        self.pins_in, self.pins_out = pins_in, pins_out
        self._demands, self._enabled = pins_out[:, pins.CURRENT_DEMAND], pins_out[:, pins.ENABLE]

    @property
    def steps(self) -> int:
        """Physics steps so far."""
        return self._steps

    @property
    def actuators(self) -> ActuatorBank:
        """Of the joints, in their order."""
        return self._actuators

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._steps * self._dt

    # --- what the calendar calls --------------------------------------------------------------------------

    def sample(self) -> None:
        """Write the drives' input pins from the present state."""
        sensed = self._sensed_items
        self._joint_sensors.write(self.pins_in, (-sensed[17], -sensed[20]))  # a foot's force on the ground points down
        if self.faults.on_pins:
            self.faults.apply(self.pins_in)

    def latch(self) -> None:
        """Let the drives' output pins take effect from now on."""
        current = self._actuators.current
        np.multiply(self._demands, self._ampere_per_count, out=current)
        current *= self._enabled != 0

    def step(self) -> None:
        """One physics step."""
        now = self.time
        joints = self._at.velocities
        self._applied[joints] = self._actuators.step()
        if self.faults.loaded:
            self._applied[joints] += self.faults.load
        if self._hoisted:
            self._hoist_base(self._hoist(now))
        if self._pushes:
            self._push[:3] = self._push_force(now + 0.5 * self._dt)  # mid-step: the impulse is exact
        # the second half of this step, then the first of the next: positions sensed are of the new state
        mujoco.mj_step2(self.model, self.data)
        self._steps += 1
        mujoco.mj_step1(self.model, self.data)
        if self._copied:
            self._follow()

    def imu(self) -> bytes:
        """One sample of the IMU on its wire."""
        return self._imu.sample(self._motion)

    def truth(self) -> np.ndarray:
        """The physical truth now, float64, named by ``truth_fields``; the array is reused."""
        sensed = self._sensed_items
        self._actuators.observe()
        self._angles[:] = self._roll_pitch_yaw()
        # along the line from the left to the right foot; by hand, as products of a BLAS differ by processor
        x, y, z = sensed[9] - sensed[12], sensed[10] - sensed[13], sensed[11] - sensed[14]
        fx, fy, fz = sensed[15] - sensed[18], sensed[16] - sensed[19], sensed[17] - sensed[20]
        self._between[0] = (x * fx + y * fy + z * fz) / math.sqrt(x * x + y * y + z * z)
        self._share[0] = self._hoist(self.time)
        if self._bends:
            np.take(self.data.qpos, self._bend_at, out=self._bent)
        return np.concatenate(self._truth_parts, out=self._truth)

    def every_step(self) -> list[tuple[list[str], np.ndarray]]:
        """Names and views of what every physics step changes, to be copied after it: what the record of the last
        seconds before a fall holds. For the generalised coordinates see plant.model."""
        joints, sensed = self.robot.joint_names, self._sensed
        feet = [foot.name for foot in self.robot.feet]
        states = sorted(
            (at, f"{name}.{joint}")
            for joint, index in zip(joints, self._actuators.symbols.state_index, strict=True)
            for name, at in index.items()
        )
        names = [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
        names += [f"{what}.{foot}.{axis}" for what in ("foot", "contact") for foot in feet for axis in "xyz"]
        return [
            ([f"qpos.{i}" for i in range(self.model.nq)], self.data.qpos),
            ([f"qvel.{i}" for i in range(self.model.nv)], self.data.qvel),
            ([f"demand.{joint}" for joint in joints], self._actuators.current),
            ([f"torque.{joint}" for joint in joints], self._actuators.torque),
            ([f"actuator.{name}" for _, name in states], self._actuators.state),
            (names, sensed[3:21]),
        ]

    def fallen(self) -> bool:
        """Whether the torso touches the ground."""
        return bool(self._sensed[36] > 0)

    def _follow(self) -> None:
        """Copy the joints' coordinates to where actuators and sensors read them."""
        np.take(self.data.qpos, self._at.positions, out=self._q)
        np.take(self.data.qvel, self._at.velocities, out=self._dq)

    # --- inside -------------------------------------------------------------------------------------------

    def _name_truth(self) -> list[str]:
        joints = self.robot.joint_names
        names = [
            f"{what}.{joint}"
            for what in ("q", "dq", "motor", "dmotor", "spring_torque", "motor_current", "winding")
            for joint in joints
        ]
        names += [f"base.{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
        names += [f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"]
        feet = [foot.name for foot in self.robot.feet]
        names += [f"{what}.{foot}.{axis}" for what in ("foot", "contact") for foot in feet for axis in "xyz"]
        names += ["internal_force", "push.x", "push.y", "push.z", "hoist"]
        return names + [f"qpos.{i}" for i in range(self.model.nq)] + [f"bend.{name}" for name in self._bends]

    def _roll_pitch_yaw(self) -> tuple[float, float, float]:
        r = self._rotation.tolist()
        pitch = math.asin(min(1.0, max(-1.0, -r[6])))
        return math.atan2(r[7], r[8]), pitch, math.atan2(r[3], r[0])

    def _hoist(self, now: float) -> float:
        """Share of the hoist's support at ``now``, 1 to 0."""
        config = self._config.hoist
        if now < config.hold:
            return 1.0
        return max(0.0, 1.0 - (now - config.hold) / config.release) if config.release > 0 else 0.0

    def _hoist_base(self, share: float) -> None:
        dofs = self._base_dofs
        if share == 0.0:
            self._applied[:dofs] = 0.0
            self._hoisted = False
            return
        qpos, velocity = self.data.qpos, self.data.qvel[:dofs]
        if dofs == 4:  # planarizer: x, z, roll, pitch
            deviation, linear = qpos[:4] - self._start[:4], 2
        else:  # free joint: twice a small quaternion's vector part is the rotation vector
            sign = 1.0 if qpos[3] >= 0 else -1.0
            deviation = np.concatenate([qpos[:3] - self._start[:3], 2.0 * sign * qpos[4:7]])
            linear = 3
        for part, (stiffness, damping) in (
            (slice(0, linear), _HOIST_LINEAR),
            (slice(linear, dofs), _HOIST_ANGULAR),
        ):
            wrench = self._support[part] - stiffness * deviation[part] - damping * velocity[part]
            self._applied[part] = share * wrench

    def _push_force(self, now: float) -> np.ndarray:
        total = np.zeros(3)
        for push, force in self._pushes:
            inside = min(now - push.at + push.ramp, push.at + push.duration + push.ramp - now)
            if inside > 0:
                total += force * (min(inside / push.ramp, 1.0) if push.ramp > 0 else 1.0)
        return total

    # --- state --------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        state = np.empty(self._state_size)
        mujoco.mj_getState(self.model, self.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        return {
            "state": state,
            "sensed": self._sensed.copy(),
            "steps": self._steps,
            "actuators": self._actuators.snapshot(),
            "joint_sensors": self._joint_sensors.snapshot(),
            "imu": self._imu.snapshot(),
            "motion_capture": None if self.motion_capture is None else self.motion_capture.snapshot(),
            "faults": self.faults.snapshot(),
            "pins": (self.pins_in.copy(), self.pins_out.copy()),
        }

    def restore(self, state: dict[str, Any]) -> None:
        mujoco.mj_setState(self.model, self.data, state["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step1(self.model, self.data)
        if self._copied:
            self._follow()
        late = self._of_the_step_before
        self._sensed[late] = state["sensed"][late]
        self._steps = state["steps"]
        self._hoisted = True
        self._actuators.restore(state["actuators"])
        self._joint_sensors.restore(state["joint_sensors"])
        self._imu.restore(state["imu"])
        if self.motion_capture is not None:
            self.motion_capture.restore(state["motion_capture"])
        self.faults.restore(state["faults"])
        self.pins_in[:], self.pins_out[:] = state["pins"]

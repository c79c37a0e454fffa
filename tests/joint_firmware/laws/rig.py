"""A torque loop alone, a drive's law alone, and an actuator with its output held, in plain floats."""

import numpy as np

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import TORQUE_LOOPS, Offsets, drive_law, torque_loop_function
from joint_firmware.laws import signals as law
from joint_firmware.memory import LawMemory
from joint_firmware.protection_config import UNPROTECTED
from robots import description, pins

HIP = description.load("hume").joint("right_hip")
ANKLE = description.load("vlca").joint("ankle")
KNEE = description.load("valve").joint("knee")
DT = 1.0 / 3000.0

MODES = {
    "torque": law.U_TORQUE_MODE, "position": law.U_POSITION_MODE, "damping": law.U_DAMPING_MODE,
    "open loop": law.U_OPEN_LOOP_MODE, "motor position": law.U_MOTOR_POSITION_MODE,
    "joint position": law.U_JOINT_POSITION_MODE, "impedance": law.U_IMPEDANCE_MODE, "none": None,
}  # fmt: skip


class LoopAlone:
    """``torque_loop_function(name)`` with its states."""

    def __init__(self, name, joint=HIP, config=FirmwareConfig()):
        loop = TORQUE_LOOPS[name]
        values = loop.values(joint, config, Offsets())
        function = torque_loop_function(name)
        self._signals, self._gains = np.zeros(4), np.zeros(3)
        self._x, self._next, self._effort = np.zeros(len(loop.states)), np.zeros(len(loop.states)), np.zeros(1)
        parameters = np.array([values[key] for key in loop.parameters])
        self._buffer, self._evaluate = function.buffer()
        self._kept = (self._signals, self._gains, self._x, parameters)
        for n, array in enumerate(self._kept):
            self._buffer.set_arg(n, memoryview(array))
        for n, array in enumerate((self._next, self._effort)):
            self._buffer.set_res(n, memoryview(array))

    def __call__(self, reference, torque, motor_velocity=0.0, velocity=0.0, kp=3.0, ki=0.0, kd=10.0):
        self._signals[:], self._gains[:] = (reference, torque, motor_velocity, velocity), (kp, ki, kd)
        self._evaluate()
        self._x[:] = self._next
        return float(self._effort[0])


class Held:
    """An actuator whose output is held: J ddphi + (b + d) dphi + k phi = effort, in steps of exact exponentials."""

    def __init__(self, joint=HIP, dt=DT):
        from scipy.signal import cont2discrete

        a = joint.actuator
        self.stiffness = a.stiffness
        damping = a.viscous + a.damping
        continuous = (
            np.array([[0.0, 1.0], [-a.stiffness / a.rotor_inertia, -damping / a.rotor_inertia]]),
            np.array([[0.0], [1.0 / a.rotor_inertia]]), np.eye(2), np.zeros((2, 1)),
        )  # fmt: skip
        self._a, self._b, *_ = cont2discrete(continuous, dt)
        self.x = np.zeros(2)

    @property
    def torque(self):
        return self.stiffness * self.x[0]

    @property
    def motor_velocity(self):
        return self.x[1]

    def step(self, effort):
        self.x = self._a @ self.x + self._b[:, 0] * effort


class Drive:
    """The whole law of ``joint``'s unprotected drive with its state, one call per tick; counts are not rounded."""

    def __init__(self, joint=HIP, **config):
        self.joint, self.config = joint, FirmwareConfig(protection=UNPROTECTED, **config)
        self.law = drive_law(joint, self.config)
        self._memory = memory = LawMemory(self.law, lambda function: function)
        memory.p_array[:] = self.law.values(joint, self.config)
        self.x, self.y = memory.x_array, memory.y_array

    def configure(self, **changes):
        self.config = self.config.model_copy(update=changes)
        self._memory.p_array[:] = self.law.values(self.joint, self.config)

    def counts(self, phi=0.0, effort=0.0):
        """Pins of an actuator whose motor stands at ``phi`` and whose compliant element bears ``effort``."""
        c = np.zeros(pins.N_INPUTS)
        c[pins.MOTOR_ENCODER] = phi * self.joint.sensor.encoder
        c[pins.SPRING_ENCODER] = effort / self.joint.actuator.stiffness * self.joint.spring_counts_per_rad
        linkage = self.joint.actuator.linkage
        q = phi if linkage is None else float(linkage.joint_angle(phi))
        c[pins.JOINT_ENCODER] = q * self.joint.sensor.joint_encoder
        if self.joint.sensor.force_resolution:
            c[pins.FORCE_ADC] = effort / self.joint.sensor.force_resolution
        return c

    def command(self, mode="torque", torque=0.0, position=0.0, velocity=0.0, limit=1e3, kp=3.0, ki=0.0, kd=10.0):
        u = np.zeros(law.INPUT_SIZE)
        u[[law.U_TORQUE, law.U_POSITION, law.U_VELOCITY, law.U_LIMIT]] = torque, position, velocity, limit
        u[[law.U_KP, law.U_KI, law.U_KD, law.U_ENABLED]] = kp, ki, kd, 1.0
        if MODES[mode] is not None:
            u[MODES[mode]] = 1.0
        return u

    def __call__(self, counts, u):
        memory = self._memory
        memory.counts_array[:], memory.u_array[:] = counts, u
        memory.evaluate()
        self.x[:] = memory.x_next_array
        return self

    def state(self, name):
        return self.x[self.law.states.index(name)]

    @property
    def effort(self):
        """Demanded, N m."""
        actuator = self.joint.actuator
        return self.y[law.Y_DEMAND] * actuator.ampere_per_count * actuator.torque_per_ampere

    @property
    def full(self):
        return self.joint.actuator.current_limit * self.joint.actuator.torque_per_ampere

    @property
    def resolution(self):
        """Half a count of demand, N m."""
        return 0.5 * self.joint.actuator.ampere_per_count * self.joint.actuator.torque_per_ampere + 1e-9

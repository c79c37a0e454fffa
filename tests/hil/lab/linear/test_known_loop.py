"""One joint on the bench, its output held, against the poles of its sampled loop by hand."""

from collections import deque

import numpy as np
import pytest

from hil.lab.linear.linearisation import Linearisation
from hil.lab.linear.operating_point import fine
from hil.streams import streams
from joint_firmware.config import FirmwareConfig
from joint_firmware.laws import drive_law
from joint_firmware.laws import signals as law
from joint_firmware.memory import LawMemory
from joint_firmware.protection_config import UNPROTECTED
from plant.bench import Bench, Locked
from plant.config import SensorConfig
from robots import description, pins

RATE, KP, KD = 3000.0, 3.0, 10.0


class BenchSection:
    """The drive's law PD_m, ``extra`` ticks of delay behind it, the actuator; as hil.lab.linear.section.Section.

    The demands under way are no states here: they must be found. What the law remembers of the position is told
    relative to the rotor's."""

    names = ("rotor", "rotor speed", "motor_velocity", "motor_position")
    period = 1.0 / RATE

    def __init__(self, extra, sizes=(1e-2, 1.0, 0.5, 1e-4)):
        robot = fine(description.load("hume"))
        self.joint = robot.joints[1]
        self.config = FirmwareConfig(law="PD_m", protection=UNPROTECTED)
        self.bench = Bench(robot, 1, Locked(), RATE, SensorConfig(noise=0.0, bias=0.0), streams(0), 0.0)
        self.law = drive_law(self.joint, self.config)
        self.memory = LawMemory(self.law, lambda function: function)
        self.memory.p_array[:] = self.law.values(self.joint, self.config)
        u = self.memory.u_array
        u[[law.U_LIMIT, law.U_KP, law.U_KD, law.U_ENABLED, law.U_TORQUE_MODE]] = 1e3, KP, KD, 1.0, 1.0
        self.sizes = np.array(sizes)
        self.under_way = deque([0] * (extra + 1))
        for _ in range(50):
            self.advance()
        assert self.bench.pins_out[pins.ENABLE] == 1
        self.origin = self.bench.snapshot(), self.memory.snapshot(), list(self.under_way)

    def advance(self):
        bench, memory = self.bench, self.memory
        bench.sample()
        bench.pins_out[pins.CURRENT_DEMAND], bench.pins_out[pins.ENABLE] = self.under_way.popleft(), 1
        bench.latch()
        memory.counts_array[:] = bench.pins_in
        memory.evaluate()
        memory.x_array[:] = memory.x_next_array
        self.under_way.append(int(memory.y_array[law.Y_DEMAND]))
        bench.step()

    def displace(self, by):
        bench, memory, under_way = self.origin
        self.bench.restore(bench)
        self.memory.restore(memory)
        self.under_way = deque(under_way)
        index, x, names = self.bench.actuator.symbols.state_index[0], self.memory.x_array, self.law.states
        self.bench.actuator.state[[index["theta"], index["dtheta"]]] += by[:2]
        x[[names.index(name) for name in self.names[2:]]] += by[2:]
        for name in ("motor_position", "deflection_position"):  # the encoder does not jump
            x[names.index(name)] += by[0]

    def read(self):
        index, state = self.bench.actuator.symbols.state_index[0], self.bench.actuator.state
        speed, before = (self.memory.x_array[self.law.states.index(name)] for name in self.names[2:])
        theta = state[index["theta"]]
        return np.array([theta, state[index["dtheta"]], speed, before - theta])

    def difference(self, first, second):
        return first - second


def by_hand(section, extra):
    """theta, dtheta, filtered velocity, theta of the tick before, then the efforts under way, the oldest first."""
    a, dt = section.joint.actuator, 1.0 / RATE
    blend = 1.0 - np.exp(-2.0 * np.pi * section.config.velocity_cutoff * dt)
    late = extra + 1
    velocity = np.zeros(4 + late)
    velocity[[0, 2, 3]] = blend / dt, 1.0 - blend, -blend / dt
    effort = -KD * velocity
    effort[0] -= KP * a.stiffness
    rotor = np.zeros(4 + late)
    rotor[[0, 1, 4]] = -dt * a.stiffness, a.rotor_inertia - dt * a.damping, dt
    rotor /= a.rotor_inertia + dt * a.viscous
    whole = np.zeros((4 + late, 4 + late))
    whole[0] = dt * rotor
    whole[0, 0] += 1.0
    whole[1], whole[2] = rotor, velocity
    whole[3, 0] = 1.0
    whole[4:-1, 5:] = np.eye(late - 1)
    whole[-1] = effort
    return whole


@pytest.mark.parametrize("extra", [0, 4, 12])
def test_poles_of_a_held_joint(extra):
    section = BenchSection(extra)
    found = Linearisation.of(section, delay=(extra + 4) / RATE)
    values = np.array([mode.eigenvalue for mode in found.modes if abs(mode.eigenvalue) > 0.3])
    known = np.linalg.eigvals(by_hand(section, extra))
    known = known[(np.abs(known) > 0.3) & (known.imag >= 0)]
    assert len(values) == len(known)
    for value in known:
        assert np.abs(values - value).min() < 2e-4
    assert found.memory == extra + 1  # ticks: what is under way, and one from a tick to the output taking effect


def test_displacements_of_any_size_give_the_same():
    small, large = (Linearisation.of(BenchSection(4), 8 / RATE, scale) for scale in (0.1, 1.0))
    assert small.growth == pytest.approx(large.growth, abs=0.5)
    assert large.change(small)["growth"] < 0.5


def test_the_critical_delay_of_a_held_joint_is_between_the_ticks_where_its_poles_cross():
    stable = [max(abs(np.linalg.eigvals(by_hand(BenchSection(0), extra)))) < 1.0 for extra in range(20)]
    crossing = stable.index(False)
    assert 0 < crossing < 19
    for extra in (crossing - 1, crossing):
        growth = Linearisation.of(BenchSection(extra), delay=(extra + 4) / RATE).growth
        assert (growth < 0.0) == stable[extra]

"""The standing robot's loop: displacements, modes that are known by hand, and what the emulation then does."""

import numpy as np
import pytest

from hil.analysis.damped_waves import damped_waves
from hil.errors import UserError
from hil.lab.linear.linearisation import Linearisation
from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.linear.section import trajectory
from hil.lab.quantity import quantity
from hil.scenario import load

DELAY = 8e-3  # s: the loop of `stand` is unstable


@pytest.fixture(scope="module")
def point():
    with OperatingPoint(load("stand"), 2.5) as standing:
        yield standing


@pytest.fixture(scope="module")
def nominal(point):
    return point.linearise()


def test_one_state_moves_when_one_is_displaced(point):
    section = point.section()
    section.displace(np.zeros(len(section.names)))
    before = section.read()
    for state, step in enumerate(np.diag(section.sizes)):
        section.displace(step)
        moved = section.difference(section.read(), before) / section.sizes
        assert np.delete(moved, state) == pytest.approx(0.0, abs=2e-3), section.names[state]  # curvature
        assert moved[state] == pytest.approx(1.0, abs=2e-3)


def test_nothing_that_watches_trips_on_a_displacement(point):
    section = point.section()
    for state, step in enumerate(np.diag(section.sizes)):
        trajectory(section, step, 3)
        assert all(node.powered and node.fault == 0 for node in point.system.joints.nodes), section.names[state]


def test_the_point_is_left_as_it_was(point):
    def reading():
        section = point.section()
        section.displace(np.zeros(len(section.names)))
        section.advance()
        return section.read(), section

    before, section = reading()
    point.linearise({"link.command.delay": DELAY}, scale=0.7)
    assert np.all(section.difference(reading()[0], before) == 0.0)


def test_modes_of_the_controllers_filters_are_those_of_its_constants(nominal):
    """The accelerometer corrects the attitude with 2 s, the feet's line the yaw with 0.5 s; an integral fades with
    ki / kp: 30/250 of CoM z and pitch."""
    growths = [mode.growth for mode in nominal.modes if mode.frequency < 0.05]

    def nearest(value):
        return min(growths, key=lambda growth: abs(growth - value))

    assert nearest(-2.0) == pytest.approx(-2.0, abs=0.01)
    assert nearest(-0.5) == pytest.approx(-0.5, abs=0.05)
    assert nearest(-30 / 250) == pytest.approx(-30 / 250, abs=0.01)
    yaw = next(mode for mode in nominal.modes if abs(mode.growth + 2.0) < 0.01)
    assert yaw.shares[0][0] == "controller's attitude yaw"


@pytest.mark.parametrize("delay", [0.0, 3e-3, DELAY])
def test_a_transient_of_the_emulation_is_the_mode_that_was_predicted(point, delay):
    found = point.linearise({"link.command.delay": delay})
    section = point.section({"link.command.delay": delay})
    world = point.system.world
    column = world.truth_fields.index("internal_force")
    step = np.zeros(len(section.names))
    step[section.names.index("left_hip rotor")] = 1e-3
    both = []
    for sign in (1.0, -1.0):
        section.displace(sign * step)
        both.append([])
        for _ in range(700):
            section.advance()
            both[-1].append(world.truth()[column])
    force = (np.array(both[0]) - both[1])[60:]
    wave = next(w for w in damped_waves(force[::4], 4 * section.period) if 10 < w.frequency < 30)
    mode = min(
        (m for m in found.modes if m.frequency > 1),
        key=lambda m: abs(complex(m.growth - wave.growth, 2 * np.pi * (m.frequency - wave.frequency))),
    )
    assert mode.frequency == pytest.approx(wave.frequency, rel=0.005)
    assert mode.growth == pytest.approx(wave.growth, abs=0.02 * abs(wave.growth) + 0.1)
    assert "controller's internal force" in dict(mode.shares[:5])


def test_a_drives_gain_is_changed_while_the_robot_stands(point, nominal):
    """Transplanted into a system with other gains: those count, and the robot stands on."""
    gain = quantity(point.scenario, "joint.torque_gain")
    same, weaker = (point.with_value(gain, value) for value in (1.0, 0.4))
    mode = max((m for m in nominal.modes if m.frequency > 10), key=lambda m: m.growth)
    assert same.like(mode).growth == pytest.approx(mode.growth, abs=0.3)
    assert weaker.like(mode).frequency < 0.9 * mode.frequency


def test_a_robot_that_hangs_is_refused():
    with OperatingPoint(load("stand"), 0.02) as point, pytest.raises(UserError, match=r"drive is off|does not stand"):
        point.linearise()


def test_an_orientation_from_motion_capture_is_refused():
    seen = load("stand", ["motion_capture.enabled=true", "controller.orientation=motion_capture"])
    with pytest.raises(UserError, match="complementary filter only"):
        OperatingPoint(seen, 2.5)


def test_halving_all_displacements_changes_little(point, nominal):
    change = nominal.change(point.linearise(scale=0.5))
    assert change["growth"] < 0.3
    assert change["angular_frequency"] < 0.3


def test_a_linearisation_in_numbers(nominal):
    record = nominal.record()
    assert record["growth"] == nominal.growth == record["dominant"]["growth"]
    assert record["states"] == len(nominal.names) > 60
    assert isinstance(nominal, Linearisation)
    for mode in record["modes"]:
        assert abs(complex(*mode["eigenvalue"])) == pytest.approx(np.exp(mode["growth"] / 1500), rel=1e-9)


def test_bending_shanks_are_refused() -> None:
    with pytest.raises(UserError, match=r"set world\.shank_stiffness=0"):
        OperatingPoint(load("stand", ["world.shank_stiffness=7000Nm/rad"]), 1.5)

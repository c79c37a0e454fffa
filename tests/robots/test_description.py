"""Robot descriptions."""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from robots import description
from robots.description import Link, UnknownRobotError


@pytest.mark.parametrize(("variant", "mass"), [(None, 23.3522), ("srlib", 21.4612)])
def test_masses_are_the_published_ones(variant, mass):
    assert description.load("hume", variant).mass == pytest.approx(mass, abs=1e-6)


def test_every_description_loads():
    assert "hume" in description.available()
    for name in description.available():
        assert description.load(name).name == name


def test_legs_mirror_each_other():
    robot = description.load("hume")
    right, left = robot.joints[:3], robot.joints[3:]
    for a, b in zip(right, left, strict=True):
        assert a.name.replace("right", "left") == b.name
        np.testing.assert_array_equal(np.array(a.position) * [1, -1, 1], b.position)
        assert a.limits == b.limits


@pytest.mark.parametrize("name", [("nobody", None), ("hume", "nothing")])
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(UnknownRobotError, match=r"hume|srlib"):
        description.load(*name)


@pytest.mark.parametrize("inertia", [(1.0, 1.0, 2.1), (0.0, 1.0, 1.0), (-1.0, 1.0, 1.0)])
def test_impossible_inertias_are_refused(inertia):
    with pytest.raises(ValueError, match="not that of a rigid body"):
        Link(mass=1.0, com=(0.0, 0.0, 0.0), inertia=inertia)


# --- actuators --------------------------------------------------------------------------------------------------

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "geared_motor.toml"


def changed(tmp_path, before, after):
    """The example's description with one line changed, beside its Python file."""
    text = EXAMPLE.read_text()
    assert before in text
    (tmp_path / "geared_motor.py").write_text(EXAMPLE.with_suffix(".py").read_text())
    path = tmp_path / "changed.toml"
    path.write_text(text.replace(before, after))
    return str(path)


def test_each_robot_s_joints_have_the_kind_that_their_description_names():
    kinds = {name: {j.actuator.kind for j in description.load(name).joints} for name in ("hume", "vlca", "valve")}
    assert kinds == {"hume": {"sea"}, "vlca": {"vlca"}, "valve": {"hydraulic"}}


@pytest.mark.parametrize("name", ["hume", "vlca", "valve"])
def test_every_actuator_has_what_firmware_asks_for(name):
    for joint in description.load(name).joints:
        a = joint.actuator
        positive = (a.stiffness, a.rotor_inertia, a.torque_per_ampere, a.current_limit, a.supply_voltage, a.nominal_arm)
        for value in positive:
            assert np.isfinite(value) and value > 0
        assert a.damping >= 0 and a.viscous >= 0
        assert (a.thermal is None) == (a.motor is None)


@pytest.mark.parametrize(("joint", "nominal"), [("right_abduction", 0.74), ("left_knee", 0.50)])
def test_hume_s_motors_stand_their_nominal_torque_for_ever(joint, nominal):
    """Thermal resistances are derived from it (robots/hume.toml): stalled, heat in is heat out at the limit."""
    a = description.load("hume").joint(joint).actuator
    rise = a.thermal.winding_limit - 25.0
    heat = a.motor.resistance * (1 + 0.00393 * rise) * (nominal / a.torque_constant) ** 2
    assert heat * (a.thermal.winding_to_housing + a.thermal.housing_to_ambient) == pytest.approx(rise, rel=0.02)


def test_the_vlca_in_equivalent_coordinates_has_the_source_s_resonance():
    """Kim 2018 Table 5.1 and (5.11) do not depend on the arm that the coordinates are scaled with."""
    a = description.load("vlca").joints[0].actuator
    mass = 3.5e-5 * 3316.0**2 + 1.3
    assert a.stiffness / a.rotor_inertia == pytest.approx(5.5e6 / mass)
    assert (a.damping + a.viscous) / a.rotor_inertia == pytest.approx((2e4 + 2e-4 * 3316.0**2) / mass)
    assert a.torque_per_ampere / a.stiffness * a.nominal_arm == pytest.approx(0.9 * 0.0448 * 3316.0 / 5.5e6)


@pytest.mark.parametrize(("before", "after", "message"), [
    ("play = 0.005", "plai = 0.005", r"joint wrist: actuator\.play: Field required"),
    (":GearedMotor", ":Geared", r"joint wrist: .*geared_motor\.py has no Geared that is derived from"),
    ("geared_motor.py:", "missing.py:", r"actuator\.kind = 'missing\.py:GearedMotor': there is no Python file"),
    ('"geared_motor.py:GearedMotor"', '"see"', r"actuator\.kind = 'see': expected one of sea, vlca, hydraulic, or FI"),
    ('motor = "small"', 'motor = "big"', r"joint wrist: no \[motor\.big\]; there is: small"),
    ("limits = [-2.0, 2.0]", "limits = 2.0", r"joint\.wrist\.limits: "),
    ("node_id = 1", "node_id = ", r"changed\.toml: "),
])  # fmt: skip
def test_a_wrong_description_is_refused_with_its_place(tmp_path, before, after, message):
    with pytest.raises(UnknownRobotError, match=message) as refused:
        description.load(changed(tmp_path, before, after))
    assert "\n" not in str(refused.value)


def test_an_error_in_one_s_own_file_is_told_with_its_place(tmp_path):
    path = changed(tmp_path, "gravity", "gravity")
    (tmp_path / "geared_motor.py").write_text("import nothing_of_that_name\n")
    with pytest.raises(UnknownRobotError, match=r"geared_motor\.py: ModuleNotFoundError: No module named 'nothing_of"):
        description.load(path)


def test_limits_that_stretch_a_linkage_out_are_refused(tmp_path):
    path = tmp_path / "vlca.toml"
    source = resources.files("robots").joinpath("vlca.toml").read_text(encoding="utf-8")
    path.write_text(source.replace("limits = [-1.1, 0.6]", "limits = [-1.5, 0.6]"))
    with pytest.raises(UnknownRobotError, match=r"joint ankle: limits .* stretch out or fold its linkage"):
        description.load(str(path))

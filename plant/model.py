"""The MuJoCo model of a robot on its terrain, built from the robot's description.

Generalised coordinates: the base's, then the joints in the robot's order, each shank's bending behind its joint if it
bends (``coordinates`` says where the joints are). The base is a free joint (position, quaternion), or with the
planarizer [slider x, z, roll, pitch], all zero at the world's origin, torso upright.
Rotors, springs and actuator friction are in ``plant.actuators``: a joint takes its torque as applied force.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from plant import visuals
from plant.config import SHANK_FORK_INERTIA, PlanarizerConfig, TerrainConfig
from plant.stance import Array, Stance
from robots.description import Foot, Joint, Link, Robot

# Contact, tuned by measurement: feet that carry the robot and are pulled sideways with 0.9 of the
# friction limit creep by less than 0.1 mm/s and sink in by 0.02 mm (tests/plant/test_contact.py).
# Critically damped; the impedance is high and does not depend on depth; friction is stiffer than the
# normal direction, else the feet creep by millimetres a second.
CONTACT_TIME_CONSTANT = 2e-3  # s; MuJoCo needs at least two time steps
CONTACT_IMPEDANCE = (0.98, 0.98, 1e-3, 0.5, 2.0)
FRICTION_TO_NORMAL_IMPEDANCE = 100.0
LIMIT_TIME_CONSTANT = 4e-3  # s, of the mechanical end stops

_FORK_MASS = 1e-3  # kg, between a knee and a shank that bends: MuJoCo moves no body without mass
_TUBE_DAMPING = 0.02  # of the critical, of a shank held at its top: what carbon fibre in epoxy loses. ASSUMED

_TERRAIN, _FOOT, _TORSO = 1, 2, 4  # collision classes: feet and torso meet the terrain, nothing else


class TerrainError(ValueError):
    """The feet cannot stand like this on this terrain."""


def panel_normals(angle: float) -> Array:
    """Upward normals (2, 3) of the right (front) and left (rear) panel: each looks at the robot."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[-sine, 0.0, cosine], [sine, 0.0, cosine]])


def build(
    robot: Robot, stance: Stance, terrain: TerrainConfig, planarizer: PlanarizerConfig, rate: float,
    shank_stiffness: float = 0.0, leds: bool = False,
) -> mujoco.MjModel:  # fmt: skip
    """Build the model. ``rate``: physics steps per second. The terrain just touches the feet of ``stance``.
    ``shank_stiffness`` [N m/rad]: of the shanks' bending, see WorldConfig; 0: rigid. ``leds``: whether it carries the
    motion capture's, as sites.

    Sensors, in this order in ``sensordata`` (3 numbers each unless said): base (torso frame's origin), com
    and com_velocity (of the robot without slider), feet's centres, contacts (force of the foot on the
    terrain, N, of the last step), gyro, accelerometer, torso_com, torso_velocity, torso_rate (of the torso's
    centre of mass, world frame), torso_contact (1, number of contacts). Raises TerrainError.
    """
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = 1.0 / rate
    option.gravity = np.array([0.0, 0.0, -robot.gravity])
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations = 20
    # A foot that creeps by a tenth of a millimetre a second starts the search at the edge of its friction cone, and one
    # that gives up after 20 evaluations leaves the forces of the step before in place.
    option.ls_iterations = 50
    option.tolerance = 1e-10
    option.impratio = FRICTION_TO_NORMAL_IMPEDANCE
    # Islands and mid phase have nothing to gain here. Automatic reset would hide a diverged run.
    # Implicit joint damping would be unknown to the contact solver, which assumes the explicit step:
    # with stiff contacts the feet chatter.
    flag = mujoco.mjtDisableBit
    option.disableflags = int(flag.mjDSBL_ISLAND | flag.mjDSBL_MIDPHASE | flag.mjDSBL_AUTORESET | flag.mjDSBL_EULERDAMP)

    visuals.scene(spec, stance)
    _terrain(spec, robot, stance, terrain)
    torso = _base(spec, robot, planarizer)
    if planarizer.enabled and planarizer.lock_x:
        _lock(spec, "slider_x", float(stance.torso[0]))
    _legs(spec, robot, torso, shank_stiffness)
    if leds and robot.motion_capture is not None:
        visuals.leds(spec, robot.motion_capture)
    _sensors(spec, robot)
    return spec.compile()


class Coordinates(NamedTuple):
    """Where the robot's joints are among the generalised coordinates and velocities: slices if they lie together."""

    positions: Any  # slice, or indices (joints,)
    velocities: Any
    base: int  # degrees of freedom of the base, which come first


def coordinates(model: mujoco.MjModel, joints: Sequence[str]) -> Coordinates:
    """Of the ``joints`` by name."""
    positions, velocities = (
        np.array([getattr(model.joint(name), what)[0] for name in joints]) for what in ("qposadr", "dofadr")
    )
    base = int(velocities[0])
    if model.nv == base + len(joints):
        return Coordinates(slice(-len(joints), None), slice(-len(joints), None), base)
    return Coordinates(positions, velocities, base)


def bends(model: mujoco.MjModel, robot: Robot) -> list[str]:
    """Names of the hinges about which the shanks bend: right then left, sagittal then lateral. None: they are rigid."""
    joints = {model.joint(i).name for i in range(model.njnt)}
    names = [f"{foot.joint}_{way}" for foot in robot.feet for way in ("sagittal", "lateral")]
    return [name for name in names if name in joints]


def initial_qpos(model: mujoco.MjModel, robot: Robot, stance: Stance) -> Array:
    """Generalised coordinates (nq,) of ``stance``, shanks straight."""
    at = coordinates(model, robot.joint_names)
    qpos = model.qpos0.copy()
    if at.base == 4:
        qpos[:4] = stance.torso[0], stance.torso[2], 0.0, 0.0
    else:
        qpos[:7] = *stance.torso, 1.0, 0.0, 0.0, 0.0
    qpos[at.positions] = stance.joints
    return qpos


def _inertial(body: Any, link: Link) -> None:
    body.mass = link.mass
    body.ipos = np.array(link.com)
    body.inertia = np.array(link.inertia)
    body.explicitinertial = True


def _base(spec: mujoco.MjSpec, robot: Robot, planarizer: PlanarizerConfig) -> Any:
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    if not planarizer.enabled:
        torso = spec.worldbody.add_body(name=robot.base.name)
        torso.add_freejoint(name="base")
    else:
        mass = max(planarizer.slider_mass, 1e-6)
        slider = spec.worldbody.add_body(name="slider", mass=mass, explicitinertial=True)
        slider.inertia = np.full(3, 1e-3)  # it does not turn
        slider.add_joint(name="slider_x", type=slide, axis=[1.0, 0.0, 0.0])
        torso = slider.add_body(name=robot.base.name)
        torso.add_joint(name="base_z", type=slide, axis=[0.0, 0.0, 1.0])
        roll = torso.add_joint(name="base_roll", type=hinge, axis=[1.0, 0.0, 0.0])
        roll.stiffness[0] = planarizer.roll_stiffness
        roll.damping[0] = planarizer.roll_damping
        torso.add_joint(name="base_pitch", type=hinge, axis=[0.0, 1.0, 0.0])
    _inertial(torso, robot.base)
    if robot.imu is not None:
        torso.add_site(name="imu", pos=list(robot.imu.position), size=[0.01, 0.01, 0.01])
    # What touches the ground in a fall: from the hips to as far above the centre of mass as they are below.
    height = 2.0 * robot.base.com[2]
    _collider(torso.add_geom(
        name="torso", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.09, 0.0, 0.0],
        fromto=[0.0, 0.0, 0.02, 0.0, 0.0, height], group=3,
    ), _TORSO)  # fmt: skip
    visuals.torso(torso, robot)
    return torso


def _lock(spec: mujoco.MjSpec, joint: str, at: float) -> None:
    """Hold the sliding ``joint`` at one place [m], as hard as the ground is."""
    lock = spec.add_equality(name=f"{joint}_lock", type=mujoco.mjtEq.mjEQ_JOINT, name1=joint)
    lock.data[0] = at
    lock.solref = np.array([CONTACT_TIME_CONSTANT, 1.0])
    lock.solimp = np.array(CONTACT_IMPEDANCE)


def _legs(spec: mujoco.MjSpec, robot: Robot, torso: Any, shank_stiffness: float) -> None:
    bodies = {robot.base.name: torso}
    shanks = {foot.joint: foot for foot in robot.feet} if shank_stiffness else {}
    for joint in robot.joints:
        body = bodies[joint.parent].add_body(name=joint.name, pos=list(joint.position))
        stop = body.add_joint(
            name=joint.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=list(joint.axis), range=list(joint.limits)
        )
        stop.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        stop.solref_limit = np.array([LIMIT_TIME_CONSTANT, 1.0])
        if joint.name in shanks:
            _inertial(body, Link(mass=_FORK_MASS, com=(0.0, 0.0, 0.0), inertia=(1e-6, 1e-6, 1e-6)))
            stop.armature = SHANK_FORK_INERTIA
            body = _tube(body, joint, shanks[joint.name], shank_stiffness)
        bodies[joint.name] = body
        _inertial(body, joint.link)
        visuals.link(body, robot, joint)
    for foot in robot.feet:
        _collider(bodies[foot.joint].add_geom(
            name=foot.name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[robot.foot_radius, 0.0, 0.0],
            pos=list(foot.position), rgba=[0.12, 0.12, 0.13, 1.0],
        ), _FOOT)  # fmt: skip
    order = [name for body in spec.bodies if (name := body.name) in robot.joint_names]
    if order != list(robot.joint_names):
        raise ValueError(f"joints of {robot.name} are not listed leg by leg from the base outwards")


def _tube(fork: Any, joint: Joint, foot: Foot, stiffness: float) -> Any:
    """The body of a shank that bends at its top, about the axis of its ``joint`` and across it."""
    tube = fork.add_body(name=visuals.tube_name(joint.name))
    along = np.asarray(foot.position)
    lever = joint.link.inertia[1] + joint.link.mass * float(np.dot(joint.link.com, joint.link.com))
    sagittal = np.asarray(joint.axis)
    for name, axis in (("sagittal", sagittal), ("lateral", np.cross(sagittal, along))):
        hinge = tube.add_joint(
            name=f"{joint.name}_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=list(axis / np.linalg.norm(axis))
        )
        hinge.stiffness[0] = stiffness
        hinge.damping[0] = 2.0 * _TUBE_DAMPING * np.sqrt(stiffness * lever)
    return tube


def _collider(geom: Any, kind: int) -> None:
    geom.contype, geom.conaffinity, geom.condim, geom.mass = kind, _TERRAIN, 3, 0.0


def _terrain(spec: mujoco.MjSpec, robot: Robot, stance: Stance, terrain: TerrainConfig) -> None:
    surfaces = []
    if terrain.kind == "flat":
        if not np.isclose(stance.feet[0, 2], stance.feet[1, 2]):
            raise TerrainError("flat ground needs both feet at one height")
        floor = float(stance.feet[0, 2]) - robot.foot_radius
        surfaces.append(visuals.floor(spec, floor))
        surfaces += [visuals.block(spec, n, block, floor) for n, block in enumerate(terrain.blocks)]
    else:
        if stance.feet[0, 0] <= stance.feet[1, 0]:
            raise TerrainError("split terrain needs the right foot in front: set stance.feet_apart > 0")
        normals = panel_normals(terrain.panel_angle)
        points = stance.feet - robot.foot_radius * normals
        middle = 0.5 * float(points[0, 0] + points[1, 0])
        # The panels meet at the middle of the feet, or would there if they were long enough.
        valley = float(points[0, 2] - (points[0, 0] - middle) * np.tan(terrain.panel_angle))
        surfaces.append(visuals.floor(spec, valley - 0.04))
        for name, point, normal in zip(("right_panel", "left_panel"), points, normals, strict=True):
            surfaces.append(visuals.panel(spec, name, point, normal, middle))
    for geom in surfaces:
        # Priority: the contact takes these numbers, not a mixture with the foot's.
        geom.priority = 1
        geom.contype, geom.conaffinity, geom.condim = _TERRAIN, _FOOT | _TORSO, 3
        geom.friction = np.array([terrain.friction, 0.0, 0.0])
        geom.solref = np.array([CONTACT_TIME_CONSTANT, 1.0])
        geom.solimp = np.array(CONTACT_IMPEDANCE)


def _sensors(spec: mujoco.MjSpec, robot: Robot) -> None:
    kind, thing = mujoco.mjtSensor, mujoco.mjtObj
    data = mujoco.mjtConDataField
    torso = robot.base.name

    def add(name: str, sensor: Any, objtype: Any, objname: str, intprm: list[int] | None = None) -> None:
        made = spec.add_sensor(name=name, type=sensor, objtype=objtype, objname=objname)
        if intprm is not None:
            made.intprm = np.array(intprm)

    add("base", kind.mjSENS_FRAMEPOS, thing.mjOBJ_XBODY, torso)
    add("com", kind.mjSENS_SUBTREECOM, thing.mjOBJ_BODY, torso)
    add("com_velocity", kind.mjSENS_SUBTREELINVEL, thing.mjOBJ_BODY, torso)
    for foot in robot.feet:
        add(f"{foot.name}.position", kind.mjSENS_FRAMEPOS, thing.mjOBJ_GEOM, foot.name)
    netforce = 3  # reduction of the contact sensor: the sum, in the world frame
    for foot in robot.feet:
        add(f"{foot.name}.contact", kind.mjSENS_CONTACT, thing.mjOBJ_GEOM, foot.name,
            [1 << data.mjCONDATA_FORCE.value, netforce, 1])  # fmt: skip
    add("gyro", kind.mjSENS_GYRO, thing.mjOBJ_SITE, "imu")
    add("accelerometer", kind.mjSENS_ACCELEROMETER, thing.mjOBJ_SITE, "imu")
    add("torso_com", kind.mjSENS_FRAMEPOS, thing.mjOBJ_BODY, torso)
    add("torso_velocity", kind.mjSENS_FRAMELINVEL, thing.mjOBJ_BODY, torso)
    add("torso_rate", kind.mjSENS_FRAMEANGVEL, thing.mjOBJ_BODY, torso)
    found = 1 << data.mjCONDATA_FOUND.value
    add("torso_contact", kind.mjSENS_CONTACT, thing.mjOBJ_GEOM, "torso", [found, 0, 1])

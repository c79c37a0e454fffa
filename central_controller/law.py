"""The controller's tick in two CasADi functions, before and after the one call of pinocchio.

``predict``: what the sensors say of the robot's state, as pinocchio's coordinates, with the base at the world's origin
and without linear velocity. ``control``: where the base really is and how fast, the task feedback, whole-body control,
the telemetry, and what the next tick remembers. Neither writes what it reads: memory → memory_next.

The base's velocity V needs no second call of pinocchio. Seen from the moving base nothing changes (Galilei): with
e = [ω × Rᵀ V; 0], h, J̇ q̇ and J̇_t q̇ grow by A e, J e and J_t e, which cancel in (2.9)–(2.11) and (2.5) since
J_t − J_t J̄ J = J_t A⁻¹ Nᵀ A.
"""

from __future__ import annotations

import casadi as ca

from bus import messages
from central_controller.estimator import turned, yaw_corrected
from central_controller.model import RobotModel
from central_controller.path import offset
from central_controller.tasks import feedback
from central_controller.wbosc import whole_body_control
from robots.description import Robot

# What a tick leaves for the next: orientation, filtered joint velocities, integrals of the feedback, heading of the
# line between the feet, filtered internal force.
ORIENTATION = slice(0, 4)


def estimate(joints: int) -> slice:
    """Where the memory of every behaviour has what ``predict`` needs: orientation and filtered joint velocities."""
    return slice(0, 4 + joints)


def memory_size(joints: int) -> int:
    return 4 + joints + 4 + 1 + 1


def memory_names(robot: Robot) -> tuple[str, ...]:
    """Names of the memory's directions: turns of the orientation in the base's frame in place of the quaternion."""
    return (
        *[f"attitude {axis}" for axis in ("roll", "pitch", "yaw")],
        *[f"velocity of {joint}" for joint in robot.joint_names],
        *[f"integral of {task}" for task in ("CoM x", "CoM z", "pitch", "roll")],
        "heading",
        "internal force",
    )


def _split_memory(memory: ca.SX, joints: int) -> list[ca.SX]:
    return ca.vertsplit(memory, [0, 4, 4 + joints, 8 + joints, 9 + joints, 10 + joints])


def measured(counts: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Joint positions [rad], velocities [rad/s] and torques [N m] from the drives' fixed-point numbers (joints, 3)."""
    return (
        counts[:, 0] * messages.RADIAN,
        counts[:, 1] * messages.RADIAN_PER_SECOND,
        counts[:, 2] * messages.NEWTON_METRE,
    )


def predict(joints: int) -> ca.Function:
    """Inputs: counts (joints, 3), gyro [rad/s], its zero, force [m/s²], estimate (4 + joints: what of the memory is so
    called), filters (see filter_constants). Outputs: q, v."""
    counts = ca.SX.sym("counts", joints, 3)
    gyro, zero, force = (ca.SX.sym(name, 3) for name in ("gyro", "zero", "force"))
    memory, filters = ca.SX.sym("estimate", 4 + joints), ca.SX.sym("filters", 5)
    quaternion, filtered = ca.vertsplit(memory, [0, 4, 4 + joints])
    position, velocity, _ = measured(counts)
    rate = gyro - zero
    filtered += filters[3] * (velocity - filtered)
    q = ca.vertcat(ca.SX.zeros(3), turned(quaternion, rate, force, filters), position)
    v = ca.vertcat(ca.SX.zeros(3), rate, filtered)
    return ca.Function(
        "controller_predict",
        [counts, gyro, zero, force, memory, filters],
        [q, v],
        ["counts", "gyro", "zero", "force", "estimate", "filters"],
        ["q", "v"],
    )


def control(model: RobotModel) -> ca.Function:
    """Inputs: counts (joints, 3), q, v, pinocchio's results (RobotModel.sources), memory, start (CoM x, z where the
    reference began), held (torques [N m] that those of the law take over from), schedule (1: reference at rest from
    ``start``, 0: where the robot is; 1: integrate, and feed the internal force back; share of the law's torque; time on
    the path [s]), gains, path, filters (see the functions that make them), internal_force (reference [N], K_F).

    Outputs: telemetry (15 + 4 joints: all but the node's own), memory_next.
    """
    joints = model.nv - 6
    inputs = {
        "counts": ca.SX.sym("counts", joints, 3),
        "q": ca.SX.sym("q", model.nq),
        "v": ca.SX.sym("v", model.nv),
        **model.symbols(),
        "memory": ca.SX.sym("memory", memory_size(joints)),
        "start": ca.SX.sym("start", 2),
        "held": ca.SX.sym("held", joints),
        "schedule": ca.SX.sym("schedule", 4),
        "gains": ca.SX.sym("gains", 3, 4),
        "path": ca.SX.sym("path", 3),
        "filters": ca.SX.sym("filters", 5),
        "internal_force": ca.SX.sym("internal_force", 2),
    }
    quaternion, v = inputs["q"][3:7], inputs["v"]
    position, _, sensed = measured(inputs["counts"])
    _, _, integral, heading, felt_force = _split_memory(inputs["memory"], joints)
    running, integrate, share, path_time = ca.vertsplit(inputs["schedule"])
    wanted_force, force_gain = ca.vertsplit(inputs["internal_force"])
    terms = model.terms(inputs, quaternion, v[3:6])

    # the feet stand: the base is above their midpoint and moves against them
    base = -(terms.feet[:, 0] + terms.feet[:, 1]) / 2
    base_velocity = -(terms.feet_velocity[:, 0] + terms.feet_velocity[:, 1]) / 2
    com, com_velocity = terms.com + base, terms.com_velocity + base_velocity
    value = ca.vertcat(com[0], com[2], terms.task[2:])
    velocity = ca.vertcat(com_velocity[0], com_velocity[2], terms.task_velocity[2:])
    orientation, heading = yaw_corrected(quaternion, terms.feet, heading, running, inputs["filters"])

    # while running: the path about the start, the torso upright
    moving = ca.horzcat(ca.vertcat(inputs["start"].T, ca.SX(2, 2)) + offset(inputs["path"], path_time), ca.SX(3, 2))
    resting = ca.vertcat(value.T, ca.SX(2, 4))
    reference = ca.if_else(running, moving, resting)
    u, integral = feedback(inputs["gains"], reference, value, velocity, integral, integrate)

    # Feedback of the internal force (5.2), low-passed: it acts on torques at once, so that without a filter the drives'
    # lag sets its margin. What is sensed holds once the feet carry the robot: until then it is fed forward alone (5.1),
    # or what feedback adds to a share of the weight leaves the friction cone.
    demanded_force = wanted_force + integrate * force_gain * (wanted_force - felt_force)
    line = terms.feet[:, 0] - terms.feet[:, 1]
    torque, _, _, internal = whole_body_control(2, 4)(
        terms.A, terms.h, terms.Js, terms.Jsdot_dq, terms.Jt, terms.Jtdot_dq, u, sensed,
        line / ca.sqrt(ca.dot(line, line)), demanded_force,
    )  # fmt: skip
    felt_force += inputs["filters"][4] * (internal - felt_force)
    telemetry = ca.vertcat(
        com, com_velocity, reference[0, :2].T, terms.rpy, reference[0, 3], reference[0, 2], internal, wanted_force,
        inputs["held"] + share * (torque - inputs["held"]), sensed, position, v[6:],
    )  # fmt: skip
    memory = ca.vertcat(orientation, v[6:], integral, heading, felt_force)
    return ca.Function(
        "controller_control",
        list(inputs.values()),
        [ca.densify(telemetry), ca.densify(memory)],
        list(inputs),
        ["telemetry", "memory_next"],
    )

"""The stepping robot's control laws as CasADi functions: double support, and single support on either foot.

Where the robot is in the world follows from the feet that stand: their weighted mean position is the ``anchor``. What
double support moves are the coordinates DOUBLE, all that two point feet abreast can; single support lets the centre of
mass go where it will in the horizontal plane and turn about the stance foot, and moves SINGLE and the swing foot
(Kim 2018 §2.2.1, §7.3.1). One list of integrals and gains serves all: COORDINATES, the foot's last.
"""

from __future__ import annotations

import casadi as ca

from central_controller.law import measured
from central_controller.model import RobotModel, Terms
from central_controller.tasks import feedback
from central_controller.wbosc import whole_body_control

DOUBLE = ("com_y", "com_z", "yaw", "pitch", "roll")
SINGLE = ("com_z", "pitch", "roll")
COORDINATES = (*DOUBLE, "foot_x", "foot_y", "foot_z")
# what the laws tell of the robot's state, in world axes: names and sizes
OBSERVED = {
    "com": 3, "com_velocity": 3, "rpy": 3, "feet": 6, "feet_velocity": 6,
    "reaction": 6,  # F_r of the commanded torque, robot on environment, right foot first
    "felt": 6,  # the same of the sensed torques
}  # fmt: skip


def observed(name: str) -> slice:
    """Where ``name`` of OBSERVED is."""
    names = list(OBSERVED)
    first = sum(OBSERVED[n] for n in names[: names.index(name)])
    return slice(first, first + OBSERVED[name])


def stepping(model: RobotModel, stance: int | None) -> ca.Function:
    """The law of single support on foot ``stance`` (0 right, 1 left), or of double support (None).

    Inputs: counts (joints, 3), q, v, pinocchio's results (RobotModel.sources), anchor (3), integral (8), reference
    (position, velocity, acceleration; 8), gains (kp, kd, ki dt; 8), integrate (1 or 0), push (3: of the foot in swing,
    see whole_body_control; single support only).
    Outputs: torque (joints), observed (see OBSERVED), integral_next (8).
    """
    joints = model.nv - 6
    inputs = {
        "counts": ca.SX.sym("counts", joints, 3),
        "q": ca.SX.sym("q", model.nq),
        "v": ca.SX.sym("v", model.nv),
        **model.symbols(),
        "anchor": ca.SX.sym("anchor", 3),
        "integral": ca.SX.sym("integral", 8),
        "reference": ca.SX.sym("reference", 3, 8),
        "gains": ca.SX.sym("gains", 3, 8),
        "integrate": ca.SX.sym("integrate"),
        "push": ca.SX.sym("push", 3),
    }
    quaternion, v = inputs["q"][3:7], inputs["v"]
    sensed = measured(inputs["counts"])[2]
    tasks = DOUBLE if stance is None else SINGLE
    terms = model.terms(inputs, quaternion, v[3:6], tasks)

    # the feet that stand do not move: the base is where they say
    weights = ca.DM([0.5, 0.5]) if stance is None else ca.DM([stance == 0, stance == 1])
    base, base_velocity = inputs["anchor"] - terms.feet @ weights, -terms.feet_velocity @ weights
    com, com_velocity = terms.com + base, terms.com_velocity + base_velocity
    feet, feet_velocity = terms.feet + ca.repmat(base, 1, 2), terms.feet_velocity + ca.repmat(base_velocity, 1, 2)

    value, velocity = _in_world(tasks, terms, base, base_velocity)
    chosen = [COORDINATES.index(task) for task in tasks]
    if stance is not None:
        swing = 1 - stance
        chosen += [5, 6, 7]
        value = ca.vertcat(value, feet[:, swing])
        velocity = ca.vertcat(velocity, feet_velocity[:, swing])
    integral = inputs["integral"]
    u, grown = feedback(
        inputs["gains"][:, chosen], inputs["reference"][:, chosen], value, velocity, integral[chosen],
        inputs["integrate"],
    )  # fmt: skip
    integral = ca.SX(integral)
    integral[chosen] = grown

    if stance is None:
        line = terms.feet[:, 0] - terms.feet[:, 1]
        torque, reaction, felt, _ = whole_body_control(2, len(tasks))(
            terms.A, terms.h, terms.Js, terms.Jsdot_dq, terms.Jt, terms.Jtdot_dq, u, sensed,
            line / ca.sqrt(ca.dot(line, line)), 0.0,
        )  # fmt: skip
    else:
        on, off = slice(3 * stance, 3 * stance + 3), slice(3 * swing, 3 * swing + 3)
        torque, *forces = whole_body_control(1, len(tasks) + 3)(
            terms.A, terms.h, terms.Js[on, :], terms.Jsdot_dq[on], ca.vertcat(terms.Jt, terms.Js[off, :]),
            ca.vertcat(terms.Jtdot_dq, terms.Jsdot_dq[off]), u, sensed, inputs["push"],
        )  # fmt: skip
        reaction, felt = (ca.vertcat(*([f, ca.SX(3, 1)] if stance == 0 else [ca.SX(3, 1), f])) for f in forces)
    seen = ca.vertcat(com, com_velocity, terms.rpy, ca.vec(feet), ca.vec(feet_velocity), reaction, felt)
    return ca.Function(
        f"stepping_{'double' if stance is None else ('right', 'left')[stance]}",
        list(inputs.values()),
        [ca.densify(torque), ca.densify(seen), ca.densify(integral)],
        list(inputs),
        ["torque", "observed", "integral_next"],
    )


def _in_world(tasks: tuple[str, ...], terms: Terms, base: ca.SX, velocity: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Values and velocities of ``tasks``, those of the centre of mass with what the base adds."""
    shift = ca.vertcat(*(base["xyz".index(task[-1])] if task.startswith("com") else 0.0 for task in tasks))
    speed = ca.vertcat(*(velocity["xyz".index(task[-1])] if task.startswith("com") else 0.0 for task in tasks))
    return terms.task + shift, terms.task_velocity + speed

"""Whole-body operational space control (Kim 2018 §2.1, with its errata), one CasADi function per contact case.

With A the mass matrix, h = b + g, J the Jacobian of the supporting feet, U the selection of the actuated joints,
N = I − J̄ J (2.8), Γ = J_t A⁻¹ Nᵀ Uᵀ and M = U A⁻¹ Nᵀ Uᵀ, the torque that gives the task acceleration u exactly is

    τ_task = M⁺ Γᵀ (Γ M⁺ Γᵀ)⁻¹ (u − J̇_t q̇ + J_t J̄ J̇ q̇ + J_t A⁻¹ Nᵀ h)                          (2.9)–(2.11)

In double support M is singular: forces d = [x̂; −x̂] along the line between the feet move nothing, so v = U Jᵀ d spans
its null space (2.12), and M⁺ Γᵀ = (M + c v vᵀ)⁻¹ Γᵀ for any c > 0. Torque α v changes the internal force
F_int = W_int F_r = dᵀ F_r (5.4)–(5.7) by exactly 2 α, and nothing else: (2.18) becomes

    α = ½ (F_int,ref − dᵀ F_r(τ_task)),    and the sensed internal force is    F_act = dᵀ F_r(τ_sensor)            (5.3)

In single support the other foot may press on the ground while it is about to leave it or has just met it. The force
f that it then exerts accelerates the tasks by −J_t A⁻¹ Nᵀ J_fᵀ f, which the control law takes back. With f that of the
double support at the same accelerations, both laws give the same torque: fading f in and out makes a switch between
them smooth. The source adds f to the task force instead (2.19), which is the same only where all motion is controlled:
Λ*_task (J_t A⁻¹ Nᵀ J_tᵀ) = I; a point-foot biped in single support moves in three more ways.

F_r = J̄ᵀ (Uᵀ τ − h) + Λ_s J̇ q̇ (2.5) is the force of the robot on the environment. All products with A⁻¹ come from one
Cholesky factorisation: with X = L⁻¹ [Jᵀ Uᵀ h J_tᵀ], every one of them is a block of Xᵀ X.
"""

from __future__ import annotations

import casadi as ca

JOINTS = 6
DOFS = 12


def _cholesky(a: ca.SX) -> ca.SX:
    """Lower factor L of the symmetric positive matrix ``a`` = L Lᵀ."""
    n = a.size1()
    factor = ca.SX(n, n)
    for j in range(n):
        for i in range(j, n):
            value = a[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = ca.sqrt(value) if i == j else value / factor[j, j]
    return factor


def _forward(factor: ca.SX, b: ca.SX) -> ca.SX:
    """L⁻¹ b."""
    rows: list[ca.SX] = []
    for i in range(factor.size1()):
        value = b[i, :]
        for k in range(i):
            value = value - factor[i, k] * rows[k]
        rows.append(value / factor[i, i])
    return ca.vertcat(*rows)


def _backward(factor: ca.SX, b: ca.SX) -> ca.SX:
    """L⁻ᵀ b."""
    n = factor.size1()
    rows: list[ca.SX] = [ca.SX(0)] * n
    for i in reversed(range(n)):
        value = b[i, :]
        for k in range(i + 1, n):
            value = value - factor[k, i] * rows[k]
        rows[i] = value / factor[i, i]
    return ca.vertcat(*rows)


def whole_body_control(contacts: int, tasks: int) -> ca.Function:
    """The control law for ``contacts`` point feet (1 or 2) and ``tasks`` task coordinates.

    Inputs: A (12, 12), h (12), J (3 contacts, 12), Jdot_dq, Jt (tasks, 12), Jtdot_dq, u (tasks), sensed (6 joint
    torques); with two contacts also line (3: x̂, unit vector from left to right foot), reference (F_int,ref); with one
    also push (3): the force that the other foot, whose position is the last three tasks, is to press with meanwhile.
    Outputs: torque (6), reaction F_r (3 contacts) and felt, the same of the sensed torques; with two contacts also
    internal, the sensed internal force (5.3).
    """
    a, h = ca.SX.sym("A", DOFS, DOFS), ca.SX.sym("h", DOFS)
    jacobian, bias = ca.SX.sym("J", 3 * contacts, DOFS), ca.SX.sym("Jdot_dq", 3 * contacts)
    task, task_bias = ca.SX.sym("Jt", tasks, DOFS), ca.SX.sym("Jtdot_dq", tasks)
    u = ca.SX.sym("u", tasks)
    line, reference = ca.SX.sym("line", 3), ca.SX.sym("reference")
    sensed, push = ca.SX.sym("sensed", JOINTS), ca.SX.sym("push", 3)

    # products with A⁻¹
    selection = ca.vertcat(ca.SX(DOFS - JOINTS, JOINTS), ca.SX.eye(JOINTS))  # Uᵀ
    x = _forward(_cholesky(a), ca.horzcat(jacobian.T, selection, h, task.T))
    first = 3 * contacts
    xj, xu = x[:, :first], x[:, first : first + JOINTS]
    xh, xt = x[:, first + JOINTS], x[:, first + JOINTS + 1 :]

    # projection into the null space of the contacts
    contact = _cholesky(xj.T @ xj)  # of Λ_s⁻¹
    yu, yh, yt = (_forward(contact, xj.T @ block) for block in (xu, xh, xt))
    yb = _forward(contact, bias)
    mobility = xu.T @ xu - yu.T @ yu  # M
    gamma = xt.T @ xu - yt.T @ yu
    gravity = xt.T @ xh - yt.T @ yh  # J_t A⁻¹ Nᵀ h

    if contacts == 2:
        direction = ca.vertcat(line, -line)  # d
        null = jacobian[:, DOFS - JOINTS :].T @ direction  # v
        mobility += ca.trace(mobility) / (JOINTS * ca.dot(null, null)) * (null @ null.T)
    factor = _cholesky(mobility)
    z = _forward(factor, gamma.T)
    task_factor = _cholesky(z.T @ z)  # of Λ*⁻¹
    wanted = u - task_bias + yt.T @ yb + gravity
    if contacts == 1:
        wanted += xt.T @ xt[:, -3:] @ push - yt.T @ yt[:, -3:] @ push
    force = _backward(task_factor, _forward(task_factor, wanted))
    torque = _backward(factor, z @ force)

    def reaction(tau: ca.SX) -> ca.SX:
        return _backward(contact, yu @ tau - yh + yb)

    felt = reaction(sensed)
    inputs = [a, h, jacobian, bias, task, task_bias, u, sensed]
    names = ["A", "h", "J", "Jdot_dq", "Jt", "Jtdot_dq", "u", "sensed"]
    if contacts == 1:
        return ca.Function(
            "wbosc_single",
            [*inputs, push],
            [torque, reaction(torque), felt],
            [*names, "push"],
            ["torque", "reaction", "felt"],
        )
    torque = torque + (reference - ca.dot(direction, reaction(torque))) / 2 * null
    return ca.Function(
        "wbosc_double",
        [*inputs, line, reference],
        [torque, reaction(torque), felt, ca.dot(direction, felt)],
        [*names, "line", "reference"],
        ["torque", "reaction", "felt", "internal"],
    )

"""The record of a robot that steps as told: times, places and torques that a test knows."""

import numpy as np

from central_controller.behaviours.step import State
from central_controller.planning.pendulum import Foot, PendulumState, on_level
from hil.record.signals import Signals

RATE = 1000
DURATIONS = {State.UNLOADING: 20, State.LIFTING: 100, State.LANDING: 150, State.LOADING: 30, State.DOUBLE: 20}  # ms
STEP = sum(DURATIONS.values())
FIRST = 100  # row of the first step
PLAN = 90  # rows after a step's begin
HEIGHT = 0.8
JOINTS = ("right_knee", "left_knee")
FEET = ("right_foot", "left_foot")
PLANNED = {"right_foot": (0.02, -0.2), "left_foot": (0.02, 0.2)}

_WORLD = [
    *(f"com.{axis}" for axis in "xyz"), *(f"com_velocity.{axis}" for axis in "xyz"),
    *(f"base.{angle}" for angle in ("roll", "pitch", "yaw")),
    *(f"{what}.{foot}.{axis}" for what in ("foot", "contact") for foot in FEET for axis in "xyz"),
    "hoist", "internal_force", "push.x", "push.z",
]  # fmt: skip
_CONTROLLER = [
    *(f"{what}.{axis}" for what in ("com", "com_velocity") for axis in "xyz"),
    "com_reference.x", "com_reference.z", "roll", "pitch", "yaw", "roll_reference", "pitch_reference",
    "internal_force", "internal_force_reference", "state_age", "phase", "missed_states", "malformed",
    *(f"{what}.{joint}" for what in ("torque_command", "torque_sensed") for joint in JOINTS),
    "state", "steps", *(f"carries.{foot}" for foot in FEET),
    *(f"foot.{foot}.{axis}" for foot in FEET for axis in "xyz"),
    *(f"pendulum.{what}" for what in ("x", "y", "vx", "vy")),
    *(f"plan.{what}" for what in ("foot.x", "foot.y", "x", "y", "vx", "vy", "remaining", "extension")),
]  # fmt: skip


def stepping_run(errors: list[tuple[float, float]]) -> dict[str, Signals]:
    """Channels ``world`` and ``controller``, one step for each of ``errors`` (m), by which it misses PLANNED.

    The right foot swings first, the stance foot of every step stands at the origin, and from the plan of each step on
    the centre of mass moves exactly as the linear pendulum about it.
    """
    n = FIRST + STEP * len(errors) + 50
    times = np.arange(n, dtype=np.int64) * (10**9 // RATE)
    world = Signals(times, tuple(_WORLD), np.zeros((n, len(_WORLD))))
    controller = Signals(times + 300_000, tuple(_CONTROLLER), np.zeros((n, len(_CONTROLLER))))
    controller["phase"][:] = 3
    controller["com_reference.z"][:] = world["com.z"][:] = HEIGHT
    for foot in FEET:
        controller[f"carries.{foot}"][:] = 1
        world[f"contact.{foot}.z"][:] = -100.0
    for number, error in enumerate(errors):
        _step(world, controller, FIRST + STEP * number, number, error)
    controller["state"][FIRST + STEP * len(errors) :] = State.DOUBLE
    return {"world": world, "controller": controller}


def _step(world: Signals, controller: Signals, begin: int, number: int, error: tuple[float, float]) -> None:
    row = begin
    for state, length in DURATIONS.items():
        controller["state"][row : row + length] = state
        row += length
    swing, stance = FEET[number % 2], FEET[1 - number % 2]
    controller["steps"][begin + 270 :] = number + 1
    controller[f"carries.{swing}"][begin : begin + 300] = 0
    planned = PLANNED[swing]
    for axis, wanted, miss in zip("xy", planned, error, strict=True):
        controller[f"plan.foot.{axis}"][begin + PLAN :] = wanted
        controller[f"foot.{stance}.{axis}"][begin : begin + STEP] = 0.0
        world[f"foot.{stance}.{axis}"][begin : begin + STEP] = 0.0
        world[f"foot.{swing}.{axis}"][begin : begin + STEP] = wanted + miss
    start = PendulumState(0.001 * number, 0.5 * planned[1], 0.1, 0.2 * np.sign(planned[1]))
    for k in range(begin, begin + STEP):
        now = on_level(start, Foot(0.0, 0.0), HEIGHT, (k - begin - PLAN) / RATE)
        for name, value in zip(("x", "y", "vx", "vy"), now, strict=True):
            controller[f"pendulum.{name}"][k] = value
        for axis, place, speed in (("x", now.x, now.vx), ("y", now.y, now.vy)):
            world[f"com.{axis}"][k], world[f"com_velocity.{axis}"][k] = place, speed
    switch = on_level(start, Foot(0.0, 0.0), HEIGHT, 0.205)
    for name, value in (*zip(("x", "y", "vx", "vy"), switch, strict=True), ("remaining", 0.205)):
        controller[f"plan.{name}"][begin + PLAN :] = value

"""How soon, and how surely, `controller.contact = "force"` tells that a foot has landed.

    python docs/examples/contact_detection.py

By the physics' own contact forces, beside the foot switch and beside what statics alone would tell.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from central_controller.model import BASE, RobotModel
from hil.record.signals import Signals
from hil.run import Request, run
from hil.scenario import load
from robots import description

SEEDS, DURATION = (0, 1, 2), "8s"
ROBOT = description.load("hume")
RATE = 1500.0
BOUNCES = 0.02  # s after a lift in which a foot that strikes the ground again does not count as landing
WINDOW = 60  # ticks after a touch-down that are looked at
THRESHOLD = 20.0  # N, of statics alone, as of controller.contact_force.press


def main() -> None:
    felt, statics, switched, airborne, believed, error = [], [], [], 0, 0, []
    for seed in SEEDS:
        settings = [f"duration={DURATION}", "controller.contact=force"]
        tables = run(Request(load("balance", settings), seed, "inline", report=False)).tables
        controller, world = tables["controller"], tables["world"]
        rows = world.latest_before(controller.times - 470_000)  # of the tick that the row tells of
        stepping = controller["state"] >= 2
        for n, foot in enumerate(("right_foot", "left_foot")):
            press = -world[f"contact.{foot}.z"][rows]
            number = np.arange(len(press))
            last = np.maximum.accumulate(np.where(press > 0.0, number, -(10**6)))
            air = stepping & (number - last > BOUNCES * RATE)
            airborne += int(air.sum())
            believed += int(controller[f"foot_contact.{foot}"][air].sum())
            stance = stepping & (controller[f"carries.{foot}"] == 1) & (press > 50.0)
            error.append(np.square(controller[f"foot_press.{foot}"] - press)[stance])
            for row in np.flatnonzero((press[1:] > 0.0) & air[:-1]) + 1:
                after = slice(row, row + WINDOW)
                felt.append(delay(controller[f"foot_contact.{foot}"][after] > 0.0))
                switched.append(delay(controller[f"foot_switch.{foot}"][after] > 0.0))
                statics.append(delay(static_press(controller, n, range(*after.indices(len(press)))) > THRESHOLD))
    print(f"balance, seeds {SEEDS}, {DURATION}: {len(felt)} touch-downs; ms from the first contact until")
    for name, delays in (("the switch tells", switched), ("force is felt", felt), ("statics alone tell", statics)):
        known = 1e3 * np.array(delays)
        print(f"  {name:20} mean {np.nanmean(known):5.2f}, longest {np.nanmax(known):5.2f}")
    print(f"contact felt in {believed} of {airborne} ticks in the air")
    print(f"force felt under the stance foot: rms error {np.sqrt(np.mean(np.concatenate(error))):.1f} N")


def delay(told: np.ndarray) -> float:
    """Time [s] to the first of these ticks that tells; NaN: none does."""
    return float(told.argmax()) / RATE if told.any() else float("nan")


_model = RobotModel(ROBOT)


def static_press(controller: Signals, foot: int, rows: range) -> np.ndarray:
    """Force [N] with which a foot would press if nothing accelerated."""
    joints, found = controller.members("torque_sensed"), []
    leg = _model.leg(foot)
    for row in rows:
        turn = pin.rpy.rpyToMatrix(*(float(controller[angle][row]) for angle in ("roll", "pitch", "yaw")))
        q = np.concatenate([np.zeros(3), pin.Quaternion(turn).coeffs(), [controller[f"q.{j}"][row] for j in joints]])
        _model.update(q, np.zeros(_model.nv))
        torque = np.array([controller[f"torque_sensed.{j}"][row] for j in joints]) - _model.h[BASE:]
        jacobian = _model.Js[3 * foot : 3 * foot + 3, [BASE + j for j in leg]]
        found.append(-np.linalg.solve(jacobian.T, torque[leg])[2])
    return np.array(found)


if __name__ == "__main__":
    main()

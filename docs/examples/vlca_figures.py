"""Figures of docs/actuators.md, from the plant's model of the VLCA.

    python docs/examples/vlca_figures.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from plant.actuators.bank import ActuatorBank
from robots import description

ROBOT = description.load("vlca")
JOINT = ROBOT.joints[0]
A, LINKAGE = JOINT.actuator, JOINT.actuator.linkage
AIR, LIQUID, LIMIT = "tab:red", "tab:blue", "0.4"


def bank(dt, **change):
    joint = JOINT.model_copy(update={"actuator": A.model_copy(update=change)})
    return ActuatorBank(ROBOT.model_copy(update={"joints": (joint,)}), dt, 0.0, lambda f: f, np.zeros(1), np.zeros(1))


def available(speed, supply_power):
    """Current [A] that flows at most when the motor is kept at ``speed`` [rad/s, equivalent]."""
    stand = bank(1e-6)
    stand.set(0, "inertia", 1e12)
    stand.set(0, "supply_power", supply_power)
    stand.state[stand.symbols.state_index[0]["dphi"]] = speed
    stand.current[0] = A.current_limit
    stand.step()
    return stand.observe().current[0]


def posture(path):
    q = np.linspace(*JOINT.limits, 200)
    arm = np.array([float(LINKAGE.arm(angle)) for angle in q])
    force = A.torque_per_ampere / A.nominal_arm
    continuous = 0.701 / A.torque_constant  # A, Kim 2018 §5.3.1
    stall = min(A.current_limit, A.supply_voltage / A.motor.resistance)
    screw = A.supply_voltage / (A.torque_constant * A.reduction)  # m/s without load
    figure, ((left, speed), (middle, right)) = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    left.plot(q, 1e3 * arm)
    left.axhline(1e3 * LINKAGE.crank, color=LIMIT, ls="--", lw=1, label="length of the crank")
    left.set(xlabel="ankle [rad]", ylabel="moment arm $N_l$ [mm]", ylim=(0, 50))
    speed.plot(q, screw / arm, label="48 V, without load")
    for value in (7.5, 20):
        speed.axhline(value, color=LIMIT, ls="--", lw=1, label="source: 7.5, 20+ rad/s" if value == 20 else None)
    speed.set(xlabel="ankle [rad]", ylabel="speed [rad/s]", ylim=(0, 25))
    middle.plot(q, force * stall * arm, color="black", label="peak: 48 V, stalled, cold")
    middle.plot(q, force * continuous * arm, color=LIQUID, label="continuous, liquid")
    middle.plot(q, force * continuous / 3.59 * arm, color=AIR, label="continuous, air")
    for value in (270, 91):
        middle.axhline(value, color=LIMIT, ls="--", lw=1, label="source: about 270, 91 N m" if value == 91 else None)
    middle.set(xlabel="ankle [rad]", ylabel="torque [N m]", ylim=(0, 400))
    speeds = np.linspace(0, 8, 200)
    for power, colour, label in ((1e9, "tab:green", "48 V"), (A.supply_power, "tab:purple", "48 V, 1500 W")):
        torque = [A.torque_per_ampere * max(available(s, power), 0.0) for s in speeds]
        right.plot(speeds, torque, color=colour, label=label)
    right.axhline(A.force_limit * A.nominal_arm, color=LIMIT, ls="--", lw=1, label="7300 N")
    right.axhline(A.torque_per_ampere * continuous, color=LIQUID, ls=":", lw=1, label="continuous, liquid")
    right.set(xlabel="speed [rad/s]", ylabel="torque at the longest arm, cold [N m]", ylim=(0, 460), xlim=(0, 8))
    for axes in (left, speed, middle, right):
        axes.legend(fontsize=9, loc="upper right")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def heating(current, cooling, seconds, dt=0.02):
    """Winding temperature [°C] of a held motor, every ``dt``."""
    stand = bank(dt, cooling=cooling)
    for name in ("stiffness", "damping", "torque_per_ampere"):  # it is held: nothing moves
        stand.set(0, name, 0.0)
    stand.set(0, "supply_power", 1e9)
    stand.current[0] = current
    rows = [25.0]
    for _ in range(round(seconds / dt)):
        stand.step()
        rows.append(float(stand.observe().temperature[0]))
        if rows[-1] > 200:
            break
    return dt * np.arange(len(rows)), np.array(rows)


def heat(path):
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    for cooling, colour in (("air", AIR), ("liquid", LIQUID)):
        for current, style in ((4.36, "-"), (15.65, "--"), (30.0, ":")):
            times, temperature = heating(current, cooling, 6000.0 if cooling == "air" else 1000.0, 0.05)
            axes.plot(times[1:], temperature[1:], color=colour, ls=style, label=f"{cooling}, {current:g} A")
    axes.axhline(155, color=LIMIT, lw=1)
    axes.text(0.12, 158, "limit of the winding, 155 °C", color=LIMIT, fontsize=9)
    axes.set(xscale="log", xlabel="time [s]", ylabel="winding [°C]", ylim=(20, 260), xlim=(0.1, 6000))
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2, loc="upper left", bbox_to_anchor=(0.0, 1.0))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent.parent
    posture(folder / "vlca-posture.png")
    heat(folder / "vlca-heat.png")

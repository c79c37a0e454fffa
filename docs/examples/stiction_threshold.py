"""What stiction adds to the margin of the linear loop: how large an oscillation it holds.

    python docs/examples/stiction_threshold.py [DELAY in ms, 12]

Dry friction of level F takes from an oscillation with velocity amplitude V as much as viscous damping of 4 F / (π V)
(describing function): the smaller the oscillation, the more. At a delay with which the loop without friction is
unstable there is so an amplitude where growth and friction are in balance: what is smaller fades, what is larger grows.
It is predicted here with the linearised loop, and tried in the emulation with friction on, on both sides of it.
"""

from __future__ import annotations

import sys

import numpy as np

from hil.lab.linear.operating_point import OperatingPoint
from hil.lab.linear.section import trajectory
from hil.scenario import load

_FRICTION = ("coulomb", "static", "load_friction")


def main() -> None:
    delay = float(sys.argv[1]) * 1e-3 if len(sys.argv) > 1 else 12e-3
    values = {"link.command.delay": delay}
    with OperatingPoint(load("split-terrain"), 3.0) as point:
        bank, world = point.system.world.actuators, point.system.world
        joints = range(len(bank.names))
        truth = dict(zip(world.truth_fields, world.truth(), strict=True))
        described = [joint.actuator for joint in world.robot.joints]
        level = np.array([
            a.coulomb + a.load_friction * abs(truth[f"spring_torque.{name}"])
            for a, name in zip(described, bank.names, strict=True)
        ])  # fmt: skip
        without = [bank.get(j, "viscous") for j in joints]

        def damped(by: np.ndarray) -> None:
            for j in joints:
                bank.set(j, "viscous", without[j] + by[j])
            point.take_parameters()

        free = point.linearise(values)
        mode = free.dominant
        print(f"{1e3 * delay:g} ms without friction: {mode.growth:.2f}/s at {mode.frequency:.2f} Hz ({mode.told(3)})")
        speeds = [free.names.index(f"{name} rotor speed") for name in bank.names]
        shape = free.shape(mode)
        low, high, hip = 0.02, 20.0, bank.names.index("left_hip")
        for _ in range(7):  # amplitude of the left hip's rotor, rad/s
            amplitude = np.sqrt(low * high)
            size = amplitude * np.abs(shape[speeds]) / abs(shape[speeds[hip]])
            damped(4.0 * level / (np.pi * size))
            found = point.linearise(values)
            wave = found.like(mode)
            low, high = (low, amplitude) if wave.growth > 0.0 else (amplitude, high)
            shape = found.shape(wave)
        damped(np.zeros(len(bank.names)))
        balance = np.sqrt(low * high)
        print(f"balance: {balance:.2f} rad/s of the left hip's rotor, {wave.frequency:.1f} Hz")

        towards = free.shape(mode)
        towards = np.real(towards / towards[speeds[hip]])  # of 1 rad/s
        for j, actuator in enumerate(described):
            for name in _FRICTION:
                bank.set(j, name, getattr(actuator, name))
        point.take_parameters()
        section = point.section(values)
        quarter = 0.25 / mode.frequency
        for share in (0.5, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0):
            readings = trajectory(section, share * balance * towards, 600)
            speed = np.array([section.difference(reading, readings[-1])[speeds[hip]] for reading in readings])
            window = int(4 * quarter / section.period)
            first, last = (np.ptp(part) / 2 for part in (speed[window : 2 * window], speed[-window:]))
            print(f"  {share:4.2f} of it kicked: {first:.2f} rad/s in the second period, {last:.2f} rad/s after 0.4 s")


if __name__ == "__main__":
    main()

"""Phase and delay margin of the internal force's feedback, by a linear model of one joint.

    python docs/examples/internal_force_margin.py

The loop K_F F(s) G(s) exp(−sT): F the low-pass of the sensed force, G the torque loop of a hip whose output is held,
without dry friction, T from a joint's sample to the command that used it taking effect, plus half a sample of hold.
"""

from __future__ import annotations

import numpy as np

from central_controller.config import InternalForceConfig
from joint_firmware.config import FirmwareConfig
from robots import description

_LATENCY = 0.62e-3 + 1 / 3000  # s: `hil run` prints the round trip


def main() -> None:
    actuator = description.load("hume").joint("right_hip").actuator
    firmware, force = FirmwareConfig(), InternalForceConfig()
    gains, omega = firmware.stance, np.linspace(1.0, 1000.0, 200_000)  # rad/s
    s = 1j * omega
    velocity = 1 / (1 + s / (2 * np.pi * firmware.velocity_cutoff))
    stiff = (1 + gains.kp) * actuator.stiffness
    damping = gains.kd * velocity + actuator.damping + actuator.viscous
    torque_loop = stiff / (actuator.rotor_inertia * s**2 + damping * s + stiff)
    for name, low_pass in (("unfiltered", 1.0), (f"{force.cutoff:g} Hz", 1 / (1 + s / (2 * np.pi * force.cutoff)))):
        loop = force.gain * low_pass * torque_loop * np.exp(-s * _LATENCY)
        crossover = np.flatnonzero((np.abs(loop[:-1]) > 1) & (np.abs(loop[1:]) <= 1))[-1]
        margin = np.pi + np.unwrap(np.angle(loop))[crossover]
        print(
            f"{name:>10}: crossover {omega[crossover] / (2 * np.pi):.0f} Hz, phase margin {np.degrees(margin):.0f}°, "
            f"delay margin {1e3 * margin / omega[crossover]:.1f} ms"
        )


if __name__ == "__main__":
    main()

"""Noise, bias and delay of the drive's velocity estimators on Hume's hip encoder, at the drive's rate.

    python docs/examples/velocity_estimators.py

Noise (1σ) and bias are those at constant velocity, over a set of velocities near the named one so that no beat of
counts and ticks is singled out. Delay is the lag behind a steep ramp, where counts are plenty.
"""

from __future__ import annotations

import math

import numpy as np

from joint_firmware.config import FirmwareConfig
from joint_firmware.laws.velocity import ESTIMATORS, estimator_function
from robots import description

CONFIG = FirmwareConfig()
DT = 1.0 / CONFIG.rate
STEP = abs(1.0 / description.load("hume").joint("right_hip").sensor.encoder)  # rad per count
VELOCITIES = (0.002, 0.02, 0.2, 2.0)  # rad/s


def run(method: str, positions: np.ndarray) -> np.ndarray:
    """Velocity of every tick, rad/s."""
    estimator, step = ESTIMATORS[method]("motor"), estimator_function(method)
    values = estimator.settings(CONFIG)
    parameters = [values[name] for name in estimator.parameters]
    buffer, evaluate = step.buffer()
    arguments = [np.zeros(1), np.zeros(1), np.full(1, STEP), np.zeros(len(estimator.states)), np.array(parameters)]
    results = [np.zeros(len(estimator.states)), np.zeros(1)]
    for n, array in enumerate(arguments):
        buffer.set_arg(n, memoryview(array))  # type: ignore[call-arg, arg-type]
    for n, array in enumerate(results):
        buffer.set_res(n, memoryview(array))  # type: ignore[call-arg, arg-type]
    trace = np.zeros(len(positions))
    for n, position in enumerate(np.floor(positions / STEP) * STEP):
        arguments[0][0], arguments[1][0] = position, float(n > 0)
        evaluate()
        arguments[3][:] = results[0]
        trace[n] = results[1][0]
    return trace


def noise_and_bias(method: str, velocity: float) -> tuple[float, float]:
    """rad/s."""
    ticks, errors = np.arange(6000), []
    for k in range(7):
        near = velocity * (1.0 + 0.01 * math.sqrt(2.0) * k)
        errors.append(run(method, near * DT * ticks + 0.37 * k * STEP)[3000:] - near)
    return float(np.std(errors)), float(np.mean(errors))


def delay(method: str) -> float:
    """s."""
    t = DT * np.arange(3000)
    return float(np.mean(t - run(method, 0.5 * 20.0 * t**2) / 20.0))


def main() -> None:
    gate = round(CONFIG.velocity_window / DT) * DT
    cutoff = CONFIG.velocity_cutoff
    print(f"count {1e6 * STEP:.1f} µrad, tick {1e6 * DT:.0f} µs, gate {1e3 * gate:g} ms, filter {cutoff:g} Hz")
    print("rad/s            " + "".join(f"{v:>18g}" for v in VELOCITIES) + "             delay")
    print("counts per tick  " + "".join(f"{v * DT / STEP:>18.3g}" for v in VELOCITIES) + "                ms")
    for method in ESTIMATORS:
        cells = ["{:.3f} {:+.3f}".format(*(1e3 * part for part in noise_and_bias(method, v))) for v in VELOCITIES]
        print(f"{method:<17}" + "".join(f"{cell:>18}" for cell in cells) + f"{1e3 * delay(method):18.2f}")
    print("                 noise (1σ) and bias in mrad/s")


if __name__ == "__main__":
    main()

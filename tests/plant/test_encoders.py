"""Encoders of the joints at power-on: what counts from zero, what is absolute, how it is mounted."""

import numpy as np
import pytest

from hil.streams import streams
from plant.bench import Bench, Locked
from plant.config import SensorConfig
from plant.sensors import joint_encoder_offset
from robots import description, pins

HUME = description.load("hume")
KNEE = HUME.joint_names.index("left_knee")
SCALE = HUME.joints[KNEE].sensor.joint_encoder


def knee(at=0.5, seed=0, **sensors):
    bench = Bench(HUME, KNEE, Locked(at=f"{at} rad"), 3000.0, SensorConfig(**sensors), streams(seed))
    bench.sample()
    return bench


@pytest.mark.parametrize("at", [-0.3, 0.0, 2.1])
def test_a_motor_counts_from_zero_wherever_power_comes_on(at):
    assert knee(at).pins_in[pins.MOTOR_ENCODER] == 0


def test_an_absolute_encoder_reads_the_angle_and_its_mounting():
    quiet = {"noise": 0.0, "bias": 0.0}
    assert knee(0.5, **quiet).pins_in[pins.JOINT_ENCODER] == round(0.5 * SCALE)
    mounted = knee(0.5, encoder_offset={"left_knee": "-0.2 rad"}, **quiet)
    assert mounted.pins_in[pins.JOINT_ENCODER] == round(0.3 * SCALE)


def test_a_mounting_is_the_same_for_a_joint_alone_and_in_its_robot_and_differs_by_joint_and_seed():
    config = SensorConfig(mounting="0.3 rad")
    drawn = np.array([[joint_encoder_offset(j, config, streams(seed)) for j in HUME.joints] for seed in range(300)])
    assert drawn.std() == pytest.approx(0.3, rel=0.05)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(6)).max() < 0.2
    for seed in range(3):
        read = knee(0.5, seed, mounting="0.3 rad", noise=0.0).pins_in[pins.JOINT_ENCODER] / SCALE
        assert read == pytest.approx(0.5 + drawn[seed, KNEE], abs=1 / SCALE)


def test_what_a_calibration_leaves_and_noise_are_those_of_the_description():
    residuals = [joint_encoder_offset(j, SensorConfig(), streams(seed)) for seed in range(100) for j in HUME.joints]
    assert np.std(residuals) == pytest.approx(HUME.joints[KNEE].sensor.joint_bias, rel=0.1)
    bench, counts = knee(), []
    for _ in range(2000):
        bench.sample()
        counts.append(int(bench.pins_in[pins.JOINT_ENCODER]))
    deviation = np.hypot(HUME.joints[KNEE].sensor.joint_noise * SCALE, 1 / np.sqrt(12))  # and that of rounding
    assert np.std(counts) == pytest.approx(deviation, rel=0.1)

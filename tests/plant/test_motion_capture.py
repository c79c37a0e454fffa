"""What the cameras see, against MuJoCo's own kinematics and the statistics that the description promises."""

from __future__ import annotations

import numpy as np
import pytest

from hil.streams import streams
from plant.config import MotionCaptureConfig, SensorConfig, StanceConfig, TerrainConfig, WorldConfig
from plant.sensors import ImuSensor
from plant.world import World
from robots import description, imu, motion_capture

ROBOT = description.load("hume")
SYSTEM = ROBOT.motion_capture
FLAT, APART = TerrainConfig(), StanceConfig(feet_apart="0.3m", feet_width="0.2m", hip_height="0.75m")
EXACT = SensorConfig(noise=0.0, bias=0.0)


def world(sensors: SensorConfig = EXACT, seed: int = 0, **config) -> World:
    planarizer = {"enabled": False}
    hoist = {"hold": 0, "release": 0}
    return World(
        ROBOT, WorldConfig(planarizer=planarizer, hoist=hoist), FLAT, APART, sensors, (), streams(seed),
        motion_capture=MotionCaptureConfig(enabled=True, **config),
    )  # fmt: skip


def places(world: World) -> np.ndarray:
    """Of the LEDs, from the bodies' frames."""
    return np.array([
        world.data.body(led.link).xpos + world.data.body(led.link).xmat.reshape(3, 3) @ led.position
        for led in SYSTEM.leds
    ])  # fmt: skip


def look(world: World, now_ns: int = 0, since: float = 0.0) -> motion_capture.Frame:
    return motion_capture.decode(world.motion_capture.expose(now_ns, since), SYSTEM)


def test_a_frame_shows_the_leds_where_they_are() -> None:
    falling = world()  # no drive holds it
    for _ in range(300):
        falling.step()
    frame = look(falling, 100_000_000)
    assert (frame.exposure_ns, frame.number) == (100_000_000, 0)
    assert frame.seen.all() and np.abs(falling.data.qvel).max() > 0.5
    np.testing.assert_allclose(frame.positions, places(falling), rtol=0, atol=SYSTEM.resolution * 0.500001)
    assert look(falling).number == 1
    assert falling.motion_capture.row[:9].all()
    np.testing.assert_allclose(falling.motion_capture.row[9:].reshape(9, 3), places(falling), rtol=0, atol=1e-12)


def test_an_exposure_between_two_steps_shows_the_leds_where_they_were() -> None:
    falling = world()
    for _ in range(300):
        falling.step()
    before = places(falling)
    falling.step()
    np.testing.assert_allclose(look(falling, since=1 / 3000).positions, before, rtol=0, atol=SYSTEM.resolution)
    exact = places(falling)
    for share in (0.25, 0.5):
        middle = look(falling, since=share / 3000).positions
        np.testing.assert_allclose(middle, exact + share * (before - exact), rtol=0, atol=SYSTEM.resolution)


def test_noise_and_placement_are_those_of_the_description() -> None:
    off, spread = [], []
    for seed in range(20):
        still = world(SensorConfig(), seed)
        positions = np.array([look(still).positions for _ in range(30)])
        off.append(positions.mean(axis=0) - places(still))
        spread.append(positions.std(axis=0))
    assert np.mean(spread) == pytest.approx(SYSTEM.noise, rel=0.05)
    assert np.std(off) == pytest.approx(np.hypot(SYSTEM.placement, SYSTEM.noise / np.sqrt(30)), rel=0.1)
    assert abs(np.mean(off)) < 1e-4


@pytest.mark.parametrize(("share", "length"), [(0.3, 0.05), (0.7, 0.02), (0.9, 0.0), (0.5, 0.0)])
def test_leds_are_hidden_for_their_share_of_the_time_and_in_pieces_of_their_length(share: float, length: float) -> None:
    still = world(occlusion=share, occlusion_time=f"{length} s")
    seen = np.array([look(still).seen for _ in range(3000)])
    hidden = seen == 0
    assert hidden.mean() == pytest.approx(share, abs=0.05)
    begins = (hidden[1:] & ~hidden[:-1]).sum()
    exposures = max(length * SYSTEM.rate, 1 / (1 - share))
    assert hidden.sum() / begins == pytest.approx(exposures, rel=0.15)
    assert np.abs(np.corrcoef(seen.T) - np.eye(len(SYSTEM.leds))).max() < 0.4  # each by a chain of its own
    assert not np.abs(still.motion_capture.row[9:].reshape(9, 3)[still.motion_capture.row[:9] == 0]).any()


def test_all_leds_are_hidden_and_seen_again() -> None:
    still = world()
    still.motion_capture.set("occluded", True)
    assert not look(still).seen.any()
    still.motion_capture.set("occluded", False)
    assert look(still).seen.all()
    still.motion_capture.set("occlusion", 1.0)
    assert not look(still).seen.any() and not look(still).seen.any()
    with pytest.raises(KeyError):
        still.motion_capture.set("enabled", False)


def test_a_restored_system_continues() -> None:
    one, other = (world(SensorConfig(), occlusion=0.5, occlusion_time="10ms") for _ in range(2))
    for _ in range(50):
        one.motion_capture.expose(0, 0.0)
    one.motion_capture.set("occlusion", 0.4)
    other.restore(one.snapshot())
    for k in range(50):
        assert one.motion_capture.expose(k, 1e-4) == other.motion_capture.expose(k, 1e-4)


def test_the_leds_change_nothing_about_the_physics() -> None:
    bare = World(
        ROBOT, WorldConfig(planarizer={"enabled": False}, hoist={"hold": 0, "release": 0}), FLAT, APART, EXACT, (),
        streams(0),
    )  # fmt: skip
    marked = world()
    assert bare.motion_capture is None
    for _ in range(100):
        bare.step()
        marked.step()
    assert bare.truth().tobytes() == marked.truth().tobytes()


def test_the_gyro_drifts_by_its_deviation_and_correlation_time() -> None:
    rate, tau, sigma = 1500.0, 0.2, 0.05
    config = SensorConfig(noise=0.0, bias=0.0, gyro_drift=f"{sigma} rad/s", gyro_drift_time=f"{tau} s")
    sensor = ImuSensor(ROBOT.imu, config, rate, streams(3))
    still = np.zeros(6)
    drift = np.array([imu.decode(sensor.sample(still), ROBOT.imu)[0] for _ in range(60_000)])
    assert drift.std() == pytest.approx(sigma, rel=0.1)
    lag = round(tau * rate)
    correlation = (drift[lag:] * drift[:-lag]).mean() / drift.var()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.12)
    twin = ImuSensor(ROBOT.imu, config, rate, streams(3))
    twin.restore(sensor.snapshot())
    assert [sensor.sample(still) for _ in range(5)] == [twin.sample(still) for _ in range(5)]

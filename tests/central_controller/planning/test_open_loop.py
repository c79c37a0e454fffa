"""The open-loop plan: against the pendulum's own equations, the feet, the speeds that the source allows."""

import numpy as np
import pytest

from central_controller.planning.config import OpenLoopConfig
from central_controller.planning.open_loop import Motion, plan
from central_controller.planning.planar import PlanarBiped
from robots import description
from robots.terrain import Block, ground_height

ROBOT = description.load("hume")
BLOCK = Block.model_validate({"start": "0.33m", "end": "0.57m", "height": "8cm"})
RATE = 1500.0


@pytest.fixture(scope="module", params=[1, 2, 3])
def planned(request: pytest.FixtureRequest) -> tuple[OpenLoopConfig, Motion]:
    config = OpenLoopConfig.model_validate({"steps": request.param})
    return config, plan(ROBOT, config, RATE, blocks(config))


def blocks(config: OpenLoopConfig) -> list[Block]:
    """What lies in the way of a motion of so many steps."""
    return [BLOCK] if config.steps == 3 else []


def test_in_single_support_it_is_the_pendulum_with_the_slider(planned: tuple[OpenLoopConfig, Motion]) -> None:
    """Kim 2018 (7.5): the force goes through the stance foot, x'' = M/(M + m_s) (x/z) (g + z''), by differences."""
    config, motion = planned
    ratio = ROBOT.mass / (ROBOT.mass + config.slider_mass)
    stride = 6  # the plan's own grid of 4 ms
    x, z = motion.com[::stride].T
    dt = stride / RATE
    ddx, ddz = np.gradient(np.gradient(x, dt), dt), np.gradient(np.gradient(z, dt), dt)
    for swing in motion.swings:
        times = motion.times[::stride]
        inside = (times > swing.lift_off + 0.05) & (times < swing.landing - 0.05)
        foot = motion.feet[::stride][inside, 1 - swing.foot]
        pendulum = ratio * (x[inside] - foot[:, 0]) / (z[inside] - foot[:, 1]) * (ROBOT.gravity + ddz[inside])
        assert np.median(np.abs(ddx[inside] - pendulum)) < 0.05


def test_speed_above_each_stance_foot_is_the_given_one(planned: tuple[OpenLoopConfig, Motion]) -> None:
    config, motion = planned
    for swing in motion.swings:
        foot = motion.feet[np.searchsorted(motion.times, swing.lift_off + 0.01), 1 - swing.foot, 0]
        assert np.interp(foot, *motion.com[:, :1].T, motion.com_velocity[:, 0]) == pytest.approx(
            config.apex_speed, abs=0.01
        )


def test_joints_put_the_feet_where_they_are_planned(planned: tuple[OpenLoopConfig, Motion]) -> None:
    _, motion = planned
    biped = PlanarBiped(ROBOT)
    for at in range(0, len(motion.times), 200):
        feet = [tuple(foot) for foot in motion.feet[at].tolist()]
        angles, _ = biped.posture(tuple(motion.com[at].tolist()), feet)
        assert motion.positions[at] == pytest.approx(angles, abs=3e-3)
    assert motion.velocities[1:-1] == pytest.approx(np.gradient(motion.positions, 1 / RATE, axis=0)[1:-1], abs=0.05)


def test_a_swing_foot_clears_the_ground_and_lands_on_it(planned: tuple[OpenLoopConfig, Motion]) -> None:
    config, motion = planned
    for swing in motion.swings:
        inside = (motion.times > swing.lift_off) & (motion.times < swing.landing)
        x, z = motion.feet[inside, swing.foot].T
        assert all(height >= ground_height(blocks(config), at) - 1e-9 for at, height in zip(x, z, strict=True))
        top = max(ground_height(blocks(config), at) for at in x)
        assert z.max() == pytest.approx(top + config.clearance, abs=2e-3)
        assert swing.end[1] == ground_height(blocks(config), swing.end[0])


def test_the_swing_is_slow_enough(planned: tuple[OpenLoopConfig, Motion]) -> None:
    """Kim 2018 §7.1.7: below 5 rad/s at the hip and 10 rad/s at the knee the pendulum is a fair model."""
    speeds = np.abs(planned[1].velocities).max(axis=0)
    assert speeds[[1, 4]].max() < 5.0 and speeds[[2, 5]].max() < 10.0


def test_the_boost_lifts_the_speed_after_lift_off() -> None:
    slow, fast = (plan(ROBOT, OpenLoopConfig.model_validate({"boost_speed": b}), RATE) for b in ("0m/s", "5cm/s"))
    at = 0.16  # m, behind the boost
    speeds = [np.interp(at, *motion.com[:, :1].T, motion.com_velocity[:, 0]) for motion in (slow, fast)]
    # the path behind is moved by 3 cm and 5 cm/s (§7.1.6)
    before = np.interp(at - 0.03, *slow.com[:, :1].T, slow.com_velocity[:, 0])
    assert speeds[1] == pytest.approx(before + 0.05, abs=0.01)


def test_what_the_legs_cannot_do_is_told() -> None:
    with pytest.raises(ValueError, match="out of reach"):
        plan(ROBOT, OpenLoopConfig.model_validate({"com_height": "1.1m"}), RATE)


def test_a_block_has_a_length() -> None:
    with pytest.raises(ValueError, match="end"):
        Block.model_validate({"start": "1m", "end": "1m", "height": "8cm"})
    assert [ground_height([BLOCK], x) for x in (0.3, 0.33, 0.6)] == [0.0, 0.08, 0.0]

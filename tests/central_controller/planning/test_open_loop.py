"""The open-loop plan: against the pendulum's own equations, the feet, the speeds that the source allows."""

import numpy as np
import pytest
from pydantic import ValidationError

from central_controller.planning.config import OpenLoopConfig
from central_controller.planning.open_loop import Motion, plan
from central_controller.planning.planar import PlanarBiped
from robots import description
from robots.terrain import Block, ground_height

ROBOT = description.load("hume")
BLOCK = Block.model_validate({"start": "0.33m", "end": "0.57m", "height": "8cm"})
RATE = 1500.0


def configured(**settings: object) -> OpenLoopConfig:
    return OpenLoopConfig.model_validate(settings)


@pytest.fixture(scope="module", params=[1, 2, 3])
def planned(request: pytest.FixtureRequest) -> tuple[OpenLoopConfig, Motion]:
    config = configured(steps=request.param)
    return config, plan(ROBOT, config, RATE, blocks(config))


@pytest.fixture(scope="module", params=[1, 2, 3])
def pendulum(request: pytest.FixtureRequest) -> tuple[OpenLoopConfig, Motion]:
    """As in the source: legs without weight."""
    config = configured(steps=request.param, swing_momentum=False)
    return config, plan(ROBOT, config, RATE, blocks(config))


def blocks(config: OpenLoopConfig) -> list[Block]:
    """What lies in the way of a motion of so many steps."""
    return [BLOCK] if config.steps == 3 else []


def differs_from_the_pendulum(config: OpenLoopConfig, motion: Motion, spin: bool) -> float:
    """Greatest median over the swings of x'' less that of Kim 2018 (7.5), by differences [m/s²]."""
    ratio = ROBOT.mass / (ROBOT.mass + config.slider_mass)
    stride = 6  # the plan's own grid of 4 ms
    (x, z), times = motion.com[::stride].T, motion.times[::stride]
    dt = stride / RATE
    ddx, ddz = np.gradient(np.gradient(x, dt), dt), np.gradient(np.gradient(z, dt), dt)
    turning = np.gradient(PlanarBiped(ROBOT).spin(motion.positions[::stride], dt), dt) * spin
    medians = []
    for swing in motion.swings:
        inside = (times > swing.lift_off + 0.05) & (times < swing.landing - 0.05)
        dx, dz = ((x, z)[axis][inside] - motion.feet[::stride][inside, 1 - swing.foot, axis] for axis in (0, 1))
        expected = ratio / dz * (dx * (ROBOT.gravity + ddz[inside]) - turning[inside] / ROBOT.mass)
        medians.append(float(np.median(np.abs(ddx[inside] - expected))))
    return max(medians)


def test_in_single_support_it_is_the_pendulum_with_the_slider(pendulum: tuple[OpenLoopConfig, Motion]) -> None:
    assert differs_from_the_pendulum(*pendulum, spin=False) < 0.05


def test_the_swing_leg_turns_the_pendulum(planned: tuple[OpenLoopConfig, Motion]) -> None:
    """The moment of the ground's force about the centre of mass changes the angular momentum, which the legs have."""
    assert differs_from_the_pendulum(*planned, spin=True) < 0.05
    assert differs_from_the_pendulum(*planned, spin=False) > 0.1


def test_speed_above_each_stance_foot_is_the_given_one(pendulum: tuple[OpenLoopConfig, Motion]) -> None:
    config, motion = pendulum
    for swing in motion.swings:
        foot = motion.feet[np.searchsorted(motion.times, swing.lift_off + 0.01), 1 - swing.foot, 0]
        assert np.interp(foot, *motion.com[:, :1].T, motion.com_velocity[:, 0]) == pytest.approx(
            config.apex_speed, abs=0.01
        )


def test_the_ground_can_give_what_the_plan_needs(planned: tuple[OpenLoopConfig, Motion]) -> None:
    """On both feet the centre of pressure is between them, and goes over from one to the other without a jump."""
    _, motion = planned
    both = np.ones(len(motion.times), bool)
    for swing in motion.swings:
        alone = (motion.times > swing.lift_off) & (motion.times < swing.landing)
        stance = motion.feet[alone, 1 - swing.foot, 0]
        assert np.abs(motion.pressure[alone] - stance)[6:-6].max() < 2e-3
        both &= ~alone
    assert (motion.pressure > motion.feet[:, :, 0].min(axis=1) - 2e-3)[both].all()
    assert (motion.pressure < motion.feet[:, :, 0].max(axis=1) + 2e-3)[both].all()
    for before, after in zip(motion.swings, motion.swings[1:], strict=False):
        between = (motion.times > before.landing) & (motion.times < after.lift_off)
        expected = np.interp(motion.times[between], (before.landing, after.lift_off), (after.start[0], before.end[0]))
        assert motion.pressure[between] == pytest.approx(expected, abs=0.02)


def test_torques_make_up_for_what_the_drives_brake() -> None:
    """Of motors that move as the joints and the springs' deflections do."""
    plain, more = (plan(ROBOT, configured(drive_damping=d), RATE) for d in (0, "6 N m s/rad"))
    stiffness = np.array([joint.actuator.stiffness for joint in ROBOT.joints])
    motors = np.gradient(plain.positions + plain.torques / stiffness, 1.0 / RATE, axis=0)
    difference = more.torques - plain.torques
    assert np.median(np.abs(difference - 6.0 * motors), axis=0) == pytest.approx(np.zeros(6), abs=0.02)
    assert np.abs(difference[:, [1, 2, 4, 5]]).max(axis=0).min() > 1.0
    assert np.array_equal(more.positions, plain.positions)


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
    slow, fast = (plan(ROBOT, configured(boost_speed=b, swing_momentum=False), RATE) for b in ("0m/s", "5cm/s"))
    at = 0.16  # m, behind the boost
    speeds = [np.interp(at, *motion.com[:, :1].T, motion.com_velocity[:, 0]) for motion in (slow, fast)]
    # the path behind is moved by 3 cm and 5 cm/s (§7.1.6)
    before = np.interp(at - 0.03, *slow.com[:, :1].T, slow.com_velocity[:, 0])
    assert speeds[1] == pytest.approx(before + 0.05, abs=0.01)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"com_height": "1.1m"}, "out of reach"),
        ({"last_landing": "2cm", "steps": 3}, "would fall faster than freely"),
        ({"push_time": "1.2s"}, "mm behind the rear foot .* push_time"),
        ({"last_landing": "12cm"}, "mm in front of the front foot .* stop_time"),
        ({"dual_time": "1s", "steps": 2}, r"step 2 leaves 0\.08 s to swing a foot"),
        ({"apex_speed": "1e-9 m/s"}, "raise apex_speed"),
    ],
)
def test_what_the_robot_cannot_do_is_told(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan(ROBOT, configured(**settings), RATE)


@pytest.mark.parametrize(
    "start, end, height, message",
    [
        ("0.33m", "0.57m", "60cm", "out of reach"),
        ("0.44m", "0.57m", "8cm", r"foothold at 0\.45 m is on the edge of a block"),
        ("0.33m", "0.42m", "40cm", r"go through the block at 0\.3\d m"),
    ],
)
def test_a_block_that_cannot_be_stepped_over_is_told(start: str, end: str, height: str, message: str) -> None:
    block = Block.model_validate({"start": start, "end": end, "height": height})
    with pytest.raises(ValueError, match=message):
        plan(ROBOT, configured(steps=2), RATE, [block])


@pytest.mark.parametrize(
    "settings",
    [
        {"apex_speed": "-0.3m/s"}, {"wind_up": "-1cm"}, {"dual_time": "-1s"}, {"push_time": "1000s"}, {"steps": 0},
        {"lift_off": "0.3m"}, {"last_landing": "0.3m"}, {"step_length": "5cm"},
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        configured(**settings)


def test_a_block_has_a_length() -> None:
    with pytest.raises(ValueError, match="end"):
        Block.model_validate({"start": "1m", "end": "1m", "height": "8cm"})
    assert [ground_height([BLOCK], x) for x in (0.3, 0.33, 0.6)] == [0.0, 0.08, 0.0]

"""Motion capture in a run: its link, its faults, the orientation that it tells, and that nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.errors import UserError
from hil.run import Outcome, Request, assemble, run
from hil.scenario import load
from robots import description

SHORT = ["duration=1.3s", "limits.settle=1.2s", "world.hoist.hold=0.3s", "world.hoist.release=0.2s",
         "controller.stand_at=0.2s"]  # fmt: skip
SEEN = [*SHORT, "motion_capture.enabled=true", "controller.orientation=motion_capture"]
ROUGH = [
    *SEEN, "sensors.gyro_drift=0.25deg/s", "motion_capture.occlusion=0.3", "motion_capture.occlusion_time=20ms",
    "link.motion_capture.jitter=3ms", "link.motion_capture.corruption=0.1", "link.motion_capture.loss=0.1",
    "inject=[{at='0.6s', until='0.7s', key='motion_capture.occluded', value=true}]",
]  # fmt: skip


def result(settings: list[str], seed: int = 2, backend: str = "inline") -> Outcome:
    return run(Request(load("stand", settings), seed=seed, backend=backend))


def tilt_error(outcome: Outcome) -> np.ndarray:
    """Of the controller's roll and pitch against the truth [rad], at the times of the samples they are from."""
    world, controller = outcome.tables["world"], outcome.tables["controller"]
    times = controller.times - 470_000  # the controller's phase and computing time
    keep = (times >= 1e9) & (times <= world.times[-1])
    truth, found = (
        [np.interp(times[keep], world.times, world[f"base.{axis}"]) for axis in ("yaw", "pitch", "roll")],
        [controller[axis][keep] for axis in ("yaw", "pitch", "roll")],
    )
    true, estimate = (Rotation.from_euler("ZYX", np.array(angles).T) for angles in (truth, found))
    return (estimate * true.inv()).as_rotvec()


def test_rough_runs_have_one_digest_on_both_backends() -> None:
    inline = result(ROUGH)
    assert inline.stable, inline.reason
    counts = inline.record["deliveries"]["link.motion_capture"]
    assert counts["sent"] == 624 and counts["lost"] > 30 and counts["corrupted"] > 30
    told = inline.tables["controller"]
    late, refused, used = (told[f"frames_{what}"][-1] for what in ("late", "refused", "used"))
    assert late > 0 and refused > 0 and used + late + refused + inline.metrics["malformed"] < counts["sent"]
    assert np.abs(told["gyro_bias.x"][-1]) < np.radians(1.0)
    assert inline.metrics["malformed"] > 0  # a flipped bit in the header, or in a position that was not seen
    assert result(ROUGH, backend="processes").digest == inline.digest
    assert result(ROUGH, seed=3).digest != inline.digest


def test_frames_are_recorded_at_their_exposures_and_change_nothing_but_the_record() -> None:
    bare, seen = result(SHORT), result([*SHORT, "motion_capture.enabled=true"])
    assert "motion_capture" not in bare.tables and "link.motion_capture" not in bare.record["deliveries"]
    for name in bare.tables:
        assert seen.tables[name].data.tobytes() == bare.tables[name].data.tobytes()
    frames = seen.tables["motion_capture"]
    assert frames.times.tolist() == [k * 10**9 // 480 for k in range(624)]
    assert (frames["seen.chest"] == 1).all()
    world = seen.tables["world"]
    height = np.interp(frames.times, world.times, world["base.z"])
    assert np.abs(frames["chest.z"] - height - 0.28).max() < 5e-3


def test_a_frame_is_under_way_for_the_delay_of_its_link() -> None:
    with assemble(Request(load("stand", [*SHORT, "motion_capture.enabled=true"]), backend="inline")) as assembly:
        system = assembly.system
        system.run_until(5_000_000)
        assert system.motion_capture_link.next_ns == 5_000_000  # exposed at 0
        system.run_until(5_000_001)
        assert system.motion_capture_link.next_ns == 7_083_333
        system.inject("link.motion_capture.delay", "20ms")  # two more are under way
        system.run_until(9_166_667)
        assert system.motion_capture_link.next_ns == 26_250_000  # exposed at 6.25 ms


def test_the_orientation_is_the_true_one_to_what_placing_the_leds_costs() -> None:
    exact = tilt_error(result([*SEEN, "sensors.bias=0", "sensors.gyro_drift=0.25deg/s"]))
    assert np.linalg.norm(exact, axis=1).max() < np.radians(0.1)
    placed = tilt_error(result([*SEEN, "sensors.gyro_drift=0.25deg/s"]))
    assert np.linalg.norm(placed, axis=1).max() < np.radians(0.4)  # 0.5 mm over some 20 cm, and three axes


@pytest.mark.parametrize("backend", ["inline", "processes"])
def test_a_restored_run_continues(backend: str) -> None:
    request = Request(load("stand", ROUGH), seed=5, backend=backend)
    with assemble(request) as assembly:
        system = assembly.system
        system.run_until(650_000_000)
        saved = system.snapshot()
        system.run_until(800_000_000)
        frames, controller = (assembly.recorder.table(name) for name in ("motion_capture", "controller"))
    with assemble(request) as assembly:  # fresh nodes
        assembly.system.run_until(10_000_000)
        assembly.system.restore(saved)
        assembly.system.run_until(800_000_000)
        again, answered = (assembly.recorder.table(name) for name in ("motion_capture", "controller"))
    assert (again.data[-72:] == frames.data[-72:]).all() and (again.times[-72:] == frames.times[-72:]).all()
    assert (answered.data[-220:] == controller.data[-220:]).all()


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["controller.orientation=motion_capture"], "needs motion_capture.enabled = true"),
        (["motion_capture.enabld=true"], "did you mean 'motion_capture.enabled'"),
        (["motion_capture.occlusion=1.5"], "expected at most 1"),
        (["sensors.gyro_drift=0.25"], "has no unit"),
        (["inject=[{at='1s', key='motion_capture.enabled', value=false}]"], "no such key"),
    ],
)
def test_mistakes_are_told_in_a_sentence(settings: list[str], sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        load("stand", settings)


def test_a_robot_without_leds_has_no_motion_capture(tmp_path) -> None:
    from importlib import resources

    from hil.injection import injectable

    text = resources.files("robots").joinpath("hume.toml").read_text(encoding="utf-8")
    begin, end = text.index("[motion_capture]"), text.index("# Windings")
    path = tmp_path / "blind.toml"
    path.write_text(text[:begin] + text[end:])
    blind = f"robot={path}"
    assert not any("motion_capture" in key for key in injectable(description.load(str(path))))
    with pytest.raises(UserError, match="hume has no LEDs"):
        load("stand", [blind, "motion_capture.enabled=true"])
    assert run(Request(load("stand", [blind, "duration=0.01s"]), backend="inline")).record["simulated_time"] == 0.01

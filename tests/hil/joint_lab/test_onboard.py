"""The force loop of a hydraulic joint on board and off board: tuning, the master's law, what tracking comes of it."""

import json
import math

import numpy as np
import pytest

from bus.messages import Mode, State
from hil.cli import main
from hil.joint_lab import hydraulics, onboard, sampled
from hil.joint_lab.law import sampled_law
from hil.joint_lab.margins import margins
from hil.joint_lab.rig import TRUTH, Rig
from hil.joint_lab.setup import Setup, Timing, ratio
from joint_firmware.config import FirmwareConfig, TorqueGains
from plant.bench import Locked
from plant.config import SensorConfig
from robots import description

ROBOT = description.load("valve")
KNEE = ROBOT.joint("knee")
FIRMWARE = FirmwareConfig(rate="5kHz", report_rate="1kHz", law="valve", torque_rate="1000000Nm/s")
SETUP = Setup(ROBOT, 0, FIRMWARE, Locked(), SensorConfig(), Timing(1000.0, 25e3, 0.27e-3, 0.2e-3))


@pytest.fixture(scope="module")
def loops():
    return {True: onboard.on_board(SETUP), False: onboard.off_board(SETUP)}


def test_both_loops_have_the_phase_margin_of_the_rule_and_the_corner_at_a_tenth(loops):
    """Looked for in the law's linear parts; found again with the law at its gains."""
    for loop in loops.values():
        plant = sampled.discretise(hydraulics.state_space(KNEE, Locked()), 1.0 / loop.rate, loop.delay)
        firmware = FIRMWARE.model_copy(update={"rate": loop.rate, "stance": loop.gains})
        law = sampled_law(KNEE, firmware, SETUP.gain_set)
        found = margins(lambda w, p=plant, c=law: sampled.open_loop(p, c, w), 1.0, 0.999 * math.pi * loop.rate)
        assert math.degrees(found.phase_margin) == pytest.approx(50.0, abs=0.1)
        assert loop.gains.ki / loop.gains.kp == pytest.approx(0.1 * found.critical.omega, rel=1e-3)
        assert sampled.spectral_radius(plant, law) < 1.0 + 1e-6


def test_the_loop_off_board_is_later_by_what_the_bus_takes_and_weaker_for_it(loops):
    on, off = loops[True], loops[False]
    assert on.delay == pytest.approx(0.2e-3)
    # the master's tick, its computing and two frames on the bus, up to the next interrupt and the one it acts at
    assert off.delay in (pytest.approx(0.8e-3), pytest.approx(1.0e-3))
    assert off.crossover.omega < 0.7 * on.crossover.omega
    assert off.gains.kp < 0.7 * on.gains.kp


def test_the_master_s_law_is_a_pi_of_the_torque_error():
    gains = TorqueGains(kp=0.3, ki=8.0)
    off = onboard.OffBoard(KNEE, FIRMWARE, 1000.0, gains)
    q, rng, integral = 0.4, np.random.default_rng(1), 0.0
    arm = ratio(KNEE, q)
    assert arm != pytest.approx(1.0, abs=0.01)
    blank = State(*[0] * len(State._fields))
    for _ in range(50):
        wanted, sensed = rng.uniform(-20, 20, 2)
        state = blank._replace(position=q, torque=sensed)
        error = (wanted - sensed) / arm
        setpoint = off.command(lambda _tick, w=wanted: w)(0, state)
        assert setpoint.mode == Mode.OPEN_LOOP
        assert setpoint.torque == pytest.approx(arm * (0.3 * error + integral), rel=1e-9)
        integral += 8.0 * error * 1e-3


def test_the_emulated_step_on_board_rises_as_the_sampled_loop_says(loops):
    """A small step without friction, noise and offsets; the valve's gain is the model's mean to an eighth."""
    loop, target = loops[True], 2.0
    smooth = KNEE.actuator.model_copy(update={"coulomb": 0.0, "static": 0.0, "valve_offset": 0.0})
    robot = ROBOT.model_copy(update={"joints": (KNEE.model_copy(update={"actuator": smooth}),)})
    quiet = SETUP._replace(
        robot=robot, sensors=SensorConfig(noise=0.0, bias=0.0),
        firmware=FIRMWARE.model_copy(update={"stance": loop.gains}),
    )  # fmt: skip
    rig = Rig(quiet, quiet.torque_command(lambda tick, _: target if tick >= 300 else 0.0))
    rig.run(0.45)
    truth = rig.recorder.table(TRUTH)
    after = truth["spring_torque"][truth.seconds > 1e-3 * (rig.master.enabled_tick + 300)]
    rising = int(np.flatnonzero(after > 0.1 * target)[0])
    measured = after[rising : rising + 100]
    plant = sampled.discretise(hydraulics.state_space(KNEE, Locked()), 1.0 / loop.rate, loop.delay)
    closed = sampled.closed_loop(plant, sampled_law(KNEE, quiet.firmware, quiet.gain_set))
    x, predicted = np.zeros(len(closed.a)), []
    for _ in range(140):
        predicted.append(float((closed.c @ x + closed.d[:, 0] * target)[1]))
        x = closed.a @ x + closed.b[:, 0] * target
    start = int(np.flatnonzero(np.array(predicted) > 0.1 * target)[0])
    theory = np.array(predicted)[start : start + 100]
    assert np.abs(measured - theory).max() < 0.15 * target
    assert measured.max() / target - 1.0 == pytest.approx(theory.max() / target - 1.0, abs=0.1)


@pytest.mark.parametrize("load", ["locked", "pendulum,mass=3kg,length=0.4m,damping=2Nms/rad"])
def test_on_board_tracks_better_and_steps_faster(load, capsys, tmp_path):
    arguments = ["--load", load, "--amplitude", "10Nm", "--out", str(tmp_path), "--json"]
    assert main(["joint", "onboard", "valve", *arguments]) == 0
    rows = json.loads(capsys.readouterr().out)
    on, off = rows["on board"], rows["off board"]
    assert on["rms_error_nm"] < 0.75 * off["rms_error_nm"]
    if load == "locked":
        assert on["rise_time_s"] < 0.8 * off["rise_time_s"]
    assert {path.name for path in tmp_path.iterdir()} == {"tracking.png", "on-board", "off-board"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["hume", "--joint", "left_knee"], "is not hydraulic"),
        (["valve", "--amplitude", "500Nm"], "expected more than 0 and at most firmware.torque_limit, 150 N m"),
        (["valve", "--frequency", "1kHz"], "expected 0.1 Hz to 100 Hz"),
    ],
)
def test_a_mistake_is_named(arguments, sentence, capsys):
    assert main(["joint", "onboard", *arguments]) == 2
    assert sentence in capsys.readouterr().err

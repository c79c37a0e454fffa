"""The rig against the calendar's order, its log against what was sent, and a master that closes a loop itself."""

import numpy as np
import pytest

from bus.messages import Mode, Setpoint, Statusword
from hil.errors import EmulationError
from hil.joint_lab import log
from hil.joint_lab.rig import TRUTH, Rig
from joint_firmware.drive import DriveState
from plant.bench import Inertia


def exchange_of(setup, directory):
    rate, ratio = int(setup.firmware.rate), setup.ticks_per_report
    path = directory / f"{setup.bus}.log"
    return log.read(path, setup.joint.node_id, setup.slot, rate, ratio)


def test_the_master_enables_the_drive_and_its_commands_act_when_the_drive_says_so(experiment, tmp_path):
    setup = experiment("hume", "left_knee")
    rig = Rig(setup, setup.torque_command(lambda tick, state: 0.01 * tick), tmp_path)
    rig.run(0.2)
    rig.recorder.close()
    assert rig.firmware.state is DriveState.OPERATION_ENABLED and rig.master.failure is None
    exchange = exchange_of(setup, tmp_path)  # raises where the drive's word differs
    assert (exchange.statuswords[-1] & Statusword.MASK) == Statusword.OPERATION_ENABLED
    ramp = exchange.commanded[exchange.commanded > 0]
    np.testing.assert_allclose(np.diff(ramp), 0.01, atol=1e-9)
    pairs = log.pairs(exchange, int(setup.firmware.rate), setup.ticks_per_report)
    assert pairs.rate == setup.firmware.report_rate and 0 <= pairs.offset < setup.ticks_per_report


@pytest.mark.parametrize("delay_ticks", [0, 1, 3])
def test_a_command_that_is_late_by_interrupts_acts_later_by_as_many(experiment, tmp_path, delay_ticks):
    setup = experiment("hume", "left_knee")
    late = delay_ticks / setup.firmware.rate
    late_setup = setup._replace(timing=setup.timing._replace(command_delay=setup.timing.command_delay + late))
    ticks = []
    for n, which in enumerate((setup, late_setup)):
        rig = Rig(which, which.torque_command(lambda tick, _: 1.0 if tick >= 30 else 0.0), tmp_path / str(n))
        rig.run(0.15)
        rig.recorder.close()
        exchange = exchange_of(which, tmp_path / str(n))
        first = exchange.command_ticks[np.flatnonzero(exchange.commanded)[0]]
        enabled = np.flatnonzero((exchange.statuswords & Statusword.MASK) == Statusword.OPERATION_ENABLED)[0]
        ticks.append(first - exchange.report_ticks[enabled])
    assert ticks[1] - ticks[0] == delay_ticks


def first_motion(setup):
    """Interrupt at which a step that is fed straight through is first seen in the spring, and how much of it, N m."""
    open_loop = setup._replace(mode=Mode.OPEN_LOOP)
    rig = Rig(open_loop, open_loop.torque_command(lambda tick, _: 20.0 if tick >= 10 else 0.0))
    rig.run(0.1)
    torque = rig.recorder.table(TRUTH)["spring_torque"]
    first = np.flatnonzero(np.abs(torque) > 0)[0]
    return first, torque[first]


@pytest.mark.parametrize("interrupts", [1.0, 1.25, 3.0, 3.75])
def test_a_delayed_loop_s_outputs_take_effect_so_much_later(experiment, interrupts):
    """The motor starts from rest: after n steps of the physics it has moved n (n + 1)/2 times as far as after one."""
    setup = experiment("hume", "left_knee")
    at_once, torque = first_motion(setup)
    late, less = first_motion(setup.delayed(interrupts * setup.period))
    assert late - at_once == int(interrupts)
    steps = round(setup.timing.physics_rate / setup.firmware.rate)
    left, dt, a = round(steps * (1 - interrupts % 1)), 1 / setup.timing.physics_rate, setup.joint.actuator

    def seen(n):
        return a.stiffness * n * (n + 1) / 2 * dt + a.damping * n

    assert less / torque == pytest.approx(seen(left) / seen(steps), rel=0.01)


def test_a_rig_is_reproducible(experiment):
    digests = []
    for _ in range(2):
        setup = experiment("vlca", "ankle")
        rig = Rig(setup, setup.torque_command(lambda tick, state: 5.0 - 0.1 * state.torque))
        rig.run(0.2)
        digests.append(rig.recorder.digest())
    assert digests[0] == digests[1]


def test_a_master_may_close_the_loop_itself(experiment):
    """Position of a flywheel, held by the master over the bus around the drive's torque loop."""
    setup = experiment("hume", "left_knee", load=Inertia(inertia="0.3 kgm2", damping="0.5 Nms/rad"))

    def servo(tick, state):
        return Setpoint(mode=Mode.TORQUE, torque=20.0 * (0.2 - state.position) - 4.0 * state.velocity)

    rig = Rig(setup, servo)
    rig.run(2.0)
    assert rig.bench.position == pytest.approx(0.2, abs=0.01)


def test_a_drive_that_drops_out_is_told_of_and_switched_off(experiment):
    setup = experiment("hume", "left_knee", settings=["firmware.torque_limit=10 N m", "firmware.torque_rate=1e6 N m/s"])
    setup = setup._replace(mode=Mode.OPEN_LOOP, firmware=setup.firmware.model_copy(update={"torque_limit": 10.0}))
    rig = Rig(setup, setup.torque_command(lambda tick, _: 10.0 * (-1.0) ** (tick // 40)))  # at its resonance
    rig.run(2.0)
    assert rig.master.failure is not None and "left operation" in rig.master.failure
    assert rig.firmware.state is not DriveState.OPERATION_ENABLED


def test_commands_that_do_not_keep_step_are_refused(experiment, tmp_path):
    setup = experiment("hume", "left_knee")
    setup = setup._replace(timing=setup.timing._replace(servo_rate=1000.0))
    rig = Rig(setup, setup.torque_command(lambda tick, _: 0.0), tmp_path)
    rig.run(0.2)
    rig.recorder.close()
    exchange = exchange_of(setup, tmp_path)
    with pytest.raises(EmulationError, match="keep step"):
        log.pairs(exchange, int(setup.firmware.rate), setup.ticks_per_report)


def test_a_log_in_which_the_drive_obeys_another_command_is_refused(experiment, tmp_path):
    setup = experiment("hume", "left_knee")
    rig = Rig(setup, setup.torque_command(lambda tick, _: 0.0), tmp_path)
    rig.run(0.2)
    rig.recorder.close()
    path = tmp_path / f"{setup.bus}.log"
    lines = path.read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if n > 100 and " 200##" in line)
    path.write_text("\n".join(lines[:at] + lines[at + 1 :]) + "\n")
    with pytest.raises(EmulationError, match="obeys command"):
        exchange_of(setup, tmp_path)

"""The benchmark of a drive's interrupt measures a drive that works, and says all that it promises."""

import json

import pytest

from hil.cli import main
from hil.commands import bench_joint
from hil.commands.bench_joint import ROWS, _enabled_drive, _samples
from hil.compiled import compiler
from joint_firmware.config import LAW_NAMES, FirmwareConfig
from joint_firmware.drive import DriveState
from joint_firmware.laws import signals as law
from robots import pins


def test_every_law_is_measured_in_every_way(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "joint", "--duration", "0.1s", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert list(results) == list(LAW_NAMES)
    for result in results.values():
        assert set(result) == {*(f"{row}_us" for row in ROWS), "operations"}
        for row in ROWS:
            cost = result[f"{row}_us"]
            assert cost is None if row in ("law_c", "law_ctypes") and compiler() is None else 0 < cost < 1e4, row


def test_it_says_which_aim_it_has(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench_joint, "LAW_NAMES", ("PD_m",))
    assert main(["bench", "joint", "--duration", "0.1s"]) == 0
    output = capsys.readouterr().out
    assert "aim for the interrupt: ≤ 5 µs: " in output and all(row in output for row in [*ROWS, "PD_m"])


def test_the_drive_that_is_measured_closes_its_loop_on_changing_pins() -> None:
    config = FirmwareConfig.model_validate({"watchdog": "1e6 s", "heartbeat_period": "0 s"})
    drive, inputs, outputs = _enabled_drive(config)
    demands = set()
    for inputs[pins.MOTOR_ENCODER], inputs[pins.JOINT_ENCODER] in 10 * _samples():
        inputs[pins.CURRENT_ADC] = outputs[pins.CURRENT_DEMAND]
        drive.tick(0, ())
        demands.add(drive.y[law.Y_DEMAND])
    assert drive.state == DriveState.OPERATION_ENABLED and not drive.error
    assert len(demands) > 40


def test_bench_refuses_what_it_does_not_know(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "joints"]) == 2
    assert "joint" in capsys.readouterr().err

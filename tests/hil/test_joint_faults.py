"""Every fault of the drives' protection, brought about in a standing robot: state, code, output, time, and its end."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bus.drive_faults import DriveFault
from hil import cli
from hil.analysis import fault_cases
from hil.analysis.fault_cases import CASES, FaultCase
from hil.analysis.fault_margins import margins
from hil.analysis.fault_trial import TrialBench, trial_bench
from hil.errors import UserError
from hil.injection import injectable
from hil.run import Outcome, Request, run
from hil.scenario import load, parse_value
from joint_firmware.drive import DriveState
from plant.config import JointFaults
from robots import description

ROBOT = description.load("hume")
KNEE = "joint.left_knee"
HEALTHY = {"heating": "0 K", "isr_time": "0 s", "node.cut": False}  # of keys whose default is no text as it stands


@pytest.fixture(scope="module")
def bench() -> Iterator[TrialBench]:
    with trial_bench() as trials:
        yield trials


def test_the_table_has_every_fault() -> None:
    assert {case.fault for case in CASES} == set(DriveFault) - {DriveFault.NONE}
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_output_is_safe_in_time_and_the_bus_hears_why(bench: TrialBench, case: FaultCase) -> None:
    trial = bench.run(case)
    assert trial.what_is_wrong() == "", trial


def healthy(case: FaultCase) -> object:
    default = JointFaults.model_fields[case.key].default if case.key in JointFaults.model_fields else None
    return HEALTHY.get(case.key, default)


LASTING = [case for case in CASES if case.key in ("supply", "heating", "isr_time")] + [
    case for case in CASES if case.fault is DriveFault.POSITION_LIMIT
]  # fmt: skip


@pytest.mark.parametrize("case", LASTING, ids=lambda case: case.name)
def test_a_fault_is_reset_when_its_cause_is_gone_and_not_before(bench: TrialBench, case: FaultCase) -> None:
    """The controller goes on commanding: its frames are cut off, a master resets by SDO."""
    bench.rewind()
    bench.bring_about(case)
    bench.go_on(0.6)  # through the time of a braking reaction
    drive = bench.drive
    assert drive.state is DriveState.FAULT and drive.fault == case.fault
    bench.cut_off()
    bench.go_on(0.01)
    for word in (0x00, 0x80, 0x00):
        drive.set_controlword(word)
        bench.go_on(0.001)
    assert drive.state is DriveState.FAULT and drive.fault == case.fault
    bench.end(case, healthy(case))
    bench.go_on(0.002)
    drive.set_controlword(0x80)
    assert drive.state is DriveState.SWITCH_ON_DISABLED and drive.fault is DriveFault.NONE and drive.error == 0
    assert int(drive.y[9]) == 0


# --- keys -----------------------------------------------------------------------------------------------------


def test_every_key_of_a_joint_is_listed_with_range_default_and_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["inject", "--list", KNEE]) == 0
    listed = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in listed] == [f"{KNEE}.{key}" for key in JointFaults.model_fields]
    assert all(len(line.split("  ")) > 3 for line in listed)
    entry = injectable(ROBOT)[f"{KNEE}.encoder"]
    assert entry.range == "ok, stuck, jump, slip, noisy, dead" and entry.default == "ok" and entry.meaning


@pytest.mark.parametrize("key, value, problem", [
    ("encoder", "broken", "expected 'ok', 'stuck', 'jump', 'slip', 'noisy' or 'dead'"),
    ("current_sensor", "slip", "expected 'ok', 'stuck', 'jump', 'noisy' or 'dead'"),
    ("spring", -1, "expected at least 0"), ("supply", 3, "expected at most 2"), ("heating", "10 A", "unit 'A'"),
    ("heating", 10, "has no unit"), ("isr_time", "2s", "expected at most 1 s"), ("brake", 1, "unknown key"),
])  # fmt: skip
def test_a_wrong_value_is_refused_with_what_would_be_right(key: str, value: object, problem: str) -> None:
    with pytest.raises(UserError, match=problem) as caught:
        parse_value(f"{KNEE}.{key}", value)
    assert f"{KNEE}.{key}" in str(caught.value)


def test_a_joint_that_the_robot_does_not_have_is_refused() -> None:
    with pytest.raises(UserError, match=r"unknown key 'joint.left_nee'; did you mean 'joint.left_knee'"):
        load("stand", ["joint.left_nee.encoder=stuck"])


# --- in a run ---------------------------------------------------------------------------------------------------


def hung(*settings: str, backend: str = "inline") -> Outcome:
    """A run of 0.25 s, drives on after 0.05 s, the robot in its hoist."""
    common = ["duration=0.25s", "controller.stand_at=0.05s", "world.hoist.hold=1s"]
    return run(Request(load("stand", [*common, *settings]), 3, backend, report=False))


def injection(*entries: str) -> str:
    """``inject=[…]`` of "at ms, key, value[, until ms]"."""
    parts = []
    for text in entries:
        at, key, value, *until = text.split(", ")
        end = f", until='{until[0]}ms'" if until else ""
        parts.append(f"{{at='{at}ms', key='{KNEE}.{key}', value='{value}'{end}}}")
    return f"inject=[{', '.join(parts)}]"


def test_a_fault_from_the_start_ends_the_run_with_its_cause() -> None:
    record = hung(f"{KNEE}.supply=0.7").record
    assert record["verdict"] == "unstable"
    assert record["reason"].startswith("drive in fault: left_knee, under voltage (3220h), at 0.0")


def test_a_fault_from_a_time_on_ends_the_run_with_its_cause() -> None:
    record = hung(injection("200, spring_encoder, dead", "200, joint_encoder, jump")).record
    assert record["reason"].startswith("drive in fault: left_knee, joint encoder (7320h), at 0.2")
    assert 0.2 <= record["simulated_time"] < 0.22


def test_a_fault_that_does_not_matter_to_the_protection_changes_the_physics_alone() -> None:
    plain, dry = hung(), hung(injection("120, friction, 3.0"))
    assert dry.record["reason"] == plain.record["reason"]
    assert dry.record["log_digest"] != plain.record["log_digest"]


MANY = injection(
    "100, friction, 2.0, 150", "110, heating, 20K", "120, supply, 0.9, 160", "130, spring, 1.2, 140",
    "150, isr_time, 100us", "200, encoder, noisy",
)  # fmt: skip


def test_the_digest_is_the_same_on_both_backends() -> None:
    inline = hung(MANY).record
    assert inline["reason"] == "drive in fault: left_knee, motor encoder (7305h), at 0.21 s"
    assert hung(MANY, backend="processes").record["log_digest"] == inline["log_digest"]


def test_the_run_is_repeated_from_its_journal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["duration=0.25s", "controller.stand_at=0.05s", "world.hoist.hold=1s", MANY]
    run(Request(load("stand", common), 3, "inline", out=tmp_path / "run", report=False))
    assert cli.main(["replay", str(tmp_path / "run")]) == 0, capsys.readouterr()


def test_a_restored_run_goes_on_with_its_faults(bench: TrialBench) -> None:
    bench.rewind()
    for key, value in (("encoder", "slip"), ("heating", "3 K"), ("spring", 0.9), ("command", "not_a_number")):
        bench.inject(f"{KNEE}.{key}", value)
    bench.go_on(0.001)
    state = bench.snapshot()
    bench.go_on(0.01)
    first = bench.truth()
    bench.restore(state)
    bench.go_on(0.01)
    assert bench.truth() == first and bench.drive.fault is DriveFault.COMMAND


def test_an_ordinary_run_stays_away_from_every_limit() -> None:
    """Most of all sensors that are compared with each other, on which nothing but a fault acts."""
    record, peaks = margins(load("stand", ["duration=2.5s", "world.hoist.hold=0.5s", "controller.stand_at=0.4s"]), 2)
    assert record["verdict"] == "stable"
    largest = np.max([*peaks.values()], axis=0)
    compared = [DriveFault.MOTOR_ENCODER, DriveFault.SPRING_ENCODER, DriveFault.JOINT_ENCODER,
                DriveFault.ENCODER_MISMATCH]  # fmt: skip
    assert 0 < max(largest[fault - 1] for fault in compared) < 0.2
    assert 0.1 < max(largest) < 0.9


# --- the documentation ----------------------------------------------------------------------------------------


def test_the_documented_table_is_that_of_the_code() -> None:
    text = (Path(__file__).parents[2] / "docs" / "protection.md").read_text(encoding="utf-8")
    assert fault_cases.markdown() in text, "put the output of `hil protection --markdown` into docs/protection.md"


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["protection", "--json"]) == 0
    cases = json.loads(capsys.readouterr().out)["cases"]
    assert [case["name"] for case in cases] == [case.name for case in CASES]
    assert cli.main(["protection", "--markdown"]) == 0
    assert capsys.readouterr().out == fault_cases.markdown()

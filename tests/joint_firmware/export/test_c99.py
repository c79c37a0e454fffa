"""The exported C, compiled as strictly as it goes, beside the emulation on recorded pins."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hil.commands.bench_joint import exported
from hil.record.law_recording import LawRecording
from joint_firmware import law
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.c99 import export, source_files
from joint_firmware.export.drive_law import drive_law
from robots import description
from tests.support.exports import build, need, need_m32, numbers, rows, run, same_bits, write

HUME = description.load("hume")
CONFIG = FirmwareConfig()


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    files = export(HUME, HUME.joint_names, "PD_m", "double", CONFIG)
    return write(files, tmp_path_factory.mktemp("firmware"))


def emulated(drive: LawRecording) -> np.ndarray:
    return np.hstack([drive.y, drive.x_next])


def test_the_recording_exercises_the_law(recorded: dict[str, LawRecording]) -> None:
    """Equal outputs prove something only if the loop is closed and the outputs move."""
    for drive in recorded.values():
        assert len(drive.u) == 3000
        assert drive.u[:, law.U_POSITION_MODE].any() and drive.u[:, law.U_TORQUE_MODE].any()
        assert len(np.unique(drive.y[:, law.Y_DEMAND])) > 100


@pytest.mark.parametrize("optimisation", ["-O0", "-O2", "-O3"])
def test_outputs_are_those_of_the_emulation_bit_for_bit(
    firmware: Path, recorded: dict[str, LawRecording], optimisation: str
) -> None:
    example = build(firmware, optimisation, name=f"built{optimisation}")
    for joint, drive in recorded.items():
        assert same_bits(numbers(run([example, joint], rows(drive)), "double"), emulated(drive)), joint


def test_so_they_are_on_32_bit(firmware: Path, recorded: dict[str, LawRecording], tmp_path: Path) -> None:
    """Other sizes of int, long and pointers; each operation rounded to double (x87 would keep more)."""
    need_m32(tmp_path)
    example = build(firmware, "-m32", "-msse2", "-mfpmath=sse", name="built32")
    drive = recorded["right_knee"]
    assert same_bits(numbers(run([example, "right_knee"], rows(drive)), "double"), emulated(drive))


def test_and_so_they_are_on_pins_and_commands_that_no_run_has() -> None:
    """All modes at once, encoders that jump over the whole range of 32 bits, gains that change at every step."""
    need("cc", "gcc libc6-dev")
    one = drive_law("PD_m", HUME.joint("left_knee"), CONFIG)
    rng = np.random.default_rng(17)
    with exported(one) as drive:
        x = np.zeros(len(one.state))
        for _ in range(3000):
            counts = (rng.uniform(-1, 1, len(one.counts)) * 2.0 ** rng.uniform(0, 31)).astype(np.int32)
            u = rng.normal(size=len(one.input)) * 10.0 ** rng.uniform(-3, 4)
            modes = slice(law.U_TORQUE_MODE, law.U_DAMPING_MODE + 1)
            u[modes] = rng.integers(0, 2, 3)
            u[-3:] *= rng.integers(0, 2, 3)
            drive.u[:] = u
            drive.step(counts)
            x, y = (np.array(part).ravel() for part in one.function(counts, x, u, one.values))
            assert same_bits(np.array(drive.x), x) and same_bits(np.array(drive.y), y)


def test_it_needs_nothing_but_libm(firmware: Path) -> None:
    need("cc", "gcc libc6-dev")
    need("nm", "binutils")
    subprocess.run(["cc", "-std=c99", "-O2", "-c", "joint_law.c"], cwd=firmware, check=True)
    undefined = run(["nm", "--undefined-only", firmware / "joint_law.o"], "")
    needed = set(re.findall(r"U (\w+)", undefined)) - {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    assert needed <= {"floor", "fabs", "memset"}  # some of them the compiler writes out
    symbols = run(["nm", firmware / "joint_law.o"], "")
    assert " T joint_law_step" in symbols and not re.search(r" [bBdDC] ", symbols)  # nothing is kept between calls


def test_the_header_states_the_sizes_that_the_compiler_finds(firmware: Path, tmp_path: Path) -> None:
    need("cc", "gcc libc6-dev")
    header = (firmware / "joint_law.h").read_text()
    state, constants = map(int, re.findall(r"Memory: (\d+) bytes .*, (\d+) bytes of constants", header)[0])
    program = tmp_path / "sizes.c"
    program.write_text(
        '#include "joint_law.h"\n#include <stdio.h>\nint main(void) {'
        'printf("%zu %zu", sizeof(joint_law) - sizeof(void *), sizeof hume_left_knee); return 0; }\n'
    )
    table = firmware / "hume_left_knee.c"
    subprocess.run(["cc", "-std=c99", "-I", firmware, "-o", tmp_path / "sizes", program, table], check=True)
    assert [state, constants] == [int(size) for size in run([tmp_path / "sizes"], "").split()]


# --- what is written ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["double", "single"])
def test_it_is_written_the_same_again_and_says_what_it_is(precision: str) -> None:
    files = export(HUME, ["left_knee"], "PD_m", precision, CONFIG)
    assert files == export(HUME, ["left_knee"], "PD_m", precision, CONFIG)
    assert set(files) == {"joint_law.h", "joint_law.c", "hume_left_knee.c", "main.c", "Makefile", "README.md"}
    for name, text in files.items():
        assert f"Robot hume, left_knee; law PD_m, {precision} precision, 3000 Hz." in text, name
        assert "Written by hume-hil 0." in text, name
        assert not re.search(r"@\w", text.replace("$@", "")), name


def test_names_stand_for_the_numbers_that_the_firmware_means() -> None:
    one = drive_law("PD_m", HUME.joint("left_hip"), CONFIG)
    names = {"x": [q.name for q in one.state], "u": [q.name for q in one.input], "y": [q.name for q in one.outputs]}
    for name, index in (
        ("theta", law.THETA), ("position", law.POSITION), ("motor_velocity", law.MOTOR_VELOCITY),
        ("velocity", law.VELOCITY), ("integral", law.INTEGRAL), ("torque_reference", law.TORQUE_REFERENCE),
        ("kp", law.KP), ("active", law.ACTIVE), ("started", law.STARTED),
    ):  # fmt: skip
        assert names["x"][index] == name
    for name in names["u"]:
        assert names["u"][getattr(law, f"U_{name.upper()}")] == name
    for name in names["y"]:
        assert names["y"][getattr(law, f"Y_{name.upper()}")] == name
    assert [len(names[key]) for key in "xuy"] == [law.STATE_SIZE, law.INPUT_SIZE, law.OUTPUT_SIZE]
    values = dict(zip([q.name for q in one.parameters], one.values, strict=True))
    joint = HUME.joint("left_hip")
    assert values["stiffness"] == 450.0 and values["dt"] == 1 / 3000 and values["rad_per_count"] == 1 / -69500.0
    assert (values["position_low"], values["position_high"]) == joint.limits
    assert values["torque_per_ampere"] == pytest.approx(6.0) and values["current_limit"] == 27.5
    assert (values["position_stiffness"], values["position_damping"]) == (300.0, 10.0)
    assert (values["soft_stop_stiffness"], values["quick_stop_damping"]) == (200.0, 30.0)


def test_every_parameter_is_named_in_the_table(firmware: Path) -> None:
    for joint in HUME.joint_names:
        lines = re.findall(r"^    (\S+), +/\* (\w+):", (firmware / f"hume_{joint}.c").read_text(), re.MULTILINE)
        one = drive_law("PD_m", HUME.joint(joint), CONFIG)
        assert [float(value) for value, _ in lines] == one.values.tolist()
        assert [name for _, name in lines] == [q.name for q in one.parameters]


def test_joints_of_different_laws_are_not_mixed() -> None:
    import casadi as ca

    from joint_firmware.export.operations import program

    one = drive_law("PD_m", HUME.joint("left_hip"), CONFIG)
    counts, x, u, p = (ca.SX.sym(n, one.function.size1_in(k)) for k, n in enumerate("cxup"))
    function = ca.Function("other", [counts, x, u, p], [x, ca.SX.zeros(law.OUTPUT_SIZE)])
    other = one._replace(function=function, program=program(function))
    with pytest.raises(ValueError, match="left_hip and left_knee differ"):
        source_files(HUME, {"left_hip": one, "left_knee": other}, "double", 3000.0)

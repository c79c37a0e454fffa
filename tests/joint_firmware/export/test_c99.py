"""The exported C, compiled as strictly as it goes, beside the emulation on recorded pins."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hil.commands.bench_joint import exported
from hil.record.law_recording import LawRecording
from joint_firmware.config import LAW_NAMES, FirmwareConfig
from joint_firmware.export.c99 import export, source_files
from joint_firmware.export.drive_law import exported_law
from joint_firmware.laws import drive_law
from joint_firmware.laws import signals as law
from robots import description, pins
from tests.support.exports import build, need, need_m32, numbers, rows, run, same_bits, write

HUME = description.load("hume")
CONFIG = FirmwareConfig()


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    files = export(HUME, HUME.joint_names, "double", CONFIG)
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


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("robot", ["hume", "vlca", "valve"])
def test_and_so_they_are_on_pins_and_commands_that_no_run_has(robot: str, name: str) -> None:
    """All modes at once, encoders that jump over the whole range of 32 bits, gains that change at every step."""
    need("cc", "gcc libc6-dev")
    joint = description.load(robot).joints[-1]
    one = exported_law(joint, FirmwareConfig.model_validate({"law": name}))
    rng = np.random.default_rng(17)
    with exported(one) as drive:
        x = np.zeros(len(one.state))
        for _ in range(1000):
            counts = (rng.uniform(-1, 1, len(one.counts)) * 2.0 ** rng.uniform(0, 31)).astype(np.int32)
            u = rng.normal(size=len(one.input)) * 10.0 ** rng.uniform(-3, 4)
            u[law.U_TORQUE_MODE :] = rng.integers(0, 2, law.INPUT_SIZE - law.U_TORQUE_MODE)
            u[[law.U_KP, law.U_KI, law.U_KD]] *= rng.uniform(0, 100, 3)
            drive.u[:] = u
            drive.step(counts)
            x, y = (np.array(part).ravel() for part in one.function(counts, x, u, one.values))
            # == : of 0 and -0 C's standard leaves fmin and fmax the choice
            assert np.array_equal(drive.x, x, equal_nan=True) and np.array_equal(drive.y, y, equal_nan=True)


def test_it_needs_nothing_but_libm(firmware: Path) -> None:
    need("cc", "gcc libc6-dev")
    need("nm", "binutils")
    subprocess.run(["cc", "-std=c99", "-O2", "-c", "joint_law.c"], cwd=firmware, check=True)
    undefined = run(["nm", "--undefined-only", firmware / "joint_law.o"], "")
    needed = set(re.findall(r"U (\w+)", undefined)) - {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    assert needed <= {"floor", "fabs", "memcpy", "memset"}  # some of them the compiler writes out
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
    files = export(HUME, ["left_knee"], precision, CONFIG)
    assert files == export(HUME, ["left_knee"], precision, CONFIG)
    assert set(files) == {"joint_law.h", "joint_law.c", "hume_left_knee.c", "main.c", "Makefile", "README.md"}
    for name, text in files.items():
        assert f"Robot hume, left_knee; law PID_m, {precision} precision, 3000 Hz." in text, name
        assert "Written by hume-hil 0." in text, name
        assert not re.search(r"@\w", text.replace("$@", "")), name


def test_names_stand_for_the_numbers_that_the_firmware_means() -> None:
    joint = HUME.joint("left_hip")
    one, built = exported_law(joint, CONFIG), drive_law(joint, CONFIG)
    for quantities, module, prefix in ((one.counts, pins, ""), (one.input, law, "U_"), (one.outputs, law, "Y_")):
        for index, quantity in enumerate(quantities):
            assert getattr(module, f"{prefix}{quantity.name.upper()}") == index
    assert [len(q) for q in (one.counts, one.input, one.outputs)] == [pins.N_INPUTS, law.INPUT_SIZE, law.OUTPUT_SIZE]
    assert tuple(q.name for q in one.state) == built.states
    assert tuple(q.name for q in one.parameters) == built.parameters
    values = dict(zip([q.name for q in one.parameters], one.values, strict=True))
    assert values["stiffness"] == 450.0 and values["dt"] == 1 / 3000 and values["rad_per_count"] == 1 / -69500.0
    assert (values["position_low"], values["position_high"]) == joint.limits


@pytest.mark.parametrize("estimator", ["filter", "M", "T", "M/T"])
@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("robot", description.available())
def test_every_number_of_every_law_has_a_meaning(robot: str, name: str, estimator: str) -> None:
    config = FirmwareConfig.model_validate({"law": name, "velocity_estimator": estimator})
    for joint in description.load(robot).joints:
        one = exported_law(joint, config)
        for quantity in (*one.counts, *one.state, *one.input, *one.parameters, *one.outputs):
            assert quantity.name.isidentifier() and quantity.meaning


def test_every_parameter_is_named_in_the_table(firmware: Path) -> None:
    for joint in HUME.joint_names:
        lines = re.findall(r"^    (\S+), +/\* (\w+):", (firmware / f"hume_{joint}.c").read_text(), re.MULTILINE)
        one = exported_law(HUME.joint(joint), CONFIG)
        assert [float(value) for value, _ in lines] == one.values.tolist()
        assert [name for _, name in lines] == [q.name for q in one.parameters]


def test_joints_of_different_laws_are_not_mixed() -> None:
    import casadi as ca

    from joint_firmware.export.operations import program

    one = exported_law(HUME.joint("left_hip"), CONFIG)
    counts, x, u, p = (ca.SX.sym(n, one.function.size1_in(k)) for k, n in enumerate("cxup"))
    function = ca.Function("other", [counts, x, u, p], [x, ca.SX.zeros(law.OUTPUT_SIZE)])
    other = one._replace(function=function, program=program(function))
    with pytest.raises(ValueError, match="left_hip and left_knee differ"):
        source_files(HUME, {"left_hip": one, "left_knee": other}, "double", 3000.0)

"""The worked example: an interrupt on a Cortex-M4F, compiled for it and, in QEMU, run on it."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hil.record.law_recording import LawRecording
from joint_firmware.config import FirmwareConfig
from joint_firmware.export.c99 import export
from joint_firmware.export.drive_law import exported_law
from joint_firmware.laws import signals as law
from robots import description, pins
from tests.support.exports import ARM, QEMU, STRICT, build, need, numbers, rows, run, same_bits, write

HUME = description.load("hume")
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "stm32g4"
PACKAGES = "gcc-arm-none-eabi libnewlib-arm-none-eabi"


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    files = export(HUME, ["left_knee"], "single", FirmwareConfig())
    return write(files, tmp_path_factory.mktemp("cortex"))


def program(firmware: Path, name: str, *sources: Path | str) -> Path:
    """A program for QEMU's board."""
    need("arm-none-eabi-gcc", PACKAGES)
    need("qemu-system-arm", "qemu-system-arm")
    link = ["--specs=rdimon.specs", "-T", EXAMPLE / "mps2.ld", "-o", name]
    both = [EXAMPLE / "startup.c", *sources, "joint_law.c", "hume_left_knee.c"]
    command = [*ARM, *STRICT, "-ffp-contract=off", "-I.", *link, *both, "-lm"]
    result = subprocess.run(command, cwd=firmware, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return firmware / name


def test_the_interrupt_compiles_for_a_cortex_m4f_and_computes_in_its_own_registers(firmware: Path) -> None:
    need("arm-none-eabi-gcc", PACKAGES)
    sources = ["joint_law.c", "hume_left_knee.c", EXAMPLE / "torque_loop.c"]
    subprocess.run([*ARM, *STRICT, "-ffp-contract=off", "-I.", "-c", *sources], cwd=firmware, check=True)
    undefined = run(["arm-none-eabi-nm", "-u", *(firmware / f"{s}.o" for s in ("joint_law", "torque_loop"))], "")
    called = set(re.findall(r"U (\w+)", undefined))
    assert called <= {"floorf", "memset", "joint_law_init", "joint_law_step", "joint_law_use", "hume_left_knee",
                      "hume_left_knee_stance"}  # fmt: skip  # no double precision in software: no __aeabi_d…


def test_a_cortex_m4f_computes_the_bits_of_this_processor(firmware: Path, recorded: dict[str, LawRecording]) -> None:
    """Another instruction set, another compiler, another C library."""
    text = rows(recorded["left_knee"])
    elf = program(firmware, "example.elf", "main.c")
    theirs = numbers(run([*QEMU, "-kernel", elf], text), "single")
    assert same_bits(numbers(run([build(firmware, "-O2")], text), "single"), theirs) and len(theirs) == 3000


def test_a_step_takes_a_small_part_of_the_interrupt_s_period(firmware: Path) -> None:
    """Instructions, counted by QEMU. None of a Cortex-M4F takes more than 14 cycles (division) but those that move
    several registers, one cycle each."""
    elf = program(firmware, "count.elf", EXAMPLE / "count.c")
    instructions = float(run([*QEMU, "-icount", "shift=10", "-kernel", elf], ""))
    operations = sum(exported_law(HUME.joint("left_knee"), FirmwareConfig()).program.counted.values())
    assert operations < instructions < 5 * operations
    assert 14 * instructions < 170e6 / 3000 / 4


def test_the_interrupt_passes_on_what_the_law_says(firmware: Path) -> None:
    """The example's own lines, on this processor: registers are variables, the demand goes out scaled and only if power
    is permitted."""
    need("cc", "gcc libc6-dev")
    source = (EXAMPLE / "torque_loop.c").read_text()
    source = re.sub(r"REGISTER\(0x(\w+)\)", r"&register_\1", source)
    names = sorted(set(re.findall(r"&register_(\w+)", source)))
    assert len(names) == 6
    declared = "#include <stdint.h>\n" + "".join(f"static volatile uint32_t register_{n};\n" for n in names)
    main = """
#include <stdio.h>
int main(void)
{
    int permitted, k;
    torque_loop_init();
    register_40000024 = (uint32_t)-66828; register_40000C24 = 100; register_50000080 = 2048 + 7;
    for (permitted = 0; permitted < 2; permitted++) {
        torque_loop_command(permitted, 20, 500);
        for (k = 0; k < 30; k++)
            TIM6_DAC_IRQHandler();
        printf("%u %u %g\\n", (unsigned)register_50000808, (unsigned)register_48000418, law.y[JOINT_LAW_Y_CURRENT]);
    }
    return 0;
}
"""
    (firmware / "host.c").write_text(declared + source + main)
    command = ["cc", "-std=c99", "-I.", "-ffp-contract=off", "-o", "host"]
    subprocess.run([*command, "host.c", "joint_law.c", "hume_left_knee.c", "-lm"], cwd=firmware, check=True)
    off, on = (line.split() for line in run([firmware / "host"], "").splitlines())
    (firmware / "host.c").unlink()
    assert off == ["2048", str(1 << 16), "14"]
    one = exported_law(HUME.joint("left_knee"), FirmwareConfig())
    x, counts = np.zeros(len(one.state)), np.zeros(pins.N_INPUTS)
    counts[[pins.MOTOR_ENCODER, pins.SPRING_ENCODER, pins.CURRENT_ADC]] = -66828, 100, 14
    u = np.zeros(law.INPUT_SIZE)
    u[[law.U_KP, law.U_KI, law.U_KD]] = 3.0, 0.0, 10.0
    for torque_mode in [0.0] * 30 + [1.0] * 30:
        u[[law.U_TORQUE, law.U_LIMIT, law.U_TORQUE_MODE]] = 20.0, 500.0, torque_mode
        x, y = (np.array(part).ravel() for part in one.function(counts, x, u, one.values))
    demand = y[law.Y_DEMAND]
    assert demand * pins.AMPERE_PER_COUNT == pytest.approx((20 + 3 * (20 - 6.74)) / 6.1, abs=0.01)
    assert on == [str(2048 + int(demand) // 2), "1", "14"]
